"""Robot descriptions as MjSpec: any MJCF file, mjstack's own mesh-free ones, or Menagerie's."""

import os
from collections.abc import Collection, Iterable
from pathlib import Path

import mujoco
import numpy as np

from mjstack.config.mjcf import read_mjcf
from mjstack.config.schema import ModelCfg, RobotCfg
from mjstack.errors import ConfigError, MjstackError, require_names
from mjstack.robots.collision import change_collision
from mjstack.robots.guest import as_guest
from mjstack.robots.hand import find_hands
from mjstack.robots.servos import prepare_servos
from mjstack.robots.tips import Fingers

BUILTIN = Path(__file__).parent
_MENAGERIE_FIX = "Set MENAGERIE_ROOT to a checkout of MuJoCo Menagerie, or use model=builtin."

_GRASP_SITES = ["grasp_first", "grasp_second"]  # the default
_CONTACT = ("contype", "conaffinity", "condim", "friction", "solref", "solimp", "priority")


def robot_spec(robot: RobotCfg, model: ModelCfg, reserved: Collection[str] = ()) -> mujoco.MjSpec:
    """Load a robot and make it ready for the task.

    Args:
        robot: The robot's profile.
        model: Where its description comes from.
        reserved: Names of the scene's own geoms, bodies and cameras.

    Returns:
        A scene with the robot alone, as a guest: its two grasp sites, and servos named after their
        joints.

    Raises:
        MjstackError: The description cannot be found or read.
        UnknownName: It lacks a joint, body or site of the profile.
        ConfigError: A joint has no range or no servo.
    """
    spec = read_robot(robot, model)
    if model.source == "menagerie" and robot.replace_collision:
        _replace_collision(spec, robot)
    _require("robot.jaw_bodies: body", robot.jaw_bodies, spec.bodies)
    _require("robot.approach_body: body", [robot.approach_body or None], spec.bodies)
    _add_grasp_sites(spec, robot)
    _require("robot.arm_joints, robot.gripper_joints: joint", robot.joints, spec.joints)
    change_collision(spec, robot)
    prepare_servos(spec, robot)
    return as_guest(spec, robot, reserved)


def read_robot(robot: RobotCfg, model: ModelCfg) -> mujoco.MjSpec:
    """The robot's file as it is; errors as of `robot_spec`."""
    menagerie = model.source == "menagerie"
    path = _menagerie_path(robot) if menagerie else _file_path(robot)
    spec = read_mjcf(path, _MENAGERIE_FIX if menagerie else "Correct the file (robot.file).")
    for elements in (spec.bodies, spec.joints):  # they are told apart by their names
        for number, element in enumerate(elements):
            element.name = element.name or f"unnamed_{number}"
    return spec


def _file_path(robot: RobotCfg) -> Path:
    """The file that the profile names, or mjstack's own."""
    if robot.file is not None:
        return Path(robot.file)
    path = BUILTIN / f"{robot.name}.xml"
    if not path.is_file():
        raise ConfigError("robot.file", "null", f"the MJCF file of robot {robot.name}")
    return path


def _menagerie_path(robot: RobotCfg) -> Path:
    """The file in MuJoCo Menagerie: below ``MENAGERIE_ROOT`` if that is set, else from the cache of
    its package.
    """
    if not (robot.menagerie_name and robot.menagerie_file):
        expected = "the robot's folder and file in MuJoCo Menagerie"
        raise ConfigError(
            "robot.menagerie_name", robot.menagerie_name, expected, "Use model=builtin"
        )
    if root := os.environ.get("MENAGERIE_ROOT"):
        return Path(root) / robot.menagerie_name / robot.menagerie_file
    import mujoco_menagerie

    try:
        return Path(mujoco_menagerie.get(robot.menagerie_name).path()) / robot.menagerie_file
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        raise MjstackError(
            f"model=menagerie: {robot.menagerie_name} is neither cached nor can it be fetched"
            f" ({type(error).__name__}). {_MENAGERIE_FIX}"
        ) from error


def _replace_collision(spec: mujoco.MjSpec, robot: RobotCfg) -> None:
    """Put the collision geoms of mjstack's own file in place of the loaded ones."""
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    builtin = mujoco.MjSpec.from_file(str(_file_path(robot))).compile()
    fields = ("type", "pos", "quat", "size", *_CONTACT)
    for i in np.flatnonzero(builtin.geom_contype | builtin.geom_conaffinity):
        values = {field: getattr(builtin, f"geom_{field}")[i] for field in fields}
        body = spec.body(builtin.body(builtin.geom_bodyid[i]).name)
        body.add_geom(name=builtin.geom(i).name, group=3, **values)


def _add_grasp_sites(spec: mujoco.MjSpec, robot: RobotCfg) -> None:
    """Add the grasp sites that the file lacks, each at its place on a body, or at the mean of its
    geoms.
    """
    missing = [name for name in robot.grasp_sites if spec.site(name) is None]
    if missing == _GRASP_SITES and not robot.grasp_parts:
        _place_grasp_sites(spec, robot)
        return
    for site in missing:
        if site not in robot.grasp_parts:
            _require("grasp site", [site], spec.sites)
        parts = robot.grasp_parts[site]
        _require("geom or body", parts, [*spec.geoms, *spec.bodies])
        bodies = [spec.body(name) or spec.geom(name).parent for name in parts]
        if len({body.name for body in bodies}) != 1:
            expected = "geoms of one body, or one body"
            raise ConfigError(f"robot.grasp_parts.{site}", parts, expected)
        pos = robot.grasp_pos.get(site, [0.0, 0.0, 0.0])
        if site not in robot.grasp_pos and bodies[0].name not in parts:
            alone = spec.copy()  # the file's positions may be in frames, or of ends
            alone.compiler.fusestatic = alone.compiler.discardvisual = False
            model = alone.compile()
            pos = np.mean([model.geom(name).pos for name in parts], axis=0)
        bodies[0].add_site(name=site, pos=pos, group=4)


def _place_grasp_sites(spec: mujoco.MjSpec, robot: RobotCfg) -> None:
    """Add grasp sites where the jaws touch an object of ``closed_width``."""
    alone = spec.copy()
    alone.compiler.fusestatic = False
    model = alone.compile()
    joints = {model.joint(name).id for name in robot.gripper_joints}
    try:
        hand = next(hand for hand in find_hands(model) if joints & {*hand.gripper})
        ranges = [robot.ranges.get(model.joint(j).name, model.jnt_range[j]) for j in hand.gripper]
        grip = Fingers(alone, hand, np.array(ranges)).measure(robot.closed_width or 0.044)
    except (StopIteration, ValueError) as error:
        reason = str(error) or "no hand has the gripper's joints"
        expected = "two sites of the robot's file"
        raise ConfigError("robot.grasp_sites", "none", expected, f"Name them: {reason}") from error
    for name, jaw, pos in zip(_GRASP_SITES, grip.jaws, grip.sites, strict=True):
        spec.body(model.body(jaw).name).add_site(name=name, pos=pos, group=4)


def _require(kind: str, names: Iterable[str | None], available: Iterable) -> None:
    require_names(kind, names, [item.name for item in available if item.name])
