"""The profile of a robot, guessed from its MJCF file."""

import math
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy import ndarray

from mjstack.config.mjcf import compile_scene
from mjstack.config.schema import ModelCfg, RobotCfg, SceneCfg, ServoCfg
from mjstack.config.schema.robot import BasePoseCfg
from mjstack.errors import ConfigError, MjstackError
from mjstack.robots.guest import mujoco_errors
from mjstack.robots.hand import Hand, find_hands, find_root
from mjstack.robots.posture import actuator_moment, posture
from mjstack.robots.servos import prepare_servos, servo_problem
from mjstack.robots.source import read_robot, robot_spec
from mjstack.robots.tips import Fingers, Grip
from mjstack.robots.workspace import Workspace, find_workspace

_WIDTH = 0.044  # m: of the cube that a closed gripper holds
_FORCE = 20.0  # N on a cube, as far as the jaws can close farther
_LEAST = 5.0  # N
_SQUEEZE = 0.003  # m nearer than the cube's width, at least
_SOFT = 2.4e-4  # m/N by which the scene's cubes give way between two jaws
_FACING = 0.8  # rad that the jaws turn to a face, either way
_LEANS = 0.1  # rad off the vertical
_SHALLOW = 0.010  # m
_POSTURES = 30  # random ones
_RUBS = 0.001  # m that links overlap
_TURN = 6.283  # rad either way, for a hinge without a range
_BANDWIDTH = 40.0  # rad/s of a servo that is made
_FLOOR = 0.024  # m: a table's top, at least
_THICK = 0.012  # m: half of a table's thickness
_BUILTIN = ModelCfg(source="builtin")  # of the file itself
_AWAY = 0.4  # m: to a table below a gantry


class Guess(NamedTuple):
    """A key of ``robot``, its value, and the reason for it."""

    key: str
    value: Any
    reason: str


def guess_profile(file: Path, scene: SceneCfg, arm: str = "") -> list[Guess]:
    """Guess a robot's profile: joints, gripper, grasp, home and a table from a file's bodies.

    Args:
        file: An MJCF file or a URDF.
        scene: The scene whose objects get their places on the table.
        arm: Part of the names of the arm that counts, where the file has several.

    Raises:
        MjstackError: The file cannot be read, or no arm with a gripper in it can be used.
    """
    spec = read_robot(RobotCfg(name="guess", file=str(file)), _BUILTIN)
    spec.compiler.fusestatic = False
    with mujoco_errors(str(file)):
        model = spec.copy().compile()
    hands, problems = [], []
    for hand in find_hands(model):
        balls = model.jnt_bodyid[model.jnt_type == int(mujoco.mjtJoint.mjJNT_BALL)]
        if loose := [body for body in balls if body in hand.bodies and model.body_geomnum[body]]:
            body = model.body(loose[0]).name
            problems.append(f"body {body} of its hand hangs on a ball joint, which no servo moves")
            continue
        try:
            servos, limits = _fit(spec, model, hand)
            grip = Fingers(spec, hand, limits[len(hand.arm) :]).measure(_WIDTH)
            hands.append((hand, grip, servos, limits))
        except (ValueError, MjstackError) as error:
            problems.append(f"{_label(model, hand)}: {error}")
    names = [model.body(hand.palm).name for hand, *_ in hands]
    chosen = [entry for entry in hands if arm.lower() in _label(model, entry[0]).lower()]
    if not hands:
        raise MjstackError(
            f"{file}: expected an arm of two joints or more with a gripper; "
            + ("; ".join(problems) or "no body has fingers, or one jaw, at the end of joints")
        )
    if not chosen:
        raise MjstackError(f"--arm {arm}: expected a part of a name of {' or '.join(names)}.")
    hand, grip, missing, limits = chosen[0]
    space = find_workspace(model, hand, grip, limits[: len(hand.arm)])
    if space is None:
        raise MjstackError(
            f"{file}: the hand of {model.body(hand.palm).name} cannot point down over a table"
            " within the arm's reach, which the drivers' grasps from above need."
        )
    if space.tilt > _LEANS:
        with suppress(ValueError):  # a tip of a hand that leans reaches lower
            grip = Fingers(spec, hand, limits[len(hand.arm) :]).measure(_WIDTH, _SHALLOW)
    rest = [name for name, entry in zip(names, hands, strict=True) if entry is not chosen[0]]
    guesses = [
        *_guess_joints(model, hand, rest),
        *_guess_grip(model, hand, grip, limits[len(hand.arm) :]),
        *_guess_home(model, hand, grip, space, limits),
        *_guess_table(space, scene),
    ]
    made = _make_servos(model, hand, grip, space, missing)
    return [*guesses, *_guess_scene(file, guesses, made, grip)]


