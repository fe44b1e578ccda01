"""Demonstrations that nobody played: steps and results by seed and world, in no time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pyarrow.parquet as pq
import torch

from mjstack.episodes.context import RunContext
from mjstack.jobs.demonstration import Played, StepRecorder
from mjstack.scene.phases import build_phases
from mjstack.sim import Simulation

LAYOUT = {
    "observation.state": 6,
    "observation.policy": 24,
    "observation.privileged": 46,
    "action": 6,
    "next.reward": 1,
}
BROKEN = 8  # red not lifted


def fake_demonstrations(
    fails: Callable[[int, int], bool],
    after: Callable[[int, torch.Tensor], None] | None = None,
    *,
    noise: bool = False,
) -> Callable[..., Played]:
    """Stands in for `play_demonstrations`.

    Args:
        fails: Whether a world of a seed breaks a rule.
        after: Called with the seed and its steps.
        noise: Steps that differ from each other and cannot be compressed, some 0.2 MB for each
            world.
    """

    def play(context: RunContext, sim: Simulation, seed: int, worlds: range) -> Played:
        steps = build_phases(context.cfg)[-1].stop
        values = torch.zeros((steps, sim.nworld, sum(LAYOUT.values())))
        for row, world in enumerate(worlds):
            values[:, row] = 1e-3 * seed + 1e-6 * world
            if noise:
                values[:, row] = torch.randn(
                    values[:, 0].shape, generator=torch.Generator().manual_seed(1000 * seed + world)
                )
        failed = np.array([BROKEN if fails(seed, world) else 0 for world in worlds], dtype=np.int32)
        if after is not None:
            after(seed, values)
        return Played(
            seed=seed,
            steps=cast(StepRecorder, SimpleNamespace(values=values, schema=LAYOUT)),
            failed=failed,
            retries=np.array([world % 3 for world in worlds], dtype=np.int32),
            worlds=worlds,
        )

    return play


def episodes_of(dataset: Path) -> list[dict[str, Any]]:
    """The rows of all episodes, without their statistics."""
    table = pq.read_table(dataset / "meta/episodes")
    return table.drop_columns(
        [name for name in table.column_names if name.startswith("stats/")]
    ).to_pylist()


def pairs(dataset: Path) -> list[tuple[int, int]]:
    """Seed and world of every episode."""
    return [(row["seed"], row["world"]) for row in episodes_of(dataset)]
