"""Job *scaling*: throughput from one world to many. A case that fails is a gap; what is done is not
done again.
"""

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
from mjstack.errors import ConfigError
from mjstack.files import to_csv, write_atomic
from mjstack.jobs.case import OutOfTime, is_done, read_case, run_case
from mjstack.jobs.gates import check_machine
from mjstack.jobs.result import JobResult
from mjstack.jobs.runner import model_text
from mjstack.report.curves import save_scaling_curves
from mjstack.report.provenance import collect_provenance
from mjstack.report.record import GateResult, Report, Status
from mjstack.report.scaling import (
    COLUMNS,
    NOT_RUN,
    PASS,
    ScalingRow,
    describe_crossover,
    to_markdown,
)
from mjstack.scene import build_model
from mjstack.sim import cuda_driver, resolve_device

log = logging.getLogger(__name__)

# What a case sets itself: these of the command line do not reach it.
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
    "gate.throughput.sections",
    "gate.throughput.steps",
    "gate.throughput.env_steps",
)
_GROWTH = 1.5  # of a case over the one before, where the last two do not tell


def check_scaling(cfg: Config) -> None:
    """Raises for what this machine cannot do, before anything is written."""
    for key in ("view", "video"):
        if getattr(cfg, key):
            raise ConfigError(
                key, "true", "false with job=scaling, which shows no world", "Leave it out"
            )
    backends = _backends(cfg)
    if "mjwarp" in backends:
        resolve_device(cfg.sim.device)
    check_machine(replace(cfg, sim=replace(cfg.sim, backend=Backend(backends[0]), device="cpu")))


def scaling_folder(cfg: Config) -> Path:
    """Where a configuration's cases are, so that another call finds them."""
    job = asdict(_job(cfg))
    for key in (
        "nworlds",
        "backends",
        "case_minutes",
        "max_minutes",
        "retry",
    ):  # they change no case
        del job[key]
    config = config_content(cfg)
    for key in ("nworld", "gates", "view", "video"):
        del config[key]
    config["sim"].pop("backend")
    return Path("outputs") / "scaling" / config_hash(config | {"job": job})[:12]


def run_scaling_job(cfg: Config, folder: Path, overrides: list[str]) -> JobResult:
    """Runs the cases that are not done, and leaves table, plot and report; see `ScalingJobCfg` for
    what ends a call.

    Args:
        cfg: The configuration.
        folder: Where everything goes, and where an earlier call's cases are.
        overrides: What was asked for on the command line; the cases get it too.

    Returns:
        How it ended: a pass if every case is there and passed.
    """
    job = _job(cfg)
    console = Console(highlight=False)
    outcome = JobResult(status=Status.interrupted, folder=folder, overrides=overrides)
    cases = [(nworld, backend) for nworld in job.nworlds for backend in _backends(cfg)]
    folders = {case: folder / "cases" / f"{case[1]}-{case[0]}" for case in cases}
    rows = {case: read_case(folders[case], *case) for case in cases}
    until = math.inf if job.max_minutes is None else time.monotonic() + 60.0 * job.max_minutes
    console.print(
        f"[bold]{cfg.robot.title}[/], task {cfg.task.name}, scaling: {len(cases)} cases ->"
        f" {escape(str(folder))}",
        soft_wrap=True,
    )
    for override in overrides:
        if _key(override) in {"nworld", "gates", "gate.throughput.repetitions"}:
            console.print(
                f"{escape(override)} is not used: each case of job=scaling has its own",
                soft_wrap=True,
            )
    try:
        incomplete = ""
        started = False
        for number, case in enumerate(cases, 1):
            nworld, backend = case
            label = f"{number}/{len(cases)} {backend}, {nworld} worlds"
            if is_done(rows[case], job.retry):
                console.print(f"{label}: {_describe(rows[case])} (done before)", soft_wrap=True)
                continue
            left = until - time.monotonic()
            if started and _estimate(rows, case) > left:
                incomplete = f"{label} needs more than the {max(left, 0.0):.0f} s that are left"
                break
            started = True
            try:
                rows[case] = run_case(
                    folders[case],
                    nworld,
                    backend,
                    case_overrides(cfg, overrides, nworld, backend),
                    case_seconds=60.0 * job.case_minutes,
                    call_seconds=left,
                )
            except OutOfTime as stop:
                incomplete = str(stop)
                break
            log.info("%s: %s", label, rows[case].status)
            console.print(f"{label}: {_describe(rows[case])}", soft_wrap=True)
            _write_tables(cfg, folder, list(rows.values()))
        outcome.status = (
            Status.passed if all(row.status == PASS for row in rows.values()) else Status.failed
        )
        outcome.gates = _conclude(cfg, folder, rows, incomplete, console)
    except KeyboardInterrupt:
        outcome.status = Status.interrupted
        try:
            outcome.gates = _conclude(cfg, folder, rows, "interrupted", console)
        except OSError as error:
            _say_unwritten(folder, error)
    except OSError as error:
        outcome.status = Status.failed
        _say_unwritten(folder, error)
    return outcome


