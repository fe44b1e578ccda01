"""Episodes of a gate, played and counted seed after seed, and the record of each seed."""

import itertools
import logging
import math
import shlex
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from mjstack.config.session import search_path_args
from mjstack.episodes.context import RunContext
from mjstack.episodes.failures import FailureMonitor, describe_sign
from mjstack.episodes.motion import MotionRecorder, records_motion, restore_batch, show_batch
from mjstack.episodes.record import FAILING, SUCCESS_FAILING, Circumstances, EpisodeRecord
from mjstack.episodes.rollout import Episode, Observer
from mjstack.errors import RunError, first_line, name_worlds
from mjstack.files import to_csv
from mjstack.interrupt import check_interrupt
from mjstack.math import wilson_interval
from mjstack.report.html import Worlds
from mjstack.report.record import GateResult, Status
from mjstack.report.svg import Map
from mjstack.report.table import Table
from mjstack.report.write import format_percent, safely_write
from mjstack.sim import Simulation
from mjstack.tasks.check import EpisodeCheck

log = logging.getLogger(__name__)
_SHOWN = 20_000  # episodes on the page; of more, the failing ones
_NAMED = 100  # episodes a line in report.md; the table of failing ones has all


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
        circumstances: For each seed, if they were recorded.
        shown: Episodes that the run's page shows: seed, worlds, and their bits, values and starts.
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
    circumstances: list[Circumstances] = field(default_factory=list)
    shown: list[tuple[int, np.ndarray, dict[str, np.ndarray]]] = field(default_factory=list)
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
    def good(self) -> int:
        """Number of episodes that succeeded."""
        return self.episodes - len(self.failed)

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the success rate."""
        return wilson_interval(self.good, self.episodes)

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
        room = max(0, _SHOWN - sum(len(worlds) for _, worlds, _ in self.shown))
        shown = np.flatnonzero((record.failed != 0) | (np.arange(len(record.failed)) < room))
        held = {"failed": record.failed, "start": record.start, **record.values}
        self.shown.append((record.seed, shown, {k: v[shown] for k, v in held.items()}))
        if record.circumstances is not None:
            self.circumstances.append(record.circumstances)
            out = np.flatnonzero(record.circumstances.unreachable).tolist()
            self.unreachable += self.names(record.seed, out)
        for name, values in (
            record.values | record.measured
        ).items():  # NaN, which a diverged world has, is handed on
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
        low, high = self.interval
        metrics: dict[str, float] = {
            "worlds": len(self.succeeded[0]),
            "seeds": len(self.seeds),
            "episodes": self.episodes,
            "succeeded": self.good,
            "success_rate": self.good / self.episodes,
            "success_rate_low95": low,
            "success_rate_high95": high,
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
        low, high = self.interval
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
            f"{self.check.rules.texts[rule]} in {len(names)}" for rule, names in self.broken.items()
        )
        return f"{name_worlds(self.failed, self.episodes, what=self.noun)} failed: {counts}"

    def all_details(self) -> list[str]:
        """Lines of the report: the failing episodes by rule, and remarks."""
        named = [("target out of reach", self.unreachable)] if self.unreachable else []
        named += [(self.check.rules.texts[rule], names) for rule, names in self.broken.items()]
        return [
            f"{text}: {name_worlds(names, self.episodes, _NAMED, self.noun)}"
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
        good: bool,
        metrics: dict[str, float],
        thresholds: dict[str, float],
        tables: Sequence[Table] = (),
    ) -> GateResult:
        """The episodes as the gate's result; with a problem it has failed.

        Args:
            parts: The result in words, before failures and problems.
            good: Whether enough episodes succeeded.
            metrics: More of them than `metrics`.
            thresholds: More of them than the check's.
            tables: More of them than `tables`.
        """
        return GateResult(
            name=self.gate,
            status=Status.passed if good and not self.problems else Status.failed,
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
            worlds = len(self.succeeded[0])
            rows = [
                [f"{first:,} to {end - 1:,}", where]
                for (first, where), end in zip(
                    self.places.items(), [*list(self.places)[1:], worlds], strict=True
                )
            ]
            title = f"Which rank played which world (seed {self.seeds[-1]})"
            tables.append(Table(title=title, header=["worlds", "where"], rows=rows))
        if self.several:
            header = ["seed", "episodes", "succeeded", "rate", "95 % interval"]
            rows = [
                [str(seed), str(len(good)), str(good.sum()), *rate_cells(good.sum(), len(good))]
                for seed, good in zip(self.seeds, self.succeeded, strict=True)
            ]
            tables.append(Table(title="Seeds", header=header, rows=rows))
        signs: dict[tuple[int, int], list[str]] = {}
        for seed, kept, good in zip(self.seeds, self.circumstances, self.succeeded, strict=False):
            for world in np.flatnonzero(~good).tolist():
                key = int(kept.sign_phase[world]), int(kept.sign[world])
                signs.setdefault(key, []).extend(self.names(seed, [world]))
        if signs:
            phases = [*self.circumstances[0].phase_names, ""]  # the last one for no sign, -1
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


def play_seeds(
    context: RunContext,
    gate: str,
    *,
    count: int,
    noun: str,
    circumstances: bool = False,
    observers: Callable[[int], Sequence[Observer]],
) -> EpisodeTally:
    """Play seed after seed in as many worlds as are configured, and record each.

    A seed that breaks ends it, and those before it still count; the first one's error is raised.

    Args:
        context: The run.
        gate: The gate, which names the files.
        count: Number of seeds, from the configured one on.
        noun: The things that are counted, such as ``worlds``.
        circumstances: Whether starts and signs of failure are recorded too.
        observers: More observers, by seed.
    """
    # The tally, and the worlds
    cfg = context.cfg
    folder = context.folder
    name = SUCCESS_FAILING if gate != "batch" and "batch" in cfg.gates else FAILING
    tally = EpisodeTally(
        gate=gate,
        noun=noun,
        several=count > 1,
        check=context.check,
        path=None if folder is None else folder / name,
        replayed=cfg.job.name == "gates",
    )
    ranks = context.ranks
    sim = context.batch_simulation(len(context.worlds))
    tally.notes = {
        "backend": sim.description,
        "sizes": str(sim.sizes or "native MuJoCo has no fixed buffers"),
    }

    # Seed after seed
    records = records_motion(context)
    last = cfg.seed + count - 1
    try:
        for seed in range(cfg.seed, last + 1):
            try:
                record = ranks.from_first(partial(_read, context, gate, seed))
                recorders = []
                if record is None:
                    monitors = [FailureMonitor()] if circumstances else []
                    recorders = [MotionRecorder()] if records and seed == cfg.seed else []
                    looking = [*monitors, *observers(seed), *recorders, *context.spectators]
                    episode = context.play(
                        sim, cfg.reset, looking, seed=seed, worlds=context.worlds
                    )
                    part = _record(context, sim, seed, episode, monitors)
                    record = EpisodeRecord.join(ranks.gather(part))
                    tally.first = episode if tally.first is None else tally.first
                else:
                    tally.again.append(seed)
                    if records and seed == cfg.seed:
                        restore_batch(context, gate)
                tally.add(record)
            except Exception as error:
                check_interrupt()
                if not tally.seeds or ranks.size > 1:
                    raise
                log.exception("seed %d broke", seed)
                why = first_line(error)
                left = f"seed {seed}" if seed == last else f"seeds {seed} to {last}"
                tally.problems.append(f"{left} not played: {why} (run.log has the traceback)")
                break
            if seed not in tally.again:
                _write(record, tally)
            for recorder in recorders:
                show_batch(context, gate, recorder, record.failed)
            if count > 1:
                context.print_line(
                    f"{gate}, seed {seed}: {int(record.succeeded.sum())} of {cfg.nworld} worlds"
                    f" succeeded, {tally.good} of {tally.episodes} so far"
                )
    finally:
        sim.close()
        tally.write_failing()  # once: its rows grow with the seeds
    if tally.again:
        seeds = ", ".join(_runs(tally.again))
        tally.details.append(f"an earlier call has played seeds {seeds}")
    if cfg.nworld > 1:
        context.page.worlds[gate] = _worlds(tally, context)
    return tally


def _worlds(tally: EpisodeTally, context: RunContext) -> Worlds:
    """The episodes as the run's page plots them."""
    scene = context.cfg.scene
    table = (scene.table_center[:2], scene.table_half[:2])
    rules = tally.check.rules
    held = {
        name: np.concatenate([values[name] for _, _, values in tally.shown])
        for name in tally.shown[0][2]
    }
    start = held.pop("start")
    bits = held.pop("failed").tolist()
    if len(bits) < tally.episodes:
        tally.details.append(
            f"report.html shows {len(bits):,} of the {tally.episodes:,} {tally.noun}: the first"
            " ones, and all that failed"
        )
    worlds = Worlds(
        names=[n for seed, which, _ in tally.shown for n in tally.names(seed, which.tolist())],
        broken=[rules.broken(failed) if failed else [] for failed in bits],
        rules=rules.texts,
        values=held,
    )
    moving = [world for world in context.page.worlds3d.get(tally.gate, []) if not world.twin]
    for name, (at, _) in context.index.objects.items():
        xy = slice(at, at + 2)
        ways = [(world.label, world.failed, world.qpos[:, xy]) for world in moving]
        worlds.maps.append(Map(title=name, xy=start[:, xy], table=table, ways=ways))
    return worlds


