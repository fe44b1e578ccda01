"""``mjstack demo``: its page in a browser, and how to go on. ``experiment=demo`` has the rest."""

import os
import webbrowser
from contextlib import suppress
from pathlib import Path

from mjstack.report.web import EPISODE, lacks_viser

_NEXT = """\
Go on with:
  mjstack demo robot={robot:<24}# another arm and its policy
  mjstack nworld=64                          # the expert's plan in every gate of this machine
  mjstack job=train task=reach sim=native nworld=64 job.folder=outputs/mine    # train one"""


def show_demo(folder: Path, robot: str) -> None:
    """Open the page of a run in a browser if there is one, and print commands to go on with, the
    first for another robot.
    """
    missing = lacks_viser()
    page = folder.absolute() / ("report.html" if missing else EPISODE)
    with suppress(webbrowser.Error, OSError):
        browser = webbrowser.get()
        # One of the terminal would take it, unless the user has named it.
        if type(browser) is not webbrowser.GenericBrowser or "BROWSER" in os.environ:
            browser.open(page.as_uri())
    note = f"{missing}\n" if missing else ""
    print(f"{note}In a browser: {page.as_uri()}\n{_NEXT.format(robot=robot)}", flush=True)