def case_overrides(cfg: Config, overrides: Sequence[str], nworld: int, backend: str) -> list[str]:
    """The command line of a case: the job's own, and what the case sets."""
    job = _job(cfg)
    native = backend == "native"
    own = _OWN + (_OWN_NATIVE if native else ())
    kept = [
        o
        for o in overrides
        if _key(o) not in own and not _key(o).startswith(("job.", "sim.backend"))
    ]
    many = nworld > job.large
    out = [*kept, "job=gates", f"sim={backend}", f"nworld={nworld}"]
    out.append(f"gate.throughput.repetitions={job.repetitions_large if many else job.repetitions}")
    if not native:
        return [*out, "gates=[batch,throughput]", "gate.throughput.native_baseline=false"]
    return [
        *out,
        "gates=[throughput]",
        "sim.device=cpu",
        "gate.throughput.sections=[physics,env_step]",
        f"gate.throughput.steps={job.native_steps}",
        f"gate.throughput.env_steps={job.native_env_steps}",
        f"gate.throughput.cpu_max_seconds={60.0 * job.case_minutes}",
    ]


def _say_unwritten(folder: Path, error: OSError) -> None:
    Console(stderr=True, soft_wrap=True).print(
        f"mjstack: {escape(str(folder))} cannot be written: {error.strerror}. Free space, and run"
        " the same command again."
    )


def _job(cfg: Config) -> ScalingJobCfg:
    return cast(ScalingJobCfg, cfg.job)


def _key(override: str) -> str:
    return override.lstrip("+~").partition("=")[0].partition("@")[0]


def _backends(cfg: Config) -> list[str]:
    """The backends to run, those that were asked for or those that make sense here."""
    asked = _job(cfg).backends
    if asked is not None:
        return list(dict.fromkeys(asked))
    if cfg.sim.backend is not Backend.auto:
        return [cfg.sim.backend.value]
    return ["mjwarp", "native"] if resolve_device(cfg.sim.device).startswith("cuda") else ["native"]


def _estimate(rows: dict[tuple[int, str], ScalingRow], case: tuple[int, str]) -> float:
    """About how long a case will take [s], from those with fewer worlds on the same backend; 0
    where there are none.
    """
    done = sorted(
        (row.nworld, float(row.seconds))
        for row in rows.values()
        if row.backend == case[1] and row.nworld < case[0] and isinstance(row.seconds, float)
    )
    if not done:
        return 0.0
    growth = done[-1][1] / done[-2][1] if len(done) > 1 else _GROWTH
    return done[-1][1] * max(1.0, growth)


def _describe(row: ScalingRow) -> str:
    if row.status != PASS:
        return f"{row.status}: {row.reason}" if row.reason else row.status
    rate = (
        f"{row.world_steps_per_s:,.0f} world-steps/s"
        if isinstance(row.world_steps_per_s, float)
        else "no figure"
    )
    return (
        f"pass ({row.seconds:.0f} s): {rate}" if isinstance(row.seconds, float) else f"pass: {rate}"
    )