def _label(model: mujoco.MjModel, hand: Hand) -> str:
    names = (model.joint(j).name for j in hand.arm)
    return f"{model.body(hand.palm).name} ({', '.join(names)})"


def _unlimited(model: mujoco.MjModel, hand: Hand) -> dict[str, list[float]]:
    joints = [j for j in (*hand.arm, *hand.gripper) if not model.jnt_limited[j]]
    return {model.joint(j).name: [-_TURN, _TURN] for j in joints}


def _fit(spec: mujoco.MjSpec, model: mujoco.MjModel, hand: Hand) -> tuple[list[str], ndarray]:
    """Joints for which servos have to be made, and where the servos of all joints can bring them
    [rad, m], shape ``(n, 2)``; a MjstackError if a tendon moves one in a way that no servo can.
    """
    names = [model.joint(j).name for j in (*hand.arm, *hand.gripper)]
    arm, gripper = names[: len(hand.arm)], names[len(hand.arm) :]
    tendons = {w.target.name for t in spec.tendons for w in t.path if w.target is not None}
    bare = [name for name in names if servo_problem(spec, name)]
    pulled = [name for name in bare if name in gripper and name in tendons]
    for missing in ([name for name in bare if name not in pulled], bare):
        servos = {name: ServoCfg(stiffness=1.0, damping=1.0, effort=1.0) for name in missing}
        robot = RobotCfg(name="guess", arm_joints=arm, gripper_joints=gripper, servos=servos)
        robot.ranges = _unlimited(model, hand)
        fitted = spec.copy()
        for key in list(fitted.keys):  # they have a number of commands
            fitted.delete(key)
        try:
            prepare_servos(fitted, robot)
            break
        except ConfigError:
            if missing == bare:
                raise
    compiled = fitted.compile()
    spans = [[compiled.joint(n).range, compiled.actuator(n).ctrlrange] for n in names]
    low, high = np.transpose(spans, (2, 0, 1))
    return missing, np.stack((low.max(axis=1), high.min(axis=1)), axis=1)


def _numbers(values: Any, digits: int = 4) -> list[float]:
    return [round(float(value), digits) + 0.0 for value in values]


def _within(values: ndarray, ranges: ndarray) -> list[float]:
    """Joint positions, rounded so that they stay within ranges."""
    low, high = ranges.T
    return _numbers(
        np.clip(np.round(values, 4), np.ceil(1e4 * low) / 1e4, np.floor(1e4 * high) / 1e4)
    )


def _guess_joints(model: mujoco.MjModel, hand: Hand, rest: list[str]) -> Iterator[Guess]:
    if root := find_root(model, hand):
        yield Guess("root", model.body(root).name, "the rest of the file is no part of this arm")
    why = f"all that carry {model.body(hand.palm).name}, the last body that branches"
    if hand.one_finger:
        why = f"all that carry {model.body(hand.palm).name}, against which one jaw closes"
    if rest:
        why += f"; --arm takes {' or '.join(rest)}"
    yield Guess("arm_joints", [model.joint(j).name for j in hand.arm], why)
    servos = "beyond it, moved by a servo or a tendon; others follow"
    if not model.nu:
        servos = "beyond it; no equality lets them follow others"
    yield Guess("gripper_joints", [model.joint(j).name for j in hand.gripper], servos)
    if ranges := _unlimited(model, hand):
        yield Guess("ranges", ranges, "the file has none: one turn either way")


def _guess_grip(model: mujoco.MjModel, hand: Hand, grip: Grip, limits: ndarray) -> Iterator[Guess]:
    jaws = [model.body(jaw).name for jaw in grip.jaws]
    yield Guess("jaw_bodies", jaws, "their surfaces face each other at the tips")
    sites_there = {model.site(k).name for k in range(model.nsite)}
    sites = [name + "_" * (name in sites_there) for name in ("grasp_first", "grasp_second")]
    yield Guess("grasp_sites", sites, "made: where these surfaces touch a cube of 44 mm")
    yield Guess("grasp_parts", {s: [jaw] for s, jaw in zip(sites, jaws, strict=True)}, "")
    places = {s: _numbers(at) for s, at in zip(sites, grip.sites, strict=True)}
    yield Guess(
        "grasp_pos",
        places,
        f"{1e3 * grip.beyond:.0f} mm from the tips' ends, in the jaws' frames, m",
    )
    yield Guess("approach_body", model.body(hand.palm).name, "it carries both jaws")
    axis = grip.approach / np.linalg.norm(grip.approach)
    yield Guess("approach_axis", _numbers(axis, 5), "from the wrist to the tips, across their way")
    wide, narrow = (f"{1e3 * max(gap, 0.0):.0f}" for gap in grip.gap)
    yield Guess(
        "gripper_open",
        _within(grip.opened, limits),
        f"of {narrow} to {wide} mm, 85 at most",
    )


