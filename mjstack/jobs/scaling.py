"""Job *scaling*: throughput from one world to many, each number of worlds in a process."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import cast

from omegaconf import OmegaConf
from rich.console import Console
from rich.markup import escape

from mjstack.config.fingerprint import config_content, config_hash
from mjstack.config.schema import Backend, Config, ScalingJobCfg
from mjstack.episodes.context import require_episode
from mjstack.errors import ConfigError
from mjstack.files import to_csv, write_atomic
from mjstack.jobs.gates import check_machine
from mjstack.jobs.job import Job
from mjstack.jobs.result import JobResult
from mjstack.jobs.runner import model_text
from mjstack.jobs.scaling_run import OutOfTime, is_done, read_run, run_process
from mjstack.report.curves import save_scaling_curves
from mjstack.report.provenance import collect_provenance
from mjstack.report.record import GateResult, Report, Status
from mjstack.report.scaling import COLUMNS, NOT_RUN, PASS, Row, describe_crossover, to_markdown
from mjstack.report.write import safely_draw, write_report
from mjstack.scene import build_model
from mjstack.sim import cuda_driver, resolve_device

log = logging.getLogger(__name__)

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
_GROWTH = 1.5  # of a run's time over the one before, where the last two do not tell

Key = tuple[int, str]
"""Number of worlds and backend."""


def check_scaling(cfg: Config) -> None:
    """Raise for what this machine cannot do, before anything is written."""
    for key in ("view", "video"):
        if getattr(cfg, key):
            raise ConfigError(
                key, "true", "false with job=scaling, which shows no world", "Leave it out"
            )
    require_episode(cfg)
    backends = _backends(cfg)
    if "mjwarp" in backends:
        resolve_device(cfg.sim.device)
    check_machine(replace(cfg, sim=replace(cfg.sim, backend=Backend(backends[0]), device="cpu")))


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


def run_scaling_job(cfg: Config, folder: Path, overrides: list[str]) -> JobResult:
    """Do the runs that are not done, and leave table, plot and report.

    `ScalingJobCfg` says what ends a call.

    Args:
        cfg: The configuration.
        folder: Where everything goes, and where an earlier call's runs are.
        overrides: The command line; the runs get it too.

    Returns:
        How it ended: a pass if every run is there and passed.
    """
    console = Console(highlight=False, soft_wrap=True)
    outcome = JobResult(status=Status.failed, folder=folder, overrides=overrides)
    keys = [(nworld, backend) for nworld in _job(cfg).nworlds for backend in _backends(cfg)]
    rows = {key: read_run(_folder(folder, key), *key) for key in keys}
    console.print(
        f"[bold]{cfg.robot.title}[/], task {cfg.task.name}, scaling: {len(rows)} runs ->"
        f" {escape(str(folder))}"
    )
    for override in overrides:
        if _key(override) in _UNUSED:
            console.print(f"{escape(override)} is not used: each run of job=scaling sets it")
    try:
        try:
            incomplete = _run_all(cfg, folder, overrides, rows, console)
            outcome.gates = _conclude(cfg, folder, list(rows.values()), incomplete, console)
            if all(row["status"] == PASS for row in rows.values()):
                outcome.status = Status.passed
        except KeyboardInterrupt:
            outcome.status = Status.interrupted
            outcome.gates = _conclude(cfg, folder, list(rows.values()), "interrupted", console)
    except OSError as error:
        Console(stderr=True, soft_wrap=True).print(
            f"mjstack: {escape(str(folder))} cannot be written: {error.strerror}. Free space, and"
            " run the same command again."
        )
    return outcome


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
    cfg: Config, folder: Path, overrides: list[str], rows: dict[Key, Row], console: Console
) -> str:
    """Do the runs that are not done, in order; return why some are left, or nothing."""
    job = _job(cfg)
    until = math.inf if job.max_minutes is None else time.monotonic() + 60.0 * job.max_minutes
    started = False
    for number, key in enumerate(rows, 1):
        label = f"{number}/{len(rows)} {key[1]}, {key[0]} worlds"
        if is_done(rows[key], job.retry):
            console.print(f"{label}: {_describe(rows[key])} (done before)")
            continue
        left = until - time.monotonic()
        if started and _estimate(rows, key) > left:
            return f"{label} needs more than the {max(left, 0.0):.0f} s that are left"
        started = True
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
        log.info("%s: %s", label, rows[key]["status"])
        console.print(f"{label}: {_describe(rows[key])}")
        _write_tables(cfg, folder, list(rows.values()))
    return ""


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


def _estimate(rows: dict[Key, Row], key: Key) -> float:
    """About how long a run takes [s], from those with fewer worlds on the same backend.

    0 where there are none.
    """
    done = sorted(
        (row["nworld"], row["seconds"])
        for row in rows.values()
        if row["backend"] == key[1] and row["nworld"] < key[0] and row["seconds"] is not None
    )
    if not done:
        return 0.0
    growth = done[-1][1] / done[-2][1] if len(done) > 1 else _GROWTH
    return done[-1][1] * max(1.0, growth)


def _describe(row: Row) -> str:
    if row["status"] != PASS:
        return f"{row['status']}: {row['reason']}" if row["reason"] else row["status"]
    rate = row["world_steps_per_s"]
    figure = "no figure" if rate is None else f"{rate:,.0f} world-steps/s"
    return f"pass ({row['seconds']:.0f} s): {figure}"


def _write_tables(cfg: Config, folder: Path, rows: list[Row], picture: str = "") -> None:
    write_atomic(folder / "scaling.csv", to_csv(list(COLUMNS), rows))
    write_atomic(folder / "scaling.md", to_markdown(rows, _title(cfg), _notes(cfg), picture))


def _title(cfg: Config) -> str:
    return f"{cfg.robot.title}, task {cfg.task.name}: throughput over the number of worlds"


def _notes(cfg: Config) -> list[str]:
    job = _job(cfg)
    t = cfg.gate.throughput
    return [
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


def _conclude(
    cfg: Config, folder: Path, rows: list[Row], incomplete: str, console: Console
) -> list[GateResult]:
    """Write table, plot and report of the runs so far."""
    picture = "scaling.png"
    args = (rows, cfg.timing.decimation, _title(cfg))
    if problem := safely_draw(folder / picture, save_scaling_curves, *args):
        console.print(escape(problem))
        picture = ""
    _write_tables(cfg, folder, rows, picture)
    provenance = collect_provenance(
        config_yaml=OmegaConf.to_yaml(OmegaConf.structured(cfg)),
        model_text=model_text(build_model(cfg)),
        device="each run's report says",
        driver=cuda_driver(),
    )
    report = Report(provenance=provenance, gates=[_as_gate(row) for row in rows])
    report.pictures = [picture] if picture else []
    if not incomplete:
        report.conclude()
    write_report(report, folder)
    # On the terminal: the crossover, the table, and how to go on.
    missing = sum(row["status"] == NOT_RUN for row in rows)
    failed = sum(row["status"] not in (PASS, NOT_RUN) for row in rows)
    console.print(describe_crossover(rows))
    console.print(f"table: {escape(str(folder))}/scaling.md")
    if failed:
        console.print(f"{failed} of {len(rows)} runs failed; job.retry=true repeats them")
    if missing:
        console.print(
            f"incomplete: {missing} of {len(rows)} runs have not run ({escape(incomplete)}). The"
            " same command goes on with them."
        )
    return report.gates


def _as_gate(row: Row) -> GateResult:
    """A row as a result of the report."""
    status = {PASS: Status.passed, NOT_RUN: Status.skipped}.get(row["status"], Status.failed)
    return GateResult(
        name=f"{row['backend']}-{row['nworld']}",
        status=status,
        reason="has not run" if row["status"] == NOT_RUN else _describe(row),
        seconds=row["seconds"] or 0.0,
        metrics={key: value for key, value in row.items() if isinstance(value, float | int)},
        notes={key: row[key] for key in ("hardware", "git_commit") if row[key]},
    )


JOB = Job(check_scaling, run_scaling_job, folder=scaling_folder)
