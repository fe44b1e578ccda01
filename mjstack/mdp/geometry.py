"""Where things are, read from the simulation's views, for all kinds of terms."""

from typing import Literal

import torch
from torch import Tensor

from mjstack.errors import require_names
from mjstack.managers.state import shared
from mjstack.managers.view import EnvView, episode_draw
from mjstack.math import constant, lowest_point, norm
from mjstack.scene.index import RobotTensors, SceneIndex
from mjstack.sim.simulation import Simulation


def robot(env: EnvView) -> RobotTensors:
    """The robot's columns and limits on the environment's device."""
    return env.index.on(env.device, env.sim.qpos.dtype)


Pose = Literal["home", "start"]  # the robot's own commands
LOADED = 1e-5  # N: a jaw that presses with more touches the object


def write_robot(env: EnvView, mask: Tensor, command: Tensor) -> None:
    """Put the masked worlds' robot at a command, shape ``(nworld, n)`` or ``(n,)``: qpos, with all
    joints that follow, and ctrl.
    """
    tensors = robot(env)
    if passive := len(tensors.passive.indices):
        true = command if (off := zeros(env)) is None else command + off
        follow, _ = env.index.posture.follow(true.to(env.sim.qpos.dtype))
        tensors.passive.write_masked(env.sim.qpos, mask, follow[..., :passive])
    tensors.qpos.write_masked(env.sim.qpos, mask, command)
    tensors.ctrl.write_masked(env.sim.ctrl, mask, command)
    if tensors.idle.indices:
        tensors.idle.write_masked(env.sim.ctrl, mask, tensors.idle_ctrl)


def zeros(env: EnvView) -> Tensor | None:
    """How far joint zeros are off the file's [rad, m], shape ``(nworld, n)``, where any may be."""
    if "qpos0" not in env.sim.fields:
        return None
    return robot(env).zero - robot(env).qpos.read(env.sim.fields["qpos0"])


def gripper_opening(env: EnvView) -> Tensor:
    """Opening of each gripper joint as measured, 0 to 1, shape ``(nworld, n_gripper)``."""
    tensors = robot(env)
    q = env.sim.part("qpos", tensors.gripper_qpos)
    return (q - tensors.gripper_closed) / tensors.gripper_travel


def pose_w(env: EnvView, name: str) -> Tensor:
    """Position [m] and quaternion (wxyz) of an object, never stale, shape ``(nworld, 7)``. A fixed
    object is where the world's model fields have it.
    """
    if name not in env.index.fixed:
        return env.sim.part("qpos", env.index.object_columns(name)[0])
    pose = constant(env.index.fixed[name], env.sim.qpos).expand(env.nworld, -1)
    body = env.index.bodies[name]
    parts = {"body_pos": pose[:, :3], "body_quat": pose[:, 3:]}
    moved = [env.sim.fields[f][:, body] if f in env.sim.fields else parts[f] for f in parts]
    return pose if parts.keys().isdisjoint(env.sim.fields) else torch.cat(moved, dim=1)


@shared
def above_table(env: EnvView, name: str) -> Tensor:
    """Height of an object's lowest point over the table [m], ``(nworld,)``; only to be read."""
    pose = pose_w(env, name)
    thing = env.cfg.scene.objects[name]
    low = lowest_point(pose[:, :3], pose[:, 3:], *thing.form)
    return low - env.cfg.scene.table_top


@shared
def place_xy(env: EnvView, name: str) -> Tensor:
    """Position of a place [m], drawn anew in each episode if it has ``random_xy``, shape ``(nworld,
    2)``. Not to be written into.

    Raises:
        UnknownName: The scene has no such place.
    """
    places = env.cfg.scene.places
    require_names("place", [name], places)
    if name in env.given_places:
        return env.given_places[name].index_select(0, env.world)
    place = places[name]
    if not any(place.random_xy):
        return constant(place.xy, env.sim.qpos).expand(env.nworld, -1)
    draw = episode_draw(env, name, 2)
    return constant(place.xy, draw) + constant(place.random_xy, draw) * draw


def source_xy(env: EnvView) -> Tensor:
    """Position of every object, then place, in order [m], shape ``(nworld, sources, 2)``."""
    objects = [pose_w(env, name)[:, :2] for name in env.cfg.scene.objects]
    places = [place_xy(env, name) for name in env.cfg.scene.places]
    return torch.stack([*objects, *places], dim=1)


def objects_in_hand(index: SceneIndex, sim: Simulation) -> Tensor:
    """Whether all jaws press on each object of the scene, ``(nworld, objects)``, bool."""
    forces = torch.stack([jaw_forces(index, sim, name) for name in index.bodies], dim=1)
    return (forces > LOADED).all(2)


def jaw_forces(index: SceneIndex, sim: Simulation, name: str) -> Tensor:
    """Contact force of each jaw on an object [N], at the last physics step, ``(nworld, 2)``."""
    require_names("object", [name], index.jaw_force)
    return norm(sim.part("sensordata", index.jaw_columns[name], -1, 3))
