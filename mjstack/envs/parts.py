"""The two halves of a step, each by itself: what a measurement of the managers' cost needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StepParts:
    """Parts of a step, on the action last given to ``action_manager.process``.

    Attributes:
        physics: The frame's substeps and the poses at its end.
        managers: Everything else.
        whole: Both, in the environment's order.
        capture_seconds: Wall time of their capture [s]; 0 where nothing was captured.
    """

    physics: Callable[[], None]
    managers: Callable[[], None]
    whole: Callable[[], None]
    capture_seconds: float = 0.0