def _guess_home(
    model: mujoco.MjModel, hand: Hand, grip: Grip, space: Workspace, limits: ndarray
) -> Iterator[Guess]:
    q = space.home.copy()
    if space.arm.upright and space.roll in space.locked:  # the nominal plan rolls no more than that
        space.arm.pose(q)
        away = math.atan2(space.arm.apart, np.linalg.norm((space.center - space.arm.shoulder)[:2]))
        turn = math.copysign(away, space.arm.data.xaxis[hand.arm[space.roll]][2])
        low, high = limits[space.roll] + [_FACING, -_FACING]  # what is left to turn to any face
        roll = q[space.roll]
        q[space.roll] = np.clip(roll + turn, min(low, roll), max(high, roll))
    home = _within(np.concatenate((q, grip.opened)), limits)
    why = (
        f"hand down {100 * space.arm.height:.0f} cm above the table's middle, by inverse kinematics"
    )
    yield Guess(
        "home", home, f"{why}; off the vertical by {math.degrees(space.tilt):.0f} deg at most"
    )
    names = [model.joint(j).name for j in hand.arm]
    if space.locked:
        locked = {names[k]: home[k] for k in space.locked}
        yield Guess("locked", locked, "the others reach the table with the hand down")
    roll = None if space.roll is None else names[space.roll]
    if roll:
        yield Guess("roll_joint", roll, "its axis is the approach axis")
        yield Guess(
            "yaw_alignment", 1.0, "the jaws turn to a face; at home to one of the first cube"
        )
    if space.arm.upright and len(names) - len(space.locked) > 3:
        yield Guess("approach_gain", 0.5, "the first joint is upright, and joints are left")
    yield Guess("approach_height", space.arm.height, "m above an object")
    yield Guess("finger_room", 0.03, "m beside an object")


def _make_servos(
    model: mujoco.MjModel, hand: Hand, grip: Grip, space: Workspace, missing: list[str]
) -> dict[str, dict[str, float]]:
    """Servos of joints that have none."""
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[list(hand.arm)]] = space.home
    data.qpos[model.jnt_qposadr[list(hand.gripper)]] = grip.opened
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    travel = np.abs(grip.shut - grip.touching)
    servos = {}
    for joint in (model.joint(name).id for name in missing):
        dof = model.jnt_dofadr[joint]
        mass, damping = inertia[dof, dof], model.dof_damping[dof]
        hinge = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        stiffness = max(mass * _BANDWIDTH**2, 20.0 * damping, 40.0 if hinge else 2000.0)
        if joint in hand.gripper:  # the way that is left has to make the force
            stiffness = max(20.0 * damping, _FORCE * _WIDTH / float((travel**2).sum()))
        effort = _effort(data, joint) or max(3.0 * abs(data.qfrc_bias[dof]), 0.3 * stiffness, 1.0)
        made = _servo(stiffness, 2.0 * math.sqrt(stiffness * mass), effort)
        servos[model.joint(joint).name] = made
    return servos


def _servo(*values: float) -> dict[str, float]:
    pairs = zip(("stiffness", "damping", "effort"), values, strict=True)
    return {key: float(f"{value:.3g}") for key, value in pairs if value < np.inf}


