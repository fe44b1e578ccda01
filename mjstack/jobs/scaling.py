"""Job *scaling*: throughput from one world to many, each number of worlds in a process."""

import math
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import cast

from rich.markup import escape

from mjstack.config.fingerprint import config_content, config_hash
from mjstack.config.schema import Backend, Config, ScalingJobCfg
from mjstack.episodes.context import RunContext, require_episode
from mjstack.files import to_csv
from mjstack.jobs.gates import check_machine
from mjstack.jobs.job import Job, JobResult
from mjstack.jobs.progress import ProgressBar
from mjstack.jobs.runner import Record, run_reported
from mjstack.jobs.scaling_run import OutOfTime, read_run, run_process
from mjstack.report.record import GateResult, Status
from mjstack.report.scaling import (
    NOT_RUN,
    PASS,
    RATE,
    Row,
    describe_crossover,
    save_scaling_curves,
    scaling_table,
)
from mjstack.report.write import write_tables
from mjstack.sim import resolve_device

# A run sets these itself; the command line's do not reach it.
_OWN = (
    "job",
    "nworld",
    "gates",
    "sim",
    "view",
    "video",
    "gate.throughput.native_baseline",
    "gate.throughput.repetitions",
)
_OWN_NATIVE = (
    "sim.device",
    "gate.throughput.measurements",
    "gate.throughput.steps",
    "gate.throughput.env_steps",
)
_UNUSED = {"nworld", "gates", "gate.throughput.repetitions"}  # and the user is told
_GROWTH = 1.5  # of a run's time over that of the one before

Key = tuple[int, str]
"""Number of worlds and backend."""


def check_scaling(cfg: Config) -> RunContext:
    """Raise for what this machine cannot do, before anything is written."""
    require_episode(cfg)
    resolve_device(cfg.sim.device)
    return check_machine(cfg)


def scaling_folder(cfg: Config) -> Path:
    """Where a configuration's runs are, so that another call finds them."""
    job = asdict(_job(cfg))
    for key in ("nworlds", "backends", "run_minutes", "max_minutes", "retry"):  # change no run
        del job[key]
    config = config_content(cfg)
    for key in ("nworld", "gates", "view", "video"):
        del config[key]
    config["sim"].pop("backend")
    return Path("outputs") / "scaling" / config_hash(config | {"job": job})[:12]


def run_scaling_job(context: RunContext, folder: Path, overrides: list[str]) -> JobResult:
    """Do the runs that are not done, and leave table, plot and report.

    `ScalingJobCfg` says what ends a call.

    Args:
        context: The configuration.
        folder: Where everything goes, and where an earlier call's runs are.
        overrides: The command line; the runs get it too.

    Returns:
        How it ended: a pass if every run is there and passed.
    """
    cfg = context.cfg
    keys = [(nworld, backend) for nworld in _job(cfg).nworlds for backend in _backends(cfg)]
    rows = {key: read_run(_folder(folder, key), *key) for key in keys}

    def work(context: RunContext, bar: ProgressBar, record: Record) -> None:
        for override in overrides:
            if _key(override) in _UNUSED:
                bar.say(f"{escape(override)} is not used: each run of job=scaling sets it")
        _write(cfg, folder, rows)
        left = _run_all(cfg, folder, overrides, rows, bar, record)
        # What is missing, and how to go on
        missing = [key for key, row in rows.items() if row["status"] == NOT_RUN]
        for key in missing:
            record(_as_gate(rows[key], left))
        if any(row["status"] not in (PASS, NOT_RUN) for row in rows.values()):
            bar.say("job.retry=true repeats the runs that failed")
        if missing:
            counts = f"{len(missing)} of {len(rows)} runs have not run ({escape(left)})"
            bar.say(f"incomplete: {counts}. The same command goes on with them.")
        if problem := _write(cfg, folder, rows, draw=True):
            bar.say(escape(problem))
        else:
            context.artifacts.pictures.append("scaling.png")
        bar.say(describe_crossover(list(rows.values())))

    title = f"task {cfg.task.name}, scaling: {len(rows)} runs"
    return run_reported(context, folder, overrides, title, work)


def run_overrides(cfg: Config, overrides: Sequence[str], nworld: int, backend: str) -> list[str]:
    """The command line of a run: the job's, and the keys that the run sets."""
    job = _job(cfg)
    native = backend == "native"
    own = _OWN + (_OWN_NATIVE if native else ())
    out = [
        override
        for override in overrides
        if _key(override) not in own and not _key(override).startswith(("job.", "sim.backend"))
    ]
    repetitions = job.repetitions_large if nworld > job.large else job.repetitions
    out += ["job=gates", f"sim={backend}", f"nworld={nworld}"]
    out += [f"gate.throughput.repetitions={repetitions}"]
    if not native:
        return [*out, "gates=[batch,throughput]", "gate.throughput.native_baseline=false"]
    return [
        *out,
        "gates=[throughput]",
        "sim.device=cpu",
        "gate.throughput.measurements=[physics,env_step]",
        f"gate.throughput.steps={job.native_steps}",
        f"gate.throughput.env_steps={job.native_env_steps}",
        f"gate.throughput.cpu_max_seconds={60.0 * job.run_minutes}",
    ]


