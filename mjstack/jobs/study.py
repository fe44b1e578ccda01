"""Job *study*: the cost of solver settings, and whether every world still succeeds.

It informs, and gates nothing.
"""

import statistics
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from mjstack.bench.physics import HeldPhysics, play_to_phase
from mjstack.bench.timing import describe_lost, steps_that_fit
from mjstack.config.schema import Config, SolverCfg, StudyJobCfg
from mjstack.episodes.context import RunContext, require_episode
from mjstack.episodes.stage import Stage
from mjstack.errors import MjstackError
from mjstack.files import to_csv
from mjstack.gates.runner import log_error
from mjstack.jobs.gates import check_machine
from mjstack.jobs.runner import CheckedJob, Job, write_tables
from mjstack.report.picture import figure
from mjstack.report.record import GateResult, Status
from mjstack.report.table import Table
from mjstack.sim import Simulation, SolverLimit
from mjstack.sim.sizes import resolve_measuring_sizes

Row = dict[str, Any]
"""One variant of the solver; a value that was not measured is missing.

``variant``, ``changes``, ``status`` (pass: it was measured; skip: it changes nothing), ``reason``;
then, of the whole episode, ``worlds``, ``succeeded``, ``broken_rules``, ``peak_rows`` (most
constraint rows of a world), the check's summaries, and ``iteration_limit_worlds`` and
``line_search_limit_worlds`` (worlds whose solver stopped at its limit in some step); then, object
in hand, ``ms_per_batched_step`` (median of the repetitions, with ``ms_min`` and ``ms_max``),
``base_ms`` (of the configured solver beside them) and ``ratio`` (of neighbouring repetitions:
median, ``ratio_min``, ``ratio_max``).
"""


def check_study(cfg: Config) -> CheckedJob:
    """Raise for what this machine cannot do, before anything is written."""
    require_episode(cfg)
    count = len(cast(StudyJobCfg, cfg.job).variants)
    title = f"task {cfg.task.name}, {cfg.nworld} worlds, study of {count} variants of the solver"
    return CheckedJob(context=check_machine(cfg), title=title, work=run_study)


def run_study(context: RunContext, folder: Path) -> None:
    """Measure every variant and leave study.csv, study.md and study.png in the folder.

    A variant passes if it was measured.
    """
    cfg = context.cfg
    job = cast(StudyJobCfg, cfg.job)
    rows: list[Row] = []
    context.begin("base")
    # The configured solver's worlds are kept beside every variant, so that the repetitions of both
    # are interleaved and start from one state.
    with closing(_simulation(context)) as sim:
        base = HeldPhysics(sim, play_to_phase(context, sim), cfg.timing.decimation)
        steps = steps_that_fit(job.steps, job.max_seconds, base.warm_up())
        for name, solver in job.variants.items():
            context.begin(name)
            began = time.perf_counter()
            rows.append(_guarded(context, base, steps, name, solver))
            _write(context, rows)
            context.record(_as_result(rows[-1], time.perf_counter() - began))
        if any(row["status"] == "pass" for row in rows):
            _write(context, rows, draw=True)


def _guarded(
    context: RunContext, base: HeldPhysics, steps: int, name: str, solver: SolverCfg
) -> Row:
    """One variant; if it breaks, the others still run."""
    before = asdict(context.cfg.solver)
    changes = {key: value for key, value in asdict(solver).items() if value != before[key]}
    row = {"variant": name, "changes": _text(changes), "status": "fail", "reason": ""}
    if not changes and name != "base":
        return row | {"status": "skip", "reason": "the same as base"}
    cfg = replace(context.cfg, solver=solver)
    stage = Stage(cfg)
    stage.planner = context.planner  # inverse kinematics has no contacts
    try:
        return row | _measure(replace(context, cfg=cfg, stage=stage), base, steps)
    except Exception as error:
        return row | {"reason": log_error(error)}


def _measure(context: RunContext, base: HeldPhysics, steps: int) -> Row:
    """Play the whole judged episode, then repetitions with the object in hand beside the base's.

    Raises:
        MjstackError: Worlds lost physics, so that their time is void.
    """
    cfg = context.cfg
    job = cast(StudyJobCfg, cfg.job)
    with closing(_simulation(context)) as sim:
        # The episode
        result = context.play(sim, cfg.reset).result
        failed = result.failed.cpu().numpy()
        rules = context.check.rules
        row: Row = {
            "worlds": sim.nworld,
            "succeeded": int((failed == 0).sum()),
            "broken_rules": ", ".join(
                f"{rules.texts[name]} in {len(worlds)}"
                for name, worlds in rules.failing(failed).items()
            ),
            "peak_rows": int(sim.peak_constraints.max()),
        }
        for metric, (value, side) in context.check.summaries.items():
            row[metric] = float(getattr(result.values[value], side)())
        if (limits := sim.solver_limits) is not None:
            for column, bit in (
                ("iteration_limit_worlds", SolverLimit.ITERATIONS),
                ("line_search_limit_worlds", SolverLimit.LS_ITERATIONS),
            ):
                row[column] = int((limits & bit != 0).sum())

        # The repetitions; each goes first in turn: what drifts, drifts for both.
        ours = HeldPhysics(sim, base.state, base.decimation)
        ours.warm_up()
        times: dict[HeldPhysics, list[float]] = {base: [], ours: []}
        for repetition in range(job.repetitions):
            for one in list(times)[:: 1 if repetition % 2 else -1]:
                times[one].append(1e3 * one.play(steps) / (steps * base.decimation))
                if problem := describe_lost(one.lost):
                    raise MjstackError(f"no time: {problem} (of {sim.nworld}).")
            context.advance("repetitions", repetition + 1, job.repetitions)
    ratios = [a / b for a, b in zip(times[ours], times[base], strict=True)]
    for name, values in (("ms", times[ours]), ("ratio", ratios)):
        row |= {f"{name}_min": min(values), f"{name}_max": max(values)}
    return row | {
        "ms_per_batched_step": statistics.median(times[ours]),
        "base_ms": statistics.median(times[base]),
        "ratio": statistics.median(ratios),
        "status": "pass",
    }


