"""Job *scaling*: throughput from one world to many, each number of worlds in a process."""

import math
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

from mjstack.config.fingerprint import config_content, config_hash
from mjstack.config.schema import Backend, Config, ScalingJobCfg
from mjstack.episodes.context import RunContext, require_episode
from mjstack.files import to_csv
from mjstack.jobs.gates import check_machine
from mjstack.jobs.runner import CheckedJob, Job, write_tables
from mjstack.jobs.scaling_run import NOT_RUN, PASS, Row, read_run, run_process
from mjstack.report.picture import figure
from mjstack.report.record import GateResult, Status
from mjstack.report.table import Table
from mjstack.sim import resolve_device

RUNS = "runs"  # within the job's folder
RATE = "physics.world_steps_per_s.median"
# A run sets these itself, and the user is told that the command line does not.
_UNUSED = {"nworld", "gates", "gate.throughput.repetitions"}
_GROWTH = 1.5  # of a run's time over that of the one before
# By backend: colour, label, and height at which failed runs are marked (share of the axis).
_BACKENDS = {"mjwarp": ("#2a7d2e", "MJWarp", 0.02), "native": ("#2457c7", "native MuJoCo", 0.06)}
_SERIES = (
    (RATE, "-", "o", "physics"),
    ("env_step.env_steps_per_s.median", "--", "s", "env.step"),
)


def check_scaling(cfg: Config) -> CheckedJob:
    """Raise for what this machine cannot do, before anything is written."""
    require_episode(cfg)
    resolve_device(cfg.sim.device)
    count = len(_job(cfg).nworlds) * len(_backends(cfg))
    folder = scaling_folder(cfg)
    return CheckedJob(
        context=check_machine(cfg),
        title=f"task {cfg.task.name}, scaling: {count} runs",
        work=run_scaling,
        folder=folder,
        own=RUNS,
        resumes=f"scaling {folder.name}",
    )


def scaling_folder(cfg: Config) -> Path:
    """Where a configuration's runs are, so that another call finds them."""
    config = config_content(cfg)
    for key in ("nworlds", "backends", "run_minutes", "max_minutes", "retry"):  # change no run
        del config["job"][key]
    for key in ("nworld", "gates", "view", "video"):
        del config[key]
    del config["sim"]["backend"]
    return Path("outputs/scaling") / config_hash(config)[:12]


def run_scaling(context: RunContext, folder: Path) -> None:
    """Do the runs that are not done, and leave table and plot beside them in the folder.

    `ScalingJobCfg` says what ends a call.
    """
    cfg = context.cfg
    rows = [
        read_run(_folder(folder, nworld, backend), nworld, backend)
        for nworld in _job(cfg).nworlds
        for backend in _backends(cfg)
    ]
    for override in context.overrides:
        if override.lstrip("+~").partition("=")[0] in _UNUSED:
            context.print_line(f"{override} is not used: each run of job=scaling sets it")
    _write(context, rows)
    left = _run_all(context, folder, rows)

    # Missing runs, and how to go on
    missing = [row for row in rows if row["status"] == NOT_RUN]
    for row in missing:
        context.record(_as_gate(row, left))
    if any(row["status"] not in (PASS, NOT_RUN) for row in rows):
        context.print_line("job.retry=true repeats the runs that failed")
    if missing:
        counts = f"{len(missing)} of {len(rows)} runs have not run ({left})"
        context.print_line(f"incomplete: {counts}. The same command goes on with them.")
    _write(context, rows, draw=True)
    context.print_line(describe_crossover(rows))


def run_overrides(cfg: Config, overrides: Sequence[str], nworld: int, backend: str) -> list[str]:
    """The command line of a run: the job's, and the keys that the run sets, which win as the last
    ones.
    """
    job = _job(cfg)
    repetitions = job.repetitions_large if nworld > job.large else job.repetitions
    out = [o for o in overrides if not o.lstrip("+~").startswith(("job=", "job."))]
    out += [f"sim.backend={backend}", f"nworld={nworld}"]
    out += [f"gate.throughput.repetitions={repetitions}"]
    if backend != "native":
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


def _run_all(context: RunContext, folder: Path, rows: list[Row]) -> str:
    """Do the runs that are not done, in order; return why some are left, or nothing."""
    cfg = context.cfg
    job = _job(cfg)
    until = math.inf if job.max_minutes is None else time.monotonic() + 60.0 * job.max_minutes
    for number, row in enumerate(rows):
        if row["status"] == PASS or (row["status"] != NOT_RUN and not job.retry):
            context.record(_as_gate(row, "done before"))
            continue
        key = (row["nworld"], row["backend"])
        name = f"{key[1]}, {key[0]} worlds"
        # About as long as the slowest one with fewer worlds took, and more
        smaller = [one for one in rows if one["backend"] == key[1] and one["nworld"] < key[0]]
        left = until - time.monotonic()
        if _GROWTH * max((one.get("seconds", 0.0) for one in smaller), default=0.0) > left:
            return f"{name} needs more than the {left:.0f} s that are left"
        context.begin(name)
        rows[number] = run_process(
            _folder(folder, *key),
            row,
            run_overrides(cfg, context.overrides, *key),
            run_seconds=60.0 * job.run_minutes,
            job_seconds=left,
        )
        if rows[number]["status"] == NOT_RUN:
            return rows[number]["reason"]
        _write(context, rows)
        context.record(_as_gate(rows[number]))
    return ""


def _folder(folder: Path, nworld: int, backend: str) -> Path:
    return folder / RUNS / f"{backend}-{nworld}"


