"""The base of a simulation, whose views keep their memory, and the check of a mask over worlds."""

from __future__ import annotations

import torch

from mjstack.errors import ArgumentError, RebindError
from mjstack.sim.model_fields import Fields
from mjstack.sim.repeated import Repeated
from mjstack.sim.sizes import BatchSizes


class FixedViews:
    """Base of a simulation: an attribute that holds a tensor keeps that tensor for life.

    Captured graphs and the stepping code know the memory, not the attribute: a rebound view would
    be ignored without a word. Capabilities that not every backend has are None here.
    """

    sizes: BatchSizes | None = None
    peak_pool: torch.Tensor | None = None
    solver_limits: torch.Tensor | None = None

    def graph_of(self, n: int = 1, *, kinematics: bool = False) -> Repeated | None:
        """The graph that ``step(n)`` replays; None: nothing is captured."""
        return None

    def memory_bytes(self) -> int | None:
        """Bytes of the arrays that grow with nworld; None: they are not counted."""
        return None

    def borrowed_bytes(self) -> int | None:
        """The most that a step borrows at once beside them; None: it is not known."""
        return None

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
    """Check what can be known of a mask without reading it.

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
