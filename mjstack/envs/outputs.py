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

StepResult = tuple[dict[str, Tensor], Tensor, Tensor, Tensor, dict[str, Any]]
_ALIGNMENT = 16  # bytes


class Outputs:
    """Results of `Env.step` in one block of memory. Rewards, ends and observations are computed
    right into it.

    Attributes:
        tensors: Each of them in that memory, by name.
        numbers: The memory of the reward and of all observations, shape ``(n,)``, float32: a look
            at one tensor tells about all of them.
    """

    def __init__(
        self,
        rewards: RewardManager,
        ends: TerminationManager,
        observations: ObservationManager,
        success: Tensor,
    ) -> None:
        """Allocate the block, and move the managers' results into it."""
        groups = observations.groups
        self._success = success
        self._groups = list(groups)
        # The same order for both kinds of observations, so that one copy takes all of them.
        like = {
            "reward": rewards.reward,
            **{f"obs/{name}": group for name, group in groups.items()},
            **{f"final/{name}": group for name, group in groups.items()},
            "terminated": ends.terminated,
            "truncated": ends.truncated,
            "success": success,
        }
        # Of each: its type, shape and strides, and where it begins, in numbers of its type
        self._layout: dict[str, tuple[torch.dtype, torch.Size, tuple[int, ...], int]] = {}
        begins: dict[str, int] = {}
        size = 0
        for name, tensor in like.items():
            begins[name] = size
            where = size // tensor.element_size()
            self._layout[name] = (tensor.dtype, tensor.shape, tensor.stride(), where)
            length = tensor.numel() * tensor.element_size()
            size = _ALIGNMENT * math.ceil((size + length) / _ALIGNMENT)
        self._memory = torch.zeros(size, dtype=torch.uint8, device=success.device)
        self.tensors = self._views(self._memory)
        for name, tensor in like.items():
            self.tensors[name].copy_(tensor)
        rewards.reward = self.tensors["reward"]
        ends.terminated = self.tensors["terminated"]
        ends.truncated = self.tensors["truncated"]
        for name in self._groups:
            groups[name] = self.tensors[f"obs/{name}"]

        final = [begins[f"final/{name}"] for name in self._groups]
        first = final[0] if final else begins["terminated"]
        self.numbers = self._memory[:first].view(torch.float32)
        obs = [begins[f"obs/{name}"] for name in self._groups]
        self._observed = self._memory[obs[0] if obs else first : first]
        self._final = self._memory[first : begins["terminated"]]

    def write_final(self, broken: Tensor | None) -> None:
        """Keep success and the observations of this step, before a reset changes them.

        Args:
            broken: Worlds whose state is not finite, shape ``(nworld,)``, bool; None if there are
                none. Their last observation is 0 where it is NaN, which a value times 0 would hand
                on.
        """
        self.tensors["success"].copy_(self._success)
        if broken is None:
            self._final.copy_(self._observed)
            return
        for name in self._groups:
            group = self.tensors[f"obs/{name}"]
            finite = group.nan_to_num(0.0, 0.0, 0.0)
            torch.where(broken[:, None], finite, group, out=self.tensors[f"final/{name}"])

    def restore_observations(self) -> None:
        """Make the final observations the current ones, where no world is reset."""
        self._observed.copy_(self._final)

    def returned(self, images: dict[str, Tensor], final_images: dict[str, Tensor]) -> StepResult:
        """Copies, as `Env.step` returns them, and the images themselves."""
        out = self._views(self._memory.clone())
        obs = {name: out[f"obs/{name}"] for name in self._groups} | images
        final = {name: out[f"final/{name}"] for name in self._groups} | final_images
        extras = {"final_obs": final, "success": out["success"]}
        return obs, out["reward"], out["terminated"], out["truncated"], extras

    def _views(self, memory: Tensor) -> dict[str, Tensor]:
        typed: dict[torch.dtype, Tensor] = {}
        views = {}
        for name, (dtype, shape, strides, where) in self._layout.items():
            if dtype not in typed:
                typed[dtype] = memory.view(dtype)
            # `data`: writing into one would else count as writing into the others.
            views[name] = typed[dtype].as_strided(shape, strides, where).data
        return views
