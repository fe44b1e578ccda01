"""Measures what each change to the physics step is worth: ``python scripts/bench_physics.py
robot=so101 nworld=2048``.
"""

from mjstack.bench.cli import main

if __name__ == "__main__":
    main("physics")