def _write_tables(cfg: Config, folder: Path, rows: list[ScalingRow], picture: str = "") -> None:
    write_atomic(folder / "scaling.csv", to_csv(COLUMNS, map(asdict, rows)))
    write_atomic(folder / "scaling.md", to_markdown(rows, _title(cfg), _notes(cfg), picture))


def _title(cfg: Config) -> str:
    return f"{cfg.robot.title}, task {cfg.task.name}: throughput over the number of worlds"


def _notes(cfg: Config) -> list[str]:
    job = _job(cfg)
    t = cfg.gate.throughput
    return [
        (
            f"ms per step and world-steps/s: physics under a held command from {t.from_phase} on,"
            f" cube in hand; medians of {job.repetitions} repetitions up to {job.large:,} worlds,"
            f" of {job.repetitions_large} above."
        ),
        (
            "env-steps/s: env.step with all managers, random actions and resets,"
            f" {cfg.timing.decimation} physics steps each; managers: what they add to its physics,"
            " in which worlds that would have ended go on; managers alone: their own time over"
            " that of physics."
        ),
        (
            "MJWarp: successful worlds of the whole episode; its seconds include the check's check;"
            " over bare steps: against replayed mujoco_warp.step alone on the same commands;"
            " capture: that of the episode's graph, without its warm-up; power, in scaling.csv:"
            " during the episodes' replayed steps alone."
        ),
        (
            f"native: {job.native_steps} steps of physics per repetition on all cores; no episode,"
            f" so these worlds are not judged; beyond {t.start_worlds} worlds the start states"
            " repeat."
        ),
    ]


def _conclude(
    cfg: Config,
    folder: Path,
    rows: dict[tuple[int, str], ScalingRow],
    incomplete: str,
    console: Console,
) -> list[GateResult]:
    """Table, plot and report of what there is."""
    table = list(rows.values())
    picture = ""
    try:
        save_scaling_curves(folder / "scaling.png", table, cfg.timing.decimation, _title(cfg))
        picture = "scaling.png"
    except Exception as error:  # drawing must not take back what the cases found
        log.exception("drawing failed")
        console.print(f"no picture: {escape(str(error) or type(error).__name__)}", soft_wrap=True)
    _write_tables(cfg, folder, table, picture)
    report = Report(
        provenance=collect_provenance(
            config_yaml=OmegaConf.to_yaml(OmegaConf.structured(cfg)),
            model_text=model_text(build_model(cfg)),
            device="each case's own report says",
            driver=cuda_driver(),
        )
    )
    report.gates = [_as_gate(row) for row in table]
    report.pictures = [picture] if picture else []
    if not incomplete:
        report.conclude()
    report.write(folder)
    missing = [row for row in table if row.status == NOT_RUN]
    failed = [row for row in table if row.status not in (PASS, NOT_RUN)]
    console.print(describe_crossover(table))
    console.print(f"table: {escape(str(folder))}/scaling.md", soft_wrap=True)
    if failed:
        console.print(f"{len(failed)} of {len(table)} cases failed; job.retry=true runs them again")
    if missing:
        console.print(
            f"incomplete: {len(missing)} of {len(table)} cases have not run ({escape(incomplete)})."
            " The same command goes on with them.",
            soft_wrap=True,
        )
    return report.gates


def _as_gate(row: ScalingRow) -> GateResult:
    """A row as a result of the report."""
    status = {PASS: Status.passed, NOT_RUN: Status.skipped}.get(row.status, Status.failed)
    reason = "has not run" if row.status == NOT_RUN else _describe(row)
    values = asdict(row).items()
    metrics = {key: value for key, value in values if isinstance(value, float | int)}
    seconds = float(row.seconds) if isinstance(row.seconds, float) else 0.0
    return GateResult(
        name=f"{row.backend}-{row.nworld}",
        status=status,
        reason=reason,
        seconds=seconds,
        metrics=metrics,
        notes={"hardware": row.hardware, "git_commit": row.git_commit},
    )
