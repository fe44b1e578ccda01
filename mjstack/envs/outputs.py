"""What a step returns, laid side by side in memory: one copy makes all of it the caller's own.

The copies share memory, so that keeping one of them keeps all of a step. To autograd each is a
tensor of its own.
"""

from __future__ import annotations

import math

import torch

_ALIGNMENT = 16  # bytes


class Outputs:
    """Tensors in one block of memory."""

    def __init__(self, like: dict[str, torch.Tensor], device: torch.device) -> None:
        """Allocates room for tensors of the same shapes and types, and takes their values."""
        self._layout: dict[str, tuple[int, torch.dtype, torch.Size]] = {}
        size = 0
        for name, tensor in like.items():
            length = tensor.numel() * tensor.element_size()
            self._layout[name] = (size, tensor.dtype, tensor.shape)
            size = _ALIGNMENT * math.ceil((size + length) / _ALIGNMENT)
        self._memory = torch.zeros(size, dtype=torch.uint8, device=device)
        self.tensors = self._views(self._memory)
        for name, tensor in like.items():
            self.tensors[name].copy_(tensor)

    def copy(self) -> dict[str, torch.Tensor]:
        """Copies of all tensors."""
        return self._views(self._memory.clone())

    def _views(self, memory: torch.Tensor) -> dict[str, torch.Tensor]:
        storage = memory.untyped_storage()
        views = {}
        for name, (start, dtype, shape) in self._layout.items():
            # Not a view of `memory`: writing into one would then count as writing into the others.
            tensor = torch.empty(0, dtype=dtype, device=memory.device)
            views[name] = tensor.set_(storage, start // tensor.element_size(), shape)  # type: ignore[call-overload]
        return views
