"""Episodes of a gate, counted seed after seed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mjstack.episodes.context import RunContext, TimedEpisode
from mjstack.episodes.failures import describe_sign
from mjstack.episodes.observers import Episode
from mjstack.episodes.record import (
    FAILING,
    SUCCESS_FAILING,
    Circumstances,
    EpisodeRecord,
)
from mjstack.errors import name_worlds
from mjstack.math import wilson_interval
from mjstack.report.markdown import format_percent
from mjstack.report.table import Table
from mjstack.sim import Simulation
from mjstack.tasks.check import Rules

_NAMED = 100  # episodes a line in report.md; the table of failing ones has all


@dataclass(eq=False, kw_only=True, slots=True)
class EpisodeTally:
    """Sums over the seeds: numbers, and the failing episodes by name.

    Attributes:
        gate: Whose episodes.
        noun: What is counted, such as ``worlds``.
        several: Whether there are several seeds; then an episode's name has its seed.
        rules: The task's.
        seeds: Those that were played.
        succeeded: For each seed, which worlds succeeded, shape ``(nworld,)``, bool.
        circumstances: For each seed, if they were recorded.
        failed: Names of the failing episodes.
        broken: The same by the name of the rule that was broken.
        unreachable: Names of the episodes with a target out of reach.
        low: Smallest of everything measured, by name.
        high: Largest of everything measured, by name.
        ends: Hashes of the final states.
        rows: Cells of the table of failing episodes.
        seconds: Wall time of the steps [s].
        steps: Physics steps of all worlds.
        first: Time of the first seed's episode.
        notes: Backend and buffer sizes in words.
        problems: Why the gate fails, whatever the rate.
        details: Remarks.
    """

    gate: str
    noun: str
    several: bool
    rules: Rules
    seeds: list[int] = field(default_factory=list)
    succeeded: list[np.ndarray] = field(default_factory=list)
    circumstances: list[Circumstances] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    broken: dict[str, list[str]] = field(default_factory=dict)
    unreachable: list[str] = field(default_factory=list)
    low: dict[str, float] = field(default_factory=dict)
    high: dict[str, float] = field(default_factory=dict)
    ends: set[int] = field(default_factory=set)
    rows: list[list[object]] = field(default_factory=list)
    seconds: float = 0.0
    steps: int = 0
    first: TimedEpisode | None = None
    notes: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    details: list[str] = field(default_factory=list)

    @property
    def episodes(self) -> int:
        """Number of episodes played."""
        return sum(len(succeeded) for succeeded in self.succeeded)

    @property
    def good(self) -> int:
        """Number of episodes that succeeded."""
        return self.episodes - len(self.failed)

    @property
    def per_seed(self) -> dict[int, int]:
        """Number of episodes that succeeded, by seed."""
        return {
            seed: int(succeeded.sum())
            for seed, succeeded in zip(self.seeds, self.succeeded, strict=True)
        }

    def add(self, record: EpisodeRecord, episode: Episode, sim: Simulation) -> None:
        """Count one seed."""
        self.seeds.append(record.seed)
        self.succeeded.append(record.succeeded)
        self.seconds += episode.timing.seconds
        self.steps += int(sim.step_count.sum())
        if self.first is None:
            self.first = TimedEpisode.of(episode, sim)
        self.failed += self.names(record.seed, np.flatnonzero(record.failed).tolist())
        for rule, worlds in self.rules.failing(record.failed).items():
            self.broken.setdefault(rule, []).extend(self.names(record.seed, worlds))
        self.rows += record.failing_rows(self.rules)
        if record.circumstances is not None:
            self.circumstances.append(record.circumstances)
            out = np.flatnonzero(record.circumstances.unreachable).tolist()
            self.unreachable += self.names(record.seed, out)
        measured = record.values | {
            "waypoint_error_m": episode.waypoint_error,
            "peak_contacts": sim.peak_contacts.cpu().numpy(),
            "peak_constraint_rows": sim.peak_constraints.cpu().numpy(),
        }
        for name, values in measured.items():  # NaN, which a diverged world has, is handed on
            self.low[name] = float(np.minimum(self.low.get(name, math.inf), values.min()))
            self.high[name] = float(np.maximum(self.high.get(name, -math.inf), values.max()))
        # Rounded: on CUDA even identical worlds differ in the last digits. Adding 0 makes -0 the
        # same as 0.
        self.ends.update(hash(row.tobytes()) for row in np.round(record.qpos, 4) + 0.0)

    def names(self, seed: int, worlds: Sequence[int]) -> list[str]:
        """Names of a seed's episodes, as ``world=`` of job=replay takes them."""
        return [f"{seed}:{world}" if self.several else str(world) for world in worlds]

    def metrics(self, context: RunContext) -> dict[str, float]:
        """Counts, the success rate with its interval, and the extremes of what was measured."""
        low, high = wilson_interval(self.good, self.episodes)
        extremes = {"min": self.low, "max": self.high}
        return {
            "worlds": context.cfg.nworld,
            "seeds": len(self.seeds),
            "episodes": self.episodes,
            "succeeded": self.good,
            "success_rate": self.good / self.episodes,
            "success_rate_low95": low,
            "success_rate_high95": high,
            **{
                metric: extremes[side][value]
                for metric, (value, side) in context.check.summaries.items()
            },
            "waypoint_error_max_m": self.high["waypoint_error_m"],
            "peak_contacts_per_world": int(self.high["peak_contacts"]),
            "peak_constraint_rows_per_world": int(self.high["peak_constraint_rows"]),
            **(
                {f"seed{seed}.succeeded": count for seed, count in self.per_seed.items()}
                if self.several
                else {}
            ),
            **{f"failed.{rule}": len(names) for rule, names in self.broken.items()},
        }

    @property
    def summary(self) -> str:
        """The success rate in words."""
        low, high = wilson_interval(self.good, self.episodes)
        rate = format_percent(self.good / self.episodes)
        return (
            f"{self.good} of {self.episodes} {self.noun} succeeded ({rate}, 95 % interval"
            f" {format_percent(low, '')} to {format_percent(high)})"
        )

    @property
    def failures(self) -> str:
        """The failing episodes and their rules in words; empty without any."""
        if not self.failed:
            return ""
        counts = "; ".join(
            f"{self.rules.texts[rule]} in {len(names)}" for rule, names in self.broken.items()
        )
        return f"{name_worlds(self.failed, self.episodes, what=self.noun)} failed: {counts}"

    def all_details(self, context: RunContext) -> list[str]:
        """Lines of the report: the failing episodes by rule, and remarks."""
        named = [(self.rules.texts[rule], names) for rule, names in self.broken.items()]
        if self.unreachable:
            named.insert(0, ("target out of reach", self.unreachable))
        lines = [
            f"{text}: {name_worlds(names, self.episodes, _NAMED, self.noun)}"
            for text, names in named
        ] + self.details
        if self.failed and context.folder is not None:
            table = failing_name(context, self.gate)
            lines.append(f"{table} has every failing episode with what was measured")
        return lines

    def way_to_look(self, context: RunContext) -> str:
        """The command that replays a failing episode; empty if there is none."""
        if not self.failed or context.folder is None:
            return ""
        named = "" if failing_name(context, self.gate) == FAILING else f"{self.gate}:"
        return f". To look at one: job=replay run={context.folder} world={named}{self.failed[0]}"

    def tables(self) -> list[Table]:
        """Tables of the report: seeds, and first signs of failure."""
        tables = []
        if self.several:
            header = ["seed", "episodes", "succeeded", "rate", "95 % interval"]
            rows = [
                [str(seed), str(len(good)), str(good.sum()), *rate_cells(good.sum(), len(good))]
                for seed, good in zip(self.seeds, self.succeeded, strict=True)
            ]
            tables.append(Table(title="Seeds", header=header, rows=rows))
        signs: dict[tuple[int, int], list[str]] = {}
        phases: list[str] = []
        for seed, kept, good in zip(
            self.seeds, self.circumstances, self.succeeded, strict=bool(self.circumstances)
        ):
            phases = kept.phases
            for world in np.flatnonzero(~good).tolist():
                key = int(kept.phase[world]), int(kept.sign[world])
                signs.setdefault(key, []).extend(self.names(seed, [world]))
        if signs:
            rows = [
                [
                    describe_sign(sign, phases[phase] if phase >= 0 else ""),
                    str(len(names)),
                    ", ".join(names[:8]) + (", ..." if len(names) > 8 else ""),
                ]
                for (phase, sign), names in sorted(signs.items())
            ]
            header = ["first sign of failure", "failed episodes", "which"]
            tables.append(Table(title="Where it went wrong", header=header, rows=rows))
        return tables


def rate_cells(k: int, n: int) -> list[str]:
    """A rate and its interval as two cells."""
    low, high = wilson_interval(k, n)
    return [f"{100.0 * k / n:.1f} %", f"{100.0 * low:.1f} to {100.0 * high:.1f} %"]


def failing_name(context: RunContext, gate: str) -> str:
    """Name of a gate's table of failing episodes."""
    return SUCCESS_FAILING if gate != "batch" and "batch" in context.cfg.gates else FAILING
