"""The two halves of a step, for measurements of the managers' cost."""

from __future__ import annotations

from dataclasses import dataclass

from mjstack.sim.repeated import Repeated


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
