"""Job *gates*: a configuration and a folder in, gates run, a report left behind."""

from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from mjstack.config.fingerprint import config_content, differences
from mjstack.config.schema import Backend, Config
from mjstack.drivers.tilt import turn_sign
from mjstack.envs import Env, build_env, driven_config
from mjstack.episodes.context import RunContext
from mjstack.episodes.earlier_run import REPORT, EarlierRun, archive_starts, archived_starts
from mjstack.episodes.rollout import CLOSED_LOOP, POLICY, STATE_BASED
from mjstack.errors import ConfigError, RunError, Unreachable, renamed_keys
from mjstack.gates.images import load_images
from mjstack.gates.runner import find_gates, run_gates
from mjstack.gates.success import success_config
from mjstack.jobs.runner import CheckedJob, Job, count_devices, run_provenance
from mjstack.jobs.showing import check_showing
from mjstack.managers.episode import required_fields
from mjstack.report.gl import require_offscreen
from mjstack.sim import resolve_backend
from mjstack.sim.cameras import check_image_memory
from mjstack.sim.memory import available_memory
from mjstack.sim.native import NativeSimulation

# Bytes of a whole run (environment, plan, check) over those of its native worlds: measured 3.2 to
# 4.6, for both drivers.
_SHARE = 4


def check_machine(cfg: Config) -> RunContext:
    """The context of a run, scene and plan built; raises for what this machine cannot do, before
    anything is written.
    """
    find_gates(cfg)
    context = RunContext(cfg)
    check_task(context)
    shown = {"baseline", "parity"}
    if cfg.view == "web" and not {*shown, "batch", "success"} & set(cfg.gates):
        expected = "gates with baseline, parity, batch or success, whose worlds are shown"
        raise ConfigError("view", "web", expected, "Add one of them to gates")
    if (cfg.view == "true" or cfg.video) and not shown & set(cfg.gates):
        key = "view" if cfg.view == "true" else "video"
        expected = "gates with baseline or parity, whose world is shown"
        raise ConfigError(key, "true", expected, "Add one of them to gates")
    check_showing(cfg)
    if "parity" in cfg.gates and cfg.gate.parity.images is not None:
        load_images(cfg)
        require_offscreen(context.model)
    _check_starts(context)
    if context.backend[0] is Backend.native and {"batch", "success", "throughput"} & set(cfg.gates):
        _check_memory(context)
    return context


def _check_memory(context: RunContext) -> None:
    """Raise if as many native worlds as are asked for do not fit into the memory that is left."""
    nworld = context.cfg.nworld
    sim = NativeSimulation(context.model, 1, fields=required_fields(context.cfg.reset))
    sim.close()
    size = _SHARE * sim.world_bytes
    free = available_memory()
    if nworld * size > free:
        sizes = f"{nworld * size / 2**30:.3g} GiB needed, {free / 2**30:.3g} GiB free"
        expected = f"at most {free // size}, because there is not enough memory for more ({sizes})"
        raise ConfigError("nworld", nworld, expected)


def _check_starts(context: RunContext) -> None:
    """Raise if worlds cannot start as a gate has them, by the key that says so."""
    cfg = context.cfg
    if "capacity" in cfg.gates:
        with suppress(Unreachable):  # the gate reports it
            own = driven_config(cfg, cfg.gate.capacity.reset)
            check_env(context, own, reset="gate.capacity.reset")
    if "success" in cfg.gates:
        own = driven_config(success_config(cfg))
        reset = "reset" if own.reset == cfg.reset else "gate.success.reset"
        try:
            check_env(context, own, reset=reset)
        except ConfigError as error:
            if cfg.gate.success.region is not None and error.key.endswith(".params.xy"):
                error.move("gate.success.region")
            raise


def check_task(context: RunContext) -> None:
    """Raise if the task cannot be played as configured, on this machine."""
    cfg = context.cfg
    resolve_backend(cfg)
    if cfg.task.check is not None:
        _ = context.check  # reads its thresholds
    check_env(context, cfg)
    check_cameras(context)
    if cfg.controller.name == POLICY:
        check_driver(context)
        return
    if not cfg.controller.phases:
        return
    phases = context.planner.phases  # reads the robot, and reaches every nominal target
    if phases[-1].stop > cfg.task.episode_steps:
        expected = f"at least the steps of the phases, {phases[-1].stop}"
        raise ConfigError("task.episode_steps", cfg.task.episode_steps, expected)
    check_env(context, context.driven({}), action="controller.action")
    if cfg.controller.approach_gain > 0.0:
        turn_sign(context.model, cfg)
    if cfg.controller.name == STATE_BASED and cfg.task.check is not None:
        check_driver(context)
    if success_config(cfg).controller.name == CLOSED_LOOP and (
        cfg.controller.name == CLOSED_LOOP or "success" in cfg.gates
    ):
        # Loads Warp, which a native open-loop run does not need.
        from mjstack.kinematics.chain import build_chain

        build_chain(context.model, cfg.robot)


