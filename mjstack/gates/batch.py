"""Gate *batch*: every world stacks, or is named with the rule it broke."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field

import numpy as np

from mjstack.episodes.batch_record import FAILING, BatchRecord, write_failing
from mjstack.episodes.context import GateContext, TimedEpisode, play_seeds
from mjstack.episodes.observers import Episode, Snapshots
from mjstack.errors import name_worlds
from mjstack.math import wilson_interval
from mjstack.report.markdown import format_percent
from mjstack.report.record import GateResult, Status
from mjstack.sim import Simulation
from mjstack.tasks.check import Rules

log = logging.getLogger(__name__)

_NAMED = 100  # worlds a rule in report.md; failing_worlds.csv has all


@dataclass(eq=False, slots=True)
class _Tally:
    """Sums over the seeds: numbers, and the failing worlds by name. Nothing of the other worlds is
    kept.

    Attributes:
        several: Whether there are several seeds; then a world's name has its seed too.
        rules: The task's.
        low: Smallest of everything measured, by name.
        high: Largest likewise.
        ends: Hashes of the final states.
    """

    several: bool
    rules: Rules
    seeds: int = 0
    worlds: int = 0
    failed: list[str] = field(default_factory=list)
    broken: dict[str, list[str]] = field(default_factory=dict)
    rows: list[str] = field(default_factory=list)
    low: dict[str, float] = field(default_factory=dict)
    high: dict[str, float] = field(default_factory=dict)
    ends: set[int] = field(default_factory=set)
    seconds: float = 0.0
    steps: int = 0

    def add(self, record: BatchRecord, episode: Episode, sim: Simulation) -> None:
        """Takes in one seed."""
        self.seeds += 1
        self.worlds += sim.nworld
        self.seconds += episode.timing.seconds
        self.steps += int(sim.step_count.sum())
        self.failed += [
            self._name(record.seed, world) for world in np.flatnonzero(record.failed).tolist()
        ]
        for rule, worlds in self.rules.failing(record.failed).items():
            self.broken.setdefault(rule, []).extend(
                self._name(record.seed, world) for world in worlds
            )
        self.rows += record.failing_rows(self.rules)
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

    def _name(self, seed: int, world: int) -> str:
        """As ``world=`` of job=replay takes it."""
        return str(world) if not self.several else f"{seed}:{world}"


def run_batch(context: GateContext) -> list[GateResult]:
    """Plays the task in nworld worlds that start differently, under every seed, and judges each."""
    cfg = context.cfg
    t = cfg.gate.batch
    tally = _Tally(t.seeds > 1, context.check.rules)
    details: list[str] = []
    sim = context.batch_simulation(cfg.nworld)
    sizes = getattr(sim, "sizes", None)
    metrics: dict[str, float] = {}
    notes = {
        "backend": sim.description,
        "sizes": (
            f"{sizes.as_overrides()} ({sizes.source})"
            if sizes
            else "native MuJoCo has no fixed buffers"
        ),
    }

    def keep(record: BatchRecord) -> None:
        details.extend(_keep(context, record, tally))
        succeeded = int((record.failed == 0).sum())
        if t.seeds > 1:
            metrics[f"seed{record.seed}.succeeded"] = succeeded
            so_far = f"{tally.worlds - len(tally.failed)} of {tally.worlds}"
            context.say(
                f"batch, seed {record.seed}: {succeeded} of {cfg.nworld} worlds succeeded, {so_far}"
                " so far"
            )

    try:
        problems = play_seeds(
            cfg.seed, t.seeds, lambda seed: _play(context, sim, seed, tally), keep
        )
    finally:
        sim.close()
    return [_judge(context, tally, metrics, notes, problems, details)]


def _play(context: GateContext, sim: Simulation, seed: int, tally: _Tally) -> BatchRecord:
    """One seed's episode in every world."""
    cfg = context.cfg
    last = context.phase_start(cfg.gate.throughput.from_phase) - 1
    # Throughput goes on from the first seed.
    snapshots = Snapshots([last] if seed == cfg.seed else [])
    episode = context.play(sim, cfg.reset, [snapshots], seed=seed)
    context.carry_start = snapshots.states.get(last, context.carry_start)
    if seed == cfg.seed:
        context.timed_episode = TimedEpisode.of(episode, sim)
    record = BatchRecord.take(seed, sim, episode)
    tally.add(record, episode, sim)
    return record


