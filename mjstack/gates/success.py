"""Gate *success*: how often the scripted controller that watches does the task from random starts,
and where it fails.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from mjstack.config.schema import Config
from mjstack.config.validate import places_objects, reads_starts_file
from mjstack.drivers.driver import Controller
from mjstack.envs import Env
from mjstack.episodes.batch_record import FAILING, write_failing
from mjstack.episodes.context import GateContext, play_seeds
from mjstack.episodes.failures import FailureMonitor, describe_sign
from mjstack.episodes.regions import Region, find_regions
from mjstack.episodes.rollout import CLOSED_LOOP, Observer
from mjstack.episodes.success_record import (
    BOTH,
    PICTURE,
    REGIONS,
    SuccessRecord,
    start_places,
    starts_name,
)
from mjstack.errors import MjstackError, name_worlds
from mjstack.files import to_csv, write_atomic
from mjstack.math import wilson_interval
from mjstack.mdp.starts.starts_file import write_starts
from mjstack.report.markdown import format_percent
from mjstack.report.record import GateResult, Status, Table
from mjstack.report.success import save_places
from mjstack.sim import Simulation
from mjstack.tasks.check import Rules

log = logging.getLogger(__name__)

_NAMED = 100  # episodes a line in report.md; the table of failing ones has all


def success_config(cfg: Config) -> Config:
    """The configuration under which the gate plays: its controller, and how its worlds start."""
    t = cfg.gate.success
    reset = dict(cfg.reset if reads_starts_file(cfg.reset) else t.reset)
    if t.region is not None:
        for name, term in reset.items():
            if places_objects(term):
                reset[name] = replace(term, params=term.params | {"xy": list(t.region)})
    return replace(cfg, reset=reset, controller=replace(cfg.controller, name=CLOSED_LOOP))


class _Starts(Observer):
    """Keeps how worlds start, and writes it down."""

    def __init__(self, path: Path | None) -> None:
        """``path`` of the starts file; None writes none."""
        self._path = path
        self.problem = ""

    def start(self, env: Env, driver: Controller) -> None:
        """See `Observer`."""
        self.places = start_places(env)
        if self._path is not None:
            try:
                write_starts(env, self._path)
            except MjstackError as error:  # a full disk, say: the episodes are played all the same
                log.error("no %s: %s", self._path, error)
                self.problem = f"{self._path.name} could not be written: {error}"


@dataclass(eq=False, slots=True)
class _Tally:
    """What is kept of the seeds: some numbers per episode, and failing ones by name.

    Attributes:
        several: Whether there are several seeds; then an episode's name has its seed.
        rules: The task's.
        phases: Names of the phases.
    """

    several: bool
    rules: Rules
    phases: list[str]
    seeds: list[int] = field(default_factory=list)
    succeeded: list[np.ndarray] = field(default_factory=list)
    retries: list[np.ndarray] = field(default_factory=list)
    places: list[np.ndarray] = field(default_factory=list)
    waypoint_error: float = 0.0
    seconds: float = 0.0
    failed: list[str] = field(default_factory=list)
    unreachable: list[str] = field(default_factory=list)
    broken: dict[str, list[str]] = field(default_factory=dict)
    signs: dict[tuple[int, int], list[str]] = field(default_factory=dict)
    rows: list[str] = field(default_factory=list)

    @property
    def episodes(self) -> int:
        """How many were played."""
        return sum(len(succeeded) for succeeded in self.succeeded)

    @property
    def good(self) -> int:
        """How many succeeded."""
        return self.episodes - len(self.failed)

    def add(self, record: SuccessRecord, seconds: float, waypoint_error: float) -> None:
        """Takes in one seed."""
        seed = record.batch.seed
        failed = ~record.succeeded

        def names(worlds: Sequence[int]) -> list[str]:
            return [f"{seed}:{world}" if self.several else str(world) for world in worlds]

        self.seeds.append(seed)
        self.succeeded.append(record.succeeded)
        self.retries.append(record.retries)
        self.places.append(record.places)
        self.waypoint_error = float(
            np.maximum(self.waypoint_error, waypoint_error)
        )  # NaN is handed on
        self.seconds += seconds
        self.failed += names(np.flatnonzero(failed).tolist())
        self.unreachable += names(np.flatnonzero(record.unreachable).tolist())
        for rule, worlds in self.rules.failing(record.batch.failed).items():
            self.broken.setdefault(rule, []).extend(names(worlds))
        for world in np.flatnonzero(failed).tolist():
            key = int(record.phase[world]), int(record.sign[world])
            self.signs.setdefault(key, []).extend(names([world]))
        self.rows += record.failing_rows(self.rules, self.phases)


def run_success(context: GateContext) -> list[GateResult]:
    """Plays the task from random starts under every seed, and holds the share of succeeded episodes
    against ``rate``.
    """
    own = context.with_config(success_config(context.cfg))
    cfg = own.cfg
    t = own.cfg.gate.success
    tally = _Tally(t.seeds > 1, own.check.rules, [phase.name for phase in own.planner.phases])
    details: list[str] = []
    sim = own.batch_simulation(cfg.nworld)
    sizes = getattr(sim, "sizes", None)
    starts = f"starts={cfg.starts}" if reads_starts_file(cfg.reset) else _describe_start(cfg)
    notes = {
        "backend": sim.description,
        "sizes": (
            f"{sizes.as_overrides()} ({sizes.source})"
            if sizes
            else "native MuJoCo has no fixed buffers"
        ),
        "starts": starts,
    }

    def keep(record: SuccessRecord) -> None:
        _keep(own, record, tally, details)
        if t.seeds > 1:
            succeeded = int(record.succeeded.sum())
            so_far = f"{tally.good} of {tally.episodes}"
            context.say(
                f"success, seed {record.batch.seed}: {succeeded} of {cfg.nworld} episodes"
                f" succeeded, {so_far} so far"
            )

    try:
        problems = play_seeds(
            cfg.seed, t.seeds, lambda seed: _play(own, sim, seed, tally, details), keep
        )
    finally:
        sim.close()
    result = _judge(own, tally, notes, problems, details)
    context.pictures += own.pictures
    return [result]


def _play(
    context: GateContext, sim: Simulation, seed: int, tally: _Tally, details: list[str]
) -> SuccessRecord:
    """One seed's episode in every world."""
    cfg = context.cfg
    path = None
    if context.folder is not None:
        path = context.folder / starts_name(seed)
        if cfg.starts is not None and path.resolve() == Path(cfg.starts).resolve():
            path = None  # the worlds start from this very file
    starts = _Starts(path)
    monitor = FailureMonitor(cfg)
    episode = context.play(sim, cfg.reset, [starts, monitor], seed=seed)
    if starts.problem:
        details.append(f"seed {seed}: {starts.problem}")
    record = SuccessRecord.take(seed, sim, cfg, episode, starts.places, monitor)
    tally.add(record, episode.timing.seconds, float(episode.waypoint_error.max()))
    return record


