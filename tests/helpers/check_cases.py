"""What the checks of both tasks are compared by: a recorded world, its outcome, and alterations of
a recording that succeeded, each with the rules that it has to break.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import pytest
from compositions import load_config

from mjstack.config.schema import Config
from mjstack.tasks.check import CheckResult, Rules, make_check


def limits(cfg: Config) -> Any:
    """Thresholds of the task's check."""
    return make_check(cfg).t


@cache
def rules_of(task: str) -> Rules:
    """Rules of a task's check."""
    return make_check(load_config([f"task={task}"])).rules


RED = 0
BLUE = 1
Alter = Callable[[Any], None]
Altered = dict[str, tuple[CheckResult, int, Any]]
STOPPED_EARLY = (
    1 << 9 | 1 << 10
)  # MJWarp's bits of a solver that reached its limits: no physics was dropped


@dataclass
class Recording:
    """One world at every step end.

    Attributes:
        phase: Name of its phase, shape ``(steps,)``; None for a driver without phases.
        pose: Red's and blue's, shape ``(steps, 2, 7)``.
        velocity: Likewise, as MuJoCo has it, shape ``(steps, 2, 6)``.
        jaw_force: Of each jaw on each cube [N], shape ``(steps, 2, jaws, 3)``.
        support_force: Of whatever else touches each cube [N], shape ``(steps, 2, n, 3)``; None in a
            scene without such sensors.
        gripper: Joint positions, shape ``(steps, n_gripper)``.
        xpos: All bodies at the end, shape ``(nbody, 3)``.
        xquat: Likewise, shape ``(nbody, 4)``.
        step_count: Physics steps the world has made.
        overflow: Whether it lost contacts or constraint rows.
        finite_elsewhere: Whether the rest of its state stayed finite.
    """

    phase: np.ndarray | None
    pose: np.ndarray
    velocity: np.ndarray
    jaw_force: np.ndarray
    support_force: np.ndarray | None
    gripper: np.ndarray
    xpos: np.ndarray
    xquat: np.ndarray
    step_count: int
    overflow: bool = False
    finite_elsewhere: bool = True


@dataclass
class Outcome:
    """Names of the broken rules, and the numbers behind them, named as the check names them."""

    failed: set[str] = field(default_factory=set)
    values: dict[str, float] = field(default_factory=dict)


def counted(rec: Recording, cfg: Config) -> set[str]:
    """The first three rules, which any task has."""
    steps = sum(round(p.seconds / cfg.timing.step_dt) for p in cfg.controller.phases.values())
    finite = np.isfinite(rec.pose).all() and np.isfinite(rec.velocity).all()
    made = rec.step_count == steps * cfg.timing.decimation and len(rec.pose) == steps
    broken = {"FINITE": not (finite and rec.finite_elsewhere), "STEPS": not made}
    return {name for name, bad in (broken | {"OVERFLOW": rec.overflow}).items() if bad}


@dataclass
class Cases:
    """Cases by name, and how near the numbers of a check are to those of the plain checker."""

    rules: Rules
    rel: float
    alter: dict[str, Alter] = field(default_factory=dict)
    breaks: dict[str, set[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.add("untouched", set(), lambda w: None)
        self.add("one_step_short", {"STEPS"}, lambda w: setattr(w, "step_count", w.step_count - 1))
        self.add("one_step_long", {"STEPS"}, lambda w: setattr(w, "step_count", w.step_count + 1))
        self.add("rows_lost", {"OVERFLOW"}, lambda w: setattr(w, "overflow", 1))
        self.add(
            "iteration_limits_are_no_overflow",
            set(),
            lambda w: setattr(w, "overflow", STOPPED_EARLY),
        )

    def add(self, name: str, rules: set[str], alter: Alter) -> None:
        """Registers an alteration."""
        assert name not in self.alter
        self.alter[name] = alter
        self.breaks[name] = rules

    def case(self, *rules: str) -> Callable[[Alter], Alter]:
        """Registers the decorated function by its name."""

        def register(alter: Alter) -> Alter:
            self.add(alter.__name__, set(rules), alter)
            return alter

        return register

    def add_values(self, values: dict[str, tuple[str, str, Any, Any]]) -> None:
        """Registers changes of an array: the rules that break, the array of a world, where, and the
        other value or what makes it of the value.
        """

        def change(world: Any, array: str, at: Any, value: Any) -> None:
            part = getattr(world, array)
            part[at] = value(part[at]) if callable(value) else value

        for name, (rules, *args) in values.items():
            self.add(name, {*rules.split()}, lambda w, args=args: change(w, *args))

    def play(self, fresh: Callable[[], Any], feed: Callable[[list[Any]], CheckResult]) -> Altered:
        """Every case as one world of one batch: by name the batch's result, the world's number in
        it, and the world.
        """
        worlds = []
        for alter in self.alter.values():
            worlds.append(fresh())
            alter(worlds[-1])
        result = feed(worlds)
        return {name: (result, k, worlds[k]) for k, name in enumerate(self.alter)}

    def broken(self, result: CheckResult, k: int = 0) -> set[str]:
        """Names of the rules that a world broke."""
        return set(self.rules.broken(int(result.failed[k])))

    def assert_same(self, result: CheckResult, k: int, expected: Outcome) -> None:
        """A world's rules and numbers are the plain checker's."""
        assert self.broken(result, k) == expected.failed
        for name, value in expected.values.items():
            near = math.degrees(1e-6) if name.endswith("_deg") else 1e-6
            near_value = pytest.approx(value, abs=near, rel=self.rel, nan_ok=True)
            assert float(result.values[name][k]) == near_value, name
