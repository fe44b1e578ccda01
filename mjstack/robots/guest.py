"""A robot as a guest in a scene: what of its file comes along, and what stays behind."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np

from mjstack.config.mjcf import (
    FREE,
    attach_guest,
    compile_scene,
    describe,
    fix_masses,
    mujoco_lines,
    option_names,
    read_object,
    scenery,
)
from mjstack.config.schema import RobotCfg
from mjstack.errors import ConfigError, MjstackError, require_names
from mjstack.robots.collision import change_collision
from mjstack.robots.posture import REST

WORLD = "world"  # MuJoCo's name of the body that never moves

# Figures of the solver that the group `solver` leaves to the robot's file where they are null
SOLVER = ("iterations", "ls_iterations", "impratio", "tolerance")
_CONFIGURED = (*SOLVER, "timestep", "integrator", "cone")  # by groups timing and solver
SAG = 0.002  # m: how far off its target a hand is of which gravity, or a report, takes no notice
_WRAPS = (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER)
PREFIX = "robot_"
OWN_WORLD = PREFIX + WORLD  # body for the file's worldbody, where robot.exclude names that
_NAMED = ("geoms", "bodies", "cameras")  # elements that a scene has too
_NAMING = {  # fields with their names, whose kind another field has, or is always renamed
    "geoms": {"name": ""},
    "bodies": {"name": ""},
    "cameras": {"name": "", "targetbody": ""},
    "pairs": {"geomname1": "", "geomname2": ""},
    "excludes": {"bodyname1": "", "bodyname2": ""},
    "equalities": {"name1": "objtype", "name2": "objtype"},
    "sensors": {"objname": "objtype", "refname": "reftype"},
    "actuators": {"target": "trntype"},
    "lights": {"targetbody": ""},
}
_RENAMED = {
    *(mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY),
    *(mujoco.mjtObj.mjOBJ_GEOM, mujoco.mjtObj.mjOBJ_CAMERA, mujoco.mjtTrn.mjTRN_BODY),
}
_DYN = mujoco.mjtDyn
_LAGS = (_DYN.mjDYN_INTEGRATOR, _DYN.mjDYN_FILTER, _DYN.mjDYN_FILTEREXACT)  # no force at rest
_FLAGS = {"disableflags": mujoco.mjtDisableBit, "enableflags": mujoco.mjtEnableBit}


def as_guest(spec: mujoco.MjSpec, robot: RobotCfg, reserved: Collection[str]) -> mujoco.MjSpec:
    """A fresh scene with the robot in it. Its compiler settings act on its bodies alone, and its
    options, sizes, keyframes, lights, floors, free and mocap bodies stay behind.

    Args:
        spec: The robot; it is changed in place, and goes on to live in the scene.
        robot: Its profile, which says where it stands, and which subtree it is.
        reserved: Names of the scene's own geoms, bodies and cameras.
    """
    fresh = mujoco.MjSpec()
    fresh.modelname = spec.modelname
    rest = _home_key(spec, robot)
    for element in _strangers(spec, robot):
        spec.delete(element)
    bodies = [body.name for body in spec.bodies]
    for pair in robot.exclude:
        if not isinstance(pair, list) or len(pair) != 2 or len({*map(str, pair)}) != 2:
            expected = "pairs of bodies, such as [[world, link1]]"
            raise ConfigError("robot.exclude", robot.exclude, expected)
        require_names("robot.exclude: body", map(str, pair), bodies)
        first, second = (OWN_WORLD if name == WORLD else str(name) for name in pair)
        spec.add_exclude(bodyname1=first, bodyname2=second)
    for servo in _idle_servos(spec, robot, *_LAGS):
        if servo.dyntype == _DYN.mjDYN_INTEGRATOR:
            servo.ctrlrange = servo.actrange  # its position, no longer a speed
        servo.dyntype = _DYN.mjDYN_NONE
        servo.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
    for camera in [c for c in spec.cameras if c.targetbody and c.targetbody not in bodies]:
        spec.delete(camera)
    geoms = {geom.name for geom in spec.geoms}
    for pair in list(spec.pairs):  # MuJoCo leaves them behind
        if not {pair.geomname1, pair.geomname2} <= geoms:
            spec.delete(pair)
    _rename(spec, robot, reserved)
    if spec.compiler.settotalmass > 0.0:  # it counts all bodies of a compilation
        fix_masses(spec)
    for name in SOLVER:
        setattr(fresh.option, name, getattr(spec.option, name))
    world = fresh.worldbody
    if any(WORLD in pair for pair in robot.exclude):  # table and floor are not excluded
        world = world.add_body(name=OWN_WORLD)
    base = world.add_frame(pos=robot.base.pos, quat=robot.base.quat)
    attach_guest(fresh, spec, base, "")
    for joint in fresh.joints:
        if joint.name in rest:
            fresh.add_numeric(name=REST + joint.name, data=rest[joint.name])
    return fresh


def compile_robot_scene(spec: mujoco.MjSpec, robot: RobotCfg) -> mujoco.MjModel:
    """Compile a scene with a robot, whose gravity is compensated as its profile says."""
    model = compile_scene(spec)
    bodies = [low for name in robot.joints for low in _below(_tree(spec.joint(name).parent))]
    compensated = any(body.gravcomp for body in bodies)
    if robot.gravcomp == "auto":
        changed = not compensated and gravity_sag(model, robot) > SAG
    else:
        changed = robot.gravcomp or compensated
    if changed:
        for body in bodies:
            body.gravcomp = float(bool(robot.gravcomp))
        model = compile_scene(spec)
    return model


def gravity_sag(model: mujoco.MjModel, robot: RobotCfg) -> float:
    """How far off its target at home gravity moves the grasp point where nothing compensates it
    [m], by the stiffness of the arm's servos.
    """
    data = mujoco.MjData(model)
    for name, value in zip(robot.joints, robot.home, strict=True):
        data.joint(name).qpos = value
    mujoco.mj_forward(model, data)
    dofs = [int(model.joint(name).dofadr[0]) for name in robot.arm_joints]
    stiffness = [-model.actuator(name).biasprm[1] for name in robot.arm_joints]
    lowered = (data.qfrc_spring - data.qfrc_bias)[dofs] / stiffness
    return float(np.linalg.norm(grasp_jacobian(data, robot.grasp_sites)[:, dofs] @ lowered))


def grasp_jacobian(data: mujoco.MjData, sites: Sequence[str | int]) -> np.ndarray:
    """Translational Jacobian of the grasp point, the midpoint of two sites, shape ``(3, nv)``."""
    jac = np.zeros((2, 3, data.model.nv))
    for part, site in zip(jac, sites, strict=True):
        mujoco.mj_jacSite(data.model, data, part, None, data.site(site).id)
    return jac.mean(axis=0)


@contextmanager
def mujoco_errors(robot: str) -> Iterator[None]:
    """Raise MuJoCo's errors as those of a robot, alone or in a scene."""
    try:
        yield
    except ValueError as error:
        fix = "Correct the robot's file or the scene, whose names (floor, table and objects) the"
        fix += " robot cannot have"
        raise MjstackError(f"robot {robot}: {mujoco_lines(error)}", fix) from error