def _run_all(
    cfg: Config,
    folder: Path,
    overrides: list[str],
    rows: dict[Key, Row],
    bar: ProgressBar,
    record: Record,
) -> str:
    """Do the runs that are not done, in order; return why some are left, or nothing."""
    job = _job(cfg)
    until = math.inf if job.max_minutes is None else time.monotonic() + 60.0 * job.max_minutes
    for key, row in rows.items():
        if row["status"] == PASS or (row["status"] != NOT_RUN and not job.retry):
            record(_as_gate(row, "done before"))
            continue
        left = until - time.monotonic()
        if _estimate(rows, key) > left:
            return f"{key[1]}, {key[0]} worlds needs more than the {left:.0f} s that are left"
        bar.start(f"{key[1]}, {key[0]} worlds")
        try:
            rows[key] = run_process(
                _folder(folder, key),
                *key,
                run_overrides(cfg, overrides, *key),
                run_seconds=60.0 * job.run_minutes,
                job_seconds=left,
            )
        except OutOfTime as stop:
            return str(stop)
        _write(cfg, folder, rows)
        record(_as_gate(rows[key]))
    return ""


def _estimate(rows: dict[Key, Row], key: Key) -> float:
    """About how long a run takes [s], from those with fewer worlds; 0 where there are none."""
    nworld, backend = key
    smaller = [row for (n, kind), row in rows.items() if kind == backend and n < nworld]
    return _GROWTH * max((row["seconds"] or 0.0 for row in smaller), default=0.0)


def _folder(folder: Path, key: Key) -> Path:
    return folder / "runs" / f"{key[1]}-{key[0]}"


def _job(cfg: Config) -> ScalingJobCfg:
    return cast(ScalingJobCfg, cfg.job)


def _key(override: str) -> str:
    return override.lstrip("+~").partition("=")[0].partition("@")[0]


def _backends(cfg: Config) -> list[str]:
    """The backends to run: those of ``job.backends``, or those that make sense here."""
    asked = _job(cfg).backends
    if asked is not None:
        return list(dict.fromkeys(asked))
    if cfg.sim.backend is not Backend.auto:
        return [cfg.sim.backend.value]
    return ["mjwarp", "native"] if resolve_device(cfg.sim.device).startswith("cuda") else ["native"]


def _as_gate(row: Row, note: str = "") -> GateResult:
    """A row as a result of the report."""
    reason = row["reason"]
    if row["status"] == NOT_RUN:
        reason = "has not run"
    elif row["status"] == PASS:
        reason = f"{row[RATE]:,.0f} world-steps/s" if RATE in row else "no figure"
    return GateResult(
        name=f"{row['backend']}-{row['nworld']}",
        status=Status.passed if row["status"] == PASS else Status.failed,
        reason=f"{reason} ({note})" if note else reason,
        seconds=row["seconds"] or 0.0,
        metrics={key: value for key, value in row.items() if isinstance(value, float | int)},
        notes={key: row[key] for key in ("hardware", "git_commit") if row[key]},
    )


def _write(cfg: Config, folder: Path, rows: dict[Key, Row], draw: bool = False) -> str:
    """Write table and plot of the runs so far; return why there is no plot."""
    job = _job(cfg)
    t = cfg.gate.throughput
    known = list(rows.values())
    title = f"{cfg.robot.title}, task {cfg.task.name}: throughput over the number of worlds"
    notes = [
        describe_crossover(known),
        (
            "ms per step and world-steps/s: physics under a held joint target from"
            f" {t.from_phase} on, object in hand; medians of {job.repetitions} repetitions up to"
            f" {job.large:,} worlds, of {job.repetitions_large} above."
        ),
        (
            "env-steps/s: env.step with all managers, random actions and resets,"
            f" {cfg.timing.decimation} physics steps each. managers: the time they add to its"
            " physics, in which worlds that would have ended go on. managers alone: their time"
            " without physics, over that of physics."
        ),
        (
            "MJWarp: successful worlds of the whole episode. Its seconds include the episode check."
            " over bare steps: against replayed mujoco_warp.step alone with the same joint targets."
            " capture: of the episode's graph, without its warm-up. Power, in scaling.csv: during"
            " the episodes' replayed steps alone."
        ),
        (
            f"native: {job.native_steps} steps of physics per repetition on all cores. No episode"
            f" is played or judged. Beyond {t.start_worlds} worlds the start states repeat."
        ),
    ]
    for name in ("hardware", "git_commit"):
        values = sorted({row[name] for row in known if row[name]})
        notes += [f"{name.removeprefix('git_')}: {value}" for value in values]
    return write_tables(
        folder,
        "scaling",
        title,
        [scaling_table(known)],
        notes,
        to_csv(known),
        (lambda path: save_scaling_curves(path, known, cfg.timing.decimation, title))
        if draw
        else None,
    )


JOB = Job(check_scaling, run_scaling_job, folder=scaling_folder)
