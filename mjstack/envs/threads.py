"""Threads of torch on the CPU."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any

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


def without_autograd(method: Callable[..., Any]) -> Callable[..., Any]:
    """Run a method in torch's inference mode on the CPU, where what autograd keeps of each small
    tensor is a tenth of its time. ``self.device`` says where.
    """
    lean = torch.inference_mode()(method)

    @wraps(method)
    def run(self: Any, *args: Any, **kwargs: Any) -> Any:
        return (method if self.device.type == "cuda" else lean)(self, *args, **kwargs)

    return run
