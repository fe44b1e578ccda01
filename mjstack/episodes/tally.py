"""Sums over a gate's episodes, and their report."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from mjstack.config.explain import assign, command
from mjstack.episodes.failures import describe_sign
from mjstack.episodes.record import FAILING, EpisodeRecord
from mjstack.episodes.rollout import Episode
from mjstack.errors import name_worlds
from mjstack.files import to_csv
from mjstack.math import rate_interval, wilson_interval
from mjstack.report.figure import Figure, figures
from mjstack.report.record import GateResult, Status
from mjstack.report.table import Table
from mjstack.report.text import format_percent
from mjstack.report.write import safely_write
from mjstack.tasks.check import EpisodeCheck

_MOST_NAMED = 100  # episodes a line in report.md; the table of failing ones has all


@dataclass(eq=False, kw_only=True, slots=True)
class EpisodeTally:
    """The records of a gate's seeds, and what they add up to.

    Attributes:
        gate: Whose episodes.
        noun: The things that are counted, such as ``worlds``.
        several: Whether there are several seeds; then an episode's name has its seed.
        check: The task's.
        path: The file of failing episodes; None where nothing is written.
        replayed: Whether job=replay takes the run.
        records: Those of the seeds, without ``qpos``; ``end`` is its hash for each world.
        first: The first seed's episode, of this rank's worlds; None where the seed was read back.
        again: Seeds that an earlier call has played.
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
    records: list[EpisodeRecord] = field(default_factory=list)
    first: Episode | None = None
    again: list[int] = field(default_factory=list)
    notes: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    details: list[str] = field(default_factory=list)

    def add(self, record: EpisodeRecord) -> None:
        """Count one seed. Of a world 200 to 300 bytes are kept, without its final positions."""
        # Rounded: on CUDA identical worlds differ in the last digits. Plus 0: -0 is the same as 0.
        rounded = np.round(record.qpos, 4) + 0.0
        worlds = record.worlds | {"end": np.array([hash(row.tobytes()) for row in rounded])}
        del worlds["qpos"]
        self.records.append(replace(record, worlds=worlds))

    def array(self, name: str) -> np.ndarray:
        """An array of `EpisodeRecord.worlds` over the episodes of all seeds."""
        return np.concatenate([record.worlds[name] for record in self.records])

    @property
    def values(self) -> dict[str, np.ndarray]:
        """The measurements of the check over the episodes of all seeds, by name with unit."""
        return {name: self.array(f"value.{name}") for name in self.records[0].values}

    @property
    def places(self) -> dict[str, np.ndarray]:
        """Where each object started, and all else that did not start the same in every episode, as
        of `start_places`, over the episodes of all seeds.
        """
        names = self.records[0].object_names
        rows = self.array("start_places").swapaxes(0, 1) if names else ()
        movable = self.check.cfg.scene.free
        return {
            name: places
            for name, places in zip(names, rows, strict=True)
            if name in movable or np.ptp(np.nan_to_num(places), 0).any()
        }

    @property
    def episodes(self) -> int:
        """Number of episodes played."""
        return sum(len(record.failed) for record in self.records)

    @property
    def successes(self) -> int:
        """Number of episodes that succeeded."""
        return sum(int(record.succeeded.sum()) for record in self.records)

    @property
    def seconds(self) -> float:
        """Wall time of the steps [s]."""
        return sum(record.seconds for record in self.records)

    def names(self, episodes: Sequence[int] | np.ndarray) -> list[str]:
        """Names of episodes, counted over all seeds, as ``world=`` of job=replay takes them."""
        seeds = [f"{record.seed}:" if self.several else "" for record in self.records]
        places = (divmod(episode, len(self.records[0].failed)) for episode in episodes)
        return [f"{seeds[seed]}{world}" for seed, world in places]

    def write_failing(self) -> None:
        """Write the table of failing episodes, if any. A full disk takes no result back."""
        rows = []
        places = self.places
        for number, record in enumerate(self.records):
            share = slice(number * len(record.failed), (number + 1) * len(record.failed))
            starts = {name: values[share] for name, values in places.items()}
            rows += record.failing_rows(self.check.rules, starts)
        if rows and self.path is not None:
            problem = safely_write(self.path, Path.write_text, to_csv(rows), stops=False)
            has = f"{self.path.name} has every failing episode with what was measured"
            self.details.append(problem or has)

    def figures(self, rate: float) -> list[Figure]:
        """Counts, the success rate with its interval and the least one that is wanted, and the
        extremes of what was measured.
        """
        counts = figures(
            worlds=len(self.records[0].failed), seeds=len(self.records), episodes=self.episodes
        )
        rates = rate_metrics(self.successes, self.episodes)
        success = Figure("success_rate", rates.pop("success_rate"), low=rate)
        measured = [*counts, success, *figures(**rates)]
        # NaN, which a diverged world has, is handed on
        values = self.values
        for name, (key, side) in self.check.summaries.items():
            value = float(getattr(values[key], side)())
            measured.append(replace(self.check.figures[key], name=name, value=value))
        ik_error = float(self.array("measured.ik_error_m").max())
        measured.append(Figure("ik_error_max", ik_error, "m"))
        for name in ("contacts", "constraint_rows"):
            peak = int(self.array(f"measured.peak_{name}").max())
            measured.append(Figure(f"peak_{name}_per_world", peak))
        if self.several:
            for record in self.records:
                measured += figures(f"seed{record.seed}", succeeded=int(record.succeeded.sum()))
        broken = self.check.rules.failing(self.array("failed"))
        return measured + figures("failed", **{rule: len(which) for rule, which in broken.items()})

    @property
    def summary(self) -> str:
        """The success rate in words."""
        low, high = wilson_interval(self.successes, self.episodes)
        rate = format_percent(self.successes / self.episodes)
        return (
            f"{self.successes} of {self.episodes} {self.noun} succeeded ({rate}, 95 % interval"
            f" {format_percent(low, '')} to {format_percent(high)})"
        )

    def result(
        self,
        parts: Sequence[str],
        *,
        passed: bool,
        figures: Sequence[Figure],
        rate: float = -math.inf,
        tables: Sequence[Table] = (),
    ) -> GateResult:
        """The episodes as the gate's result, in words (``parts``) before failures and problems;
        with a problem it has failed. Figures and tables add to those of the tally and the check.
        ``rate`` is the least success rate that is wanted.
        """
        bits = self.array("failed")
        failed = np.flatnonzero(bits)
        texts = self.check.rules.texts
        which = self.check.rules.failing(bits)
        broken = {texts[rule]: episodes for rule, episodes in which.items()}
        why, beyond = self.check.why(bits, self.values)
        reason = [*parts]
        if len(failed):
            counts = "; ".join(f"{texts[n]} in {len(which[n])}{words}" for n, words in why.items())
            reason.append(f"{self._name(failed, 8)} failed: {counts}")
        look = ""
        if len(failed) and self.path is not None and self.replayed:
            gate = "" if self.path.name == FAILING else f"{self.gate}:"
            world = f"world={gate}{self.names(failed[:1])[0]}"
            look = command("job=replay", assign("run", self.path.parent), world)
            look = f". To look at one: {look}"
        if "sign" in self.records[0].worlds and self.array("unreachable").any():
            unreachable = np.flatnonzero(self.array("unreachable"))
            broken = {"target out of reach": unreachable.tolist()} | broken
        named = [f"{text}: {self._name(which, _MOST_NAMED)}" for text, which in broken.items()]
        return GateResult(
            name=self.gate,
            status=Status.passed if passed and not self.problems else Status.failed,
            reason="; ".join([*reason, *self.problems]) + look,
            figures=[*self.check.thresholds(), *self.figures(rate), *figures],
            beyond=beyond,
            notes=self.notes,
            details=named + self.details,
            tables=[*self.tables(), *tables],
        )

    def _name(self, episodes: Sequence[int] | np.ndarray, limit: int) -> str:
        """How many episodes, and the names of the first ones."""
        return name_worlds(self.names(episodes), self.episodes, limit, self.noun)

    def tables(self) -> list[Table]:
        """Tables of the report: seeds, and first signs of failure."""
        tables = []
        last = self.records[-1]
        if self.several:
            header = ["seed", "episodes", "succeeded", "rate", "95 % interval"]
            counts = [(r.seed, len(r.failed), int(r.succeeded.sum())) for r in self.records]
            rows = [[str(seed), str(n), str(k), *rate_cells(k, n)] for seed, n, k in counts]
            tables.append(Table(title="Seeds", header=header, rows=rows))
        failed = np.flatnonzero(self.array("failed"))
        if "sign" in last.worlds and len(failed):
            signs: dict[tuple[int, int, str], list[str]] = {}
            keys = (self.array(name)[failed].tolist() for name in ("sign_phase", "sign", "failed"))
            for name, phase, sign, bits in zip(self.names(failed), *keys, strict=True):
                # Where there is no sign, the rules say more.
                rules = "" if sign else f": {self.check.rules.describe(bits)}"
                signs.setdefault((phase, sign, rules), []).append(name)
            phases = [*last.phase_names, ""]  # the last one for no sign, -1
            rows = [
                [
                    describe_sign(sign, phases[phase]) + rules,
                    str(len(names)),
                    ", ".join(names[:8]) + (", ..." if len(names) > 8 else ""),
                ]
                for (phase, sign, rules), names in sorted(signs.items())
            ]
            header = ["first sign of failure", "failed episodes", "which"]
            tables.append(Table(title="Where it went wrong", header=header, rows=rows))
        return tables


def rate_metrics(succeeded: int, episodes: int) -> dict[str, float]:
    """A number of successes, and their rate with its 95 % interval, by name."""
    return {"succeeded": succeeded} | rate_interval("success_rate", succeeded, episodes)


def rate_cells(k: int, n: int) -> list[str]:
    """A rate and its interval as two cells."""
    low, high = wilson_interval(k, n)
    return [f"{100.0 * k / n:.1f} %", f"{100.0 * low:.1f} to {100.0 * high:.1f} %"]
