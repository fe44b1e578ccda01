"""Scratch memory for Warp's temporaries, so that a captured graph has no nodes that allocate and
free.
"""

from __future__ import annotations

from collections import defaultdict

import torch
import warp as wp

_ALIGNMENT = 512  # bytes


class Scratch:
    """An allocator for Warp during one capture. Blocks that were given back serve the next request
    of their size.

    MJWarp allocates some thirty temporaries per step. Through CUDA's own pool each becomes two
    nodes of a captured graph, which run one after the other like kernels do; from here they are
    addresses. A block goes back to the stream that used it, where later work comes after earlier
    work, so parallel branches never share one.
    """

    deallocate_requires_context_guard = False

    def __init__(self, device: wp.Device) -> None:
        """Start empty."""
        self._device = device
        self._torch_device = torch.device(wp.device_to_torch(device))
        self._free: dict[tuple[int, int], list[int]] = defaultdict(list)
        self._owner: dict[int, int] = {}
        self._blocks: list[torch.Tensor] = []

    def allocate(self, size_in_bytes: int) -> int:
        """Address of a block on the current stream."""
        size = -(-size_in_bytes // _ALIGNMENT) * _ALIGNMENT
        stream = self._device.stream.cuda_stream or 0
        free = self._free[stream, size]
        if free:
            return free.pop()
        block = torch.empty(size, dtype=torch.uint8, device=self._torch_device)
        self._blocks.append(block)
        self._owner[block.data_ptr()] = stream
        return block.data_ptr()

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Take a block back. The memory itself stays, because a graph may write to it at every
        replay.
        """
        size = -(-size_in_bytes // _ALIGNMENT) * _ALIGNMENT
        self._free[self._owner[ptr], size].append(ptr)
