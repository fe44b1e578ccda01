"""Measures what the managers cost: ``python scripts/bench_env_step.py task=stack nworld=256``."""

from mjstack.bench.cli import main

if __name__ == "__main__":
    main("env_step")
