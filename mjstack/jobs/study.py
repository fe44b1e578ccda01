"""Job *study*: the cost of solver settings, and whether every world still succeeds.

It informs, and gates nothing.
"""

from __future__ import annotations

import logging
import statistics
import time
from dataclasses import asdict, fields, replace
from enum import Enum
from pathlib import Path
from typing import cast

from mjstack.bench.physics import HeldPhysics
from mjstack.bench.timing import describe_lost, steps_that_fit
from mjstack.config.schema import Config, SolverCfg, StudyJobCfg
from mjstack.episodes.context import RunContext, Stage, play_to, require_episode
from mjstack.errors import ConfigError, MjstackError
from mjstack.files import to_csv, write_atomic
from mjstack.jobs.gates import check_machine
from mjstack.jobs.job import Job
from mjstack.jobs.progress import ProgressBar
from mjstack.jobs.result import JobResult
from mjstack.jobs.runner import Record, run_reported
from mjstack.managers.reset import required_fields
from mjstack.report.record import GateResult, Status
from mjstack.report.study import COLUMNS, Row, save_study, to_markdown
from mjstack.report.write import safely_draw
from mjstack.sim import Simulation, SolverLimit, make_simulation
from mjstack.sim.sizes import resolve_measuring_sizes

log = logging.getLogger(__name__)


def check_study(cfg: Config) -> RunContext:
    """Raise for what this machine cannot do, before anything is written."""
    for key in ("view", "video"):
        if getattr(cfg, key):
            raise ConfigError(
                key, "true", "false with job=study, which shows no world", "Leave it out"
            )
    require_episode(cfg)
    return check_machine(cfg)


def run_study_job(context: RunContext, folder: Path, overrides: list[str]) -> JobResult:
    """Measures every variant and leaves study.csv, study.md, study.png and the report.

    Args:
        context: The configuration, and what its check built.
        folder: Where they go.
        overrides: What was asked for on the command line.

    Returns:
        How it ended: a pass if every variant was measured, whatever was found.
    """
    cfg = context.cfg
    job = cast(StudyJobCfg, cfg.job)

    def work(context: RunContext, bar: ProgressBar, record: Record) -> None:
        rows: list[Row] = []
        bar.start("base")
        try:
            base, steps = _prepare(context, job)
        except Exception as error:  # nothing can be compared with it
            log.exception("the configured solver broke")
            first = (str(error) or type(error).__name__).splitlines()[0]
            reason = f"the configured solver cannot be timed: {first}"
            record(GateResult(name="base", status=Status.failed, reason=reason))
            return
        try:
            for name, solver in job.variants.items():
                bar.start(name)
                began = time.perf_counter()
                row = _guarded(context, base, steps, name, solver)
                rows.append(row)
                _write_tables(context, folder, rows)
                record(_as_result(row, time.perf_counter() - began))
            _draw(context, folder, rows)
        finally:
            base.sim.close()

    title = (
        f"task {cfg.task.name}, {cfg.nworld} worlds, study of {len(job.variants)} variants of the"
        " solver"
    )
    return run_reported(context, folder, overrides, title, work)


def _prepare(context: RunContext, job: StudyJobCfg) -> tuple[HeldPhysics, int]:
    """The configured solver's worlds with the object in hand, and the steps of a repetition.

    They are kept beside every variant, so that the repetitions of both are interleaved and start
    from one state.
    """
    sim = _simulation(context)
    state = play_to(context, sim, context.cfg.gate.throughput.from_phase)
    base = HeldPhysics(sim, state, context.cfg.timing.decimation)
    return base, steps_that_fit(job.steps, job.max_seconds, base.warm_up())


def _guarded(
    context: RunContext, base: HeldPhysics, steps: int, name: str, solver: SolverCfg
) -> Row:
    """One variant; if it breaks, the others still run."""
    changes = _changes(context.cfg.solver, solver)
    row = {"variant": name, "changes": changes or "nothing", "status": "fail", "reason": ""}
    if not changes and name != "base":
        return row | {"status": "skip", "reason": "the same as base"}
    try:
        row |= _measure(_variant(context, solver), base, steps)
    except MjstackError as error:
        row["reason"] = str(error)
    except Exception as error:
        log.exception("variant %s broke", name)
        first = (str(error) or "no message").splitlines()[0]
        row["reason"] = f"{type(error).__name__}: {first} (run.log has the traceback)"
    return row


def _variant(context: RunContext, solver: SolverCfg) -> RunContext:
    """The same run with another solver. Its plan is the same too, because inverse kinematics has no
    contacts.
    """
    cfg = replace(context.cfg, solver=solver)
    stage = Stage(cfg)
    stage.planner = context.planner
    return replace(context, cfg=cfg, stage=stage)


def _measure(context: RunContext, base: HeldPhysics, steps: int) -> Row:
    """Play the whole judged episode, then repetitions with the object in hand beside the base's.

    Raises:
        MjstackError: Worlds lost physics, so that their time is void.
    """
    cfg = context.cfg
    job = cast(StudyJobCfg, cfg.job)
    sim = _simulation(context)
    try:
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
            context.tell("repetitions", repetition + 1, job.repetitions)
    finally:
        sim.close()
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
    cfg, (backend, device) = context.cfg, context.backend
    fields = required_fields(cfg.reset)
    sizes = resolve_measuring_sizes(cfg)
    return make_simulation(
        context.model, cfg, cfg.nworld, backend=backend, device=device, fields=fields, sizes=sizes
    )


def _changes(base: SolverCfg, solver: SolverCfg) -> str:
    """The settings that differ, such as ``iterations=5``."""
    pairs = (
        (field.name, getattr(base, field.name), getattr(solver, field.name))
        for field in fields(SolverCfg)
    )
    return ", ".join(f"{name}={_text(new)}" for name, old, new in pairs if new != old)


def _text(value: object) -> str:
    if isinstance(value, Enum):
        return str(value.value)
    return (
        "the model's" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
    )


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


def _title(context: RunContext) -> str:
    cfg = context.cfg
    return f"{cfg.robot.title}, task {cfg.task.name}: the solver's settings, {cfg.nworld} worlds"


def _notes(context: RunContext) -> list[str]:
    job = cast(StudyJobCfg, context.cfg.job)
    base = asdict(context.cfg.solver)
    backend, device = context.backend
    notes = [
        f"base: {', '.join(f'{name}={_text(value)}' for name, value in base.items())}",
        (
            f"{backend.value} on {device}. Times: object in hand, joint target held; medians"
            f" of {job.repetitions} repetitions, interleaved with those of base. A ratio is that of"
            " two neighbouring repetitions; in brackets the smallest and the largest."
        ),
        "base as a variant is a second copy of it: its ratio shows how far equal runs differ.",
    ]
    if backend.value == "native":
        notes.append("Native MuJoCo does not tell which worlds stopped at a limit of the solver.")
    return notes


def _write_tables(context: RunContext, folder: Path, rows: list[Row], picture: str = "") -> None:
    write_atomic(folder / "study.csv", to_csv([*COLUMNS, *context.check.summaries], rows))
    write_atomic(folder / "study.md", to_markdown(rows, _title(context), _notes(context), picture))


def _draw(context: RunContext, folder: Path, rows: list[Row]) -> None:
    """Draw the variants that were measured."""
    done = [row for row in rows if row["status"] == "pass"]
    if not done:
        return
    if problem := safely_draw(folder / "study.png", save_study, done, _title(context)):
        context.say(problem)
    else:
        _write_tables(context, folder, rows, "study.png")


JOB = Job(check_study, run_study_job)
