"""The two halves of a step, each by itself: what a measurement of the managers' cost needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StepParts:
    """A step taken apart, for measurements. Each part acts in place on the action that was last taken in.

    On CUDA each is a graph of its own, captured at its second call, unless ``graph=off``; elsewhere the managers run eagerly.

    Attributes:
        physics: The substeps, and the poses after them.
        managers: Everything else of a step: commands, success, terminations, rewards, observations, resets.
        whole: Both, in the order of a step.
    """

    physics: Callable[[], None]
    managers: Callable[[], None]
    whole: Callable[[], None]

    @property
    def capture_seconds(self) -> float:
        """What the captures took so far [s]."""
        return sum(getattr(part, "capture_seconds", 0.0) for part in (self.physics, self.managers, self.whole))