def _failing_name(cfg: Config) -> str:
    return BOTH if "batch" in cfg.gates else FAILING


def _keep(context: GateContext, record: SuccessRecord, tally: _Tally, details: list[str]) -> None:
    """Writes the seed's record, before the next one can break or be stopped. A full disk takes no
    result back.
    """
    folder = context.folder
    if folder is None:
        return
    try:
        record.write(folder, tally.phases)
        if tally.rows:
            write_failing(
                folder,
                record.header(context.cfg.scene.free),
                tally.rows,
                _failing_name(context.cfg),
            )
    except OSError as error:
        log.exception("the record of seed %d was not written", record.batch.seed)
        details.append(
            f"seed {record.batch.seed}: no record of its episodes could be written"
            f" ({error.strerror})"
        )


def _judge(
    context: GateContext,
    tally: _Tally,
    notes: dict[str, str],
    problems: list[str],
    details: list[str],
) -> GateResult:
    cfg = context.cfg
    t = context.cfg.gate.success
    n = tally.episodes
    good = tally.good
    rate, (low, high) = good / n, wilson_interval(good, n)
    succeeded, retries, places = (
        np.concatenate(parts) for parts in (tally.succeeded, tally.retries, tally.places)
    )
    retried = retries > 0
    regions = find_regions(
        places,
        succeeded,
        cell=t.cell,
        yaw_cell_deg=t.yaw_cell_deg,
        episodes=t.cell_episodes,
        objects=list(cfg.scene.free),
    )
    metrics: dict[str, float] = {
        "worlds": cfg.nworld,
        "seeds": len(tally.seeds),
        "episodes": n,
        "succeeded": good,
        "success_rate": rate,
        "success_rate_low95": low,
        "success_rate_high95": high,
        "distinct_starts": len(np.unique(np.round(places, 6).reshape(n, -1), axis=0)),
        "retried": int(retried.sum()),
        "retries": int(retries.sum()),
        "retried_succeeded": int((retried & succeeded).sum()),
        "unreachable": len(tally.unreachable),
        "waypoint_error_max_m": tally.waypoint_error,
        "episode_s": tally.seconds,
        **{f"failed.{rule}": len(worlds) for rule, worlds in tally.broken.items()},
    }
    per_seed = [int(part.sum()) for part in tally.succeeded]
    if t.seeds > 1:
        metrics |= {
            f"seed{seed}.succeeded": k for seed, k in zip(tally.seeds, per_seed, strict=True)
        }

    interval = (
        f"{format_percent(rate)}, 95 % interval {format_percent(low, '')} to {format_percent(high)}"
    )
    reason = f"{good} of {n} episodes succeeded ({interval}), {format_percent(t.rate)} wanted"
    if retried.any():
        reason += f"; {retried.sum()} retried, {(retried & succeeded).sum()} of them succeeded"
    if tally.failed:
        counts = "; ".join(
            f"{tally.rules.texts[rule]} in {len(worlds)}" for rule, worlds in tally.broken.items()
        )
        reason += f"; {name_worlds(tally.failed, n, what='episodes')} failed: {counts}"
    reason = "; ".join([reason, *problems])
    if rate < t.rate:
        problems.append("rate")
    if not regions:
        details.append(
            f"no region has {t.cell_episodes} episodes (gate.success.cell_episodes): more seeds"
            " have more"
        )
    elif all(region.succeeded == region.episodes for region in regions):
        details.append(f"no region of at least {t.cell_episodes} episodes had a failure")
    if tally.unreachable:
        details.append(
            f"target out of reach: {name_worlds(tally.unreachable, n, _NAMED, 'episodes')}"
        )
    details += [
        f"{tally.rules.texts[rule]}: {name_worlds(worlds, n, _NAMED, 'episodes')}"
        for rule, worlds in tally.broken.items()
    ]
    if context.folder is not None:
        details += _save(
            context, regions, places, succeeded, f"{good} of {n} episodes succeeded ({interval})"
        )
        if tally.failed:
            which = "success:" if "batch" in cfg.gates else ""
            details.append(
                f"{_failing_name(cfg)} has every failing episode with its start and what was"
                " measured"
            )
            reason += (
                f". To look at one: job=replay run={context.folder} world={which}{tally.failed[0]}"
            )
    return GateResult(
        name="success",
        status=Status.failed if problems else Status.passed,
        reason=reason,
        thresholds=dict(context.check.thresholds(cfg)) | {"success_rate_min": t.rate},
        metrics=metrics,
        notes=notes,
        details=details,
        tables=_tables(cfg, tally, per_seed, regions),
    )


