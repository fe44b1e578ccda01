"""Episode checks: how a task judges an episode. `mjstack new task NAME` writes one."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain
from typing import Any, ClassVar, Self, cast

import numpy as np
import torch
from torch import Tensor

from mjstack.config.complete import typed
from mjstack.config.fields import field_range
from mjstack.config.functions import resolve_func
from mjstack.config.schema import Config
from mjstack.errors import ConfigError, TermError, require_names
from mjstack.managers.state import lost_state
from mjstack.managers.view import EnvView
from mjstack.mdp.geometry import LOADED
from mjstack.report.figure import Figure, suffix
from mjstack.scene.phases import Phase
from mjstack.sim.simulation import LOST_PHYSICS
from mjstack.tasks.view import PhaseNames, Step

_EVERY_TASK = {
    "FINITE": "state not finite",
    "STEPS": "step counter off",
    "OVERFLOW": "buffer overflow",
}

Judgement = tuple[Tensor, Iterable[Tensor]]
"""Whether a rule was shown to hold, bool, shape ``(nworld,)`` or ``(nworld, rules)``, and values of
its figures and of ``measured``, in their order, each ``(nworld,)``."""


class Rules(dict[str, int]):
    """A task's rules: the bit of each by its name, in order. A world passes with none set.

    FINITE, STEPS and OVERFLOW come first, for every task.
    """

    def __init__(self, texts: Mapping[str, str]) -> None:
        """Numbers the rules.

        Args:
            texts: The failure in words if a rule of the task is broken, by the rule's name.
        """
        self.texts = {**_EVERY_TASK, **texts}
        super().__init__((name, 1 << number) for number, name in enumerate(self.texts))

    def broken(self, bits: int) -> list[str]:
        """Names of the rules in a bit set."""
        return [name for name, bit in self.items() if bits & bit]

    def describe(self, bits: int) -> str:
        """The broken rules of a bit set, in words."""
        return ", ".join(self.texts[name] for name in self.broken(bits))

    def failing(self, failed: np.ndarray) -> dict[str, list[int]]:
        """Which worlds broke which rule, by its name.

        Args:
            failed: Bits of every world, shape ``(nworld,)``.
        """
        masks = {name: failed & bit for name, bit in self.items()}
        return {name: np.flatnonzero(mask).tolist() for name, mask in masks.items() if mask.any()}


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of a check, on the device.

    Attributes:
        failed: Bits of the task's rules, shape ``(nworld,)``, int32.
        values: Measured values, by the keys of the check's figures, each ``(nworld,)``.
        phased: Whether the driver had phases, so that rules counted in those that they name.
    """

    failed: Tensor
    values: dict[str, Tensor]
    phased: bool


class Rule(ABC):
    """One rule of a check, or the same rule for each of several objects.

    It is data until `start` allocates for every world. `update` may be captured into a CUDA graph.

    Attributes:
        texts: The failure in words if it is broken, by name; one entry, or one for each object.
        figures: What tells about each of them, with the limits within which it holds: they tell
            which of several thresholds broke.
        measured: What else it measures.
        phases: For each object, the phases in which it counts.
        at_end: Whether it can only hold at the end of a whole episode.
    """

    measured: Sequence[Figure] = ()
    phases: PhaseNames = ()
    at_end = False

    def __init__(
        self, name: str, text: str, objects: Sequence[str] = (), figures: Sequence[Figure] = ()
    ) -> None:
        """Name the rule.

        Args:
            name: In capital letters. The rule of one of several objects is ``NAME_OBJECT``.
            text: The failure in words if it is broken; ``{object}`` is the object's name.
            objects: The objects that it judges one by one.
            figures: What it measures of each of them, without values; of several objects, ``{}``
                in a name is ``_OBJECT``.
        """
        self.objects = list(objects)
        suffixes = [f"_{object}" for object in objects] if len(objects) > 1 else [""]
        self.texts = {
            f"{name}{suffix.upper()}": text.format(object=object)
            for suffix, object in zip(suffixes, objects or [""], strict=True)
        }
        self.figures = [[replace(f, name=f.name.format(s)) for f in figures] for s in suffixes]

    def start(self, step: Step) -> None:  # noqa: B027
        """Allocate for the worlds of an environment, at their start."""

    def update(self, step: Step) -> None:  # noqa: B027
        """Process the state at the end of a step. Fixed shapes, no host read."""

    @abstractmethod
    def judge(self, end: Step) -> Judgement:
        """Judge the episode.

        Args:
            end: The state at its end.
        """

    def declared(self) -> Iterator[Figure]:
        """All that it measures, in the order of its values."""
        for figure in chain(*self.figures, self.measured):
            yield replace(figure, limit="")  # the check's thresholds have it

    def by_object(self, *values: Tensor) -> Iterable[Tensor]:
        """Values of each object, shape ``(nworld, objects)`` for each of its figures, in the order
        of all figures.
        """
        return torch.stack(torch.broadcast_tensors(*values), dim=2).flatten(1).unbind(1)


