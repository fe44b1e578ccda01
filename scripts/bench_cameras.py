"""Measures images alone: ``python scripts/bench_cameras.py robot=so101 nworld=2048
cameras=front``.
"""

from mjstack.bench.cli import main

if __name__ == "__main__":
    main("cameras")
