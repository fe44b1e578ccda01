"""The moving links from the world to a gripper's grasp sites, read from a compiled model."""

import mujoco
import numpy as np
import warp as wp
from numpy import ndarray

from mjstack.config.schema import RobotCfg
from mjstack.errors import ConfigError, MjstackError
from mjstack.kinematics.ik_kernels import HINGE, SLIDE, Chain, Shape
from mjstack.scene.index import approach_body, joint_limits

_NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])

_Pose = tuple[ndarray, ndarray]  # position and quaternion (wxyz)
_Link = tuple[_Pose, ndarray, int, int]  # frame, axis, kind, column of the joint targets


def build_chain(model: mujoco.MjModel, robot: RobotCfg) -> tuple[Chain, Shape]:
    """Read the bodies from the world to each site.

    Args:
        model: The compiled model.
        robot: The robot's profile.

    Returns:
        The chain, in Warp arrays on the current device, and its shape.
    """
    # Columns of the joint targets: the joint of each, those that move, and their limits
    columns = {model.joint(name).id: column for column, name in enumerate(robot.joints)}
    moved = [robot.arm_joints.index(name) for name in robot.ik_joints]
    limits = np.tile(np.array([[-np.inf], [np.inf]], dtype=np.float32), len(columns))
    for side, values in enumerate(joint_limits(model, robot.ik_joints)):
        limits[side, moved] = _round_inwards(values, 1.0 - 2.0 * side)

    # Links from the world to the jaws, and from there to each site
    first, second = (model.site(name).id for name in robot.grasp_sites)
    first_path = _path(model, model.site_bodyid[first])
    second_path = _path(model, model.site_bodyid[second])
    shared = len({*first_path} & {*second_path})
    chain = Chain()
    links: list[_Link] = []
    turned: dict[int, ndarray] = {}  # quaternions of the bodies on the last link, seen from it

    def extend(bodies: list[int], start: _Pose) -> _Pose:
        """Append the bodies' links; return the frame after them, seen from the last joint."""
        pose = start
        for body in bodies:
            pose = _compose(pose, (model.body_pos[body], model.body_quat[body]))
            first_joint = model.body_jntadr[body]
            for joint in range(first_joint, first_joint + model.body_jntnum[body]):
                if joint in columns:
                    pose = _compose(pose, (model.jnt_pos[joint], _NO_TURN))
                    links.append(_read_link(model, joint, pose, columns[joint]))
                    pose = (-model.jnt_pos[joint], _NO_TURN)
                    turned.clear()
            turned[body] = pose[1]
        return pose

    trunk = extend(first_path[:shared], (np.zeros(3), _NO_TURN))
    chain.trunk = len(links)
    body = approach_body(model, robot)
    if body not in turned:
        names = ", ".join(model.body(b).name for b in turned) or "none"
        expected = (
            f"a body that carries both grasp sites and that every joint before them moves: {names}"
        )
        raise ConfigError("robot.approach_body", model.body(body).name, expected)
    axis = np.empty(3)
    mujoco.mju_rotVecQuat(axis, np.array(robot.approach_axis, dtype=float), turned[body])
    chain.approach = wp.vec3(*(axis / np.linalg.norm(axis)))
    end = extend(first_path[shared:], trunk)
    chain.first_site = wp.vec3(*_compose(end, (model.site_pos[first], _NO_TURN))[0])
    chain.fork = len(links)
    end = extend(second_path[shared:], trunk)
    chain.second_site = wp.vec3(*_compose(end, (model.site_pos[second], _NO_TURN))[0])
    chain.end = len(links)
    frames, axes, kinds, column = (list(values) for values in zip(*links, strict=True))
    poses = [[*pos, *quat[1:], quat[0]] for pos, quat in frames]  # Warp: xyzw
    chain.frame = wp.array(poses, dtype=wp.transform)
    chain.axis = wp.array(axes, dtype=wp.vec3)
    chain.kind = wp.array(kinds, dtype=int)
    chain.column = wp.array(column, dtype=int)
    chain.low = wp.array(limits[0, column], dtype=float)
    chain.high = wp.array(limits[1, column], dtype=float)
    ik_links = tuple(c in moved for c in column)
    if not any(ik_links) or any(ik_links[chain.trunk :]):
        expected = f"joints that move both grasp sites, {' and '.join(robot.grasp_sites)}"
        raise ConfigError("robot.ik_joints", robot.ik_joints, expected)
    return chain, Shape(tuple(kinds), ik_links, chain.trunk, chain.fork, chain.end)


def _read_link(model: mujoco.MjModel, joint: int, pose: _Pose, column: int) -> _Link:
    """Read a joint whose frame at qpos0 is ``pose``; its frame at 0 is turned, or shifted, back by
    qpos0.
    """
    kind = int(model.jnt_type[joint])
    axis = model.jnt_axis[joint].copy()
    if kind not in (HINGE, SLIDE):
        name = model.joint(joint).name
        type_ = mujoco.mjtJoint(kind).name.removeprefix("mjJNT_").lower()
        raise MjstackError(
            f"joint '{name}' is of type {type_}, expected hinge or slide. Name no other joints."
        )
    zero = float(model.qpos0[model.jnt_qposadr[joint]])
    turn = _NO_TURN.copy()
    if kind == HINGE:
        mujoco.mju_axisAngle2Quat(turn, axis, -zero)
        back = (np.zeros(3), turn)
    else:
        back = (-zero * axis, turn)
    return _compose(pose, back), axis, kind, column


def _path(model: mujoco.MjModel, body: int) -> list[int]:
    """Bodies from the world, which is left out, to the given one."""
    return [*_path(model, model.body_parentid[body]), int(body)] if body else []


def _compose(a: _Pose, b: _Pose) -> _Pose:
    pos = np.empty(3)
    quat = np.empty(4)
    mujoco.mju_mulPose(pos, quat, a[0], a[1], b[0], b[1])
    return pos, quat


def _round_inwards(limits: ndarray, sign: float) -> ndarray:
    """Limits as float32 that are not outside of the given ones; sign is 1 for low ones, else -1."""
    rounded = limits.astype(np.float32)
    inwards = np.nextafter(rounded, np.float32(sign * np.inf))
    return np.where(sign * rounded < sign * limits, inwards, rounded)
