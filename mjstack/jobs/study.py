"""Job *study*: what settings of the solver cost, and whether every world is still succeeded. It
informs, and gates nothing.
"""

from __future__ import annotations

import logging
import statistics
import time
from dataclasses import asdict, dataclass, fields, replace
from enum import Enum
from pathlib import Path
from typing import cast

import numpy as np
import torch

from mjstack.config.schema import Config, SolverCfg, StudyJobCfg
from mjstack.episodes.context import RunContext, Stage, play_to, require_episode
from mjstack.episodes.rollout import State, restore
from mjstack.errors import ConfigError, MjstackError
from mjstack.files import to_csv, write_atomic
from mjstack.jobs.gates import check_machine
from mjstack.jobs.job import Job
from mjstack.jobs.progress import ProgressBar
from mjstack.jobs.result import JobResult
from mjstack.jobs.runner import Record, run_reported
from mjstack.managers.reset import required_fields
from mjstack.report.picture import save_study
from mjstack.report.record import GateResult, Status
from mjstack.report.study import COLUMNS, StudyRow, to_markdown
from mjstack.sim import LOST_PHYSICS, Simulation, SolverLimit, make_simulation
from mjstack.sim.sizes import resolve_measuring_sizes

log = logging.getLogger(__name__)

_WARM_CALLS = 3  # one compiles, one captures, one replays


@dataclass(eq=False, slots=True)
class _Base:
    """The configured solver, kept beside every variant so that both are timed in turns.

    Attributes:
        sim: Its worlds.
        state: Cube in hand: where every timed repetition of every variant starts.
        steps: Steps of a repetition.
    """

    sim: Simulation
    state: State
    steps: int


def check_study(cfg: Config) -> RunContext:
    """Raises for what this machine cannot do, before anything is written."""
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
        rows: list[StudyRow] = []
        bar.start("base")
        try:
            base = _prepare(context, job)
        except Exception as error:  # nothing can be compared with it
            log.exception("the configured solver broke")
            reason = (str(error) or type(error).__name__).splitlines()[0]
            record(
                GateResult(
                    name="base",
                    status=Status.failed,
                    reason=f"the configured solver cannot be timed: {reason}",
                )
            )
            return
        try:
            for name, solver in job.variants.items():
                bar.start(name)
                began = time.perf_counter()
                row = _guarded(context, job, base, name, solver)
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


def _prepare(context: RunContext, job: StudyJobCfg) -> _Base:
    """The configured solver's worlds, played up to where they hold the cube."""
    cfg = context.cfg
    sim = _simulation(context)
    state = play_to(context, sim, cfg.gate.throughput.from_phase)
    restore(sim, state)
    _play(sim, cfg, _WARM_CALLS)
    seconds = _play(sim, cfg, 1)
    return _Base(sim, state, max(1, min(job.steps, int(job.max_seconds / seconds))))


def _guarded(
    context: RunContext, job: StudyJobCfg, base: _Base, name: str, solver: SolverCfg
) -> StudyRow:
    """One variant; if it breaks, the others still run."""
    cfg = context.cfg
    changes = _changes(cfg.solver, solver)
    row = StudyRow(variant=name, changes=changes or "nothing")
    if not changes and name != "base":
        row.status = Status.skipped.value
        row.reason = "the same as base"
        return row
    try:
        _measure(_variant(context, solver), job, base, row)
    except MjstackError as error:
        row.reason = str(error)
    except Exception as error:
        log.exception("variant %s broke", name)
        row.reason = (
            f"{type(error).__name__}: {(str(error) or 'no message').splitlines()[0]} (run.log has"
            " the traceback)"
        )
    return row


def _variant(context: RunContext, solver: SolverCfg) -> RunContext:
    """The same run with another solver. Its plan is the same too, because inverse kinematics has no
    contacts.
    """
    cfg = replace(context.cfg, solver=solver)
    stage = Stage(cfg)
    stage.planner = context.planner
    return replace(context, cfg=cfg, stage=stage)


