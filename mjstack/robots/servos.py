"""A robot's servos: every commanded joint gets one position servo, whose command is the joint's
position [rad, m].
"""

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from mjstack.config.mjcf import set_range
from mjstack.config.schema import RobotCfg, ServoCfg
from mjstack.errors import ConfigError, MjstackError, UnknownName, require_names
from mjstack.robots.guest import PREFIX

_JOINT = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_TENDON = mujoco.mjtTrn.mjTRN_TENDON


def prepare_servos(spec: mujoco.MjSpec, robot: RobotCfg) -> None:
    """Give every joint of the profile its range and its servo, named after it.

    A servo of the file is kept if its command is the joint's position, and otherwise replaced by
    one that makes the same force: for other gears, gains and offsets, and for tendons that move
    several fingers. ``robot.servos`` makes servos for joints that have none, or a motor.

    Raises:
        MjstackError: A joint has no range, or a servo cannot be had with the same force.
    """
    for name, ends in robot.ranges.items():
        require_names("robot.ranges: joint", [name], robot.joints)
        set_range(spec.joint(name), ends)
    for name in robot.servos:
        if name not in robot.joints:
            problem = UnknownName("robot.servos: joint", name, robot.joints)
            fix = "Or set actuator to a choice for this robot, or default"
            raise MjstackError(f"{problem}", fix)
    for actuator in [a for a in spec.actuators if a.trntype in (*_JOINT, _TENDON)]:
        find = spec.tendon if actuator.trntype == _TENDON else spec.joint
        if (moved := find(actuator.target)) is not None:  # its rotor outlives the actuator
            gear = abs(actuator.gear[0])
            moved.armature += actuator.armature * gear**2
            moved.damping += actuator.damping * gear ** np.arange(2.0, 5.0)
            actuator.armature, actuator.damping = 0.0, np.zeros(3)
        if actuator.ctrllimited == mujoco.mjtLimited.mjLIMITED_FALSE:  # the file uses no range
            actuator.ctrlrange, actuator.inheritrange = [0.0, 0.0], 0.0
    _split_tendons(spec, robot)
    servos = {name: _find_servo(spec, name, robot.servos.get(name)) for name in robot.joints}
    _name_servos(spec, servos)
    for name, servo in servos.items():
        if not servo.ctrlrange[0] < servo.ctrlrange[1]:
            servo.inheritrange = servo.inheritrange or 1.0
            servo.ctrlrange = [0.0, 0.0]  # none, which an offset may have moved
        servo.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
        if name in robot.arm_joints and robot.arm_force_limit is not None:
            servo.forcerange = [-robot.arm_force_limit, robot.arm_force_limit]
            servo.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        if name in robot.servos:
            _set_servo(spec, name, robot.servos[name])


def _find_servo(spec: mujoco.MjSpec, name: str, made: ServoCfg | None) -> mujoco.MjsActuator:
    """The servo of a joint, in its units; a new one where the configuration has all of it."""
    joint = spec.joint(name)
    low, high = joint.range
    if not low < high:
        expected = f"a range, in the file or as robot.ranges.{name}=[LOW,HIGH]"
        raise ConfigError(f"range of joint {name}", [float(low), float(high)], expected)
    servos = _servos(spec, name)
    reason = servo_problem(spec, name)
    if not reason:
        servos[0].trntype = mujoco.mjtTrn.mjTRN_JOINT  # the same for hinges and slides
        _convert(spec, servos[0])
        return servos[0]
    if made is None or not _complete(made):
        names = ", ".join(a.name or "unnamed" for a in servos) or "none"
        because = "" if reason.startswith("it has") else f" ({reason})"
        expected = f"one <position> in the robot's file{because}, or"
        expected += f" stiffness, damping and effort in robot.servos.{name}"
        raise ConfigError(f"actuators of joint {name}", names, expected)
    for servo in servos:
        spec.delete(servo)
    return _add_servo(spec, name, made)


def _complete(made: ServoCfg | None) -> bool:
    """Whether a servo can be made of what the configuration gives."""
    return made is not None and None not in (made.stiffness, made.damping, made.effort)


