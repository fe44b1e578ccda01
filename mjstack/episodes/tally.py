"""Sums over a gate's episodes, and their report."""

import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mjstack.config.session import search_path_args
from mjstack.episodes.failures import describe_sign
from mjstack.episodes.record import CIRCUMSTANCES, FAILING, EpisodeRecord
from mjstack.episodes.rollout import Episode
from mjstack.errors import name_worlds
from mjstack.files import to_csv
from mjstack.math import wilson_interval
from mjstack.report.record import GateResult, Status
from mjstack.report.table import Table
from mjstack.report.text import format_percent
from mjstack.report.write import safely_write
from mjstack.tasks.check import EpisodeCheck

_MOST_PLOTTED = 20_000  # episodes on the page; of more, the failing ones
_MOST_NAMED = 100  # episodes a line in report.md; the table of failing ones has all


@dataclass(eq=False, kw_only=True, slots=True)
class EpisodeTally:
    """Sums over the seeds: numbers, and the failing episodes by name.

    Attributes:
        gate: Whose episodes.
        noun: The things that are counted, such as ``worlds``.
        several: Whether there are several seeds; then an episode's name has its seed.
        check: The task's.
        path: The file of failing episodes; None where nothing is written.
        replayed: Whether job=replay takes the run.
        seeds: Those that were played.
        succeeded: For each seed, which worlds succeeded, shape ``(nworld,)``, bool.
        circumstances: For each seed, if they were recorded, by name.
        object_names: Names of the objects of circumstances.
        phase_names: Names of the phases of circumstances.
        plotted: Episodes that the run's page plots: seed, worlds, their bits, values and starts.
        failed: Names of the failing episodes.
        broken: The same by the name of the rule that was broken.
        unreachable: Names of the episodes with a target out of reach.
        low: Smallest of everything measured, by name.
        high: Largest of everything measured, by name.
        ends: Hashes of the final states, an array for each seed.
        rows: Cells of the table of failing episodes, by column.
        seconds: Wall time of the steps [s].
        steps: Physics steps of all worlds.
        first: The first seed's episode, of this rank's worlds; None where the seed was read back.
        again: Seeds that an earlier call has played.
        places: Where worlds were played: the host and device of each rank, by its first world.
        notes: Backend and buffer sizes in words.
        problems: Why the gate fails at any rate of success.
        details: Remarks.
    """

    gate: str
    noun: str
    several: bool
    check: EpisodeCheck
    path: Path | None
    replayed: bool
    seeds: list[int] = field(default_factory=list)
    succeeded: list[np.ndarray] = field(default_factory=list)
    circumstances: list[dict[str, np.ndarray]] = field(default_factory=list)
    object_names: list[str] = field(default_factory=list)
    phase_names: list[str] = field(default_factory=list)
    plotted: list[tuple[int, np.ndarray, dict[str, np.ndarray]]] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    broken: dict[str, list[str]] = field(default_factory=dict)
    unreachable: list[str] = field(default_factory=list)
    low: dict[str, float] = field(default_factory=dict)
    high: dict[str, float] = field(default_factory=dict)
    ends: list[np.ndarray] = field(default_factory=list)
    rows: list[dict[str, object]] = field(default_factory=list)
    seconds: float = 0.0
    steps: int = 0
    first: Episode | None = None
    again: list[int] = field(default_factory=list)
    places: dict[int, str] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    details: list[str] = field(default_factory=list)

    @property
    def episodes(self) -> int:
        """Number of episodes played."""
        return sum(len(succeeded) for succeeded in self.succeeded)

    @property
    def successes(self) -> int:
        """Number of episodes that succeeded."""
        return self.episodes - len(self.failed)

    @property
    def distinct_ends(self) -> int:
        """Number of distinct final states."""
        return len(np.unique(np.concatenate(self.ends)))

    def add(self, record: EpisodeRecord) -> None:
        """Count one seed. Some 9 bytes of a world that has not failed are kept, and its
        circumstances.
        """
        self.seeds.append(record.seed)
        self.succeeded.append(record.succeeded)
        self.seconds += record.seconds
        self.steps += record.steps
        self.places = record.ranks
        self.failed += self.names(record.seed, np.flatnonzero(record.failed).tolist())
        for rule, worlds in self.check.rules.failing(record.failed).items():
            self.broken.setdefault(rule, []).extend(self.names(record.seed, worlds))
        self.rows += record.failing_rows(self.check.rules)
        room = max(0, _MOST_PLOTTED - sum(len(worlds) for _, worlds, _ in self.plotted))
        plotted = np.flatnonzero((record.failed != 0) | (np.arange(len(record.failed)) < room))
        measured = record.named("value")
        arrays = {"failed": record.failed, "start": record.start, **measured}
        self.plotted.append((record.seed, plotted, {k: v[plotted] for k, v in arrays.items()}))
        if "sign" in record.worlds:
            self.object_names = record.object_names
            self.phase_names = record.phase_names
            self.circumstances.append({name: record.worlds[name] for name in CIRCUMSTANCES})
            unreachable = np.flatnonzero(record.worlds["unreachable"]).tolist()
            self.unreachable += self.names(record.seed, unreachable)
        # NaN, which a diverged world has, is handed on
        for name, values in (measured | record.named("measured")).items():
            self.low[name] = float(np.minimum(self.low.get(name, math.inf), values.min()))
            self.high[name] = float(np.maximum(self.high.get(name, -math.inf), values.max()))
        # Rounded: on CUDA even identical worlds differ in the last digits. Adding 0 makes -0 the
        # same as 0.
        rounded = np.round(record.qpos, 4) + 0.0
        self.ends.append(np.array([hash(row.tobytes()) for row in rounded]))

    def write_failing(self) -> None:
        """Write the table of failing episodes, if there are any. A full disk takes no result
        back.
        """
        if self.rows and self.path is not None:
            text = to_csv(self.rows)
            problem = safely_write(self.path, Path.write_text, text, stops=False)
            has = f"{self.path.name} has every failing episode with what was measured"
            self.details.append(problem or has)

    def names(self, seed: int, worlds: Sequence[int]) -> list[str]:
        """Names of a seed's episodes, as ``world=`` of job=replay takes them."""
        return [f"{seed}:{world}" if self.several else str(world) for world in worlds]

    def metrics(self) -> dict[str, float]:
        """Counts, the success rate with its interval, and the extremes of what was measured."""
        metrics: dict[str, float] = {
            "worlds": len(self.succeeded[0]),
            "seeds": len(self.seeds),
            "episodes": self.episodes,
            **rate_metrics(self.successes, self.episodes),
        }
        for metric, (value, side) in self.check.summaries.items():
            metrics[metric] = (self.low if side == "min" else self.high)[value]
        metrics["waypoint_error_max_m"] = self.high["waypoint_error_m"]
        for name in ("contacts", "constraint_rows"):
            metrics[f"peak_{name}_per_world"] = int(self.high[f"peak_{name}"])
        if self.several:
            for seed, succeeded in zip(self.seeds, self.succeeded, strict=True):
                metrics[f"seed{seed}.succeeded"] = int(succeeded.sum())
        return metrics | {f"failed.{rule}": len(names) for rule, names in self.broken.items()}

    @property
    def summary(self) -> str:
        """The success rate in words."""
        low, high = wilson_interval(self.successes, self.episodes)
        rate = format_percent(self.successes / self.episodes)
        return (
            f"{self.successes} of {self.episodes} {self.noun} succeeded ({rate}, 95 % interval"
            f" {format_percent(low, '')} to {format_percent(high)})"
        )

    @property
    def failures(self) -> str:
        """The failing episodes and their rules in words; empty without any."""
        if not self.failed:
            return ""
        counts = "; ".join(
            f"{self.check.rules.texts[rule]} in {len(names)}" for rule, names in self.broken.items()
        )
        return f"{name_worlds(self.failed, self.episodes, what=self.noun)} failed: {counts}"

    def all_details(self) -> list[str]:
        """Lines of the report: the failing episodes by rule, and remarks."""
        named = [("target out of reach", self.unreachable)] if self.unreachable else []
        named += [(self.check.rules.texts[rule], names) for rule, names in self.broken.items()]
        return [
            f"{text}: {name_worlds(names, self.episodes, _MOST_NAMED, self.noun)}"
            for text, names in named
        ] + self.details

    @property
    def way_to_look(self) -> str:
        """The command that replays a failing episode; empty if there is none."""
        if not self.failed or self.path is None or not self.replayed:
            return ""
        gate = "" if self.path.name == FAILING else f"{self.gate}:"
        run = shlex.join([*search_path_args(), "job=replay", f"run={self.path.parent}"])
        return f". To look at one: {run} world={gate}{self.failed[0]}"

    def result(
        self,
        parts: Sequence[str],
        *,
        passed: bool,
        metrics: dict[str, float],
        thresholds: dict[str, float],
        tables: Sequence[Table] = (),
    ) -> GateResult:
        """The episodes as the gate's result; with a problem it has failed.

        Args:
            parts: The result in words, before failures and problems.
            passed: Whether enough episodes succeeded.
            metrics: More of them than `metrics`.
            thresholds: More of them than the check's.
            tables: More of them than `tables`.
        """
        return GateResult(
            name=self.gate,
            status=Status.passed if passed and not self.problems else Status.failed,
            reason="; ".join(filter(None, [*parts, self.failures, *self.problems]))
            + self.way_to_look,
            thresholds=self.check.thresholds() | thresholds,
            metrics=self.metrics() | metrics,
            notes=self.notes,
            details=self.all_details(),
            tables=[*self.tables(), *tables],
        )

    def tables(self) -> list[Table]:
        """Tables of the report: seeds, and first signs of failure."""
        tables = []
        if self.places:
            firsts = [*self.places, len(self.succeeded[0])]
            rows = [
                [f"{first:,} to {end - 1:,}", where]
                for (first, where), end in zip(self.places.items(), firsts[1:], strict=True)
            ]
            title = f"Which rank played which world (seed {self.seeds[-1]})"
            tables.append(Table(title=title, header=["worlds", "where"], rows=rows))
        if self.several:
            header = ["seed", "episodes", "succeeded", "rate", "95 % interval"]
            rows = [
                [str(seed), str(len(flags)), str(flags.sum()), *rate_cells(flags.sum(), len(flags))]
                for seed, flags in zip(self.seeds, self.succeeded, strict=True)
            ]
            tables.append(Table(title="Seeds", header=header, rows=rows))
        signs: dict[tuple[int, int], list[str]] = {}
        for seed, arrays, succeeded in zip(
            self.seeds, self.circumstances, self.succeeded, strict=False
        ):
            for world in np.flatnonzero(~succeeded).tolist():
                key = int(arrays["sign_phase"][world]), int(arrays["sign"][world])
                signs.setdefault(key, []).extend(self.names(seed, [world]))
        if signs:
            phases = [*self.phase_names, ""]  # the last one for no sign, -1
            rows = [
                [
                    describe_sign(sign, phases[phase]),
                    str(len(names)),
                    ", ".join(names[:8]) + (", ..." if len(names) > 8 else ""),
                ]
                for (phase, sign), names in sorted(signs.items())
            ]
            header = ["first sign of failure", "failed episodes", "which"]
            tables.append(Table(title="Where it went wrong", header=header, rows=rows))
        return tables


def rate_metrics(succeeded: int, episodes: int) -> dict[str, float]:
    """A success rate with its 95 % interval, by name."""
    low, high = wilson_interval(succeeded, episodes)
    return {
        "succeeded": succeeded,
        "success_rate": succeeded / episodes,
        "success_rate_low95": low,
        "success_rate_high95": high,
    }


def rate_cells(k: int, n: int) -> list[str]:
    """A rate and its interval as two cells."""
    low, high = wilson_interval(k, n)
    return [f"{100.0 * k / n:.1f} %", f"{100.0 * low:.1f} to {100.0 * high:.1f} %"]
