"""Job *export*: a trained policy as ONNX, and the scene that it was trained for as a model file of
MuJoCo; or the policy as a folder of LeRobot's.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco

from mjstack.config.functions import find_instance
from mjstack.config.schema import Config, ExportJobCfg
from mjstack.drivers.driver import with_controller
from mjstack.envs import driven_config
from mjstack.envs.columns import group_columns, joint_units
from mjstack.episodes.stage import Stage
from mjstack.errors import FolderError, require_names
from mjstack.files import write_atomic
from mjstack.gates.runner import run_guarded
from mjstack.jobs.gates import check_task
from mjstack.jobs.runner import CheckedJob, Job, model_bytes
from mjstack.policy.checkpoint import policy_facts
from mjstack.policy.onnx import require_onnx, to_onnx
from mjstack.report.figure import Figure
from mjstack.report.record import GateResult, Status
from mjstack.version import __version__

NAME = "export"
POLICY = "policy.onnx"
MODEL = "model.mjb"


@dataclass(frozen=True)
class Format:
    """A format of exported policies; ``job.formats`` names it.

    Attributes:
        files: Their contents by name, in the order in which they are written.
        require: Raises a MjstackError where a package is missing.
    """

    files: Callable[[Stage], Mapping[str, str | bytes]]
    require: Callable[[], object] = lambda: None


def find_format(job: ExportJobCfg) -> Format:
    """The format that the job names; a MjstackError if there is none."""
    require_names("job.format", [job.format], job.formats)
    return find_instance(f"job.formats.{job.format}", job.formats[job.format], Format)


def check_export(cfg: Config) -> CheckedJob:
    """Raise for what cannot be exported, before anything is written."""
    find_format(cfg.job).require()
    stage = Stage(with_controller(cfg, "policy"))
    check_task(stage)
    return CheckedJob(
        stage=stage,
        title=f"task {cfg.task.name}, policy {stage.assets.policy.folder}",
        work=lambda run, folder: run_guarded(run, NAME, lambda run: export_policy(stage, folder)),
    )


def onnx_files(stage: Stage) -> Mapping[str, str | bytes]:
    """The policy as ONNX, and the scene's model."""
    onnx = to_onnx(stage.assets.policy.network, export_facts(stage))
    return {MODEL: model_bytes(stage.model), POLICY: onnx}


def export_policy(stage: Stage, folder: Path) -> list[GateResult]:
    """Write all files, or none."""
    policy = stage.assets.policy
    files = find_format(stage.cfg.job).files(stage)
    try:
        for name, content in files.items():
            write_atomic(folder / name, content)
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
        names, column_units = group_columns(env, policy.group)
        index = env.index
    network = policy.network
    return policy_facts(policy) | {
        "versions": policy.versions,
        "exported_with": {"mjstack": __version__, "mujoco": mujoco.__version__},
        "columns": {"names": names, "units": column_units},
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
            name: {
                **_fields(object_cfg, "shape", "size", "fixed"),
                "jaw_force": list(map(int, index.jaw_force.get(name, []))),
            }
            for name, object_cfg in cfg.scene.objects.items()
        },
        "places": {
            name: _fields(place_cfg, "xy", "random_xy")
            for name, place_cfg in cfg.scene.places.items()
        },
    }


def _fields(cfg: Any, *names: str) -> dict[str, Any]:
    """Some fields of a configuration, by name."""
    return {name: getattr(cfg, name) for name in names}


FORMAT = Format(onnx_files, require_onnx)
JOB = Job(check_export)
