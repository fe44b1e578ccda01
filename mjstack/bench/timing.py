"""Wall time and energy of work on a simulation, and the repetitions of a measurement."""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from torch import Tensor
from typing_extensions import override

from mjstack.config.schema import Config
from mjstack.episodes.rollout import Observer, RolloutTiming
from mjstack.math import not_finite
from mjstack.report.figure import Figure, figures
from mjstack.sim import LOST_PHYSICS, Simulation
from mjstack.sim.build import cuda_uuid, device_memory
from mjstack.sim.graph import StepGraph

_RATES = ("world_steps", "env_steps", "images")  # samples per second
WARM_UP = 3  # calls: eager, captured, replayed
EAGER = 2  # steps: the warm-up, and the one that is captured
SHORTEST = 0.5  # s, of a stretch of work on average: the counter moves some ten times a second


class EnergyMeter:
    """Adds up the GPU's energy from `start` to `stop`, of all processes on it.

    Attributes:
        reason: Why there is no figure; empty where there is one.
    """

    def __init__(self, device: str) -> None:
        """Open the counter of ``cpu`` or ``cuda:N``."""
        self._counter: Callable[[], float] | None = None  # [mJ]
        self._joules = self._seconds = 0.0
        self._stretches = 0
        self.reason = ""
        if device == "cpu":
            return
        try:
            import pynvml

            pynvml.nvmlInit()
            handle = pynvml.nvmlDeviceGetHandleByUUID(cuda_uuid(device))
            pynvml.nvmlDeviceGetTotalEnergyConsumption(handle)
        except ImportError:
            self.reason = "nvidia-ml-py is not installed: pip install 'mjstack[gpu]'"
        except pynvml.NVMLError as error:  # a part of a GPU, or an old one, has no counter
            self.reason = f"NVML: {error}"
        else:
            self._counter = partial(pynvml.nvmlDeviceGetTotalEnergyConsumption, handle)

    def start(self) -> None:
        """Begin a stretch of work, the device idle."""
        self._first = self._counter() if self._counter else 0.0
        self._began = time.perf_counter()

    def stop(self) -> None:
        """End it, the device idle again, and add it."""
        self._seconds += time.perf_counter() - self._began
        if self._counter:
            self._joules += 1e-3 * (self._counter() - self._first)
        self._stretches += 1

    @property
    def missing(self) -> str:
        """Why there is no figure; empty where there is one, and on a CPU."""
        mean = self._seconds / max(self._stretches, 1)
        if self._counter is None or mean >= SHORTEST:
            return self.reason
        return f"stretches of {mean:.2g} s are too short for NVML's counter"

    def figures(self) -> list[Figure]:
        """Energy and mean power of the stretches; nothing where they are missing."""
        if self._counter is None or self.missing:
            return []
        power = Figure("gpu_power_mean", self._joules / self._seconds, "W")
        return [power, Figure("gpu_energy", self._joules, "J")]


NO_METER = EnergyMeter("cpu")  # which has no counter


class EnergyObserver(Observer):
    """Measures the energy of a rollout's steps from the third on, when all are replayed."""

    def __init__(self, meter: EnergyMeter) -> None:
        self._meter = meter

    @override
    def after_step(self, step: int) -> None:
        if step == EAGER - 1:
            self.env.sim.synchronize()
            reading = time.perf_counter()
            self._meter.start()
            self.aside = time.perf_counter() - reading

    @override
    def finish(self) -> None:
        self._meter.stop()


