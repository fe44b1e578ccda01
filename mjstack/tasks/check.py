"""What a task's acceptance gives the gates: rules as bits, check fed step by step, and a result."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar, cast

import numpy as np
import torch

from mjstack.config.schema import Config
from mjstack.errors import TermError
from mjstack.managers.base import resolve_func
from mjstack.scene import SceneIndex
from mjstack.scene.phases import Phase
from mjstack.sim.simulation import Simulation


class Rules(Mapping[str, int]):
    """A task's rules: the bit of each by its name, in order. A world passes with none set.

    FINITE, STEPS and OVERFLOW come first, whatever the task.
    """

    def __init__(self, texts: Mapping[str, str]) -> None:
        """Numbers the rules.

        Args:
            texts: What went wrong if a rule of the task is broken, by the rule's name.
        """
        self.texts = {**_EVERY_TASK, **texts}
        self._bits = {name: 1 << number for number, name in enumerate(self.texts)}

    def __getitem__(self, name: str) -> int:
        return self._bits[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._bits)

    def __len__(self) -> int:
        return len(self._bits)

    def broken(self, bits: int) -> list[str]:
        """Names of the rules in a bit set."""
        return [name for name, bit in self.items() if bits & bit]

    def describe(self, bits: int) -> str:
        """What went wrong, in words."""
        return ", ".join(self.texts[name] for name in self.broken(bits))

    def failing(self, failed: np.ndarray) -> dict[str, list[int]]:
        """Which worlds broke which rule, by its name.

        Args:
            failed: Bits of every world, shape ``(nworld,)``.
        """
        worlds = {name: np.flatnonzero(failed & bit).tolist() for name, bit in self.items()}
        return {name: found for name, found in worlds.items() if found}


_EVERY_TASK = {
    "FINITE": "state not finite",
    "STEPS": "step counter off",
    "OVERFLOW": "buffer overflow",
}


@dataclass(frozen=True, slots=True)
class CheckResult:
    """What the check says, on the device.

    Attributes:
        failed: Bits of the task's rules, shape ``(nworld,)``, int32.
        values: What was measured, by name with unit, each ``(nworld,)``.
    """

    failed: torch.Tensor
    values: dict[str, torch.Tensor]

    @classmethod
    def of(
        cls, rules: Rules, held: Mapping[str, torch.Tensor], values: dict[str, torch.Tensor]
    ) -> CheckResult:
        """From whether each rule held, ``(nworld,)`` bool."""
        failed = torch.zeros_like(held["FINITE"], dtype=torch.int32)
        for name, bit in rules.items():
            failed |= bit * (~held[name]).to(failed.dtype)
        return cls(failed, values)


class EpisodeCheck(ABC):
    """Collects what a task's rules of the check need, for every world at once, on the device.

    Memory does not grow with the episode. The step is counted on the device, so that a captured
    graph can hold `update`.

    Attributes:
        rules: The task's rules.
        summaries: What a batch reports: name of the metric, and of the value, and whether its
            ``min`` or ``max`` counts.
    """

    rules: ClassVar[Rules]
    summaries: ClassVar[Mapping[str, tuple[str, str]]]

    @abstractmethod
    def __init__(
        self, cfg: Config, index: SceneIndex, phases: list[Phase], nworld: int, device: torch.device
    ) -> None:
        """Allocates for nworld worlds."""

    @abstractmethod
    def update(self, sim: Simulation, phase: torch.Tensor) -> None:
        """Takes in the state at the end of a step. Fixed shapes, no host read.

        Args:
            sim: The worlds.
            phase: Number of the phase that each world's command belonged to, shape ``(nworld,)``,
                int64.
        """

    @abstractmethod
    def result(self, sim: Simulation) -> CheckResult:
        """Judges the episode; every rule that was not shown to hold has failed."""

    @abstractmethod
    def placed(self, sim: Simulation) -> torch.Tensor:
        """Whether each cube is where it belongs right now, red first, shape ``(nworld, 2)``, bool.
        No host read.
        """

    @classmethod
    @abstractmethod
    def thresholds(cls, cfg: Config) -> dict[str, float]:
        """The rules' numbers, with units, for a report."""

    @classmethod
    @abstractmethod
    def explain(
        cls, cfg: Config, steps: Mapping[str, np.ndarray], values: Mapping[str, float]
    ) -> dict[str, tuple[str, str]]:
        """What a world's recording says to each rule: by the rule's name, what was found, and what
        it wants.

        Args:
            cfg: The configuration.
            steps: What a replay keeps at step ends, by name, steps first.
            values: What the check measured.
        """

    @classmethod
    @abstractmethod
    def headline(cls, values: Mapping[str, float]) -> str:
        """A world's values in a few words."""


def check_class(cfg: Config) -> type[EpisodeCheck]:
    """The check of the configured task.

    Raises:
        TermError: ``task.check`` names none.
    """
    found = resolve_func("task.check", cfg.task.check)
    if not (isinstance(found, type) and issubclass(found, EpisodeCheck)):
        raise TermError(
            "task.check",
            f"{cfg.task.check}: expected a subclass of mjstack.tasks.check.EpisodeCheck",
        )
    return cast(type[EpisodeCheck], found)