def check_cameras(context: RunContext) -> None:
    """Raise if the images of all worlds do not fit into memory, or cannot be drawn here."""
    cfg = context.cfg
    if not cfg.scene.cameras:
        return
    backend, device = context.backend
    native = backend is Backend.native
    # Ranks on CUDA have a device each, others share the memory.
    ranks = max(context.ranks.size, count_devices(cfg)) if device.startswith("cuda") else 1
    check_image_memory(
        context.model,
        cfg.scene.cameras,
        -(-cfg.nworld // ranks),
        torch.device(device),
        mjwarp=not native,
    )
    if native:
        require_offscreen(context.model)


def check_driver(context: RunContext) -> None:
    """Raise if the configured driver does not fit the configured worlds, such as a policy of other
    ones.
    """
    cfg = context.driven({})
    with closing(_one_world(context, cfg)) as env:
        env.reset()
        context.driver(env)


def check_env(context: RunContext, cfg: Config, **keys: str) -> None:
    """Build an environment in the context's scene, which checks every term. ``keys`` has the key of
    each group whose terms come from elsewhere.
    """
    with renamed_keys(keys):
        _one_world(context, cfg).close()


def _one_world(context: RunContext, cfg: Config) -> Env:
    return build_env(cfg, model=context.model, nworld=1, backend=Backend.native, device="cpu")


def check_gates(cfg: Config) -> CheckedJob:
    """Raise for what this machine cannot do, before anything is written."""
    title = f"task {cfg.task.name}, {cfg.nworld} worlds, gates {', '.join(cfg.gates)}"
    context = check_machine(cfg)
    earlier: list[str] = []
    if cfg.resume is not None and context.ranks.writes:
        earlier = _check_resumed(context, cfg.resume)
    return CheckedJob(
        context=context,
        title=title,
        work=_run_gates,
        folder=None if cfg.resume is None else Path(cfg.resume),
        own=REPORT,
        resumable="gates",
        earlier=earlier,
        spreads=True,
    )


def _check_resumed(context: RunContext, name: str) -> list[str]:
    """Raise if a folder has no run of this configuration, of which episodes can be kept.

    Returns:
        The calls that have played it so far.

    Raises:
        RunError: It has none, or one of another configuration or model.
    """
    run = EarlierRun.read(name, "resume")
    theirs, ours = (_played_config(cfg) for cfg in (run.cfg, context.cfg))
    if found := differences(theirs, ours):
        raise RunError(
            f"resume={name}: has a run of another configuration: {found}.",
            "Name another folder, or set these keys back",
        )
    if run.provenance.get("model_sha256") != run_provenance(context)["model_sha256"]:
        raise RunError(
            f"resume={name}: the compiled model is not the same as in that run, expected the same"
            " physics.",
            "Name another folder",
        )
    then = run.provenance
    call = ", ".join(str(then.get(key)) for key in ("date", "git_commit", "device"))
    return [*then.get("earlier_calls", []), call]


def _played_config(cfg: Config) -> dict[str, Any]:
    """Everything that the episodes of batch and success depend on; more seeds may be asked for."""
    config = config_content(cfg)
    for key in ("gates", "view", "video", "graph"):
        del config[key]
    backend, _ = resolve_backend(cfg)
    config["sim"] = {"backend": backend, "step": cfg.sim.step}
    for name in [*config["gate"]]:
        if name not in ("batch", "success"):
            del config["gate"][name]
    for gate in config["gate"].values():
        del gate["seeds"]
    return config


def _run_gates(context: RunContext, folder: Path) -> None:
    if context.ranks.writes and context.cfg.resume is None:
        cfg = archive_starts(context.cfg, folder)
    elif context.cfg.resume is not None:
        cfg = archived_starts(context.cfg, folder)
    else:  # rank 0 makes the copies
        cfg = context.cfg
    run_gates(replace(context, cfg=cfg))


JOB = Job(check_gates, shows=True, live=True)
