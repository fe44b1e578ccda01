"""One training in several processes, as torchrun starts them: a process per device, which its
variables number.
"""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor


@dataclass(frozen=True, slots=True)
class Ranks:
    """The processes of a training.

    Attributes:
        rank: Number of this one. Number 0 alone writes files and prints.
        size: How many there are.
    """

    rank: int = 0
    size: int = 1

    @property
    def writes(self) -> bool:
        """Whether this process writes files."""
        return self.rank == 0

    def sum_(self, *tensors: Tensor) -> None:
        """Replace tensors by their sums over the processes, in place."""
        if self.size > 1:
            for tensor in tensors:
                dist.all_reduce(tensor)

    def average_gradients(self, parameters: Iterable[Tensor]) -> None:
        """Replace gradients by their means over the processes, in place."""
        if self.size == 1:
            return
        gradients = [p.grad for p in parameters if p.grad is not None]
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        dist.all_reduce(flat)
        parts = (flat / self.size).split([gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view_as(gradient))

    def gather(self, tensor: Tensor) -> list[Tensor]:
        """A CPU tensor of every process, by rank, each of the same shape."""
        if self.size == 1:
            return [tensor]
        found: list[Tensor | None] = [None] * self.size
        dist.all_gather_object(found, tensor)
        return [each for each in found if each is not None]


def torchrun_ranks() -> Ranks:
    """The processes that torchrun has started, from its variables; one where it has not."""
    return Ranks(int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1)))


@contextmanager
def joined(device: str) -> Iterator[Ranks]:
    """Join the processes of the training inside: NCCL on CUDA, Gloo elsewhere.

    Args:
        device: Device of this process, such as ``cuda:1``.
    """
    ranks = torchrun_ranks()
    if ranks.size == 1:
        yield ranks
        return
    if device.startswith("cuda"):
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if device.startswith("cuda") else "gloo")
    try:
        yield ranks
    finally:
        dist.destroy_process_group()
