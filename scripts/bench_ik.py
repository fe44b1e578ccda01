"""Measures batched inverse kinematics: ``python scripts/bench_ik.py robot=so101 --nworld 2048
--iterations 4 8``.
"""

from mjstack.bench.cli import bench_ik

if __name__ == "__main__":
    bench_ik()