def _keep(context: GateContext, record: BatchRecord, tally: _Tally) -> list[str]:
    """Writes the seed's record, before the next one can break or be stopped. A full disk takes no
    result back.
    """
    if context.folder is None:
        return []
    try:
        record.write(context.folder)
        if tally.rows:
            write_failing(context.folder, record.header(), tally.rows)
    except OSError as error:
        log.exception("the record of seed %d was not written", record.seed)
        return [f"seed {record.seed}: no record of its worlds could be written ({error.strerror})"]
    return []


def _judge(
    context: GateContext,
    tally: _Tally,
    metrics: dict[str, float],
    notes: dict[str, str],
    problems: list[str],
    details: list[str],
) -> GateResult:
    cfg = context.cfg
    t = cfg.gate.batch
    what = "worlds" if t.seeds == 1 else "world-episodes"
    succeeded = tally.worlds - len(tally.failed)
    bad = tally.failed
    rate, (low, high) = succeeded / tally.worlds, wilson_interval(succeeded, tally.worlds)
    metrics = {
        "worlds": cfg.nworld,
        "seeds": tally.seeds,
        "world_episodes": tally.worlds,
        "succeeded": succeeded,
        "success_rate": rate,
        "success_rate_low95": low,
        "success_rate_high95": high,
        "distinct_final_states": len(tally.ends),
        **{
            metric: (tally.low if side == "min" else tally.high)[value]
            for metric, (value, side) in context.check.summaries.items()
        },
        "waypoint_error_max_m": tally.high["waypoint_error_m"],
        "peak_contacts_per_world": int(tally.high["peak_contacts"]),
        "peak_constraint_rows_per_world": int(tally.high["peak_constraint_rows"]),
        **metrics,
        **{f"failed.{rule}": len(worlds) for rule, worlds in tally.broken.items()},
    }
    if not bad:  # how fast worlds are that do not do the task is no figure
        metrics |= {"episode_s": tally.seconds, "world_steps_per_s": tally.steps / tally.seconds}
    details = [
        *(
            f"{tally.rules.texts[rule]}: {name_worlds(worlds, tally.worlds, _NAMED, what)}"
            for rule, worlds in tally.broken.items()
        ),
        *details,
    ]
    counts = "; ".join(
        f"{tally.rules.texts[rule]} in {len(worlds)}" for rule, worlds in tally.broken.items()
    )
    interval = (
        f"{format_percent(rate)}, 95 % interval {format_percent(low, '')} to {format_percent(high)}"
    )
    summary = (
        f"{succeeded} of {tally.worlds} {what} succeeded ({interval}), {len(tally.ends)} distinct"
    )
    failing = f"{name_worlds(bad, tally.worlds, what=what)} failed: {counts}"
    if len(bad) > t.failed_worlds:
        problems.insert(0, failing)
    elif bad:
        summary += f"; {failing}"
    if tally.worlds > 1 and len(tally.ends) < t.distinct_fraction * tally.worlds:
        problems.append(
            f"only {len(tally.ends)} distinct final states of {tally.worlds} {what}: identical"
            " worlds prove nothing, use reset=jitter"
        )
    reason = "; ".join([summary, *problems])
    if bad and context.folder is not None:
        details.append(f"{FAILING} has every failing world with what was measured")
        reason += f". To look at one: job=replay run={context.folder} world={bad[0]}"
    thresholds = dict(context.check.thresholds(cfg))
    thresholds |= {"failed_worlds": t.failed_worlds, "distinct_fraction": t.distinct_fraction}
    return GateResult(
        name="batch",
        status=Status.failed if problems else Status.passed,
        reason=reason,
        thresholds=thresholds,
        metrics=metrics,
        notes=notes,
        details=details,
    )