def left_behind(
    spec: mujoco.MjSpec, robot: RobotCfg, model: mujoco.MjModel, reserved: Collection[str]
) -> Iterator[str]:
    """List requests of a robot's file that the scene does not follow, a line each.

    Args:
        spec: The file as it was read.
        robot: Its profile.
        model: The compiled scene.
        reserved: As of `as_guest`.
    """
    strangers = _strangers(spec, robot)
    yield from change_collision(spec.copy(), robot)
    yield from _options_left(spec, model)
    if robot.gravcomp != "auto" or not any(body.gravcomp for body in spec.bodies):
        state = "on" if model.body_gravcomp.any() else "off"
        sag = f"without it the hand sags {1e3 * gravity_sag(model, robot):.1f} mm at home"
        value = f"robot.gravcomp={robot.gravcomp}".lower()
        yield f"gravity compensation {state} ({value}; auto: from {1e3 * SAG:g} mm on); {sag}"
    if strangers:
        yield f"left out: {describe(strangers)}"
    if lags := _idle_servos(spec, robot, *_LAGS):
        yield f"without activation, which an idle joint does not need: {describe(lags)}"
    if pids := _idle_servos(spec, robot, _DYN.mjDYN_PID):
        yield f"not held at rest, as its command stays 0: {describe(pids)}"
    names = set(_clashes(spec, reserved)) - {e.name for e in strangers}
    if names:
        yield f"renamed to {PREFIX}NAME: {', '.join(sorted(names))}"


def object_left_behind(file: str, model: mujoco.MjModel, *, fixed: bool) -> Iterator[str]:
    """List requests of an object's file that the compiled scene does not follow, a line each."""
    spec, left = read_object(file, fixed=fixed)
    yield from _options_left(spec, model)
    if left:
        yield f"left out: {left}"


