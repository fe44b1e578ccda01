"""Work that is repeated step by step, captured or not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol


class Repeated(Protocol):
    """Work that is the same at every call.

    A `mjstack.sim.graph.StepGraph`, or `Eager` where nothing is captured.

    Attributes:
        captured: Whether the next call replays a graph.
        warm_up_seconds: Time of the first call, if it was a warm-up [s].
        capture_seconds: Time of the capture [s].
    """

    @property
    def captured(self) -> bool:
        """Whether the next call replays a graph."""

    warm_up_seconds: float
    capture_seconds: float

    def __call__(self) -> None:
        """Do the work."""

    def drop(self) -> None:
        """Free the graph and its memory."""


class Eager:
    """Work that just runs."""

    captured = False
    warm_up_seconds = capture_seconds = 0.0

    def __init__(self, work: Callable[[], None]) -> None:
        """``work`` is called as it is."""
        self._work = work

    def __call__(self) -> None:
        """Do the work."""
        self._work()

    def drop(self) -> None:
        """There is nothing to free."""
