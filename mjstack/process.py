"""Processes of one command: those that it starts, and those that it is one of."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path

# The working folder is not imported from (-P), only the folder that has this mjstack. On Linux the
# process ends with the one that started it (PR_SET_PDEATHSIG), which a second Ctrl-C ends at once.
_START = (
    "import ctypes, sys; sys.platform == 'linux' and ctypes.CDLL(None).prctl(1, 9);"
    f" sys.path.insert(0, {str(Path(__file__).parents[1])!r});"
    " from mjstack.__main__ import main; main()"
)


def is_rank() -> bool:
    """Whether torchrun, or something like it, has started this process beside others."""
    return int(os.environ.get("WORLD_SIZE", 1)) > 1


def own_command(args: Sequence[str]) -> list[str]:
    """The command that runs this mjstack with some arguments, in a process of its own."""
    return [sys.executable, "-P", "-c", _START, *args]
