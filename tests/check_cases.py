"""Alterations of an succeeded recording, each with the rules that it has to break; for the check of
either task.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

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


Alter = Callable[[Any], None]
Altered = dict[str, tuple[CheckResult, int, Any]]
STOPPED_EARLY = (
    1 << 9 | 1 << 10
)  # MJWarp's bits of a solver that reached its limits: no physics was dropped


@dataclass
class Cases:
    """Cases by name. A world has at least ``step_count`` and ``overflow``."""

    rules: Rules
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
