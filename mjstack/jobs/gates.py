"""Job *gates*: a configuration and a folder in, gates run, a report left behind."""

from contextlib import suppress

import torch

from mjstack.config.schema import Backend, Config
from mjstack.drivers.driver import check_driver
from mjstack.envs import driven_config
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError, MjstackError, Unreachable, renamed_keys
from mjstack.gates.episodes import gate_config
from mjstack.gates.images import load_images
from mjstack.gates.runner import find_gates, run_gates
from mjstack.jobs.runner import VIEWS, CheckedJob, Job, count_devices
from mjstack.jobs.showing import check_showing
from mjstack.managers.episode import required_fields
from mjstack.managers.term import blamed
from mjstack.math import describe_tensor
from mjstack.report.gl import require_offscreen
from mjstack.scene.index import turn_sign
from mjstack.sim import resolve_backend
from mjstack.sim.cameras import check_image_memory
from mjstack.sim.memory import available_memory
from mjstack.sim.native import NativeSimulation

# Bytes of a run over those of its native worlds: measured 3.2 to 4.6, for both drivers.
_SHARE = 4


def check_machine(cfg: Config) -> Stage:
    """The stage of a run, scene and plan built; raises for what this machine cannot do, before
    anything is written.
    """
    find_gates(cfg)
    stage = Stage(cfg)
    check_task(stage)
    for key, value in (("view", cfg.view), ("video", str(cfg.video).lower())):
        names = ["baseline", "parity", *(cfg.gate.episodes() if key == "view" else ())]
        if value != "false" and not {*names} & {*cfg.gates}:
            expected = f"a gate that shows worlds: {', '.join(names)}"
            raise ConfigError(key, value, expected, "Add one of them to gates")
    check_showing(cfg)
    if "parity" in cfg.gates and cfg.gate.parity.images is not None:
        load_images(cfg)
        require_offscreen(stage.model)
    _check_starts(stage)
    batch = cfg.episode_gates or "throughput" in cfg.gates
    if batch and stage.backend[0] is Backend.native:
        _check_memory(stage)
    return stage


def _check_memory(stage: Stage) -> None:
    """Raise if as many native worlds as are asked for do not fit into the memory that is left."""
    nworld = stage.cfg.nworld
    sim = NativeSimulation(stage.model, 1, fields=required_fields(stage.cfg.reset))
    sim.close()
    size = _SHARE * sim.world_bytes
    free = available_memory()
    if nworld * size > free:
        sizes = f"{nworld * size / 2**30:.3g} GiB needed, {free / 2**30:.3g} GiB free"
        expected = f"at most {free // size}, because there is not enough memory for more ({sizes})"
        raise ConfigError("nworld", nworld, expected)


def _check_starts(stage: Stage) -> None:
    """Raise if worlds cannot start as a gate has them, by the key that says so."""
    cfg = stage.cfg
    if "capacity" in cfg.gates:
        with suppress(Unreachable):  # the gate reports it
            driven = driven_config(cfg, cfg.gate.success.reset)
            check_env(stage, driven, reset="gate.success.reset")
    for gate in cfg.episode_gates:
        driven = driven_config(gate_config(cfg, gate))
        if driven.reset != cfg.reset:
            check_env(stage, driven, reset=f"gate.{gate}.reset")


def check_task(stage: Stage) -> None:
    """Raise if the task cannot be played as configured, on this machine."""
    cfg = stage.cfg
    resolve_backend(cfg)
    keys = {} if stage.policy else {"action": "controller.action"}
    if cfg.task.check is not None:
        with renamed_keys(keys):
            _try_check(stage)
    check_env(stage, cfg)
    check_cameras(stage)
    driver = stage.driver_class
    if driver.needs_phases:
        if not cfg.controller.phases:
            return
        phases = stage.planner.phases  # reads the robot, and reaches every nominal target
        if phases[-1].stop > cfg.task.episode_steps:
            expected = f"at least the steps of the phases, {phases[-1].stop}"
            raise ConfigError("task.episode_steps", cfg.task.episode_steps, expected)
        if cfg.controller.approach_gain > 0.0:
            turn_sign(stage.model, cfg.robot)
    # Two worlds show a driver that answers for one.
    with renamed_keys(keys), stage.native_env(stage.driven({}), nworld=2) as env:
        if cfg.task.check is not None or not driver.needs_phases:
            env.reset()
            check_driver(env, cfg, stage.assets)
    feedback = any(cfg.gate[gate].reset for gate in cfg.episode_gates)
    if feedback and driver.planned:  # the closed-loop expert plays
        from mjstack.kinematics.batched_ik import build_chain  # loads Warp

        build_chain(stage.model, cfg.robot)


def _try_check(stage: Stage) -> None:
    """Raise if the task's check cannot judge a step of two worlds."""
    check = stage.check
    with stage.native_env(stage.driven({}), nworld=2) as env, blamed("task.check.func"):
        check.start(env, 1)
        check.update()
        check.result()
        placed = check.placed(env.state)
        expected = describe_tensor(torch.zeros((env.nworld, len(check.objects) or 1)) > 0)
        if (actual := describe_tensor(placed)) != expected:
            raise MjstackError(f"placed: {actual}, expected {expected}, of two worlds")


def check_cameras(stage: Stage) -> None:
    """Raise if the images of all worlds do not fit into memory, or cannot be drawn here."""
    cfg = stage.cfg
    if not cfg.scene.cameras:
        return
    backend, device = stage.backend
    native = backend is Backend.native
    # Ranks on CUDA have a device each, others share the memory.
    ranks = max(stage.ranks.size, count_devices(cfg)) if device.startswith("cuda") else 1
    check_image_memory(
        stage.model,
        cfg.scene.cameras,
        -(-cfg.nworld // ranks),
        torch.device(device),
        mjwarp=not native,
    )
    if native:
        require_offscreen(stage.model)


def check_env(stage: Stage, cfg: Config, **keys: str) -> None:
    """Build an environment of the stage's scene, which checks every term.

    Args:
        stage: The stage.
        cfg: The environment's configuration.
        keys: The key of each group whose terms come from elsewhere.
    """
    with renamed_keys(keys), stage.native_env(cfg):
        pass


def check_gates(cfg: Config) -> CheckedJob:
    """Raise for what this machine cannot do, before anything is written."""
    title = f"task {cfg.task.name}, {cfg.nworld} worlds, gates {', '.join(cfg.gates)}"
    return CheckedJob(stage=check_machine(cfg), title=title, work=run_gates, spreads=True)


JOB = Job(check_gates, views=VIEWS)
