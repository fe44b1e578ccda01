"""Results of a step, laid side by side in memory: one copy makes all of it the caller's.

The copies share memory, so that keeping one of them keeps all of a step. To autograd each is
a separate tensor.
"""

import math
from typing import Any

import torch
from torch import Tensor

from mjstack.managers.episode import RewardManager, TerminationManager
from mjstack.managers.observation import ObservationManager

_ALIGNMENT = 16  # bytes


class Outputs:
    """Results of `Env.step` in one block of memory. Rewards, ends and observations are computed
    right into it.
    """

    def __init__(
        self,
        rewards: RewardManager,
        ends: TerminationManager,
        observations: ObservationManager,
        success: Tensor,
    ) -> None:
        """Allocate the block, and move the managers' results into it."""
        self._groups = list(observations.groups)
        like = {
            "reward": rewards.reward,
            "terminated": ends.terminated,
            "truncated": ends.truncated,
            "success": success,
        }
        for name, group in observations.groups.items():
            like[f"obs/{name}"] = like[f"final/{name}"] = group
        self._layout: dict[str, tuple[int, torch.dtype, torch.Size]] = {}
        size = 0
        for name, tensor in like.items():
            length = tensor.numel() * tensor.element_size()
            self._layout[name] = (size, tensor.dtype, tensor.shape)
            size = _ALIGNMENT * math.ceil((size + length) / _ALIGNMENT)
        self._memory = torch.zeros(size, dtype=torch.uint8, device=success.device)
        self.tensors = self._views(self._memory)
        for name, tensor in like.items():
            self.tensors[name].copy_(tensor)
        rewards.reward = self.tensors["reward"]
        ends.terminated = self.tensors["terminated"]
        ends.truncated = self.tensors["truncated"]
        for name in self._groups:
            observations.groups[name] = self.tensors[f"obs/{name}"]

    def write_final(self, success: Tensor, broken: Tensor) -> None:
        """Keep success and the observations of this step, before a reset changes them.

        Args:
            success: Shape ``(nworld,)``, bool.
            broken: Worlds whose state is not finite, shape ``(nworld,)``, bool. Their last
                observation is 0 where it is NaN, which a value times 0 would hand on.
        """
        self.tensors["success"].copy_(success)
        whole = not broken.is_cuda and not bool(broken.any())
        for name in self._groups:
            group = self.tensors[f"obs/{name}"]
            if whole:
                self.tensors[f"final/{name}"].copy_(group)
                continue
            finite = group.nan_to_num(0.0, 0.0, 0.0)
            torch.where(broken[:, None], finite, group, out=self.tensors[f"final/{name}"])

    def restore_observations(self) -> None:
        """Make the final observations the current ones, where no world is reset."""
        for name in self._groups:
            self.tensors[f"obs/{name}"].copy_(self.tensors[f"final/{name}"])

    def returned(
        self,
    ) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor, dict[str, Any]]:
        """Copies, as `Env.step` returns them."""
        out = self._views(self._memory.clone())
        obs = {name: out[f"obs/{name}"] for name in self._groups}
        final = {name: out[f"final/{name}"] for name in self._groups}
        extras = {"final_obs": final, "success": out["success"]}
        return obs, out["reward"], out["terminated"], out["truncated"], extras

    def _views(self, memory: Tensor) -> dict[str, Tensor]:
        storage = memory.untyped_storage()
        views = {}
        for name, (start, dtype, shape) in self._layout.items():
            # Not a view of `memory`: writing into one would then count as writing into the others.
            tensor = torch.empty(0, dtype=dtype, device=memory.device)
            views[name] = tensor.set_(storage, start // tensor.element_size(), shape)  # type: ignore[call-overload]
        return views