def _read(context: RunContext, gate: str, seed: int) -> EpisodeRecord | None:
    """The results of a seed that an earlier call of the run has left."""
    if context.cfg.resume is None or context.folder is None:
        return None
    record = EpisodeRecord.read(context.folder, seed, gate, whole=True)
    if record is not None and len(record.failed) != context.cfg.nworld:
        raise RunError(
            f"resume={context.folder}: has {len(record.failed)} worlds of seed {seed}, expected"
            f" {context.cfg.nworld}. Name another folder."
        )
    return record


def _record(
    context: RunContext,
    sim: Simulation,
    seed: int,
    episode: Episode,
    monitors: Sequence[FailureMonitor],
) -> EpisodeRecord:
    """The record of this rank's worlds."""
    place = f"rank {context.ranks.rank}: {socket.gethostname()}, {sim.device}"
    return EpisodeRecord(
        seed=seed,
        backend=sim.backend,
        device=str(sim.device),
        failed=episode.failed,
        values=episode.values,
        qpos=sim.qpos.cpu().numpy().copy(),
        start=episode.start,
        circumstances=Circumstances.of(episode, monitors[0]) if monitors else None,
        measured={
            "waypoint_error_m": episode.waypoint_error,
            "peak_contacts": sim.peak_contacts.cpu().numpy().copy(),
            "peak_constraint_rows": sim.peak_constraints.cpu().numpy().copy(),
        },
        seconds=episode.timing.seconds,
        steps=int(sim.step_count.sum()),
        ranks={context.worlds.start: place} if context.ranks.size > 1 else {},
    )


def _runs(numbers: Sequence[int]) -> Iterator[str]:
    """Ascending numbers in words, neighbours as ``3 to 7``."""
    for _, group in itertools.groupby(enumerate(numbers), lambda pair: pair[1] - pair[0]):
        run = [number for _, number in group]
        yield str(run[0]) if len(run) == 1 else f"{run[0]} to {run[-1]}"


def _write(record: EpisodeRecord, tally: EpisodeTally) -> None:
    """Write the seed's record, before the next one can break or be stopped. A full disk takes no
    result back.
    """
    if tally.path is None:
        return
    try:
        record.write(tally.path.parent, tally.gate)
    except OSError as error:
        log.exception("the record of seed %d was not written", record.seed)
        tally.details.append(
            f"seed {record.seed}: no record of its {tally.noun} could be written ({error.strerror})"
        )


def rate_cells(k: int, n: int) -> list[str]:
    """A rate and its interval as two cells."""
    low, high = wilson_interval(k, n)
    return [f"{100.0 * k / n:.1f} %", f"{100.0 * low:.1f} to {100.0 * high:.1f} %"]
