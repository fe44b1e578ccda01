"""The command: ``mjstack``, ``python -m mjstack`` and ``python scripts/run.py``."""

from mjstack.startup import guard, started


def main() -> None:
    """Entry point of the console script; leaves with the exit status of the run."""
    guard()
    try:
        from mjstack.cli import main as run  # takes seconds

        run()
    finally:
        started()


if __name__ == "__main__":
    main()
