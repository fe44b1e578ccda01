"""Ctrl-C while the command loads its modules and composes its configuration: one line, and nothing
has happened yet.

Where torch, Warp or omegaconf meet a `KeyboardInterrupt`, what comes out is their traceback, or
another error of theirs.
"""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType

INTERRUPTED = 130


def guard() -> None:
    """From here to `started` Ctrl-C ends the process at once. Handlers of somebody else's and other
    threads are left alone.
    """
    if (
        threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    ):
        signal.signal(signal.SIGINT, _stop)


def started() -> None:
    """Ctrl-C raises `KeyboardInterrupt` again: there are results to keep."""
    if signal.getsignal(signal.SIGINT) is _stop:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _stop(signum: int, frame: FrameType | None) -> None:
    os.write(2, b"mjstack: interrupted before anything ran\n")
    os._exit(INTERRUPTED)
