"""Observation terms: functions of the environment that return ``(nworld,)`` or ``(nworld, d)``."""

from functools import partial

import torch
from torch import Tensor

from mjstack.errors import require_names
from mjstack.managers.state import shared
from mjstack.managers.view import EnvView, offers
from mjstack.math import constant, quat_to_matrix
from mjstack.mdp.geometry import LOADED, jaw_forces, place_xy, pose_w, robot, zeros

_in = partial(offers, "observation term", reads="state")
_in_metres = _in(unit="m")
_by_joint = _in(unit="joint")


@_by_joint
def joint_pos(env: EnvView) -> Tensor:
    """Joint positions [rad, m], arm then gripper, shape ``(nworld, n)``."""
    return env.sim.part("qpos", robot(env).qpos)


@_by_joint
def joint_pos_relative(env: EnvView) -> Tensor:
    """Joint positions less home [rad, m], shape ``(nworld, n)``."""
    return joint_pos(env) - robot(env).home


@_in(unit="joint/s")
def joint_vel(env: EnvView) -> Tensor:
    """Joint velocities [rad/s, m/s], shape ``(nworld, n)``."""
    return env.sim.part("qvel", robot(env).qvel)


@_in_metres
@shared
def grasp_point_pos(env: EnvView) -> Tensor:
    """Midpoint between the jaws [m], world frame, shape ``(nworld, 3)``. Not to be written into."""
    first, second = (env.sim.part("site_xpos", site) for site in env.index.grasp_sites)
    return 0.5 * (first + second)


@_in_metres
def grasp_point_to_object(env: EnvView, *, object: str, height: float = 0.0) -> Tensor:
    """From the grasp point to a point above an object's centre [m], shape ``(nworld, 3)``.

    Args:
        env: The environment.
        object: Scene object.
        height: How far above [m].
    """
    offset = pose_w(env, object)[:, :3] - grasp_point_pos(env)
    if height:
        offset[:, 2] += height
    return offset


@_in_metres
def object_to_object(env: EnvView, *, a: str, b: str) -> Tensor:
    """From one object's centre to another's [m], shape ``(nworld, 3)``."""
    return pose_w(env, b)[:, :3] - pose_w(env, a)[:, :3]


@_in_metres
def object_to_place(env: EnvView, *, object: str, place: str, height: float = 0.0) -> Tensor:
    """From an object's centre to where it is when it stands at a place [m], shape ``(nworld, 3)``.

    Args:
        env: The environment.
        object: Scene object.
        place: Scene place.
        height: Of the place above the table, such as a box's floor [m].
    """
    at = pose_w(env, object)[:, :3]
    height += env.cfg.scene.table_top + env.cfg.scene.objects[object].half_height
    return torch.cat((place_xy(env, place) - at[:, :2], height - at[:, 2:]), dim=1)


@_in(unit=("m",) * 3 + ("1",) * 4)
def object_pose(env: EnvView, *, object: str) -> Tensor:
    """Position [m] and quaternion (wxyz), world frame, shape ``(nworld, 7)``."""
    return pose_w(env, object)


@_in_metres
def positions(env: EnvView) -> Tensor:
    """Where the objects that can move are [m], world frame, shape ``(nworld, 3 * objects)``."""
    parts = [pose_w(env, name)[:, :3] for name in env.index.objects]
    return torch.cat([env.sim.qpos[:, :0], *parts], dim=1)


