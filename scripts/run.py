"""Runs mjstack from a checkout: ``python scripts/run.py robot=so101 nworld=2048``."""

from mjstack.__main__ import main

if __name__ == "__main__":
    main()