def _options_left(spec: mujoco.MjSpec, model: mujoco.MjModel) -> Iterator[str]:
    """List options and flags of a file that the compiled scene does not have, a line each."""
    fresh = mujoco.MjSpec().option
    for name in option_names(fresh):
        asked, default, there = (getattr(o, name) for o in (spec.option, fresh, model.opt))
        if name in _CONFIGURED or np.array_equal(asked, default) or np.array_equal(asked, there):
            continue
        if kind := _FLAGS.get(name):
            bits = [
                name.rpartition("_")[2].lower()
                for name, bit in kind.__members__.items()
                if int(bit) & asked & ~there
            ]
            if bits:
                yield f"flags {', '.join(bits)}"
        else:
            yield f"option {name} {_text(asked)}: the scene has {_text(there)}"


def _strangers(spec: mujoco.MjSpec, robot: RobotCfg) -> list[Any]:
    """Elements of the file that are not the robot: all outside of ``robot.root`` if that is given,
    else floors, lights, and bodies that are free or mocap; and keyframes, which fit no scene.
    """
    world = spec.worldbody
    if not robot.root:
        trees = {_tree(spec.joint(name).parent).name for name in robot.joints}
        free = [
            body
            for body in world.bodies
            if body.name not in trees
            and any(b.mocap or any(j.type == FREE for j in b.joints) for b in _below(body))
        ]
        return [*scenery(spec), *free]
    require_names("robot.root: body", [robot.root], [body.name for body in spec.bodies])
    root = spec.body(robot.root)
    subtree = {body.name for body in (*_below(root), *_above(root))}
    outside = [b for b in spec.bodies if b.name not in subtree and b.parent.name in subtree]
    known = [joint.name for joint in root.find_all("joint")]
    require_names(f"robot.root={robot.root}: joint", robot.joints, known)
    carried = [joint for body in _above(root) for joint in body.joints]  # its base stands
    return [*spec.keys, *world.lights, *world.geoms, *outside, *carried]


def _idle_servos(
    spec: mujoco.MjSpec, robot: RobotCfg, *dynamics: mujoco.mjtDyn
) -> list[mujoco.MjsActuator]:
    """Servos with some dynamics that move joints of the profile neither alone nor by a tendon."""
    paths = {t.name: {wrap.target.name for wrap in t.path if wrap.target} for t in spec.tendons}
    return [
        a
        for a in spec.actuators
        if a.dyntype in dynamics
        and a.biasprm[1] < 0.0
        and {a.target, *paths.get(a.target, ())}.isdisjoint(robot.joints)
    ]


def _home_key(spec: mujoco.MjSpec, robot: RobotCfg) -> dict[str, np.ndarray]:
    """Positions in the file's keyframe ``home`` of joints that the profile does not name."""
    idle = {joint.name for joint in spec.joints if joint.name} - {*robot.joints}
    if not idle or "home" not in [key.name for key in spec.keys]:
        return {}
    model = spec.copy().compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    return {name: data.joint(name).qpos.copy() for name in idle}


def _tree(body: mujoco.MjsBody) -> mujoco.MjsBody:
    """The child of the world that a body hangs below."""
    return [body, *_above(body)][-2] if body.name not in (WORLD, OWN_WORLD) else body


def _above(body: mujoco.MjsBody) -> list[mujoco.MjsBody]:
    """A body's ancestors, up to the world."""
    return [] if body.name in (WORLD, OWN_WORLD) else [body.parent, *_above(body.parent)]


def _below(body: mujoco.MjsBody) -> list[mujoco.MjsBody]:
    """A body and its descendants."""
    return [body, *body.find_all("body")]


def _clashes(spec: mujoco.MjSpec, reserved: Collection[str]) -> list[str]:
    return [e.name for kind in _NAMED for e in getattr(spec, kind) if e.name in reserved]


def _rename(spec: mujoco.MjSpec, robot: RobotCfg, reserved: Collection[str]) -> None:
    """Put a prefix in front of names that the scene needs, and wherever they are named."""
    clashes = _clashes(spec, reserved)
    paths = [wrap for tendon in spec.tendons for wrap in tendon.path]
    wraps = [wrap.target.name for wrap in paths if wrap.type in _WRAPS]  # they keep their names
    profile = {*robot.jaw_bodies, robot.approach_body, *wraps}
    if names := profile & set(clashes):
        raise MjstackError(
            f"robot {robot.name}: the scene has {', '.join(sorted(names))} too, expected other"
            " names in the robot's file. Rename them there"
        )
    for kind, fields in _NAMING.items():
        for element in getattr(spec, kind):
            for field, of in fields.items():
                typed = not of or getattr(element, of) in _RENAMED
                if typed and getattr(element, field) in clashes:
                    setattr(element, field, PREFIX + getattr(element, field))


def _text(value: Any) -> str:
    return " ".join(f"{number:g}" for number in np.ravel(value))