@_in_metres
def offsets(env: EnvView) -> Tensor:
    """From the grasp point to the objects that can move [m], shape ``(nworld, 3 * objects)``."""
    at = positions(env)
    return at - grasp_point_pos(env).repeat(1, at.shape[1] // 3)


@_in_metres
def goals(env: EnvView) -> Tensor:
    """Where the scene's places are [m], shape ``(nworld, 2 * places)``."""
    places = [place_xy(env, name) for name in env.cfg.scene.places]
    return torch.cat([env.sim.qpos[:, :0], *places], dim=1)


@_in(unit="1")
def headings(env: EnvView) -> Tensor:
    """How the boxes that can move are turned about z: cosine and sine of four times the yaw of
    each, which are the same after a quarter turn, shape ``(nworld, 2 * boxes)``.
    """
    boxes = [name for name, thing in env.cfg.scene.free.items() if thing.shape == "box"]
    if not boxes:
        return env.sim.qpos[:, :0]
    w, x, y, z = torch.stack([pose_w(env, name)[:, 3:] for name in boxes], dim=1).unbind(2)
    cos = 1.0 - 2.0 * (y * y + z * z)
    sin = 2.0 * (w * z + x * y)
    # Of the yaw, then of twice, then of four times. A box that stands on edge has no yaw.
    length = torch.sqrt(cos * cos + sin * sin).clamp(min=1e-6)
    cos, sin = cos / length, sin / length
    for _ in range(2):
        cos, sin = cos * cos - sin * sin, 2.0 * cos * sin
    return torch.stack((cos, sin), dim=2).flatten(1)


@_in(unit="1")
def tilts(env: EnvView) -> Tensor:
    """How the objects that can move lean: x and y of the most upright axis of each, upwards, shape
    ``(nworld, 2 * objects)``.
    """
    names = list(env.cfg.scene.free)
    if not names:
        return env.sim.qpos[:, :0]
    axes = quat_to_matrix(torch.stack([pose_w(env, name)[:, 3:] for name in names], dim=1))
    number = axes[..., 2, :].abs().argmax(-1)
    up = axes.gather(-1, number[..., None, None].expand(*number.shape, 3, 1))[..., 0]
    return (up[..., :2] * torch.sign(up[..., 2:])).flatten(1)


@_in(unit="1")
def grasped(env: EnvView) -> Tensor:
    """Whether all jaws press on each object that can move, 0 or 1, shape ``(nworld, objects)``."""
    parts = [(jaw_forces(env.index, env.sim, n) > LOADED).all(1) for n in env.cfg.scene.free]
    return torch.stack(parts, dim=1).to(env.sim.qpos) if parts else env.sim.qpos[:, :0]


@_in(unit=("m/s",) * 3 + ("rad/s",) * 3)
def object_velocity(env: EnvView, *, object: str) -> Tensor:
    """Linear [m/s, world frame] and angular [rad/s, body frame] velocity, shape ``(nworld, 6)``."""
    if object in env.index.fixed:
        return constant([0.0] * 6, env.sim.qvel).expand(env.nworld, -1)
    return env.sim.part("qvel", env.index.object_columns(object)[1])


@_in()
def fixture_pos(env: EnvView, *, joint: str) -> Tensor:
    """Position of a fixture's joint [rad, m], shape ``(nworld,)``. Not to be written into."""
    require_names("joint of a fixture", [joint], env.index.joints)
    return env.sim.part("qpos", env.index.joints[joint][0])


@_in()
def fixture_vel(env: EnvView, *, joint: str) -> Tensor:
    """Velocity of a fixture's joint [rad/s, m/s], shape ``(nworld,)``. Not to be written into."""
    require_names("joint of a fixture", [joint], env.index.joints)
    return env.sim.part("qvel", env.index.joints[joint][1])


@_in(unit="N")
def jaw_force(env: EnvView, *, object: str) -> Tensor:
    """Size of each jaw's contact force on an object [N], shape ``(nworld, 2)``."""
    return jaw_forces(env.index, env.sim, object)


@_by_joint
def last_action(env: EnvView) -> Tensor:
    """The policy's last action, shape ``(nworld, action_dim)``."""
    return env.action


@_by_joint
def joint_zeros(env: EnvView) -> Tensor:
    """How far each joint truly is from where its servo believes it to be [rad, m], which no real
    arm knows, shape ``(nworld, n)``.
    """
    off = zeros(env)
    return torch.zeros_like(joint_pos(env)) if off is None else off.to(env.sim.qpos.dtype)
