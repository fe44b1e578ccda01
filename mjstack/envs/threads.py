"""Threads of torch on the CPU."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

_WORLDS = 2048  # of a thread


@contextmanager
def few_threads(device: torch.device, nworld: int) -> Iterator[None]:
    """Torch on few threads inside, on the CPU: the numbers of some thousand worlds are too few to
    share out, and threads that wait for more take cores from the physics.
    """
    before = torch.get_num_threads()
    threads = max(1, min(before, nworld // _WORLDS))
    if threads == before or device.type == "cuda":
        yield
        return
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)
