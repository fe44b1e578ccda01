"""Step an environment with random actions for a long time: nothing is lost, and memory stays flat.

    python tools/soak.py sim=native robot=rebot nworld=64 --steps 10000

The exit status is 1 if an observation or a reward is not finite, if two episodes start alike, or if
memory grows by more than 2 % after the first fifth of the steps.
"""

import argparse
import json
import os
import sys
import time

import torch

from mjstack import load_config, make_env

_STARTS = 1000  # that are compared: keeping every start would itself take memory
_GROWTH = 2.0  # percent


def resident_mb() -> float:
    """Memory of this process [MB]."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGESIZE") / 1e6


def soak(overrides: list[str], steps: int) -> dict[str, object]:
    """Step with random actions; return figures, and the ``problems`` in words."""
    env = make_env(overrides, nworld=load_config(overrides).nworld, seed=0)
    manager = env.action_manager
    generator = torch.Generator(device=env.device).manual_seed(0)
    finite = torch.ones((), dtype=torch.bool, device=env.device)
    episodes = torch.zeros((), dtype=torch.int64, device=env.device)
    starts: set[tuple[float, ...]] = set()
    compared = 0
    env.reset()
    began = time.perf_counter()
    for step in range(1, steps + 1):
        shape = (env.nworld, manager.action_dim)
        noise = torch.rand(shape, generator=generator, device=env.device)
        obs, reward, terminated, truncated, extras = env.step(
            manager.low + (manager.high - manager.low) * noise
        )
        done = terminated | truncated
        episodes += done.sum()
        for value in (*obs.values(), reward):
            finite &= torch.isfinite(value).all()
        for value in extras["final_obs"].values():
            finite &= (torch.isfinite(value).all(1) | terminated).all()
        if compared < _STARTS:
            rows = obs["privileged"][done].tolist()
            compared += len(rows)
            starts |= {tuple(row) for row in rows}
        if step == max(1, steps // 5):
            early_mb = resident_mb()
    seconds = time.perf_counter() - began
    growth = 100.0 * (resident_mb() / early_mb - 1.0)
    problems = {
        "a value is not finite": not finite,
        "two episodes start alike": len(starts) < compared,
        "memory grows": growth > _GROWTH,
    }
    terminations = {
        name.partition("/")[2]: round(share, 4)
        for name, share in env.read_statistics().items()
        if name.startswith("termination/")
    }
    env.close()
    return {
        "worlds": env.nworld,
        "steps": steps,
        "episodes": int(episodes),
        "terminations": terminations,
        "memory_mb": round(early_mb, 1),
        "memory_growth_percent": round(growth, 3),
        "seconds": round(seconds, 1),
        "problems": [problem for problem, holds in problems.items() if holds],
    }


def main() -> None:
    """Run as the command line says."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    help_text = "as for run.py (default: reset=randomized task.episode_steps=150)"
    parser.add_argument("overrides", nargs="*", help=help_text)
    parser.add_argument("--steps", type=int, default=10_000)
    args = parser.parse_intermixed_args()
    figures = soak(["reset=randomized", "task.episode_steps=150", *args.overrides], args.steps)
    print(json.dumps(figures, indent=1))
    sys.exit(bool(figures["problems"]))


if __name__ == "__main__":
    main()