class EpisodeCheck(ABC):
    """Judges an episode of every world at once, on the device.

    A subclass has a dataclass ``Thresholds``, whose values are those of ``task.check``, and builds
    its rules, most of them of `mjstack.tasks.parts`. They look at every step. Memory does not grow
    with the episode. The step is counted on the device, so that a captured graph can hold `update`.

    With a driver that has phases, rules count in the phases that they name. Without, they count at
    any time before the settled window, each once the one before it holds.

    Attributes:
        cfg: The configuration.
        t: The thresholds.
        rules: Names, bits and words of the rules.
        objects: The objects that the task is about, which the rules read; perhaps none.
        figures: What the rules measure, without values, by key.
        summaries: Metrics of a batch: by name without unit, the key of a figure and which of its
            worlds' counts, ``min`` or ``max``.
    """

    Thresholds: ClassVar[type]
    summaries: Mapping[str, tuple[str, str]] = {}
    term_kind = "check"  # as of `offers`

    def __init__(self, cfg: Config) -> None:
        """Read the thresholds and build the rules.

        Raises:
            MjstackError: A threshold is missing, unknown, of the wrong type or out of range.
        """
        node = dict(cfg.task.check or {})
        node.pop("func", None)
        self.cfg = cfg
        self.t: Any = typed("task.check", node, self.Thresholds)
        phases = cfg.controller.phases
        steps = sum(round(phase.seconds / cfg.timing.step_dt) for phase in phases.values())
        steps = steps or cfg.task.episode_steps
        if self.settle_steps > steps:
            expected = f"at most {steps} steps (the episode)"
            raise ConfigError("task.check.window", self.settle_steps, expected)
        self.objects = list(cfg.scene.objects)
        self._rules = self.build()
        require_names("task.check: object", self.objects, cfg.scene.objects)
        if phases:
            named = chain(*chain(*(rule.phases for rule in self._rules)))
            require_names("task.check: phase", named, phases)
        self.rules = Rules(dict(chain(*(rule.texts.items() for rule in self._rules))))
        self.figures = {f.key: f for rule in self._rules for f in rule.declared()}

    @classmethod
    def from_env(cls, env: EnvView) -> Self:
        """The check of an environment, a ConfigError if it is of another class."""
        if not isinstance(check := env.check, cls):
            name, expected = (f"{c.__module__}.{c.__name__}" for c in (type(check), cls))
            raise ConfigError("task.check.func", name, f"{expected}, whose rules a term needs")
        return check

    @abstractmethod
    def build(self) -> list[Rule]:
        """The task's rules, in the order of their bits."""

    @property
    def force(self) -> float:
        """A jaw or a support that presses with more than this touches an object [N]."""
        return getattr(self.t, "force", LOADED)

    @property
    def tolerance(self) -> float:
        """Its smallest threshold that is a length [m]: so exactly has an object to arrive."""
        lengths = [figure.high for figure in self.thresholds() if figure.unit == "m"]
        return min((length for length in lengths if length > 0.0), default=math.inf)

    @property
    def settle_steps(self) -> int:
        """Length of the window at the episode's end in which everything has to be at rest."""
        return getattr(self.t, "window", 0)

    def start(self, env: EnvView, steps: int, phases: Sequence[Phase] = ()) -> None:
        """Allocate for an episode.

        Args:
            env: The worlds, at their start.
            steps: Length of the episode.
            phases: Those of the driver, if it has any.
        """
        self._steps = steps
        # Without phases, rules count before the settled window.
        stop = steps if phases else steps - self.settle_steps
        self._step = Step(env, self.objects, phases, stop=stop, force=self.force)
        for rule in self._rules:
            rule.start(self._step)
        self._finite = torch.ones(env.nworld, dtype=torch.bool, device=env.device)

    def update(self, phase: Tensor | None = None) -> None:
        """Process the state at the end of a step. Fixed shapes, no host read.

        Args:
            phase: Number of the phase that each world's command belonged to, shape ``(nworld,)``,
                int64; None without phases.
        """
        self._finite &= ~lost_state(self._step.env)
        self._step.phase = phase
        for rule in self._rules:
            rule.update(self._step)
        self._step.count += 1

    def result(self) -> CheckResult:
        """Judge the episode; every rule that was not shown to hold has failed."""
        end = self._step
        end.phase = None
        sim = end.env.sim
        complete = int(end.count) == self._steps
        physics_steps = self._steps * self.cfg.timing.decimation
        passed = {
            "FINITE": self._finite,
            "STEPS": (sim.step_count == physics_steps) & complete,
            "OVERFLOW": (sim.overflow & LOST_PHYSICS) == 0,
        }
        values: dict[str, Tensor] = {}
        for rule in self._rules:
            holds, measured = rule.judge(end)
            if rule.at_end:
                holds = holds & complete
            passed |= zip(rule.texts, holds.view(len(holds), -1).unbind(1), strict=True)
            values |= zip((figure.key for figure in rule.declared()), measured, strict=True)
        bits = [bit * (~passed[name]).int() for name, bit in self.rules.items()]
        failed = torch.stack(bits).sum(0, dtype=torch.int32)
        return CheckResult(failed, values, end.phased)

    def why(
        self, failed: np.ndarray, values: Mapping[str, np.ndarray]
    ) -> tuple[dict[str, str], list[str]]:
        """The thresholds that broke, in words, by the name of each rule that was broken, empty
        where the rule has but one; and the keys of all figures beyond their limits. ``failed`` are
        the rules' bits, ``values`` what was measured, each of shape ``(nworld,)``.
        """
        broken = dict.fromkeys(self.rules.failing(failed), "")
        beyond_keys = []
        for name, figures in chain(*(zip(r.texts, r.figures, strict=True) for r in self._rules)):
            limited = [figure for figure in figures if figure.limits]
            reasons = []
            for figure in limited if name in broken else ():
                measured = values[figure.key]
                violating = (failed & self.rules[name] != 0) & ~figure.holds(measured)
                if violating.any():
                    limit = figure.high if measured[0] > figure.high else figure.low
                    number = f"{measured[0]:.4g} of {limit:g}"
                    reasons.append(
                        f"{figure.column or figure.key}"
                        f" {number if len(failed) == 1 else f'in {violating.sum()}'}"
                    )
                    beyond_keys.append(figure.key)
            if reasons and len(limited) > 1:
                broken[name] = f" ({', '.join(reasons)})"
        return broken, beyond_keys

    @abstractmethod
    def placed(self, step: Step) -> Tensor:
        """Whether each object is where it belongs, in the order of ``objects``, shape ``(nworld,
        objects)``, bool; of a check without objects, whether all is done, shape ``(nworld, 1)``. No
        host read.
        """

    def goals(self, step: Step) -> dict[str, Tensor]:
        """Where the centre of each object that is carried belongs [m], each ``(nworld, 3)``, by
        name in their order; for `mjstack.tasks.progress.Progress`. No host read.
        """
        return {}

    def trace(self, step: Step) -> dict[str, Tensor]:
        """Values that a replay keeps at every step end, by name with unit, each ``(nworld,)``."""
        return {}

    def thresholds(self) -> list[Figure]:
        """The rules' numbers, as requirements."""
        numbers = []
        for item in fields(self.Thresholds):
            value = getattr(self.t, item.name)
            unit = field_range(item).unit
            if isinstance(value, int | float):
                name = item.name.removesuffix(suffix(unit))
                numbers.append(Figure(name, unit=unit, high=value))
        return numbers

    def report(self, result: CheckResult) -> dict[str, tuple[str, str]]:
        """Measured and expected values of the first world, by the task's rules."""
        report = {}
        for rule in self._rules:
            phases = rule.phases if result.phased and rule.phases else [()] * len(rule.texts)
            for name, figures, names in zip(rule.texts, rule.figures, phases, strict=True):
                during = f" in {' and '.join(names)}" if names else ""
                keys = [figure.key for figure in (*figures, *rule.measured)]
                values = {key: float(result.values[key][0]) for key in keys}
                measured = EpisodeCheck.headline(self, values) or "see the values"
                allowed = dict.fromkeys(f.allowed for f in figures if f.limits)
                report[name] = (measured, (", ".join(allowed) or "see the thresholds") + during)
        return report

    def headline(self, values: Mapping[str, float]) -> str:
        """A world's values in a few words; those of parts, with a dot, are left out."""
        named = {name: value for name, value in values.items() if "." not in name}
        return ", ".join(f"{name} {value:.4g}" for name, value in named.items())


def make_check(cfg: Config) -> EpisodeCheck:
    """The task's check, its thresholds checked.

    Raises:
        MjstackError: The task has none, ``task.check.func`` names none or one that lacks a method,
            or a threshold cannot be used.
    """
    if cfg.task.check is None:
        expected = f"a check of task {cfg.task.name}: without one it can be trained, not verified"
        raise ConfigError("task.check", "null", expected, "Train it: mjstack.make_env")
    name = str(cfg.task.check.get("func"))
    check = cast(type[EpisodeCheck], resolve_func("task.check", name, base=EpisodeCheck))
    for method in sorted(check.__abstractmethods__):
        raise TermError("task.check.func", f"{name}: method '{method}' is missing")
    return check(cfg)
