"""Views that keep their memory: what guards them against rebinding, and the check of a mask over
worlds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch

from mjstack.errors import ArgumentError, MissingField, RebindError


class Fields(Mapping[str, torch.Tensor]):
    """Per-world model fields by MuJoCo's name. Write into a tensor; the mapping itself cannot be
    changed.
    """

    def __init__(self, tensors: Mapping[str, torch.Tensor]) -> None:
        self._tensors = dict(tensors)

    def __getitem__(self, name: str) -> torch.Tensor:
        if name not in self._tensors:
            raise MissingField(name)
        return self._tensors[name]

    def __setitem__(self, name: str, value: torch.Tensor) -> None:
        # Python ends `fields[name] *= 2` by setting the item to the tensor that it has just changed
        # in place.
        if self[name] is not value:
            raise RebindError(f"sim.fields['{name}']")

    def __iter__(self) -> Iterator[str]:
        return iter(self._tensors)

    def __len__(self) -> int:
        return len(self._tensors)


class FixedViews:
    """Base of a simulation: an attribute that holds a tensor keeps that tensor for life.

    Captured graphs and the stepping code know the memory, not the attribute: a rebound view would
    be ignored without a word.
    """

    def __setattr__(self, name: str, value: object) -> None:
        bound = self.__dict__.get(name)
        # Python ends `sim.qpos += 1` by setting the attribute to the tensor that it has just
        # changed in place.
        if isinstance(bound, (torch.Tensor, Fields)) and bound is not value:
            raise RebindError(
                f"sim.{name}" if isinstance(bound, torch.Tensor) else f"sim.{name}[name]"
            )
        super().__setattr__(name, value)


def check_mask(mask: torch.Tensor, nworld: int, device: torch.device) -> None:
    """Checks what can be known of a mask without reading it.

    Args:
        mask: Selects worlds, shape ``(nworld,)``, bool, on the simulation's device.
        nworld: Number of worlds.
        device: The simulation's device.

    Raises:
        ArgumentError: The mask is of another type, shape, dtype or device.
    """
    expected = f"a torch.bool tensor of shape ({nworld},) on {device}"
    if not isinstance(mask, torch.Tensor):
        raise ArgumentError("mask", f"a {type(mask).__name__}", expected)
    if mask.dtype is not torch.bool or mask.shape != (nworld,) or mask.device != device:
        raise ArgumentError(
            "mask", f"a {mask.dtype} tensor of shape {tuple(mask.shape)} on {mask.device}", expected
        )
