"""The files of a report: report.json for machines, and a format each for people."""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

from mjstack.report.html import to_html
from mjstack.report.markdown import to_markdown
from mjstack.report.page import Page
from mjstack.report.record import Report
from mjstack.report.sections import Section, make_sections
from mjstack.report.write import safely_write, write_report

Format = Callable[[Sequence[Section]], str]
FORMATS: dict[str, Format] = {"report.md": to_markdown, "report.html": to_html}


def write_formats(report: Report, page: Page) -> None:
    """Replace report.json and the report in every format, each in one step.

    Called after every result, so that nothing finished is lost. A format that fails takes no result
    back.

    Raises:
        OSError: report.json cannot be written.
    """
    write_report(report)
    sections = cache(lambda: make_sections(report, page))

    def write(path: Path, to_text: Format) -> None:
        path.write_text(to_text(sections()), encoding="utf-8")

    for name, to_text in FORMATS.items():
        safely_write(report.folder / name, write, to_text, stops=False)
