"""Builds a scene around a robot: floor, table, objects, timestep and solver, all set before
compilation.
"""

import itertools
import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from mjstack.config.mjcf import (
    attach_guest,
    compile_scene,
    fix_masses,
    free_body,
    measure,
    mujoco_lines,
    read_object,
    set_range,
)
from mjstack.config.schema import CameraCfg, Config, ObjectCfg, SceneCfg
from mjstack.errors import ConfigError, MjstackError, UnknownName, require_names
from mjstack.robots import robot_spec
from mjstack.robots.bodies import forward_kinematics
from mjstack.robots.guest import SOLVER, WORLD, compile_robot_scene, mujoco_errors
from mjstack.robots.jaws import jaw_members

TABLE = "table"
CAPSULE_TURN = np.array([math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0])
"""MuJoCo's capsule stands along z; an object's lies along x."""
_TOUCH = 1e-5  # m: objects closer together by less only touch
_NETFORCE = 3  # the contact sensor's reduction to one force and torque, in the world frame


def build_model(cfg: Config, *, visuals: bool = False) -> mujoco.MjModel:
    """The configured robot in the configured scene, compiled.

    Args:
        cfg: The configuration.
        visuals: Keep geoms that only pictures need, as cameras do. The physics is the same without
            them, and steps faster.

    Raises:
        MjstackError: The robot's file does not fit the scene, such as one with a geom named table.
    """
    with mujoco_errors(f"{cfg.robot.name} in scene {cfg.scene.name}"):
        spec = robot_spec(cfg.robot, cfg.model, scene_names(cfg.scene))
        try:
            model = build_scene(spec, cfg, visuals=visuals)
        except ValueError:
            _require_objects(cfg.scene)
            raise
    for friction in (model.geom_friction, model.pair_friction):  # as contacts have it
        friction[:] = friction.clip(min=mujoco.mjMINMU)  # MJWarp warns of less
    return model


def scene_names(scene: SceneCfg) -> set[str]:
    """Names of the scene's own geoms, bodies and cameras."""
    geoms = (name + suffix for name, thing in scene.objects.items() for suffix in thing.pieces)
    return {"floor", TABLE, *scene.objects, *scene.cameras, *geoms}


def build_scene(spec: mujoco.MjSpec, cfg: Config, *, visuals: bool = False) -> mujoco.MjModel:
    """Add the scene to a robot and compile it; arguments as of `add_scene`.

    Returns:
        The compiled model; its ``qpos0`` has the objects at their nominal positions.
    """
    add_scene(spec, cfg, visuals=visuals)
    model = compile_robot_scene(spec, cfg.robot)
    _require_clear(model, cfg.scene)
    return model


