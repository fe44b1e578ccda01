"""Wall time of work on a simulation, and what repetitions of it say."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from mjstack.bench.power import EnergyMeter
from mjstack.config.schema import GraphMode
from mjstack.sim import Simulation

WARM_UP = 3  # calls: eager, captured, replayed


def timed(sim: Simulation, work: Callable[[], object], meter: EnergyMeter | None = None) -> float:
    """Seconds that some work takes, the device idle at both ends; a meter takes in its energy."""
    sim.synchronize()
    if meter is not None:
        meter.start()
    began = time.perf_counter()
    work()
    sim.synchronize()
    seconds = time.perf_counter() - began
    if meter is not None:
        meter.stop()
    return seconds


def capture_problem(sim: Simulation, mode: GraphMode, captured: bool) -> str:
    """Why work that ran eagerly has no figure: on CUDA it should have been captured. Empty where it
    has one.
    """
    if captured or sim.device.type != "cuda" or mode is GraphMode.off:
        return ""
    return "it was not captured and ran eagerly (run.log says why); graph=off measures it like that"


def spread(name: str, values: Sequence[float]) -> dict[str, float]:
    """Median, least and largest of some values as three metrics."""
    return {
        f"{name}.median": statistics.median(values),
        f"{name}.min": min(values),
        f"{name}.max": max(values),
    }


@dataclass(kw_only=True, slots=True)
class Timing:
    """Repetitions of the same work.

    Attributes:
        nworld: Number of worlds.
        steps: Control intervals in one repetition.
        decimation: Physics steps in one of them.
        seconds: Wall time of each repetition [s].
    """

    nworld: int
    steps: int
    decimation: int
    seconds: list[float] = field(default_factory=list)

    @property
    def median(self) -> float:
        """Median repetition [s]."""
        return statistics.median(self.seconds)

    @property
    def world_steps_per_s(self) -> float:
        """Physics steps of all worlds together per second, median."""
        return self.nworld * self.steps * self.decimation / self.median

    def step_metrics(self) -> dict[str, float]:
        """Per physics step: what a batched one costs, and how many world-steps are made in a
        second.
        """
        steps = self.steps * self.decimation
        return spread("ms_per_batched_step", [1e3 * s / steps for s in self.seconds]) | spread(
            "world_steps_per_s", [self.nworld * steps / s for s in self.seconds]
        )

    def env_step_metrics(self) -> dict[str, float]:
        """Likewise per control interval."""
        return spread("ms_per_env_step", [1e3 * s / self.steps for s in self.seconds]) | spread(
            "env_steps_per_s", [self.nworld * self.steps / s for s in self.seconds]
        )


def steps_that_fit(most: int, budget: float, seconds_per_step: float) -> int:
    """As many steps as a time budget [s] allows, from 1 to most."""
    return max(1, min(most, int(budget / max(seconds_per_step, 1e-9))))
