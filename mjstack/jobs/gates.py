"""Job *gates*: a configuration and a folder in, gates run, a report left behind."""

from dataclasses import replace
from pathlib import Path

from mjstack.config.check import reads_starts_file
from mjstack.config.schema import Backend, Config
from mjstack.drivers.tilt import turn_sign
from mjstack.envs import build_env
from mjstack.episodes.context import RunContext
from mjstack.episodes.earlier_run import archive_starts
from mjstack.episodes.record import clear_records
from mjstack.errors import ConfigError
from mjstack.gates.runner import find_gates, run_gates
from mjstack.gates.success import success_config
from mjstack.jobs.runner import CheckedJob, Job, check_showing
from mjstack.sim import resolve_backend


def check_machine(cfg: Config) -> RunContext:
    """Build scene and plan, and raise for what this machine cannot do, before anything is written.

    Returns:
        The context of the run.
    """
    find_gates(cfg)
    context = RunContext(cfg)
    check_task(context)
    if (cfg.view or cfg.video) and not {"baseline", "parity"} & set(cfg.gates):
        key = "view" if cfg.view else "video"
        expected = "gates with baseline or parity, whose world is shown"
        raise ConfigError(key, "true", expected, "Add one of them to gates")
    check_showing(cfg)
    if "success" in cfg.gates:
        _check_success(context)
    return context


def _check_success(context: RunContext) -> None:
    """Raise if worlds cannot start as the success gate has them, by the key that says so."""
    cfg = context.cfg
    try:
        check_env(context, success_config(cfg))
    except ConfigError as error:
        if error.key.startswith("reset.") and not reads_starts_file(cfg.reset):
            region = cfg.gate.success.region is not None and error.key.endswith(".params.xy")
            raise error.at(
                "gate.success.region" if region else f"gate.success.{error.key}"
            ) from error
        raise


def check_task(context: RunContext) -> None:
    """Raise if the task cannot be played as configured, on this machine."""
    cfg = context.cfg
    resolve_backend(cfg)
    if cfg.task.check is not None:
        _ = context.check  # reads its thresholds
    if cfg.controller.phases:
        _ = context.planner  # reads the robot, and reaches every nominal target
    check_env(context, cfg)
    if cfg.controller.phases and cfg.controller.approach_gain > 0.0:
        turn_sign(context.model, cfg)


def check_env(context: RunContext, cfg: Config) -> None:
    """Build an environment in the context's scene, which checks every term."""
    build_env(cfg, model=context.model, nworld=1, backend=Backend.native, device="cpu").close()


def check_gates(cfg: Config) -> CheckedJob:
    """Raise for what this machine cannot do, before anything is written."""
    title = f"task {cfg.task.name}, {cfg.nworld} worlds, gates {', '.join(cfg.gates)}"
    return CheckedJob(context=check_machine(cfg), title=title, work=_run_gates)


def _run_gates(context: RunContext, folder: Path) -> None:
    """Run the gates in a folder without an earlier run's records."""
    context = replace(context, cfg=archive_starts(context.cfg, folder))
    starts = context.cfg.starts
    clear_records(folder, keep=None if starts is None else Path(starts))
    run_gates(context)


JOB = Job(check_gates, shows=True)
