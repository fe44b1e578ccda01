"""Ctrl-C and SIGTERM of the command: a flag, looked at between the steps and stages of a job.

An exception in the middle of anything could be lost in other people's code, or leave that half
done. Only the command installs these handlers: in a script nothing sets the flag.
"""

import atexit
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import current_thread, main_thread
from types import FrameType

EXIT_CODE = 130

_running = False  # a job may be writing
_asked = False  # to stop


@contextmanager
def handle_interrupts() -> Iterator[None]:
    """Handle the signals of the process inside: before a job has begun they end it, afterwards the
    first one sets the flag and the second ends it. A signal that was ignored stays so.
    """
    global _running, _asked
    _running = _asked = False
    previous = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        # The main thread alone may set handlers.
        if current_thread() is main_thread() and signal.getsignal(number) != signal.SIG_IGN:
            previous[number] = signal.signal(number, _handle)
    try:
        yield
    finally:
        for number, handler in previous.items():
            atexit.register(signal.signal, number, signal.SIG_DFL)  # no traceback at the end
            signal.signal(number, handler)


def begin_job() -> None:
    """From here on files are written, and a signal lets the job stop by itself."""
    global _running
    _running = True


def interrupted() -> bool:
    """Whether the command was asked to stop."""
    return _asked


def withdraw_interrupt() -> None:
    """Forget that the command was asked to stop: the cause is another one."""
    global _asked
    _asked = False


def check_interrupt() -> None:
    """Stop here if the command was asked to. Called where nothing is half done.

    Raises:
        KeyboardInterrupt: It was.
    """
    if _asked:
        raise KeyboardInterrupt


def _handle(number: int, frame: FrameType | None) -> None:
    global _asked
    if _running and not _asked:
        _asked = True
        return
    # torch stops the other ranks so where one has failed, which is no interruption.
    by_torch = number == signal.SIGTERM and "TORCHELASTIC_RUN_ID" in os.environ
    if not _running and not by_torch:
        os.write(2, b"mjstack: interrupted before anything ran\n")
    with suppress(Exception):  # it may be in the middle of a print
        sys.stdout.flush()
    os._exit(EXIT_CODE)
