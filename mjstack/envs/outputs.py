"""Results of a step, which are copies, and statistics of the episodes that ended: what a reset
would change is kept or added up on the device.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mjstack.managers.state import lost_state

if TYPE_CHECKING:
    from mjstack.envs.env import Env

ResetResult = tuple[dict[str, Tensor], dict[str, Any]]
StepResult = tuple[dict[str, Tensor], Tensor, Tensor, Tensor, dict[str, Any]]


class Outputs:
    """Results of `Env.step`. Success and observations of worlds that are reset are kept in buffers
    of their own.
    """

    def __init__(self, env: "Env") -> None:
        self._env = env
        self._groups = env.observation_manager.groups
        self._final = {name: torch.zeros_like(group) for name, group in self._groups.items()}
        self._final_success = torch.zeros_like(env.success)

    def write_final(self) -> None:
        """Keep success and the observations of this step, before a reset changes them. Those of
        worlds whose state is not finite are 0 where they are NaN, which a value times 0 would hand
        on.
        """
        lost = lost_state(self._env)
        self._final_success.copy_(self._env.success)
        for name, final in self._final.items():
            group = self._groups[name]
            if lost is self._env.sim.no_worlds:
                final.copy_(group)
            else:
                finite = group.nan_to_num(0.0, 0.0, 0.0)
                torch.where(lost[:, None], finite, group, out=final)

    def restore_observations(self) -> None:
        """Make the final observations the current ones, where no world is reset."""
        for name, final in self._final.items():
            self._groups[name].copy_(final)

    def returned(self, images: dict[str, Tensor], final_images: dict[str, Tensor]) -> StepResult:
        """Copies, as `Env.step` returns them, and the images themselves."""
        obs = {name: group.clone() for name, group in self._groups.items()} | images
        final = {name: group.clone() for name, group in self._final.items()} | final_images
        extras = {"final_obs": final, "success": self._final_success.clone()}
        ends = self._env.termination_manager
        reward = self._env.reward_manager.reward.clone()
        return obs, reward, ends.terminated.clone(), ends.truncated.clone(), extras


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
        self._sums = torch.zeros(len(self._names), dtype=torch.float64, device=env.device)

    def update(self, done: Tensor) -> None:
        """Add the episodes that end in this step, shape ``(nworld,)``, bool."""
        env = self._env
        # A step count is exact in float32 up to 16.7 million; the sums are float64.
        ends = [part.float()[:, None] for part in (done, env.episode_step, env.success)]
        ways = env.termination_manager.values.float()
        row = torch.cat((*ends, env.reward_manager.episode_sums, ways), dim=1)
        self._sums += torch.where(done[:, None], row, 0.0).sum(0, dtype=torch.float64)

    def read(self) -> dict[str, float]:
        """Means over the episodes that ended since the last read, which starts anew. Waits for the
        device.

        Returns:
            ``episodes``; and if there were any ``steps``, ``success``, ``return``,
            ``reward/<term>`` (sums per episode) and ``termination/<term>`` (fraction of episodes).
        """
        episodes, steps, success, *sums = self._sums.tolist()
        self._sums.zero_()
        total = sum(sums[: len(self._env.cfg.reward)])
        sums = [steps, success, total, *sums]
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