def _name_servos(spec: mujoco.MjSpec, servos: Mapping[str, mujoco.MjsActuator]) -> None:
    """Name each servo after its joint. Another actuator of such a name gets a prefix, and sensors
    go on to measure their actuators.
    """
    names = {servo.name: name for name, servo in servos.items()}
    for name, servo in servos.items():
        servo.name = f"servo of {name}"
    for actuator in spec.actuators:
        if actuator.name in servos:
            names[actuator.name] = PREFIX + actuator.name
            actuator.name = PREFIX + actuator.name
    for name, servo in servos.items():
        servo.name = name
    for sensor in spec.sensors:
        if sensor.objtype == mujoco.mjtObj.mjOBJ_ACTUATOR:
            sensor.objname = names.get(sensor.objname, sensor.objname)


def _add_servo(spec: mujoco.MjSpec, joint: str, made: ServoCfg) -> mujoco.MjsActuator:
    """A new position servo, with nothing of the file's default class."""
    servo = spec.add_actuator(name=f"servo of {joint}", target=joint)
    servo.trntype = mujoco.mjtTrn.mjTRN_JOINT
    servo.gear = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    servo.ctrlrange = servo.forcerange = [0.0, 0.0]
    servo.forcelimited = mujoco.mjtLimited.mjLIMITED_AUTO
    servo.set_to_position(kp=made.stiffness, kv=made.damping)
    servo.inheritrange = 0.0
    return servo


def _servos(spec: mujoco.MjSpec, name: str) -> list[mujoco.MjsActuator]:
    return [a for a in spec.actuators if a.trntype in _JOINT and a.target == name]


def servo_problem(spec: mujoco.MjSpec, name: str) -> str:
    """Why a joint's actuators are no servo of its position; empty if one is."""
    servos = _servos(spec, name)
    if len(servos) == 1:
        return _refusal(servos[0])
    mocap = [f"mocap body {body.name} takes no commands" for body in spec.bodies if body.mocap]
    return mocap[0] if mocap and not servos else f"it has {len(servos)} actuators"


def _refusal(servo: mujoco.MjsActuator) -> str:
    """The attribute that keeps an actuator from being a position servo; empty if there is none."""
    gain, bias = servo.gainprm[0], servo.biasprm[1]
    wrong = {
        f"dyntype {_word(servo.dyntype)}": servo.dyntype != mujoco.mjtDyn.mjDYN_NONE,
        f"gaintype {_word(servo.gaintype)}": servo.gaintype != mujoco.mjtGain.mjGAIN_FIXED,
        f"biastype {_word(servo.biastype)}": servo.biastype != mujoco.mjtBias.mjBIAS_AFFINE,
        f"gainprm {gain:g}": gain == 0.0,
        f"biasprm of the position {bias:g}": bias >= 0.0,
        f"gear {servo.gear[0]:g}": servo.gear[0] == 0.0,
        f"delay {servo.delay:g}": servo.delay != 0.0,
    }
    return next((f"{servo.name} has {text}" for text, holds in wrong.items() if holds), "")


def _word(value: Any) -> str:
    """MuJoCo's word for a value of an enumeration."""
    return str(value.name).rpartition("_")[2].lower()


def _convert(spec: mujoco.MjSpec, servo: mujoco.MjsActuator) -> None:
    """Count a servo's command in the position of what it moves, with the same force.

    Its force is ``gear (g u + b0 + b1 gear q + b2 gear v)``: that of a servo with stiffness ``-b1
    gear^2`` and damping ``-b2 gear^2`` towards ``-(g u + b0) / (b1 gear)``.
    """
    gear = float(servo.gear[0])
    gain = float(servo.gainprm[0])
    offset, bias, damping = servo.biasprm[:3]
    if gear == 1.0 and gain == -bias and offset == 0.0 and servo.trntype != _TENDON:
        return
    if damping > 0.0 or servo.inheritrange:  # a damping ratio: MuJoCo resolves both
        servo.name = servo.name or f"servo of {servo.target}"
        compiled = spec.copy().compile().actuator(servo.name)
        damping = compiled.biasprm[2]
        servo.ctrlrange = compiled.ctrlrange
        servo.inheritrange = 0.0
    servo.ctrlrange = np.sort(-(gain * servo.ctrlrange + offset) / (bias * gear))
    servo.forcerange = np.sort(gear * servo.forcerange)
    servo.gear[0] = 1.0
    servo.gainprm[0] = -bias * gear**2
    servo.biasprm[:3] = [0.0, bias * gear**2, damping * gear**2]


def _coefficients(spec: mujoco.MjSpec, actuator: mujoco.MjsActuator) -> dict[str, float]:
    """Joints that an actuator moves by a fixed tendon, with their coefficients in its length."""
    tendon = spec.tendon(actuator.target) if actuator.trntype == _TENDON else None
    path = [] if tendon is None else tendon.path
    fixed = all(wrap.type == mujoco.mjtWrap.mjWRAP_JOINT for wrap in path)
    return {wrap.target.name: wrap.coef for wrap in path if fixed}


