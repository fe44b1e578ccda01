"""The command: ``mjstack``, ``python -m mjstack`` and ``python scripts/run.py``."""

import sys

from mjstack.interrupt import EXIT_CODE, handle_interrupts, interrupted


def main() -> None:
    """Entry point of the console script; leaves with the exit status of the run."""
    with handle_interrupts():
        from mjstack.cli import run  # takes seconds

        status = run(sys.argv[1:])
        raise SystemExit(EXIT_CODE if interrupted() else status)


if __name__ == "__main__":
    main()