def _measure(context: RunContext, job: StudyJobCfg, base: _Base, row: StudyRow) -> None:
    """The whole episode, judged; then turns of some steps with the base, from the base's state with
    the cube in hand.
    """
    cfg = context.cfg
    advance = context.advance
    sim = _simulation(context)
    try:
        result = context.play(sim, cfg.reset).result
        failed = result.failed.cpu().numpy()
        row.worlds = sim.nworld
        row.succeeded = int((failed == 0).sum())
        rules = context.check.rules
        row.broken_rules = ", ".join(
            f"{rules.texts[name]} in {len(worlds)}"
            for name, worlds in rules.failing(failed).items()
        )
        row.peak_rows = int(sim.peak_constraints.max())
        row.values = {
            metric: float(getattr(result.values[value], side)())
            for metric, (value, side) in context.check.summaries.items()
        }
        limits: torch.Tensor | None = getattr(
            sim, "solver_limits", None
        )  # native MuJoCo does not tell
        if limits is not None:
            row.iteration_limit_worlds = int((limits & SolverLimit.ITERATIONS != 0).sum())
            row.line_search_limit_worlds = int((limits & SolverLimit.LS_ITERATIONS != 0).sum())
        times: dict[Simulation, list[float]] = {base.sim: [], sim: []}
        restore(sim, base.state)
        _play(sim, cfg, _WARM_CALLS)
        for repetition in range(job.repetitions):
            # Each goes first in turn: what drifts, drifts for both.
            for one in list(times)[:: 1 if repetition % 2 else -1]:
                restore(one, base.state)
                times[one].append(_play(one, cfg, base.steps))
                _require_sound(one, base.steps * cfg.timing.decimation)
            if advance is not None:
                advance("repetitions", repetition + 1, job.repetitions)
    finally:
        sim.close()
    per_step = 1e3 / (base.steps * cfg.timing.decimation)
    ratios = [ours / theirs for ours, theirs in zip(times[sim], times[base.sim], strict=True)]
    row.ms_per_batched_step = per_step * statistics.median(times[sim])
    row.ms_min = per_step * min(times[sim])
    row.ms_max = per_step * max(times[sim])
    row.base_ms = per_step * statistics.median(times[base.sim])
    row.ratio = statistics.median(ratios)
    row.ratio_min = min(ratios)
    row.ratio_max = max(ratios)
    row.status = Status.passed.value


def _simulation(context: RunContext) -> Simulation:
    """Worlds with room to spare: buffer sizes are not what is studied."""
    cfg, (backend, device) = context.cfg, context.backend
    fields = required_fields(cfg.reset)
    sizes = resolve_measuring_sizes(cfg)
    return make_simulation(
        context.model, cfg, cfg.nworld, backend=backend, device=device, fields=fields, sizes=sizes
    )


def _play(sim: Simulation, cfg: Config, steps: int) -> float:
    """Seconds that some steps take under the held command, the device idle at both ends."""
    sim.synchronize()
    began = time.perf_counter()
    for _ in range(steps):
        sim.step(cfg.timing.decimation)
    sim.synchronize()
    return time.perf_counter() - began


def _require_sound(sim: Simulation, steps: int) -> None:
    """Refuses the time of worlds that lost physics or were not stepped.

    Raises:
        MjstackError: Some did.
    """
    bad = (sim.overflow & LOST_PHYSICS) != 0
    bad |= ~(torch.isfinite(sim.qpos).all(1) & torch.isfinite(sim.qvel).all(1))
    bad |= sim.step_count != steps
    if count := int(bad.sum()):
        raise MjstackError(
            f"no time: {count} of {sim.nworld} worlds overflowed, diverged or were not stepped."
        )


def _changes(base: SolverCfg, solver: SolverCfg) -> str:
    """What differs: ``iterations=5``."""
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


def _as_result(row: StudyRow, seconds: float) -> GateResult:
    """A row as a result of the report."""
    values = (asdict(row) | row.values).items()
    metrics = {key: value for key, value in values if isinstance(value, float | int)}
    reason = row.reason
    if row.status == Status.passed.value:
        reason = (
            f"{row.ms_per_batched_step:.3g} ms per step, {row.ratio:.2f} of base, {row.succeeded}"
            f" of {row.worlds} succeeded"
        )
        reason += f" ({row.broken_rules})" if row.broken_rules else ""
    return GateResult(
        name=row.variant,
        status=Status(row.status),
        reason=reason,
        seconds=seconds,
        metrics=metrics,
        notes={"changes": row.changes},
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
            f"{backend.value} on {device}. Times: cube in hand, command held; medians of"
            f" {job.repetitions} repetitions, in turns with base. A ratio is that of two"
            " neighbouring turns; in brackets the smallest and the largest."
        ),
        "base as a variant is a second copy of it: its ratio shows how far equal runs differ.",
    ]
    if backend.value == "native":
        notes.append("Native MuJoCo does not tell which worlds stopped at a limit of the solver.")
    return notes


def _write_tables(
    context: RunContext, folder: Path, rows: list[StudyRow], picture: str = ""
) -> None:
    columns = [*COLUMNS, *context.check.summaries]
    write_atomic(folder / "study.csv", to_csv(columns, [asdict(row) | row.values for row in rows]))
    write_atomic(folder / "study.md", to_markdown(rows, _title(context), _notes(context), picture))


def _draw(context: RunContext, folder: Path, rows: list[StudyRow]) -> None:
    """The picture of what was measured. Its failure takes nothing back."""
    done = [row for row in rows if row.status == Status.passed.value]
    if not done:
        return
    ratios = np.array([[row.ratio, row.ratio_min, row.ratio_max] for row in done], dtype=float)
    labels = [row.variant for row in done]
    try:
        succeeded = [row.succeeded or 0 for row in done]
        save_study(
            folder / "study.png", labels, ratios, succeeded, context.cfg.nworld, _title(context)
        )
    except Exception as error:
        log.exception("drawing failed")
        context.say(f"no picture: {str(error) or type(error).__name__}")
        return
    _write_tables(context, folder, rows, "study.png")


JOB = Job(check_study, run_study_job)