def _split_tendons(spec: mujoco.MjSpec, robot: RobotCfg) -> None:
    """Put a servo of each joint in place of a position servo that moves them by a tendon.

    A tendon of the length ``sum(c q)`` moves joints together, each along ``p + r s``, where s is
    the first one's position: as equalities say, else all alike in the tendon's direction. A share
    of the servo's stiffness k is ``c k L / r``, and its target ``p + r (u - P) / L``, with
    ``L = sum(c r)`` and ``P = sum(c p)``. That of joints that follow goes to those of the profile.

    Raises:
        ConfigError: The servo is no position servo, or the joints cancel in the tendon.
    """
    for servo in list(spec.actuators):
        share = _coefficients(spec, servo)
        known = robot.joints if len(share) == 1 else robot.gripper_joints
        names = [name for name in known if name in share]
        if not names:
            continue
        if reason := _refusal(servo):
            if all(_complete(robot.servos.get(name)) for name in names):
                spec.delete(servo)
                continue
            expected = f"a position servo ({reason}), or servos of its joints in robot.servos"
            raise ConfigError(f"actuator of tendon {servo.target}", servo.name, expected)
        _convert(spec, servo)
        lines = _couplings(spec, names, share)
        start, length = np.sum([np.multiply(c, lines[name]) for name, c in share.items()], axis=0)
        followers = sum(c * lines[name][1] for name, c in share.items() if name not in names)
        for name in names:
            origin, ratio = lines[name]
            coef = share[name] + followers / len(names) / ratio
            if coef * length / ratio < 1e-9:
                expected = "coefficients with which each joint moves as the servo pulls it"
                raise ConfigError(f"tendon {servo.target}", share, expected)
            stiffness, damping = -coef * length / ratio * servo.biasprm[1:3]
            actuator = _add_servo(spec, name, ServoCfg(stiffness, damping))
            actuator.forcelimited = servo.forcelimited
            actuator.ctrlrange = np.sort(origin + (servo.ctrlrange - start) * ratio / length)
            actuator.forcerange = np.sort(coef * servo.forcerange)
        spec.delete(servo)


def _couplings(
    spec: mujoco.MjSpec, names: Sequence[str], share: Mapping[str, float]
) -> dict[str, tuple[float, float]]:
    """Where each joint of a tendon is while the first of the profile's is at 0 [rad, m], and how
    far it moves while that moves by 1; a ConfigError if it follows in another way, or freely.
    """
    lines = {names[0]: (0.0, 1.0)}
    linked = set(lines)
    kind = mujoco.mjtEq.mjEQ_JOINT
    links = [e for e in spec.equalities if e.type == kind and e.active and e.name2]
    for link in links * len(links):  # chains of them
        follower, leader = spec.joint(link.name1), spec.joint(link.name2)
        if linked & {follower.name, leader.name}:
            linked |= {follower.name, leader.name}
        offset, slope, *rest = link.data[:5]
        offset += follower.ref * _unit(follower) - slope * leader.ref * _unit(leader)
        if leader.name in lines and slope and not any(rest):
            origin, ratio = lines[leader.name]
            lines.setdefault(follower.name, (offset + slope * origin, slope * ratio))
        elif follower.name in lines and slope and not any(rest):
            origin, ratio = lines[follower.name]
            lines[leader.name] = ((origin - offset) / slope, ratio / slope)
    for name, coef in share.items():
        if name not in lines and (name in linked or name not in names):
            expected = f"one that moves as {names[0]}, or that linear equalities couple to it"
            raise ConfigError("joint of a tendon", name, expected)
        lines.setdefault(name, (0.0, float(np.sign(coef * share[names[0]]))))
    return lines


def _unit(joint: mujoco.MjsJoint) -> float:
    """The unit in which the file has a joint's positions [rad, m]."""
    turns = joint.type == mujoco.mjtJoint.mjJNT_HINGE
    return np.pi / 180.0 if turns and joint.compiler.degree else 1.0


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
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    joint = spec.joint(name)
    if servo.armature is not None:
        joint.armature = servo.armature
    if servo.dry_friction is not None:
        joint.frictionloss = servo.dry_friction
    if servo.viscous_friction is not None:
        joint.damping[0] = servo.viscous_friction  # what follows is for higher powers of velocity
