"""Measures batched inverse kinematics: ``python scripts/bench_ik.py robot=so101 --nworld 2048
--iterations 4 8``.
"""

from mjstack.bench.cli import main

if __name__ == "__main__":
    main("ik")
