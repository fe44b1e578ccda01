"""Where things are, read from the simulation's views: what observations, rewards and terminations
share.
"""

from __future__ import annotations

import torch

from mjstack.errors import ParameterError
from mjstack.managers.base import EnvView, shared
from mjstack.math import lowest_corner
from mjstack.scene import table_top
from mjstack.scene.index import CUBES, RobotTensors, SceneIndex
from mjstack.sim.simulation import Simulation


def robot(env: EnvView) -> RobotTensors:
    """The robot's columns and limits on the environment's device."""
    return env.index.on(env.device, env.sim.qpos.dtype)


POSES = ("home", "start")
LOADED = 1e-5  # N: a jaw that presses with more touches the cube (as in gate.box.force)


def named_pose(env: EnvView, pose: str) -> torch.Tensor:
    """One of the robot's own commands, `POSES`, shape ``(n,)``.

    Raises:
        ParameterError: There is no such pose.
    """
    if pose not in POSES:
        raise ParameterError("pose", pose, " or ".join(POSES))
    return getattr(robot(env), pose)


def joint_positions(env: EnvView) -> torch.Tensor:
    """Arm joints [rad], then gripper joints [rad or m], shape ``(nworld, n)``. Not to be written
    into.
    """
    return robot(env).qpos.read(env.sim.qpos)


def joint_velocities(env: EnvView) -> torch.Tensor:
    """Likewise [rad/s, m/s]."""
    return robot(env).qvel.read(env.sim.qvel)


def grasp_point(env: EnvView) -> torch.Tensor:
    """Midpoint between the jaws [m], world frame, shape ``(nworld, 3)``."""
    first, second = env.index.grasp_sites
    return 0.5 * (env.sim.site_xpos[:, first] + env.sim.site_xpos[:, second])


def gripper_opening(env: EnvView) -> torch.Tensor:
    """How far each gripper joint is open as measured, 0 closed to 1 open, shape ``(nworld,
    n_gripper)``.
    """
    tensors = robot(env)
    q = tensors.gripper_qpos.read(env.sim.qpos)
    return (q - tensors.gripper_closed) / (tensors.gripper_open - tensors.gripper_closed)


def pose_w(env: EnvView, name: str) -> torch.Tensor:
    """Position [m] and quaternion (wxyz) of an object, from qpos, which is never stale, shape
    ``(nworld, 7)``.
    """
    address, _ = env.index.object_address(name)
    return env.sim.qpos[:, address : address + 7]


def above_table(env: EnvView, name: str) -> torch.Tensor:
    """Height of a cube's lowest corner above the table [m], shape ``(nworld,)``. Not to be written
    into.
    """

    def compute() -> torch.Tensor:
        pose = pose_w(env, name)
        return lowest_corner(pose[:, :3], pose[:, 3:], env.cfg.scene.cube_half) - table_top(
            env.cfg.scene
        )

    return shared((id(env), above_table, name), compute)


def jaw_forces(env: EnvView, name: str) -> torch.Tensor:
    """Size of the contact force [N] of each jaw on an object, at the last physics step, shape
    ``(nworld, 2)``.
    """
    env.index.object_address(name)
    return _jaw_forces(env.index, env.sim, name)


def cubes_in_hand(index: SceneIndex, sim: Simulation) -> torch.Tensor:
    """Whether both jaws press on each cube, at the last physics step, shape ``(nworld,
    2)``, bool.
    """
    return torch.stack([(_jaw_forces(index, sim, name) > LOADED).all(1) for name in CUBES], dim=1)


def _jaw_forces(index: SceneIndex, sim: Simulation, name: str) -> torch.Tensor:
    parts = [sim.sensordata[:, a : a + 3] for a in index.jaw_force[name]]
    return torch.linalg.vector_norm(torch.stack(parts, dim=1), dim=2)
