"""A robot's servos: every commanded joint gets one position servo, whose command is the joint's
position [rad, m].
"""

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from mjstack.config.schema import RobotCfg, ServoCfg
from mjstack.errors import ConfigError, MjstackError, UnknownName, require_names

_JOINT = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)


def prepare_servos(spec: mujoco.MjSpec, robot: RobotCfg) -> None:
    """Give every joint of the profile its range and its servo, named after it.

    A servo of the file is kept if its command is the joint's position, and otherwise replaced by
    one that makes the same force: for other gears, gains and offsets, and for tendons that move
    several fingers. ``robot.servos`` makes servos for joints that have none, or a motor.

    Raises:
        MjstackError: A joint has no range, or a servo cannot be had with the same force.
    """
    for name, (low, high) in robot.ranges.items():
        require_names("robot.ranges: joint", [name], robot.joints)
        joint = spec.joint(name)
        turns = joint.type == mujoco.mjtJoint.mjJNT_HINGE and joint.compiler.degree
        joint.range = np.degrees([low, high]) if turns else [low, high]
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
    for name in robot.servos:
        if name not in robot.joints:
            problem = UnknownName("robot.servos: joint", name, robot.joints)
            fix = "Or set actuator to a choice for this robot, or default"
            raise MjstackError(f"{problem}", fix)
    _split_tendons(spec, robot.gripper_joints)
    servos = {name: _find_servo(spec, name, robot.servos.get(name)) for name in robot.joints}
    for servo in servos.values():  # its later name may be that of another joint's servo now
        servo.name = f"servo of {servo.target}"
    for name, servo in servos.items():
        servo.name = name
        if not servo.ctrlrange[0] < servo.ctrlrange[1]:
            servo.inheritrange = servo.inheritrange or 1.0
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
        _convert(servos[0])
        return servos[0]
    if made is None or made.stiffness is None or made.damping is None or made.effort is None:
        names = ", ".join(a.name or "unnamed" for a in servos) or "none"
        because = f" ({reason})" if len(servos) == 1 else ""
        expected = f"one <position> in the robot's file{because}, or"
        expected += f" stiffness, damping and effort in robot.servos.{name}"
        raise ConfigError(f"actuators of joint {name}", names, expected)
    for servo in servos:
        spec.delete(servo)
    return _add_servo(spec, name, made.stiffness, made.damping)


def _add_servo(
    spec: mujoco.MjSpec, joint: str, stiffness: float, damping: float
) -> mujoco.MjsActuator:
    """A new position servo, with nothing of the file's default class."""
    servo = spec.add_actuator(name=f"servo of {joint}", target=joint)
    servo.trntype = mujoco.mjtTrn.mjTRN_JOINT
    servo.gear = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    servo.ctrlrange = servo.forcerange = [0.0, 0.0]
    servo.ctrllimited = servo.forcelimited = mujoco.mjtLimited.mjLIMITED_AUTO
    servo.set_to_position(kp=stiffness, kv=damping)
    servo.inheritrange = 0.0
    return servo


def _servos(spec: mujoco.MjSpec, name: str) -> list[mujoco.MjsActuator]:
    return [a for a in spec.actuators if a.trntype in _JOINT and a.target == name]


def servo_problem(spec: mujoco.MjSpec, name: str) -> str:
    """Why a joint's actuators are no servo of its position; empty if one is."""
    servos = _servos(spec, name)
    return _refusal(servos[0]) if len(servos) == 1 else f"it has {len(servos)} actuators"


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


def _convert(servo: mujoco.MjsActuator) -> None:
    """Count a servo's command in the position of what it moves, with the same force.

    Its force is ``gear (g u + b0 + b1 gear q + b2 gear v)``: that of a servo with stiffness ``-b1
    gear^2`` and damping ``-b2 gear^2`` towards ``-(g u + b0) / (b1 gear)``. A positive b2 is a
    damping ratio, which a gear does not change.
    """
    gear = float(servo.gear[0])
    gain = float(servo.gainprm[0])
    offset, bias, damping = servo.biasprm[:3]
    if gear == 1.0 and gain == -bias and offset == 0.0:
        return
    servo.ctrlrange = np.sort(-(gain * servo.ctrlrange + offset) / (bias * gear))
    if not servo.inheritrange and not np.ptp(servo.ctrlrange):
        servo.ctrlrange = [0.0, 0.0]  # none, which an offset has moved
    servo.forcerange = np.sort(gear * servo.forcerange)
    servo.gear[0] = 1.0
    servo.gainprm[0] = -bias * gear**2
    servo.biasprm[:3] = [0.0, bias * gear**2, damping * (1.0 if damping > 0.0 else gear**2)]


def _split_tendons(spec: mujoco.MjSpec, joints: Sequence[str]) -> None:
    """Put a servo of each finger in place of a position servo that moves them by a tendon.

    A tendon of the length ``sum(c q)`` moves fingers together, each by r where the first moves by
    1: as equalities say, else all alike in the tendon's direction. A finger's share of the servo's
    stiffness k is ``c k L / r``, and its target ``u r / L``, with ``L = sum(c r)``.

    Raises:
        ConfigError: The servo is no position servo, or the fingers cancel in the tendon.
    """
    for servo in list(spec.actuators):
        if servo.trntype != mujoco.mjtTrn.mjTRN_TENDON:
            continue
        tendon = spec.tendon(servo.target)
        share = {wrap.target.name: wrap.coef for wrap in tendon.path}
        if not share.keys() <= set(joints):
            continue
        if reason := _refusal(servo):
            expected = f"a position servo ({reason})"
            raise ConfigError(f"actuator of tendon {tendon.name}", servo.name, expected)
        if servo.biasprm[2] > 0.0:  # a damping ratio, which MuJoCo resolves for the tendon
            servo.name = servo.name or f"servo of {tendon.name}"
            compiled = spec.copy().compile()
            servo.biasprm[2] = compiled.actuator(servo.name).biasprm[2]
        _convert(servo)
        moves = _ratios(spec, share)
        length = sum(coef * moves[name] for name, coef in share.items())
        if min(coef * length / moves[name] for name, coef in share.items()) < 1e-9:
            expected = "coefficients with which each finger moves as the servo pulls it"
            raise ConfigError(f"tendon {tendon.name}", share, expected)
        _, bias, damping = servo.biasprm[:3]
        for name, coef in share.items():
            part = coef * length / moves[name]
            actuator = _add_servo(spec, name, -part * bias, -part * damping)
            actuator.ctrllimited = servo.ctrllimited
            actuator.forcelimited = servo.forcelimited
            actuator.ctrlrange = np.sort(servo.ctrlrange * moves[name] / length)
            actuator.forcerange = np.sort(coef * servo.forcerange)
        spec.delete(servo)


def _ratios(spec: mujoco.MjSpec, share: Mapping[str, float]) -> dict[str, float]:
    """How far each finger of a tendon moves where the first moves by 1."""
    first = next(iter(share))
    ratios = {name: float(np.sign(coef * share[first])) for name, coef in share.items()}
    for equality in spec.equalities:
        names = (equality.name1, equality.name2)
        slope = equality.data[1]
        linear = equality.type == mujoco.mjtEq.mjEQ_JOINT and not equality.data[0]
        if linear and equality.active and first in names and slope:
            follower, leader = names
            ratios |= {follower: slope} if leader == first else {leader: 1.0 / slope}
    return {name: ratios[name] for name in share}


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
