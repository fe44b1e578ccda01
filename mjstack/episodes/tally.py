"""Sums over a gate's episodes, and their report."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from mjstack.config.explain import assign, command
from mjstack.episodes.failures import Sign, describe_sign
from mjstack.episodes.record import EpisodeRecord
from mjstack.episodes.stage import Stage
from mjstack.errors import name_worlds
from mjstack.files import to_csv
from mjstack.math import rate_interval, wilson_interval
from mjstack.report.figure import Figure, figures
from mjstack.report.page import Map, World, Worlds
from mjstack.report.record import GateResult, Status
from mjstack.report.table import Table
from mjstack.report.text import format_percent
from mjstack.report.write import safely_write
from mjstack.tasks.check import EpisodeCheck

_MOST_NAMED = 100  # episodes a line in report.md; the table of failing ones has all
_MOST_PLOTTED = 20_000  # episodes on the page; of more, the failing ones


@dataclass(eq=False, kw_only=True, slots=True)
class EpisodeTally:
    """The records of a gate's seeds, and what they add up to.

    Attributes:
        gate: Whose episodes.
        check: The task's.
        folder: Where its files go; None where nothing is written.
        records: Those of the seeds, without ``qpos``; ``end`` is its hash for each world.
        notes: Backend and buffer sizes in words.
        problems: Why the gate fails at any rate of success.
        details: Remarks.
    """

    gate: str
    check: EpisodeCheck
    folder: Path | None
    records: list[EpisodeRecord] = field(default_factory=list)
    notes: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    details: list[str] = field(default_factory=list)

    @property
    def several(self) -> bool:
        """Whether there are several seeds; then an episode's name has its seed."""
        return self.check.cfg.gate[self.gate].seeds > 1

    def write(
        self, name: str, save: Callable[..., object], content: object, remark: str = ""
    ) -> None:
        """Write a file of the gate, if there is a folder, and add a remark, or the problem: a full
        disk takes no result back.
        """
        if self.folder is not None:
            problem = safely_write(self.folder / name, save, content, stops=False)
            self.details += filter(None, [problem or remark])

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
    def start_poses(self) -> dict[str, np.ndarray]:
        """Where each object started, and all else that did not start the same in every episode, as
        of `start_places`, over the episodes of all seeds.
        """
        names = self.records[0].object_names
        rows = self.array("start_places").swapaxes(0, 1) if names else ()
        movable = self.check.cfg.scene.free
        return {
            name: poses
            for name, poses in zip(names, rows, strict=True)
            if name in movable or np.ptp(np.nan_to_num(poses), 0).any()
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
        pairs = (divmod(episode, len(self.records[0].failed)) for episode in episodes)
        return [f"{seeds[seed]}{world}" for seed, world in pairs]

    def write_failing(self) -> None:
        """Write the table of failing episodes, if any: rules, signs, where objects were at the
        start, and all measurements.
        """
        rows = []
        failed = np.flatnonzero(self.array("failed")).tolist() if self.records else []
        poses = self.start_poses if failed else {}
        for episode in failed:
            number, world = divmod(episode, len(self.records[0].failed))
            record = self.records[number]
            values = {name: array[world] for name, array in record.worlds.items()}
            row: dict[str, object] = {"seed": record.seed, "world": world}
            row["rules"] = " ".join(self.check.rules.broken(values["failed"]))
            if "sign" in values:
                row["sign"] = Sign(values["sign"]).name
                row["phase"] = [*record.phase_names, ""][values["sign_phase"]]
                row["step"] = values["sign_step"] if values["sign_step"] >= 0 else ""
                row |= {"retries": values["retries"], "unreachable": int(values["unreachable"])}
            for name, starts in poses.items():
                cells = zip(("x_m", "y_m", "yaw_rad"), starts[episode], strict=True)
                row |= {f"{name}_{end}": f"{x:.6g}" for end, x in cells if not np.isnan(x)}
            row |= {name: f"{values[f'value.{name}']:.6g}" for name in record.values}
            rows.append(row)
        if rows:
            name = f"{self.gate}_failing.csv"
            remark = f"{name} has every failing episode with what was measured"
            self.write(name, Path.write_text, to_csv(rows), remark)

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
            f"{self.successes} of {self.episodes} episodes succeeded ({rate}, 95 % interval"
            f" {format_percent(low, '')} to {format_percent(high)})"
        )

    def result(
        self,
        sentences: Sequence[str],
        *,
        passed: bool,
        figures: Sequence[Figure],
        rate: float = -math.inf,
    ) -> GateResult:
        """The episodes as the gate's result, in words (``sentences``) before failures and problems;
        with a problem it has failed. Figures add to those of the tally and the check.
        ``rate`` is the least success rate that is wanted.
        """
        bits = self.array("failed")
        failed = np.flatnonzero(bits)
        texts = self.check.rules.texts
        which = self.check.rules.failing(bits)
        broken = {texts[rule]: episodes for rule, episodes in which.items()}
        why, beyond_keys = self.check.why(bits, self.values)
        reason = [*sentences]
        if len(failed):
            counts = "; ".join(
                f"{texts[n]} in {len(which[n])}{detail}" for n, detail in why.items()
            )
            reason.append(f"{self._name(failed, 8)} failed: {counts}")
        hint = ""
        cfg = self.check.cfg
        if len(failed) and self.folder is not None and cfg.job.name == "gates":
            gate = "" if self.gate == cfg.episode_gates[0] else f"{self.gate}:"
            world = f"world={gate}{self.names(failed[:1])[0]}"
            hint = command("job=replay", assign("run", self.folder), world)
            hint = f". To look at one: {hint}"
        if "sign" in self.records[0].worlds and self.array("unreachable").any():
            unreachable = np.flatnonzero(self.array("unreachable"))
            broken = {"target out of reach": unreachable.tolist()} | broken
        named = [f"{text}: {self._name(which, _MOST_NAMED)}" for text, which in broken.items()]
        return GateResult(
            name=self.gate,
            status=Status.passed if passed and not self.problems else Status.failed,
            reason="; ".join([*reason, *self.problems]) + hint,
            figures=[*self.check.thresholds(), *self.figures(rate), *figures],
            beyond=beyond_keys,
            notes=self.notes,
            details=named + self.details,
            tables=self.tables(),
        )

    def _name(self, episodes: Sequence[int] | np.ndarray, limit: int) -> str:
        """How many episodes, and the names of the first ones."""
        return name_worlds(self.names(episodes), self.episodes, limit, "episodes")

    def plot(self, stage: Stage, moving: Sequence[World]) -> Worlds:
        """The episodes as the run's page plots them, with the ways of objects in some of them."""
        scene = stage.cfg.scene
        table = (scene.table_center[:2], scene.table_half[:2])
        rules = self.check.rules
        bits = self.array("failed")
        plotted = np.flatnonzero((bits != 0) | (np.arange(len(bits)) < _MOST_PLOTTED))
        if len(plotted) < len(bits):
            self.details.append(
                f"report.html shows {len(plotted):,} of the {len(bits):,} episodes: the first ones,"
                " and all that failed"
            )
        worlds = Worlds(
            names=self.names(plotted),
            broken=[rules.broken(failed) for failed in bits[plotted].tolist()],
            rules=rules.texts,
            values=[(self.check.figures[key], v[plotted]) for key, v in self.values.items()],
        )
        # What the check judges, and what else differs
        index = stage.index
        judged = self.check.objects
        starts = self.start_poses
        marks = {name: place_cfg.xy for name, place_cfg in scene.places.items()}
        marks |= {name: at for name, at in index.fixed.items() if name in judged}
        marks = {name: at[:2] for name, at in marks.items() if name not in starts}
        for name, poses in starts.items():
            if name in index.objects and name not in judged:
                worlds.unjudged.append(name)
                continue
            paths = []
            if name in index.objects:
                x, _ = index.objects[name]
                paths = [(w.caption, bool(w.rules), w.qpos[:, x : x + 2]) for w in moving]
            xy = poses[plotted, :2]
            worlds.maps.append(
                Map(title=name, xy=xy, table=table, ways=paths, marks=marks, base=index.base)
            )
        return worlds

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
