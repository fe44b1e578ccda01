"""Runs mjstack from a checkout: ``python scripts/run.py robot=so101 nworld=2048``."""

from mjstack.cli import main

if __name__ == "__main__":
    main()
