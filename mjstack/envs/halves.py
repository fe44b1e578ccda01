"""Work that is repeated step by step, and the two halves of a step: what a measurement of the
managers' cost needs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol


class Repeated(Protocol):
    """Work that is the same at every call: a `mjstack.sim.graph.StepGraph`, or `Eager` where
    nothing is captured.

    Attributes:
        captured: Whether the next call replays a graph.
        warm_up_seconds: What the first call took, if it was a warm-up [s].
        capture_seconds: What the capture took [s].
    """

    @property
    def captured(self) -> bool:
        """Whether the next call replays a graph."""

    warm_up_seconds: float
    capture_seconds: float

    def __call__(self) -> None:
        """Does the work."""

    def drop(self) -> None:
        """Gives the graph and its memory back."""


class Eager:
    """Work that just runs."""

    captured = False
    warm_up_seconds = capture_seconds = 0.0

    def __init__(self, work: Callable[[], None]) -> None:
        """Takes the work."""
        self._work = work

    def __call__(self) -> None:
        """Does it."""
        self._work()

    def drop(self) -> None:
        """There is nothing to give back."""


@dataclass(frozen=True, slots=True)
class StepHalves:
    """A step taken apart, for measurements. Each part acts in place on the action that was last
    taken in.

    On CUDA each is a graph of its own, captured at its second call, unless ``graph=off``; elsewhere
    the managers run eagerly.

    Attributes:
        physics: The decimation, and the poses after them.
        managers: Everything else of a step: commands, success, terminations, rewards, observations,
            resets.
    """

    physics: Repeated
    managers: Repeated

    @property
    def capture_seconds(self) -> float:
        """What the captures took so far [s]."""
        return self.physics.capture_seconds + self.managers.capture_seconds
