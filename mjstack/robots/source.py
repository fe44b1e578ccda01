"""Robot descriptions as MjSpec: any MJCF file, mjstack's own mesh-free ones, or Menagerie's."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import mujoco
import numpy as np

from mjstack.config.schema import ModelCfg, RobotCfg, ServoCfg
from mjstack.errors import ConfigError, MjstackError, UnknownName, first_line, require_names

BUILTIN = Path(__file__).parent
_MENAGERIE_FIX = "Set MENAGERIE_ROOT to a checkout of MuJoCo Menagerie, or use model=builtin."

_CONTACT = ("contype", "conaffinity", "condim", "friction", "solref", "solimp", "priority")
_GEOM_DEFAULTS = ("type", "density", "mass", "gap", "margin", "solmix", "group", "material", "rgba")


def robot_spec(robot: RobotCfg, model: ModelCfg) -> mujoco.MjSpec:
    """Load a robot and make it ready for the task.

    Args:
        robot: The robot's profile.
        model: Where its description comes from.

    Returns:
        A spec with the robot's two grasp sites, servos named after their joints and, where the
        profile has one, the arm's force limit. It has no keyframes.

    Raises:
        MjstackError: The description cannot be found or read.
        UnknownName: It lacks a joint, body or site of the profile.
        ConfigError: A joint has no range or no servo.
    """
    menagerie = model.source == "menagerie"
    path = _menagerie_path(robot) if menagerie else _file_path(robot)
    spec = read_mjcf(path, _MENAGERIE_FIX if menagerie else "Correct the file (robot.file).")
    if menagerie and robot.replace_collision:
        _replace_collision(spec, robot)
    _require("robot.jaw_bodies: body", robot.jaw_bodies, spec.bodies)
    _require("robot.approach_body: body", [robot.approach_body or None], spec.bodies)
    _add_grasp_sites(spec, robot)
    _split_tendon_servos(spec, robot.gripper_joints)
    for key in ("arm_joints", "gripper_joints"):
        for name in getattr(robot, key):
            _require(f"robot.{key}: joint", [name], spec.joints)
            _prepare_joint(spec, name)
    fresh = mujoco.MjSpec().default.geom
    # The file's own defaults would count for the scene's geoms too
    for field in (*_GEOM_DEFAULTS, *_CONTACT):
        setattr(spec.default.geom, field, getattr(fresh, field))
    for key in list(spec.keys):  # keyframes of the robot alone do not fit a scene's state
        spec.delete(key)
    if robot.arm_force_limit is not None:
        for name in robot.arm_joints:
            spec.actuator(name).forcerange = [-robot.arm_force_limit, robot.arm_force_limit]
    for name, servo in robot.servos.items():
        if name not in robot.joints:
            problem = UnknownName("robot.servos: joint", name, robot.joints)
            raise MjstackError(
                f"{problem}", "Or set actuator to a choice for this robot, or default"
            )
        _set_servo(spec, name, servo)
    return spec


def read_mjcf(path: str | Path, fix: str) -> mujoco.MjSpec:
    """Load an MJCF file.

    Args:
        path: The file.
        fix: What to do where it cannot be read.

    Raises:
        MjstackError: It cannot.
    """
    try:
        return mujoco.MjSpec.from_file(str(path))
    except (ValueError, FileNotFoundError) as error:
        raise MjstackError(f"{path} cannot be read: {first_line(error)}. {fix}") from error


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
    """Add the grasp sites that the file lacks, each at the mean of its geoms or bodies."""
    for site in robot.grasp_sites:
        if spec.site(site) is not None:
            continue
        if site not in robot.grasp_parts:
            _require("grasp site", [site], spec.sites)
        parts = robot.grasp_parts[site]
        if spec.body(parts[0]) is not None:
            pos = robot.grasp_pos.get(site, [0.0, 0.0, 0.0])
            spec.body(parts[0]).add_site(name=site, pos=pos, group=4)
            continue
        _require("geom", parts, spec.geoms)
        geoms = [spec.geom(name) for name in parts]
        geoms[0].parent.add_site(name=site, pos=np.mean([g.pos for g in geoms], axis=0), group=4)


def _split_tendon_servos(spec: mujoco.MjSpec, joints: Sequence[str]) -> None:
    """Put a servo of each finger in place of a position servo that moves them by a tendon.

    Its target is the finger's position, whatever the tendon's unit is. Gains and force are the
    finger's share, so that fingers which move alike feel the same.
    """
    for servo in list(spec.actuators):
        if servo.trntype != mujoco.mjtTrn.mjTRN_TENDON:
            continue
        share = {part.target.name: part.coef for part in spec.tendon(servo.target).path}
        offset, stiffness, damping = servo.biasprm[:3] * [1.0, -1.0, -1.0]
        if not share.keys() <= set(joints) or not stiffness > 0.0:
            continue
        moved = sum(share.values())  # of the tendon, where all fingers move by 1
        span = (servo.gainprm[0] * servo.ctrlrange + offset) / (stiffness * moved)
        for name, part in share.items():
            actuator = spec.add_actuator(name=name, target=name, ctrlrange=np.sort(span))
            actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
            actuator.set_to_position(kp=part * moved * stiffness, kv=part * moved * damping)
            actuator.forcerange = part * servo.forcerange
        spec.delete(servo)


def _prepare_joint(spec: mujoco.MjSpec, name: str) -> None:
    """Name a joint's servo after it, with the joint's range unless it has its own."""
    low, high = spec.joint(name).range
    if not low < high:
        raise ConfigError(
            f"range of joint {name}", [float(low), float(high)], "a range in the robot's file"
        )
    servos = [a for a in spec.actuators if a.target == name]
    positions = [a for a in servos if a.gainprm[0] and a.biasprm[1] == -a.gainprm[0]]
    if len(servos) != 1 or not positions:
        names = ", ".join(a.name for a in servos) or "none"
        raise ConfigError(f"actuators of joint {name}", names, "one <position> in the robot's file")
    (servo,) = servos
    servo.name = name
    if not servo.ctrlrange[0] < servo.ctrlrange[1]:
        servo.inheritrange = 1.0


def _set_servo(spec: mujoco.MjSpec, name: str, servo: ServoCfg) -> None:
    """Replace the values of a joint and its servo that are given."""
    actuator = spec.actuator(name)
    if servo.stiffness is not None:
        actuator.gainprm[0] = servo.stiffness
        actuator.biasprm[1] = -servo.stiffness
    if servo.damping is not None:
        actuator.biasprm[2] = -servo.damping
    if servo.effort is not None:
        actuator.forcerange = [-servo.effort, servo.effort]
    joint = spec.joint(name)
    if servo.armature is not None:
        joint.armature = servo.armature
    if servo.dry_friction is not None:
        joint.frictionloss = servo.dry_friction
    if servo.viscous_friction is not None:
        joint.damping[0] = servo.viscous_friction  # what follows is for higher powers of velocity


def _require(kind: str, names: Iterable[str | None], available: Iterable) -> None:
    require_names(kind, names, [item.name for item in available if item.name])