@dataclass(kw_only=True, slots=True)
class Measurement:
    """Repetitions of timed work, and facts on it.

    Attributes:
        name: Such as ``physics``; it begins the names of all metrics.
        samples: A number per repetition, by the figure's name.
        totals: Figures over all repetitions, such as the energy.
        facts: Figures that hold with or without samples.
        notes: Facts in words.
        captured: Whether all that should be captured was.
        failed: Whether a world failed the check.
        problem: Why the figures are void; empty where they count.
        missing: Why there are no figures, which is no failure; empty where there are.
        headline: The measurement in a few words.
    """

    name: str
    samples: dict[str, list[float]] = field(default_factory=dict)
    totals: list[Figure] = field(default_factory=list)
    facts: list[Figure] = field(default_factory=list)
    notes: dict[str, str] = field(default_factory=dict)
    captured: bool = True
    failed: bool = False
    problem: str = ""
    missing: str = ""
    headline: str = ""

    def median(self, sample: str) -> float:
        """Median of a figure's repetitions."""
        return statistics.median(self.samples[sample])

    def add_repetitions(
        self,
        sim: Simulation,
        cfg: Config,
        seconds: list[float],
        steps: int,
        meter: EnergyMeter,
        *work: StepGraph | RolloutTiming | None,
        captured: bool,
        whole: bool = True,
    ) -> None:
        """Add the figures of timed repetitions, their energy, and how they were captured.

        On CUDA, work that should have been captured and ran eagerly has no figure.

        Args:
            sim: The worlds.
            cfg: Their configuration.
            seconds: Wall time of each repetition [s].
            steps: Control steps in a repetition.
            meter: Has measured their energy.
            work: The captured work, if any; the slowest counts.
            captured: Whether the steps were replayed from a graph.
            whole: Whether they were whole, not physics alone.
        """
        # Time and rate per physics step and per whole control step
        decimation = cfg.timing.decimation
        counts = {("ms_per_batched_step", "world_steps"): steps * decimation}
        if whole:
            counts["ms_per_env_step", "env_steps"] = steps
        for (ms, rate), count in counts.items():
            self.samples[ms] = [1e3 * s / count for s in seconds]
            self.samples[rate] = [sim.nworld * count / s for s in seconds]

        # Energy, and the memory that is taken on the GPU
        self.totals += meter.figures()
        if meter.missing:
            self.notes["gpu_power_mean_w"] = f"not measured: {meter.missing}"
        if (used := device_memory(str(sim.device))) is not None:
            self.facts += [
                Figure("gpu_memory_arrays", used[0] / 2**20, "MiB"),
                Figure("gpu_memory_whole_gpu", used[1] / 2**20, "MiB"),
            ]

        # The capture. On Warp's CPU device physics alone is captured
        graphs = [graph for graph in work if graph is not None]
        cuda = sim.device.type == "cuda"
        self.captured = captured
        self.facts += [
            *figures(steps_per_repetition=steps, repetitions=len(seconds)),
            Figure("warm_up", max([0.0, *(graph.warm_up_seconds for graph in graphs)]), "s"),
            Figure("capture", max([0.0, *(graph.capture_seconds for graph in graphs)]), "s"),
            *figures(captured=captured),
        ]
        physics = None if cuda else sim.graph_of(decimation, kinematics=True)
        if physics is not None:
            self.facts += figures(physics_captured=physics.captured)
        if cuda and not captured and cfg.graph != "off":
            eager = "it was not captured and ran eagerly (run.log says why)"
            self.problem = self.problem or f"{eager}; graph=off measures it like that"

    def figures(self) -> list[Figure]:
        """All that count, under the measurement's name: median and range of samples."""
        counted = list(self.facts)
        if not self.problem:
            for name, values in self.samples.items():
                unit = "/s" if name in _RATES else ""
                ends = {"median": statistics.median(values), "min": min(values), "max": max(values)}
                counted += [Figure(name, value, unit, column=end) for end, value in ends.items()]
            counted += self.totals
        return [replace(figure, group=self.name) for figure in counted]

    def named_notes(self) -> dict[str, str]:
        """The notes, under the measurement's name."""
        missing = {"status": f"not measured: {self.missing}"} if self.missing else {}
        return {f"{self.name}.{key}": text for key, text in (self.notes | missing).items()}


def timed(sim: Simulation, work: Callable[[], object], meter: EnergyMeter = NO_METER) -> float:
    """Seconds that some work takes, the device idle at both ends; a meter adds its energy."""
    sim.synchronize()
    meter.start()
    began = time.perf_counter()
    work()
    sim.synchronize()
    seconds = time.perf_counter() - began
    meter.stop()
    return seconds


def lost_worlds(sim: Simulation, steps: int | None = None) -> Tensor:
    """Worlds whose time would be void, shape ``(nworld,)``, bool. ``steps`` are the physics steps
    that they must have made since their last reset; None for any number.
    """
    lost = not_finite(sim.qpos, sim.qvel) | ((sim.overflow & LOST_PHYSICS) != 0)
    return lost if steps is None else lost | (sim.step_count != steps)


def describe_lost(lost: Tensor) -> str:
    """The number of lost worlds in a sentence; empty where there are none. Waits for the device."""
    count = int(lost.sum())
    return f"{count} worlds overflowed, diverged or were not stepped" if count else ""


def settled(cfg: Config, times: Sequence[float]) -> bool:
    """Whether no more repetitions are needed: there are two at least, and half the range of their
    times is less than ``precision``, relative to the median.
    """
    range_allowed = 2.0 * cfg.gate.throughput.precision * statistics.median(times)
    return len(times) > 1 and max(times) - min(times) < range_allowed


def time_budget(cfg: Config, sim: Simulation) -> float:
    """Seconds that a measurement on these worlds may take."""
    t = cfg.gate.throughput
    return t.max_seconds if sim.device.type == "cuda" else t.cpu_max_seconds


def steps_that_fit(most: int, budget: float, seconds_per_step: float) -> int:
    """As many steps as a time budget [s] allows, from 1 to most."""
    return max(1, int(min(most, budget / max(seconds_per_step, 1e-9))))