def _job(cfg: Config) -> ScalingJobCfg:
    return cast(ScalingJobCfg, cfg.job)


def _backends(cfg: Config) -> list[str]:
    """The backends to run: those of ``job.backends``, or those that make sense here."""
    asked = _job(cfg).backends
    if asked is not None:
        return asked
    if cfg.sim.backend is not Backend.auto:
        return [str(cfg.sim.backend)]
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
        seconds=row.get("seconds", 0.0),
        metrics={key: value for key, value in row.items() if isinstance(value, float | int)},
        notes={key: row[key] for key in ("hardware", "git_commit") if row[key]},
    )


def _write(context: RunContext, rows: list[Row], draw: bool = False) -> None:
    """Write table and plot of the runs so far."""
    cfg = context.cfg
    job = _job(cfg)
    t = cfg.gate.throughput
    title = f"{cfg.robot.title}, task {cfg.task.name}: throughput over the number of worlds"
    notes = [
        describe_crossover(rows),
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
        values = sorted({row[name] for row in rows if row[name]})
        notes += [f"{name.removeprefix('git_')}: {value}" for value in values]
    write_tables(
        context,
        "scaling",
        title,
        Table.of(SHOWN, rows),
        notes,
        to_csv(rows),
        (lambda path: save_scaling_curves(path, rows, cfg.timing.decimation, title))
        if draw
        else None,
    )


def crossover(rows: Sequence[Row]) -> float | None:
    """Number of worlds from which MJWarp makes more world-steps/s than native MuJoCo.

    Interpolated between the two numbers of worlds that bracket it, straight in logarithms. Runs
    that failed do not count. None where the rows do not show it.
    """
    rates = {
        (row["backend"], row["nworld"]): row[RATE]
        for row in rows
        if row["status"] == PASS and RATE in row
    }
    both = sorted({n for _, n in rates if ("mjwarp", n) in rates and ("native", n) in rates})
    points = [(n, math.log(rates["mjwarp", n] / rates["native", n])) for n in both]
    for (n0, gap0), (n1, gap1) in pairwise(points):
        if gap0 <= 0.0 < gap1:
            return math.exp(math.log(n0) + (math.log(n1) - math.log(n0)) * -gap0 / (gap1 - gap0))
    return None


def describe_crossover(rows: Sequence[Row]) -> str:
    """The crossover in a sentence."""
    at = crossover(rows)
    if at is None:
        return "Crossover: the runs that passed do not show MJWarp passing native MuJoCo."
    return (
        f"Crossover: from about {at:,.0f} worlds on MJWarp makes more physics steps than native"
        " MuJoCo on all cores."
    )


def save_scaling_curves(path: Path, rows: Sequence[Row], decimation: int, title: str) -> None:
    """Draw throughput and time per step over the number of worlds.

    A run that did not pass interrupts its curves, even with figures, and a cross marks it. Steps of
    environments are drawn as world-steps/s too.
    """
    with figure(path, f"{title} (x: no figure)", 2, figsize=(12, 4.8)) as (_, (rate, cost)):
        for backend, (color, label, height) in _BACKENDS.items():
            mine = sorted(
                (row for row in rows if row["backend"] == backend), key=lambda row: row["nworld"]
            )
            worlds = [row["nworld"] for row in mine]
            # A curve per series
            for name, line, marker, series in _SERIES:
                factor = 1 if name == RATE else decimation
                values = [
                    factor * row.get(name, math.nan) if row["status"] == PASS else math.nan
                    for row in mine
                ]
                if all(math.isnan(value) for value in values):
                    continue
                steps_ms = [1e3 * n / value for n, value in zip(worlds, values, strict=True)]
                style: dict[str, Any] = {"marker": marker, "markersize": 4, "color": color}
                for axes, curve in ((rate, values), (cost, steps_ms)):
                    axes.plot(worlds, curve, line, label=f"{label}, {series}", **style)
            # Runs without a figure
            failed = [row["nworld"] for row in mine if row["status"] != PASS]
            for axes in (rate, cost):
                at_height = axes.get_xaxis_transform()
                axes.plot(failed, [height] * len(failed), "x", color=color, transform=at_height)
        # Axes
        at = crossover(rows)
        ticks = sorted({row["nworld"] for row in rows})
        for axes, name in ((rate, "world-steps/s"), (cost, "ms per physics step of all worlds")):
            axes.set(yscale="log", xlabel="worlds", ylabel=name)
            axes.set_xscale("log", base=2)
            axes.set_xticks(ticks, [f"{n:,}" for n in ticks], rotation=45)
            axes.grid(alpha=0.3)
            if at is not None:
                axes.axvline(at, color="0.4", linestyle=":", label=f"crossover, {at:,.0f} worlds")
            if axes.get_legend_handles_labels()[0]:
                axes.legend(frameon=False, fontsize=8)


SHOWN = {
    "worlds": "nworld",
    "backend": "backend",
    "succeeded": "succeeded",
    "ms per step": "physics.ms_per_batched_step.median",
    "world-steps/s": RATE,
    "env-steps/s": "env_step.env_steps_per_s.median",
    "managers": "env_step.managers_over_physics.median",
    "managers alone": "env_step.managers_alone_over_physics.median",
    "episode, s": "episode.seconds.median",
    "over bare steps": "episode.bare_ratio.median",
    "GPU memory, MiB": "env_step.gpu_memory_whole_gpu_mib",
    "capture, s": "episode.capture_s",
    "status": "status",
    "reason": "reason",
}

JOB = Job(check_scaling)