def _simulation(context: RunContext) -> Simulation:
    """Worlds with room to spare: buffer sizes are not what is studied."""
    sizes = resolve_measuring_sizes(context.cfg)
    return context.simulation(context.cfg.nworld, *context.backend, sizes=sizes)


def _text(settings: dict[str, object]) -> str:
    """Settings such as ``iterations=5, tolerance=1e-06``; null is the value of the robot's file."""
    return ", ".join(f"{key}={value}" for key, value in settings.items()) or "nothing"


def _as_result(row: Row, seconds: float) -> GateResult:
    """A row as a result of the report."""
    reason = row["reason"]
    if row["status"] == "pass":
        reason = (
            f"{row['ms_per_batched_step']:.3g} ms per step, {row['ratio']:.2f} of base,"
            f" {row['succeeded']} of {row['worlds']} succeeded"
        )
        reason += f" ({row['broken_rules']})" if row["broken_rules"] else ""
    return GateResult(
        name=row["variant"],
        status=Status(row["status"]),
        reason=reason,
        seconds=seconds,
        metrics={key: value for key, value in row.items() if not isinstance(value, str)},
        notes={"changes": row["changes"]},
    )


def _write(context: RunContext, rows: list[Row], draw: bool = False) -> None:
    """Write the tables and the picture so far."""
    cfg = context.cfg
    backend, device = context.backend
    title = f"{cfg.robot.title}, task {cfg.task.name}: the solver's settings, {cfg.nworld} worlds"
    notes = [
        f"base: {_text(asdict(cfg.solver))}",
        (
            f"{backend} on {device}. Times: object in hand, joint target held; medians of"
            f" {cast(StudyJobCfg, cfg.job).repetitions} repetitions, interleaved with those of"
            " base. A ratio is that of two neighbouring repetitions."
        ),
        "base as a variant is a second copy of it: its ratio shows how far equal runs differ.",
    ]
    if backend == "native":
        notes.append("Native MuJoCo does not tell which worlds stopped at a limit of the solver.")
    done = [row for row in rows if row["status"] == "pass"]
    picture = (lambda path: _draw(path, done, title)) if draw else None
    table = Table.of(_SHOWN, rows)
    write_tables(context, "study", title, table, notes, to_csv(rows), picture)


def _draw(path: Path, rows: Sequence[Row], title: str) -> None:
    """Draw a bar per measured variant: its time over that of the base, and the worlds that
    succeeded.
    """
    nworld = rows[0]["worlds"]
    places = np.arange(len(rows))
    succeeded = [row["succeeded"] for row in rows]
    colors = ["#2457c7" if count == nworld else "#cc2a24" for count in succeeded]
    middle, low, high = (
        np.array([row[key] for row in rows]) for key in ("ratio", "ratio_min", "ratio_max")
    )
    size = (11, 1.5 + 0.3 * len(rows))
    with figure(path, title, 2, figsize=size, sharey=True) as (_, (time, worlds)):
        whiskers = (middle - low, high - middle)
        time.barh(places, middle, xerr=whiskers, color=colors, ecolor="0.4", capsize=2)
        time.axvline(1.0, color="0.3", linewidth=1.0)
        time.set(xlabel="time per step over that of base (whiskers: all repetitions)")
        time.set_yticks(places, [row["variant"] for row in rows])
        time.invert_yaxis()
        worlds.barh(places, succeeded, color=colors)
        worlds.set(xlabel=f"succeeded of {nworld} worlds (red: not all)", xlim=(0, nworld))
        for axes in (time, worlds):
            axes.grid(alpha=0.3, axis="x")


_SHOWN = {
    "variant": "variant",
    "changes": "changes",
    "ms per step": "ms_per_batched_step",
    "ratio to base": "ratio",
    "smallest": "ratio_min",
    "largest": "ratio_max",
    "worlds": "worlds",
    "succeeded": "succeeded",
    "iteration limit": "iteration_limit_worlds",
    "line-search limit": "line_search_limit_worlds",
    "broken rules": "broken_rules",
    "notes": "reason",
}

JOB = Job(check_study)
