"""Compares the fused solver with MJWarp's and native MuJoCo's on recorded states: ``COLUMNS=240
python scripts/bench_solver.py robot=so101 nworld=2048 batch.njmax=768 --states 20000``.
"""

from mjstack.bench.cli import main

if __name__ == "__main__":
    main("solver")
