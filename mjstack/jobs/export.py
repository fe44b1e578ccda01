"""Job *export*: a trained policy as ONNX, and the scene that it was trained for as a model file of
MuJoCo.
"""

from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import cast

import mujoco
import numpy as np

import mjstack
from mjstack.config.schema import Backend, Config
from mjstack.envs import Env, build_env, driven_config
from mjstack.episodes.context import RunContext
from mjstack.episodes.rollout import POLICY as DRIVER
from mjstack.errors import FolderError, PolicyError
from mjstack.files import write_atomic
from mjstack.gates.runner import run_guarded
from mjstack.jobs.demonstration import group_feature, joint_units
from mjstack.jobs.gates import check_task
from mjstack.jobs.runner import CheckedJob, Job
from mjstack.policy import Policy
from mjstack.policy.checkpoint import policy_facts
from mjstack.policy.onnx import require_onnx, to_onnx
from mjstack.report.record import GateResult, Status

NAME = "export"
POLICY = "policy.onnx"
MODEL = "model.mjb"


def check_export(cfg: Config) -> CheckedJob:
    """Raise for what cannot be exported, before anything is written."""
    require_onnx()
    context = RunContext(replace(cfg, controller=replace(cfg.controller, name=DRIVER)))
    check_task(context)
    if context.stage.policy.network.vision.sizes:
        raise PolicyError(
            f"policy={cfg.policy}: sees images, expected one that sees numbers alone, which ONNX"
            " files are written for",
            "Play it with controller=policy",
        )
    title = f"task {cfg.task.name}, policy {context.stage.policy.folder}"
    return CheckedJob(
        context=context,
        title=title,
        work=lambda context, folder: run_guarded(context, NAME, export_policy),
    )


def export_policy(context: RunContext) -> list[GateResult]:
    """Write both files, or none."""
    folder = cast(Path, context.folder)
    policy = context.stage.policy
    facts = export_facts(context.cfg, policy)
    files = {MODEL: _model_bytes(context.model), POLICY: to_onnx(policy.network, facts)}
    try:
        for name, content in files.items():
            write_atomic(folder / name, content)
    except OSError as error:
        for name in files:
            (folder / name).unlink(missing_ok=True)
        raise FolderError(
            f"{folder} cannot be written ({error.strerror or error}), and nothing was exported",
            "Make room, or set hydra.run.dir to another",
        ) from error
    width = sum(policy.widths.values())
    answer = "numbers of its action terms" if policy.action else "joint targets"
    shape = f"{policy.network.chunk} x {policy.network.joints} {answer}"
    sizes = {f"{name.replace('.', '_')}_mb": len(data) / 1e6 for name, data in files.items()}
    return [
        GateResult(
            name=NAME,
            status=Status.passed,
            reason=f"{folder / POLICY}: {width} numbers observed, {shape}; {folder / MODEL}",
            metrics={"inputs": width, **sizes},
            notes={"policy": str(policy.folder)},
        )
    ]


def export_facts(cfg: Config, policy: Policy) -> dict:
    """Everything that a program needs beside the network, in JSON's types, by name."""
    own = driven_config(cfg)
    own.observation = {policy.group: policy.observation}
    own.action = policy.action or own.action
    with closing(build_env(own, nworld=1, backend=Backend.native, device="cpu")) as env:
        return policy_facts(policy) | _scene_facts(env, policy)


def _scene_facts(env: Env, policy: Policy) -> dict:
    cfg = env.cfg
    robot = cfg.robot
    units = joint_units(env)
    columns = group_feature(env, policy.group, units)
    network = policy.network
    return {
        "versions": policy.versions,
        "exported_with": {"mjstack": mjstack.__version__, "mujoco": mujoco.__version__},
        "columns": {"names": columns.names, "units": columns.units},
        "normalization": {
            name: network.get_buffer(name).tolist() for name, _ in network.named_buffers()
        },
        "robot": {
            "name": robot.name,
            "joints": robot.joints,
            "units": units,
            "qpos": env.index.robot_qpos.tolist(),
            "qvel": env.index.robot_qvel.tolist(),
            "ctrl": env.index.ctrl.tolist(),
            "low": env.index.ctrl_range[:, 0].tolist(),
            "high": env.index.ctrl_range[:, 1].tolist(),
            "home": robot.home,
            "start": robot.start,
            "grasp_sites": robot.grasp_sites,
        },
        "task": {
            name: value
            for name, value in asdict(cfg.task).items()
            if name in ("name", "instruction", "control_hz", "episode_steps", "params")
        },
        "timing": {
            name: getattr(cfg.timing, name)
            for name in ("physics_dt", "decimation", "command_delay")
        },
        "objects": {
            name: {"shape": thing.shape, "size": thing.size, "fixed": thing.fixed}
            for name, thing in cfg.scene.objects.items()
        },
        "places": {
            name: {"xy": place.xy, "random_xy": place.random_xy}
            for name, place in cfg.scene.places.items()
        },
    }


def _model_bytes(model: mujoco.MjModel) -> bytes:
    """The compiled model as mujoco saves it: every number as physics has it, meshes included."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


JOB = Job(check_export)
