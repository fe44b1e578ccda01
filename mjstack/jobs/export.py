"""Job *export*: a trained policy as ONNX, and the scene that it was trained for as a model file of
MuJoCo; or the policy as a folder of LeRobot's.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco

from mjstack.config.schema import Config
from mjstack.drivers.driver import with_controller
from mjstack.envs import driven_config
from mjstack.episodes.stage import Stage
from mjstack.errors import FolderError
from mjstack.files import write_atomic
from mjstack.gates.runner import run_guarded
from mjstack.jobs.collect_plan import group_feature, joint_units
from mjstack.jobs.gates import check_task
from mjstack.jobs.runner import CheckedJob, Job, model_bytes
from mjstack.policy import save_policy
from mjstack.policy.checkpoint import policy_facts
from mjstack.policy.lerobot import lerobot_files
from mjstack.policy.onnx import require_onnx, to_onnx
from mjstack.report.figure import Figure
from mjstack.report.record import GateResult, Status
from mjstack.version import __version__

NAME = "export"
POLICY = "policy.onnx"
MODEL = "model.mjb"


def check_export(cfg: Config) -> CheckedJob:
    """Raise for what cannot be exported, before anything is written."""
    if cfg.job.format == "onnx":
        require_onnx()
    stage = Stage(with_controller(cfg, "policy"))
    check_task(stage)
    return CheckedJob(
        stage=stage,
        title=f"task {cfg.task.name}, policy {stage.assets.policy.folder}",
        work=lambda run, folder: run_guarded(run, NAME, lambda run: export_policy(stage, folder)),
    )


def export_policy(stage: Stage, folder: Path) -> list[GateResult]:
    """Write all files, or none."""
    policy = stage.assets.policy
    lerobot = stage.cfg.job.format == "lerobot"
    files: Mapping[str, str | bytes]
    if lerobot:
        files = lerobot_files(policy, stage.index.servo_range)
    else:
        onnx = to_onnx(policy.network, export_facts(stage))
        files = {MODEL: model_bytes(stage.model), POLICY: onnx}
    try:
        for name, content in files.items():
            write_atomic(folder / name, content)
        if lerobot:
            save_policy(folder, policy)
    except OSError as error:
        for name in files:
            (folder / name).unlink(missing_ok=True)
        problem = (
            f"{folder} cannot be written ({error.strerror or error}), and nothing was exported"
        )
        raise FolderError(problem, "Make room, or set hydra.run.dir to another") from error
    width = sum(policy.widths.values())
    shape = f"{policy.network.chunk} x {policy.network.width} numbers of its action terms"
    sizes = [Figure(n.replace(".", "_"), len(data) / 1e6, "MB") for n, data in files.items()]
    return [
        GateResult(
            name=NAME,
            status=Status.passed,
            reason=f"{folder}: {', '.join(files)}: {width} numbers observed, {shape}",
            figures=[Figure("inputs", width), *sizes],
            notes={"policy": str(policy.folder)},
        )
    ]


def export_facts(stage: Stage) -> dict[str, Any]:
    """Everything that a program needs beside the network, in JSON's types, by name."""
    policy = stage.assets.policy
    cfg = driven_config(stage.cfg, action=policy.action)
    cfg.observation = {policy.group: policy.observation}
    with stage.native_env(cfg) as env:
        units = joint_units(env)
        columns = group_feature(env, policy.group)
        index = env.index
    network = policy.network
    return policy_facts(policy) | {
        "versions": policy.versions,
        "exported_with": {"mjstack": __version__, "mujoco": mujoco.__version__},
        "columns": {"names": columns.names, "units": columns.units},
        "normalization": {
            name: network.get_buffer(name).tolist() for name, _ in network.named_buffers()
        },
        "robot": {
            **_fields(cfg.robot, "name", "joints", "home", "start", "grasp_sites"),
            "units": units,
            "qpos": index.robot_qpos.tolist(),
            "qvel": index.robot_qvel.tolist(),
            "ctrl": index.ctrl.tolist(),
            "low": index.ctrl_range[:, 0].tolist(),
            "high": index.ctrl_range[:, 1].tolist(),
        },
        "task": _fields(cfg.task, "name", "instruction", "control_hz", "episode_steps", "params"),
        "timing": _fields(cfg.timing, "physics_dt", "decimation", "command_delay"),
        "objects": {
            name: _fields(thing, "shape", "size", "fixed")
            for name, thing in cfg.scene.objects.items()
        },
        "places": {
            name: _fields(place, "xy", "random_xy") for name, place in cfg.scene.places.items()
        },
    }


def _fields(cfg: Any, *names: str) -> dict[str, Any]:
    """Some fields of a configuration, by name."""
    return {name: getattr(cfg, name) for name in names}


JOB = Job(check_export)
