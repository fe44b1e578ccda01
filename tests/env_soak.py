"""Random actions for a long time: nothing becomes NaN, and memory stays flat.

python tests/env_soak.py native 64 10000
"""

from __future__ import annotations

import json
import os
import sys
import time

import torch

from mjstack import make_env

STARTS_KEPT = 1000  # per run; keeping every start would itself grow


def resident_mb() -> float:
    """Memory of this process [MB]."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGESIZE") / 1e6


def soak(
    backend: str, nworld: int, steps: int, *, episode_steps: int = 150, robot: str = "so101"
) -> dict[str, object]:
    """Steps one environment with random actions; episodes end by the clock and by what happens.

    Args:
        backend: ``native`` or ``mjwarp`` (on the CPU), or ``mjwarp-cuda``.
        nworld: Number of worlds.
        steps: Calls of step.
        episode_steps: After which the time-out ends an episode.
        robot: Name of its configuration.
    """
    kind, _, device = backend.partition("-")
    overrides = [
        "task=stack",
        f"sim={kind}",
        f"robot={robot}",
        "reset=randomized",
        f"task.episode_steps={episode_steps}",
    ]
    env = make_env(overrides, nworld=nworld, seed=0, device="cuda:0" if device else "cpu")
    generator = torch.Generator(device=env.device).manual_seed(0)
    low = env.action_manager.low
    span = env.action_manager.high - env.action_manager.low
    shape = (nworld, env.action_manager.action_dim)
    finite = torch.ones((), dtype=torch.bool, device=env.device)
    episodes = torch.zeros((), dtype=torch.int64, device=env.device)
    starts: set[tuple[float, ...]] = set()
    env.reset()
    rss = {0: resident_mb()}
    began = time.perf_counter()
    for step in range(1, steps + 1):
        obs, reward, terminated, truncated, extras = env.step(
            low + span * torch.rand(shape, generator=generator, device=env.device)
        )
        done = terminated | truncated
        episodes += done.sum()
        for value in (*obs.values(), reward):
            finite &= torch.isfinite(value).all()
        for value in extras["final_obs"].values():
            finite &= (torch.isfinite(value).all(1) | terminated).all()
        if len(starts) < STARTS_KEPT:
            starts |= {tuple(row) for row in obs["privileged"][done].tolist()}
        if step in (steps // 5, steps):
            rss[step] = resident_mb()
    seconds = time.perf_counter() - began
    statistics = env.read_statistics()
    env.close()
    return {
        "backend": backend,
        "robot": robot,
        "nworld": nworld,
        "steps": steps,
        "episodes": int(episodes),
        "distinct_starts": len(starts),
        "rss_start_mb": round(rss[0], 1),
        "rss_20_percent_mb": round(rss[steps // 5], 1),
        "rss_end_mb": round(rss[steps], 1),
        "rss_growth_percent": round(100.0 * (rss[steps] / rss[steps // 5] - 1.0), 3),
        "finite": bool(finite),
        "seconds": round(seconds, 1),
        "ended_by": {
            name.partition("/")[2]: round(v, 4)
            for name, v in statistics.items()
            if name.startswith("termination/")
        },
    }


if __name__ == "__main__":
    name = sys.argv[1]
    worlds = int(sys.argv[2])
    number = int(sys.argv[3])
    print(
        json.dumps(soak(name, worlds, number, robot=sys.argv[4] if len(sys.argv) > 4 else "so101")),
        flush=True,
    )
