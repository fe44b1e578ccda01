"""Statistics of the episodes that ended, added up on the device and read now and then."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from mjstack.envs.env import Env


class EpisodeStatistics:
    """Sums over finished episodes. One tensor holds them all, so that reading is one copy."""

    def __init__(self, env: "Env") -> None:
        self._env = env
        self._names = [
            *("steps", "success", "return"),
            *(f"reward/{name}" for name in env.cfg.reward),
            *(f"termination/{name}" for name in env.cfg.termination),
        ]
        # float64 counts exactly far beyond the 16.7 million at which float32 stops.
        self._sums = torch.zeros(1 + len(self._names), dtype=torch.float64, device=env.device)

    def update(self, done: Tensor) -> None:
        """Add the episodes that end in this step, shape ``(nworld,)``, bool."""
        env = self._env
        rewards = env.reward_manager.episode_sums
        # A step count is exact in float32 up to 16.7 million; the sums are float64.
        ends = (done.float(), env.episode_step.float(), env.success.float(), rewards.sum(1))
        parts = (torch.stack(ends, dim=1), rewards, env.termination_manager.values.float())
        row = torch.cat(parts, dim=1)
        self._sums += torch.where(done[:, None], row, 0.0).sum(0, dtype=torch.float64)

    def read(self) -> dict[str, float]:
        """Means over the episodes that ended since the last read, which starts anew. Waits for the
        device.

        Returns:
            ``episodes``; and if there were any ``steps``, ``success``, ``return``,
            ``reward/<term>`` (sums per episode) and ``termination/<term>`` (fraction of episodes).
        """
        episodes, *sums = self._sums.tolist()
        self._sums.zero_()
        means = zip(self._names, sums, strict=True) if episodes else ()
        return {"episodes": episodes} | {name: total / episodes for name, total in means}


def join_statistics(parts: Sequence[dict[str, float]]) -> dict[str, float]:
    """Statistics of the episodes of all ranks, from those that each has read."""
    if len(parts) == 1:
        return parts[0]
    total = sum(part["episodes"] for part in parts)
    names = dict.fromkeys(name for part in parts for name in part if name != "episodes")
    means = {
        name: sum(part["episodes"] * part[name] for part in parts if name in part) / total
        for name in names
    }
    return {"episodes": total, **means}
