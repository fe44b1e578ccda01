"""The moving links from the world to a gripper's grasp sites, read from a compiled model."""

from collections.abc import Collection, Sequence

import mujoco
import numpy as np
import warp as wp

from mjstack.config.schema import RobotCfg
from mjstack.errors import ConfigError, MjstackError
from mjstack.kinematics.ik_kernels import HINGE, SLIDE, Chain, Shape
from mjstack.scene.index import approach_body, joint_limits


def build_chain(model: mujoco.MjModel, robot: RobotCfg) -> tuple[Chain, Shape]:
    """Read the joints from the world to each site, as MuJoCo has them with the robot's joints at 0
    and all others at qpos0.

    Args:
        model: The compiled model.
        robot: The robot's profile.

    Returns:
        The chain, in Warp arrays on the current device, and its shape.

    Raises:
        MjstackError: A joint is neither hinge nor slide.
        ConfigError: A part of the profile does not suit the chain.
    """
    # Columns of the joint targets: the joint of each, those that move, and their limits
    columns = {model.joint(name).id: column for column, name in enumerate(robot.joints)}
    moved = [robot.arm_joints.index(name) for name in robot.ik_joints]
    limits = np.tile(np.array([[-np.inf], [np.inf]], dtype=np.float32), len(columns))
    for side, values in enumerate(joint_limits(model, robot.ik_joints)):
        limits[side, moved] = _round_inwards(values, 1.0 - 2.0 * side)
    data = mujoco.MjData(model)
    for joint in columns:
        if model.jnt_type[joint] not in (HINGE, SLIDE):
            name = model.joint(joint).name
            type_ = mujoco.mjtJoint(model.jnt_type[joint]).name.removeprefix("mjJNT_").lower()
            expected = "expected hinge or slide. Name no other joints."
            raise MjstackError(f"joint '{name}' is of type {type_}, {expected}")
        data.qpos[model.jnt_qposadr[joint]] = 0.0
    mujoco.mj_kinematics(model, data)

    # Links from the world to the jaws, and from there to each site. Indices ascend from the world.
    first, second = (model.site(name).id for name in robot.grasp_sites)
    first_path = _path(model, model.site_bodyid[first])
    second_path = _path(model, model.site_bodyid[second])
    shared = first_path & second_path

    def joints_of(bodies: Collection[int]) -> list[int]:
        return sorted(joint for joint in columns if model.jnt_bodyid[joint] in bodies)

    def offsets(joints: Sequence[int], start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """From each joint to the next, beginning at a point; and the last one's position."""
        points = np.vstack((start, data.xanchor[joints]))
        return np.diff(points, axis=0), points[-1]

    trunk, *fingers = (joints_of(p) for p in (shared, first_path - shared, second_path - shared))
    links = [*trunk, *fingers[0], *fingers[1]]
    trunk_offsets, palm = offsets(trunk, np.zeros(3))
    first_offsets, first_end = offsets(fingers[0], palm)
    second_offsets, second_end = offsets(fingers[1], palm)
    chain = Chain()
    chain.trunk = len(trunk)
    chain.fork = len(trunk) + len(fingers[0])
    chain.end = len(links)
    chain.first_site = wp.vec3(*(data.site_xpos[first] - first_end))
    chain.second_site = wp.vec3(*(data.site_xpos[second] - second_end))
    column = [columns[joint] for joint in links]
    kinds = model.jnt_type[links]
    positions = np.vstack((trunk_offsets, first_offsets, second_offsets))
    chain.offset = wp.array(positions, dtype=wp.vec3)
    chain.axis = wp.array(data.xaxis[links], dtype=wp.vec3)
    chain.kind = wp.array(kinds, dtype=int)
    chain.column = wp.array(column, dtype=int)
    chain.low = wp.array(limits[0, column], dtype=float)
    chain.high = wp.array(limits[1, column], dtype=float)

    # The approach axis, and whether the moved joints carry both sites
    body = approach_body(model, robot)
    last = model.jnt_bodyid[trunk[-1]] if trunk else 0
    rigid = [b for b in sorted(shared) if b >= last]
    if body not in rigid:
        names = ", ".join(model.body(b).name for b in rigid) or "none"
        expected = (
            f"a body that carries both grasp sites and that every joint before them moves: {names}"
        )
        raise ConfigError("robot.approach_body", model.body(body).name, expected)
    axis = data.xmat[body].reshape(3, 3) @ robot.approach_axis
    chain.approach = wp.vec3(*(axis / np.linalg.norm(axis)))
    ik_links = tuple(c in moved for c in column)
    if not any(ik_links) or any(ik_links[chain.trunk :]):
        expected = f"joints that move both grasp sites, {' and '.join(robot.grasp_sites)}"
        raise ConfigError("robot.ik_joints", robot.ik_joints, expected)
    return chain, Shape(tuple(kinds.tolist()), ik_links, chain.trunk, chain.fork, chain.end)


def _path(model: mujoco.MjModel, body: int) -> set[int]:
    """Bodies from the world, which is left out, to the given one."""
    path: set[int] = set()
    while body:
        path.add(int(body))
        body = model.body_parentid[body]
    return path


def _round_inwards(limits: np.ndarray, sign: float) -> np.ndarray:
    """Limits as float32 that are not outside of the given ones; sign is 1 for low ones, else -1."""
    rounded = limits.astype(np.float32)
    inwards = np.nextafter(rounded, np.float32(sign * np.inf))
    return np.where(sign * rounded < sign * limits, inwards, rounded)
