"""Job *gates*: a configuration and a folder in, gates run, a report left behind."""

from __future__ import annotations

from pathlib import Path

from mjstack.config.schema import Backend, Config
from mjstack.config.validate import reads_starts_file
from mjstack.drivers.open_loop import OpenLoopPlanner
from mjstack.drivers.tilt import turn_sign
from mjstack.envs import build_env
from mjstack.episodes.context import GateContext
from mjstack.episodes.record import clear_records
from mjstack.errors import ConfigError
from mjstack.gates.runner import run_gates
from mjstack.gates.success import success_config
from mjstack.jobs.archived_starts import archive_starts
from mjstack.jobs.memory_check import check_room
from mjstack.jobs.progress import ProgressBar
from mjstack.jobs.result import JobResult
from mjstack.jobs.runner import Record, check_showing, run_reported
from mjstack.sim import resolve_backend
from mjstack.tasks.check import make_check


def check_machine(cfg: Config) -> None:
    """Raises for what this machine cannot do, before anything is written."""
    check_task(cfg)
    if (cfg.view or cfg.video) and not {"baseline", "parity"} & set(cfg.gates):
        key = "view" if cfg.view else "video"
        raise ConfigError(
            key,
            "true",
            "gates with baseline or parity, whose world is shown",
            "Add one of them to gates",
        )
    check_showing(cfg)
    if "success" in cfg.gates:
        _check_success(cfg)


def _check_success(cfg: Config) -> None:
    """Raises if worlds cannot start as the success gate has them, by the key that says so."""
    try:
        build_env(success_config(cfg), nworld=1, backend=Backend.native, device="cpu").close()
    except ConfigError as error:
        if error.key.startswith("reset.") and not reads_starts_file(cfg.reset):
            region = cfg.gate.success.region is not None and error.key.endswith(".params.xy")
            raise error.at(
                "gate.success.region" if region else f"gate.success.{error.key}"
            ) from error
        raise


def check_task(cfg: Config) -> None:
    """Raises if the scripted task cannot be played as configured, on this machine."""
    resolve_backend(cfg)
    make_check(cfg)  # reads its thresholds
    OpenLoopPlanner(cfg)  # reads the robot, and reaches every nominal target
    env = build_env(
        cfg, nworld=1, backend=Backend.native, device="cpu"
    )  # builds and checks every term
    if cfg.job.name in ("gates", "study"):
        check_room(cfg, env.sim.model)
    if cfg.controller.approach_gain > 0.0:
        turn_sign(env.sim.model, cfg)
    env.close()


def run_gates_job(cfg: Config, folder: Path, overrides: list[str]) -> JobResult:
    """Runs the gates of one configuration and writes its report after each; see `run_reported`."""
    title = f"task {cfg.task.name}, {cfg.nworld} worlds, gates {', '.join(cfg.gates)}"
    return run_reported(cfg, folder, overrides, title, _run)


def _run(context: GateContext, bar: ProgressBar, record: Record) -> None:
    if context.folder is not None:
        context.cfg = archive_starts(context.cfg, context.folder)
        starts = context.cfg.starts
        clear_records(context.folder, keep=None if starts is None else Path(starts))
    run_gates(context, bar.start, record)