def add_scene(spec: mujoco.MjSpec, cfg: Config, *, visuals: bool = False) -> None:
    """Add the scene to a robot.

    Args:
        spec: The robot; it is changed in place.
        cfg: Table, objects, the physics timestep, the solver's settings (``None``
            keeps the robot file's own), and the jaws, whose force on each object a sensor measures.
        visuals: Keep geoms that only pictures need, and add a disc for each place.
    """
    scene = cfg.scene
    solver = cfg.solver
    jaw_bodies = cfg.robot.jaw_bodies

    # Options and jaws
    option = spec.option
    option.timestep = cfg.timing.physics_dt
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = getattr(mujoco.mjtCone, f"mjCONE_{solver.cone.upper()}")
    for name in SOLVER:
        if (value := getattr(solver, name)) is not None:
            setattr(option, name, value)
    parents = {body.name: body.parent.name for body in spec.bodies[1:]}
    members = jaw_members(parents, jaw_bodies)
    if solver.gripper_condim is not None:
        for name in itertools.chain(*members.values()):
            for geom in spec.body(name).geoms:
                geom.condim = solver.gripper_condim

    # Bodies
    world = spec.worldbody
    _add_geom(world, "floor", "plane", size=[0, 0, 0.05], rgba=[0.32, 0.36, 0.42, 1])
    table = _add_geom(world, TABLE, "box", pos=scene.table_center, size=scene.table_half)
    table.friction = scene.table_friction
    table.rgba = [0.72, 0.66, 0.58, 1]
    for name, thing in scene.objects.items():
        _add_object(spec, name, thing, scene.table_top)

    # Sensors
    pairs = [(jaw, name) for name in scene.objects for jaw in jaw_bodies]
    if scene.support_sensors:
        pairs += [(WORLD, name) for name in scene.objects]
        pairs += itertools.combinations(scene.objects, 2)
    body = mujoco.mjtObj.mjOBJ_BODY
    subtree = mujoco.mjtObj.mjOBJ_XBODY
    trees = {n: subtree for n, thing in scene.objects.items() if thing.file}
    trees |= {
        jaw: subtree
        for jaw, bodies in members.items()
        if any(spec.body(b).geoms for b in bodies[1:])
    }
    for first, second in pairs:  # the net contact force [N]: 3 numbers, world frame
        spec.add_sensor(
            name=force_sensor(first, second),
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=trees.get(first, body),
            objname=first,
            reftype=trees.get(second, body),
            refname=second,
            intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), _NETFORCE, 1],
        )

    # Cameras, and what only pictures need
    if visuals:
        for name, place in scene.places.items():
            disc = _add_geom(world, f"place/{name}", "cylinder", size=[0.012, 5e-4, 0.0])
            disc.pos = [*place.xy, scene.table_top]
            disc.rgba = [0.2, 0.2, 0.2, 1.0]
            disc.contype = disc.conaffinity = 0
    for name, camera in scene.cameras.items():
        _add_camera(spec, name, camera, scene)
    if visuals or scene.cameras:
        # Light too weak for white, without highlights, which renderers draw differently
        matte = [0.0, 0.0, 0.0]
        world.add_light(
            pos=[0.2, -0.6, 1.6], dir=[0.1, 0.4, -1.0], diffuse=[0.55, 0.55, 0.55], specular=matte
        )
        spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
        spec.visual.headlight.diffuse = [0.3, 0.3, 0.3]
        spec.visual.headlight.specular = matte
        spec.visual.global_.offwidth = 1280
        spec.visual.global_.offheight = 960
        spec.visual.quality.shadowsize = 1024  # without a GPU, MuJoCo's 4096 doubles the time
    else:
        spec.compiler.discardvisual = True


def force_sensor(first: str, second: str) -> str:
    """Name of the sensor of the force between two bodies: a jaw or the world, and an object; or two
    objects in the scene's order.
    """
    return f"{first}/{second}"


def _add_geom(body: mujoco.MjsBody, name: str, shape: str, **values: Any) -> mujoco.MjsGeom:
    """Add a geom whose contacts slide and do not turn about their normal."""
    kind = getattr(mujoco.mjtGeom, f"mjGEOM_{shape.upper()}")
    return body.add_geom(name=name, type=kind, condim=3, **values)


def _add_object(spec: mujoco.MjSpec, name: str, thing: ObjectCfg, top: float) -> None:
    """Add an object where it stands on a surface at height top [m], or is. Its body, joint and geom
    have its name; geoms of parts and what comes from a file begin with it.
    """
    height = top + thing.half_height if thing.pos is None else thing.pos[2]
    pose: dict[str, Any] = {"pos": [*thing.xy, height], "quat": thing.turned}
    if thing.file is not None:
        _attach_file(spec, name, thing, pose)
        return
    body = spec.worldbody.add_body(name=name, **pose)
    if not thing.fixed:
        body.add_freejoint(name=name)
    surface: dict[str, Any] = {"friction": thing.friction, "rgba": thing.color}
    if thing.mass is not None:
        surface["mass"] = thing.mass / max(1, len(thing.pieces))
    elif thing.density is not None:
        surface["density"] = thing.density
    for suffix, piece in thing.pieces.items():
        size = [*piece.size, 0.0, 0.0][:3]
        geom = _add_geom(body, name + suffix, piece.shape, size=size, pos=piece.pos, **surface)
        geom.quat = piece.turned
        if piece.solref is not None:
            geom.solref[:] = piece.solref
        if piece.shape == "capsule":
            mujoco.mju_mulQuat(geom.quat, piece.turned, CAPSULE_TURN)