def _describe_start(cfg: Config) -> str:
    """How worlds start, in a few words."""
    regions = [
        term.params["xy"]
        for term in cfg.reset.values()
        if places_objects(term) and "xy" in term.params
    ]
    where = "".join(f", objects within {x:g} x {y:g} m of their places" for x, y in regions)
    return f"gate.success.reset ({', '.join(cfg.reset)}{where})"


def _save(
    context: GateContext,
    regions: list[Region],
    places: np.ndarray,
    succeeded: np.ndarray,
    title: str,
) -> list[str]:
    """Writes the table of regions and the picture; returns what did not work, which takes no result
    back.
    """
    folder = context.folder
    scene = context.cfg.scene
    assert folder is not None
    table = (scene.table_center[:2], scene.table_half[:2])
    work: dict[str, Callable[[], None]] = {
        REGIONS: lambda: write_atomic(
            folder / REGIONS, to_csv([f.name for f in fields(Region)], map(asdict, regions))
        ),
        PICTURE: lambda: save_places(
            folder / PICTURE,
            places,
            succeeded,
            table,
            f"{context.cfg.robot.title}: {title}",
            {name: thing.color for name, thing in scene.free.items()},
        ),
    }
    lost = []
    for name, save in work.items():
        try:
            save()
        except Exception as error:
            log.exception("%s was not written", name)
            (folder / name).unlink(missing_ok=True)  # a picture may be there in part
            lost.append(
                f"{name} could not be written"
                f" ({getattr(error, 'strerror', None) or type(error).__name__})"
            )
        else:
            context.pictures += [name] if name == PICTURE else []
    return lost


def _tables(cfg: Config, tally: _Tally, per_seed: list[int], regions: list[Region]) -> list[Table]:
    """What report.md shows: seeds, first signs of failure, and the worst regions."""
    t = cfg.gate.success
    n = cfg.nworld
    tables = []
    if len(tally.seeds) > 1:
        rows = [
            [str(seed), str(n), str(k), *_rate_cells(k, n)]
            for seed, k in zip(tally.seeds, per_seed, strict=True)
        ]
        tables.append(
            Table(
                title="Seeds",
                header=["seed", "episodes", "succeeded", "rate", "95 % interval"],
                rows=rows,
            )
        )
    if tally.signs:
        rows = [
            [
                describe_sign(sign, tally.phases[phase] if phase >= 0 else ""),
                str(len(worlds)),
                ", ".join(worlds[:8]) + (", ..." if len(worlds) > 8 else ""),
            ]
            for (phase, sign), worlds in sorted(tally.signs.items())
        ]
        header = ["first sign of failure", "failed episodes", "which"]
        tables.append(Table(title="Where it went wrong", header=header, rows=rows))
    failing = [r for r in regions if r.succeeded < r.episodes]
    if not failing:
        return tables
    worst = [
        [r.where, str(r.episodes), str(r.succeeded), *_rate_cells(r.succeeded, r.episodes)]
        for r in failing
    ]
    shown = f"{min(len(worst), t.worst_regions)} of {len(worst)} with a failure"
    tables.append(
        Table(
            title=f"Worst regions of at least {t.cell_episodes} episodes ({shown})",
            header=["where the cube started", "episodes", "succeeded", "rate", "95 % interval"],
            rows=worst[: t.worst_regions],
        )
    )
    return tables


def _rate_cells(k: int, n: int) -> list[str]:
    """A rate and its interval as two cells."""
    low, high = wilson_interval(k, n)
    return [f"{100.0 * k / n:.1f} %", f"{100.0 * low:.1f} to {100.0 * high:.1f} %"]
