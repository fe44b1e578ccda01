"""Processes of one command: those that it is one of, and those that it starts, follows and ends."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO

POLL = 0.1  # s, between two looks at processes
_GRACE = 30.0  # s, in which an interrupted process must have ended

# The working folder is not imported from (-P), only the folder that has this mjstack. On Linux the
# process ends with the one that started it (PR_SET_PDEATHSIG), which a second Ctrl-C ends at once.
_START = (
    "import ctypes, sys; sys.platform == 'linux' and ctypes.CDLL(None).prctl(1, 9);"
    f" sys.path.insert(0, {str(Path(__file__).parents[1])!r});"
)


def is_rank() -> bool:
    """Whether torchrun, or something like it, has started this process beside others."""
    return int(os.environ.get("WORLD_SIZE", 1)) > 1


def available_cores() -> int:
    """Cores that this process may use: under torchrun its share of the machine's."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(1, (cores or 1) // int(os.environ.get("LOCAL_WORLD_SIZE", 1)))


def own_command(args: Sequence[str]) -> list[str]:
    """The command that starts this mjstack in a process."""
    start = f"{_START} from mjstack.__main__ import main; main()"
    return [sys.executable, "-P", "-c", start, *args]


class Child(subprocess.Popen[bytes]):
    """This mjstack in a process of its own, which outlives the call that starts it."""

    def __init__(
        self,
        args: Sequence[str],
        log: IO[bytes],
        *,
        env: Mapping[str, str] | None = None,
        folder: Path | None = None,
    ) -> None:
        """Start it with the command's arguments; the log gets its output. Environment variables add
        to those of this process, and by default it works in the folder of this process.
        """
        self._began = time.monotonic()
        super().__init__(
            own_command(args),
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=os.environ | dict(env or {}),
            start_new_session=True,  # Ctrl-C of the terminal comes through this process
        )

    @property
    def seconds(self) -> float:
        """Time since it started."""
        return time.monotonic() - self._began


def stop_all(children: Collection[Child]) -> None:
    """Interrupt processes, wait for them, and kill those that go on for too long."""
    for child in children:
        with suppress(OSError):
            child.send_signal(signal.SIGINT)
    until = time.monotonic() + _GRACE
    for child in children:
        try:
            child.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
