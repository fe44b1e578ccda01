"""Checks of the arguments of an environment's reset."""

import operator

import torch
from torch import Tensor

from mjstack.errors import ArgumentError


def check_seed(seed: int, *, masked: bool) -> int:
    """The seed as a Python integer.

    Raises:
        ArgumentError: It is no 32-bit integer, or a mask is given beside it.
    """
    if masked:
        expected = "no mask beside it, because a seed starts every world anew"
        raise ArgumentError("seed", str(seed), expected, "Leave one out")
    number = operator.index(seed) if hasattr(seed, "__index__") else -1
    if isinstance(seed, bool) or not 0 <= number < 1 << 32:
        raise ArgumentError("seed", repr(seed), "an integer from 0 to 4294967295")
    return number


def check_mask(mask: Tensor, nworld: int, device: torch.device, *, started: bool) -> None:
    """Check a mask of worlds.

    Raises:
        ArgumentError: It has a wrong type, shape, dtype or device, or no world has started yet.
    """
    expected = f"a bool tensor of shape ({nworld},) on {device}"
    if not isinstance(mask, Tensor):
        raise ArgumentError("mask", type(mask).__name__, expected)
    if tuple(mask.shape) != (nworld,) or mask.dtype is not torch.bool or mask.device != device:
        found = f"{mask.dtype} of shape {tuple(mask.shape)} on {mask.device}"
        raise ArgumentError("mask", found, expected)
    if not started:
        raise ArgumentError(
            "mask", "a part of the worlds", "none at the first reset", "Call env.reset()"
        )
