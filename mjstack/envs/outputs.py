"""Results of a step: what a reset changes is kept, and everything returned is a copy."""

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

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

    def write_final(self, broken: Tensor | None) -> None:
        """Keep success and the observations of this step, before a reset changes them.

        Args:
            broken: Worlds whose state is not finite, shape ``(nworld,)``, bool; None if there are
                none. Their last observation is 0 where it is NaN, which a value times 0 would hand
                on.
        """
        self._final_success.copy_(self._env.success)
        for name, final in self._final.items():
            group = self._groups[name]
            if broken is None:
                final.copy_(group)
            else:
                finite = group.nan_to_num(0.0, 0.0, 0.0)
                torch.where(broken[:, None], finite, group, out=final)

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
