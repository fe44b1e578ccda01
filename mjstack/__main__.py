"""The command: ``mjstack``, ``python -m mjstack`` and ``python scripts/run.py``."""

import sys


def main() -> None:
    """Entry point of the console script; leaves with the exit status of the run."""
    try:
        from mjstack.cli import run  # takes seconds
    except KeyboardInterrupt:
        print("mjstack: interrupted before anything ran", file=sys.stderr)
        raise SystemExit(130) from None
    raise SystemExit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
