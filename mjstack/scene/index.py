"""Names to addresses, resolved once."""

from __future__ import annotations

import mujoco
import numpy as np

from mjstack.config.schema import RobotCfg
from mjstack.errors import UnknownName
from mjstack.scene.build import BLUE, RED


class SceneIndex:
    """Where each named thing of a scene lies in MuJoCo's arrays.

    Attributes:
        cube_qpos: First qpos address of the red and of the blue cube (7 numbers each: position, quaternion).
        cube_qvel: First qvel address of the red and of the blue cube (6 numbers each).
        robot_qpos: qpos addresses of the arm's and then the gripper's joints.
        ctrl: Actuator indices in the same order.
        aperture_sites: The two site indices whose midpoint is the aperture centre.
    """

    def __init__(self, model: mujoco.MjModel, robot: RobotCfg) -> None:
        joints = [*robot.arm_joints, *robot.gripper_joints]
        self.robot_qpos = np.array([model.jnt_qposadr[find(model, "joint", n)] for n in joints])
        self.ctrl = np.array([find(model, "actuator", n) for n in joints])
        self.aperture_sites = [find(model, "site", n) for n in robot.aperture_sites]
        cubes = [find(model, "joint", n) for n in (RED, BLUE)]
        self.cube_qpos = [int(model.jnt_qposadr[j]) for j in cubes]
        self.cube_qvel = [int(model.jnt_dofadr[j]) for j in cubes]


def find(model: mujoco.MjModel, kind: str, name: str) -> int:
    """Index of a named joint, actuator or site; an unknown name is an error that lists the known ones."""
    index = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if index < 0:
        count = {"joint": model.njnt, "actuator": model.nu, "site": model.nsite}[kind]
        raise UnknownName(kind, name, [getattr(model, kind)(i).name for i in range(count)])
    return index
