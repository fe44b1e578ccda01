"""Demonstrations that nobody played: steps and results by seed and world, in no time."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pyarrow.parquet as pq
import torch

from mjstack.config.schema import Config
from mjstack.envs import Env
from mjstack.episodes.batches import Batch, BatchPlan
from mjstack.episodes.rollout import Episode
from mjstack.episodes.stage import Stage
from mjstack.scene.phases import build_phases

LAYOUT = {
    "observation.state": 6,
    "observation.policy": 24,
    "observation.privileged": 46,
    "action": 6,
    "next.reward": 1,
}
BROKEN = 8  # red not lifted


def fake_batches(
    fails: Callable[[int, int], bool],
    after: Callable[[int, torch.Tensor], None] | None = None,
    *,
    noise: bool = False,
) -> Callable[..., Iterator[Batch]]:
    """Stands in for `play_batches`.

    Args:
        fails: Whether a world of a seed breaks a rule.
        after: Called with the seed and its measured joints, ``(steps + 1, worlds, 6)``.
        noise: Steps that differ from each other and cannot be compressed, some 0.2 MB for each
            world.
    """

    def play(
        stage: Stage, plans: Iterable[BatchPlan], channels: object, *, cfg: Config
    ) -> Iterator[Batch]:
        steps = build_phases(stage.cfg)[-1].stop
        for plan in plans:
            rows = {}
            for number, (name, dim) in enumerate(LAYOUT.items()):
                count = steps + (name not in ("action", "next.reward"))
                values = torch.zeros((count, len(plan.worlds), dim))
                for row, world in enumerate(plan.worlds):
                    values[:, row] = 1e-3 * plan.seed + 1e-6 * world
                    if noise:
                        seed = 10_000 * plan.seed + 10 * world + number
                        generator = torch.Generator().manual_seed(seed)
                        values[:, row] = torch.randn(count, dim, generator=generator)
                rows[name] = values
            if after is not None:
                after(plan.seed, rows["observation.state"])
            bits = [BROKEN if fails(plan.seed, world) else 0 for world in plan.worlds]
            episode = SimpleNamespace(
                failed=np.array(bits, dtype=np.int32),
                retries=np.array([world % 3 for world in plan.worlds], dtype=np.int32),
            )
            env = SimpleNamespace(sim=SimpleNamespace(fields={}))
            yield Batch(plan, cast(Env, env), cast(Episode, episode), rows)

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