def _attach_file(spec: mujoco.MjSpec, name: str, thing: ObjectCfg, pose: Mapping[str, Any]) -> None:
    """Add an object from a file, which moves about the middle of its box, or is fixed, with joints
    of the file.
    """
    assert thing.file is not None
    if thing.fixed:
        child, _ = read_object(thing.file, fixed=True)
        child.fuse_static()
    else:
        center = measure(thing.file, fixed=False).center
        child = free_body(thing.file, name, -center, thing.density)
        if thing.mass is not None:
            child.compiler.settotalmass = thing.mass
            fix_masses(child)
    for geom in child.geoms:
        if thing.friction is not None:
            geom.friction = thing.friction
        if thing.color is not None:
            geom.rgba = thing.color
            geom.material = ""
    known = [joint.name for joint in child.joints]
    require_names(f"scene.objects.{name}.joints: joint", thing.joints, known)
    for joint, values in thing.joints.items():
        if values.damping is not None:
            child.joint(joint).damping[0] = values.damping
        if values.range is not None:
            set_range(child.joint(joint), values.range)
    if thing.fixed:
        body = spec.worldbody.add_body(name=name, **pose)
        attach_guest(spec, child, body.add_frame(), f"{name}_")
    else:
        attach_guest(spec, child, spec.worldbody.add_frame(**pose), "")


def _require_objects(scene: SceneCfg) -> None:
    """Raise a `MjstackError` for the first object from a file that does not compile alone."""
    for name, thing in scene.objects.items():
        alone = mujoco.MjSpec()
        try:
            _add_object(alone, name, thing, scene.table_top)
            compile_scene(alone)
        except ValueError as error:
            problem = f"scene.objects.{name}: {mujoco_lines(error)}"
            raise MjstackError(problem, f"Correct it, or its file {thing.file}") from error


def _require_clear(model: mujoco.MjModel, scene: SceneCfg) -> None:
    """Raise a `ConfigError` for the first moving object that starts inside of another thing."""
    data = forward_kinematics(model)
    root = model.body_rootid[model.geom_bodyid]
    geoms = {name: np.flatnonzero(root == model.body(name).id) for name in scene.objects}
    for name, thing in scene.free.items():
        for obstacle in [label for label in geoms if label != name]:
            pairs = itertools.product(geoms[name], geoms[obstacle])
            gaps = [mujoco.mj_geomDistance(model, data, *pair, 1.0, None) for pair in pairs]
            if min(gaps, default=0.0) < -_TOUCH:
                key = f"scene.objects.{name}.{'xy' if thing.pos is None else 'pos'}"
                depth = f"into which it reaches {-1e3 * min(gaps):.1f} mm"
                expected = f"a position clear of {obstacle}, {depth}"
                raise ConfigError(key, thing.pos or thing.xy, expected)


def _add_camera(spec: mujoco.MjSpec, name: str, camera: CameraCfg, scene: SceneCfg) -> None:
    """Add a camera to what carries it."""
    pose = camera.pose
    assert pose is not None, "configurations are complete"
    on_table = pose.mount == TABLE
    origin = [*scene.table_center[:2], scene.table_top] if on_table else [0.0, 0.0, 0.0]
    body = spec.body(WORLD if on_table else pose.mount)
    if body is None:
        known = [TABLE, *(named.name for named in spec.bodies if named.name)]
        raise UnknownName(f"scene.cameras.{name}.pose.mount: body", pose.mount, known)
    # A camera looks along its -z, and its y points up in the image.
    back = np.subtract(pose.pos, pose.target)
    right = np.cross(pose.up, back)
    axes = np.array([right, np.cross(back, right), back])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.T.ravel())
    body.add_camera(name=name, pos=np.add(origin, pose.pos), quat=quat, fovy=camera.fovy)