def _guess_scene(
    file: Path, guesses: list[Guess], servos: dict[str, dict[str, float]], grip: Grip
) -> Iterator[Guess]:
    """Keys that depend on the compiled robot: servos, stiffer ones where the file's own let a cube
    slip, how far the jaws close, and links that touch each other in nearly every posture.
    """
    values = {guess.key: guess.value for guess in guesses if guess.key != "placements"}
    base = BasePoseCfg(**values.pop("base", {}))
    made = {name: ServoCfg(**servo) for name, servo in servos.items()}
    robot = RobotCfg(name="guess", file=str(file), servos=made, base=base, **values)
    with mujoco_errors(str(file)):
        model = compile_scene(robot_spec(robot, _BUILTIN))
    gripper = [model.actuator(name).id for name in robot.gripper_joints]
    gains, damping = model.actuator_gainprm[gripper, 0], -model.actuator_biasprm[gripper, 2]
    limited = model.actuator_forcelimited[gripper]
    efforts = np.where(limited, model.actuator_forcerange[gripper, 1], np.inf)
    travel = grip.shut - grip.touching
    press = gains * travel**2 / _WIDTH  # N where they close all the way, without limits
    soft = 1.0 + press.sum() * _SOFT / _WIDTH
    force = np.minimum(press / soft, efforts * np.abs(travel) / _WIDTH).sum()
    reasons = []
    if servos:
        why = "made where the file has no position servo: from the inertia,"
        reasons.append(f"{why} {_BANDWIDTH:g} rad/s")
    if force < _LEAST:
        reasons.append(f"the file's own press with {force:.1f} N, and a cube slips")
        more = max(1.0, _FORCE / press.sum())
        efforts = np.maximum(efforts, 2.0 * _FORCE * gains * np.abs(travel) / press.sum())
        press *= more
        stiffer = zip(more * gains, more * damping, efforts, strict=True)
        servos |= zip(robot.gripper_joints, (_servo(*values) for values in stiffer), strict=True)
    if servos:
        yield Guess("servos", servos, "; ".join(reasons))
    soft = 1.0 + press.sum() * _SOFT / _WIDTH
    share = min(1.0, max(_FORCE * soft / press.sum(), _SQUEEZE / _WIDTH))
    force = np.minimum(share * press / soft, efforts * np.abs(travel) / _WIDTH).sum()
    limits = model.jnt_range[[model.joint(name).id for name in robot.gripper_joints]]
    closed = _within(grip.touching + share * travel, limits)
    yield Guess("gripper_closed", closed, f"around 44 mm, to press with {force:.0f} N")
    data = mujoco.MjData(model)
    opened = values["gripper_open"]
    whole = posture(model, tuple(robot.joints))
    joints = [model.joint(name).id for name in robot.arm_joints]
    low, high = np.clip(model.jnt_range[joints], -np.pi, np.pi).T
    count: Counter[tuple[str, ...]] = Counter()
    for q in np.random.default_rng(0).uniform(low, high, (_POSTURES, len(low))):
        data.qpos[:] = whole.qpos(np.concatenate((q, opened)))
        mujoco.mj_fwdPosition(model, data)
        bodies = [model.geom_bodyid[c.geom] for c in data.contact if c.dist < -_RUBS]
        count.update({tuple(sorted(model.body(b).name for b in pair)) for pair in bodies})
    always = [[*pair] for pair, times in sorted(count.items()) if times > 0.8 * _POSTURES]
    if always:
        yield Guess("exclude", always, "they touch in nearly every posture")


def _effort(data: mujoco.MjData, joint: int) -> float:
    """The largest force that the file gives a joint's motor [N m, N]; 0 if it says none."""
    model = data.model
    for k in np.flatnonzero(gears := actuator_moment(data)[:, model.jnt_dofadr[joint]]):
        if model.actuator_forcelimited[k]:
            return float(np.abs(gears[k] * model.actuator_forcerange[k]).max())
        if model.actuator_ctrllimited[k] and model.actuator_biastype[k] == 0:
            gain = gears[k] * model.actuator_gainprm[k, 0]
            return float(np.abs(gain * model.actuator_ctrlrange[k]).max())
    limited = model.jnt_actfrclimited[joint]
    return float(np.abs(model.jnt_actfrcrange[joint]).max()) if limited else 0.0


def _guess_table(space: Workspace, scene: SceneCfg) -> Iterator[Guess]:
    """Where the arm stands, the table before it, and what stands on it."""
    distance = float(np.linalg.norm((space.center - space.arm.shoulder)[:2]))
    cos, sin = math.cos(space.azimuth), math.sin(space.azimuth)
    turn = np.array([[cos, sin], [-sin, cos]])  # so that the table is ahead
    shift = np.array([0.0, 0.0, max(0.0, _FLOOR - space.center[2], -space.lowest)])
    if space.azimuth or distance < 0.15 or np.linalg.norm(space.arm.shoulder[:2]) > 0.1:
        shift[:2] = -turn @ space.arm.shoulder[:2]
        shift[0] += _AWAY * (distance < 0.15)
    if space.azimuth or shift.any():
        quat = [math.cos(-0.5 * space.azimuth), 0.0, 0.0, math.sin(-0.5 * space.azimuth)]
        base = {"pos": _numbers(shift, 3), "quat": _numbers(quat, 6)}
        yield Guess(
            "base", base, "so that the table is ahead of the arm, and all is above the floor"
        )
    x, y = _numbers(turn @ space.center[:2] + shift[:2], 3)
    top = float(space.center[2] + shift[2])
    half = [round(min(0.14, max(0.09, distance - 0.1)) if distance > 0.15 else 0.14, 3)]
    sides = np.linspace(-space.arm.apart, space.arm.apart, len(scene.objects))
    places = {
        "table_center": [x, y, round(top - _THICK, 3)],
        "table_half": [*half, round(space.arm.apart + 0.12, 3), _THICK],
        "objects": {
            name: [x, round(y + s, 3)] for name, s in zip(scene.objects, sides, strict=True)
        },
        "random_xy": [0.03, 0.03],
    }
    yield Guess("placements", {scene.name: places}, "m; the hand reaches all of it, pointing down")
