"""The command: ``mjstack``, ``python -m mjstack`` and ``python scripts/run.py``."""

import gc
import os
import sys

from mjstack.interrupt import handle_interrupts


def main() -> None:
    """Entry point of the console script; leaves with the exit status of the run."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:  # closed; a file opened later would take its place
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), "r+"))
    gc.disable()  # until a job begins: loading makes a million objects, which stay
    with handle_interrupts():
        from mjstack.cli import run  # takes seconds

        status = run(sys.argv[1:])
        gc.freeze()  # files are closed, and looking for cycles takes seconds
        gc.enable()
        raise SystemExit(status)


if __name__ == "__main__":
    main()
