"""The scene's own physics, held against its configuration before anything is judged."""

import copy
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from mjstack.config.mjcf import compile_scene
from mjstack.config.schema import Config
from mjstack.scene.build import TABLE, add_scene

_STEPS = 20  # of a fall
_HEIGHT = 10.0  # m
_FALL_FLAGS = (
    mujoco.mjtDisableBit.mjDSBL_ACTUATION
    | mujoco.mjtDisableBit.mjDSBL_CONTACT
    | mujoco.mjtDisableBit.mjDSBL_SPRING
    | mujoco.mjtDisableBit.mjDSBL_AUTORESET
)
"""Flags of a fall: neither an arm that is unstable nor a ceiling disturbs it."""
# Of mjModel: indices, values that follow from others, and looks
_IGNORED = re.compile(r".*(id|adr|num|user|plugin|sameframe|rgba|group|shadow|M0|invweight0)$")


def scene_faults(cfg: Config, model: mujoco.MjModel) -> Iterator[str]:
    """List where a compiled scene is not as configured, a line each.

    Options and all fields of its own bodies, geoms and joints are held against the scene compiled
    without the robot. Then each object falls, is pushed and turned, free of contact.
    """
    spec = mujoco.MjSpec()
    bare = replace(cfg.scene, cameras={})
    add_scene(spec, replace(cfg, robot=replace(cfg.robot, jaw_bodies=[]), scene=bare))
    expected = compile_scene(spec)
    shapes = {TABLE: (bare.table_half, bare.table_friction)}
    for name, object_cfg in bare.objects.items():
        friction = object_cfg.friction or []  # null of a file alone, which has no pieces
        shapes |= {name + end: (p.size, friction) for end, p in object_cfg.pieces.items()}
        if not object_cfg.fixed and object_cfg.mass is not None:
            expected.body(name).mass = object_cfg.mass
    for name, (size, friction) in shapes.items():  # not as `add_scene` has understood them
        expected.geom(name).size[: len(size)] = size
        expected.geom(name).friction = friction
    expected.geom_friction[:] = expected.geom_friction.clip(min=mujoco.mjMINMU)  # as in contacts
    yield from _field_faults(cfg, model, expected)
    falling = copy.copy(model)
    falling.opt.disableflags |= _FALL_FLAGS
    for name in bare.free:
        yield from _fall_faults(cfg, falling, expected, name)


def _field_faults(cfg: Config, model: mujoco.MjModel, expected: mujoco.MjModel) -> Iterator[str]:
    for name in [name for name in dir(expected.opt) if not name.startswith("_")]:
        if getattr(cfg.solver, name, "") is not None:  # else the robot's file has it
            value, configured = (getattr(m.opt, name) for m in (model, expected))
            yield from _fault(f"option {name}", value, configured)
    elements = _elements(model, expected)
    for owner, rows_of in _elements(expected, expected).items():
        for kind, rows in rows_of.items():
            numbers = elements[owner][kind]
            if len(numbers) != len(rows):
                yield f"{owner} has {len(numbers)} {kind} for collisions, configured {len(rows)}"
                continue
            for name in [name for name in dir(expected) if name.startswith(f"{kind}_")]:
                if not _IGNORED.match(name):
                    key = name.removeprefix(f"{kind}_")
                    known = hasattr(cfg.scene.objects.get(owner), key)
                    key = f"scene.objects.{owner}.{key}" if known else ""
                    value, configured = getattr(model, name)[numbers], getattr(expected, name)[rows]
                    yield from _fault(f"{owner} {name}", value, configured, key)
    configured_pairs = _pairs(expected)  # of fixtures
    for (kind, names), pair in _pairs(model).items():
        scene_numbers = {number for rows in elements.values() for number in rows.get(kind, ())}
        if not scene_numbers.isdisjoint(pair) and (kind, names) not in configured_pairs:
            yield f"{names} have an exclude or a pair of contacts, configured none"


def _pairs(model: mujoco.MjModel) -> dict[tuple[str, str], tuple[int, int]]:
    """Numbers of bodies without contacts, and of pairs of geoms, by kind and names."""
    excluded = [divmod(int(signature), 1 << 16) for signature in model.exclude_signature]
    pairs = {"body": excluded, "geom": zip(model.pair_geom1, model.pair_geom2, strict=True)}
    return {
        (kind, " and ".join(getattr(model, kind)(number).name for number in pair)): pair
        for kind in pairs
        for pair in pairs[kind]
    }


def _elements(model: mujoco.MjModel, scene: mujoco.MjModel) -> dict[str, dict[str, np.ndarray]]:
    """Numbers of a model's elements that a scene without a robot has too, by name of the body, or
    of the world's geom, and kind. Only geoms that collide: others may have been discarded.
    """
    collide = (model.geom_contype | model.geom_conaffinity) != 0
    result = {}
    for geom in (scene.geom(number).name for number in np.flatnonzero(scene.geom_bodyid == 0)):
        number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, geom)
        result[geom] = {"geom": np.flatnonzero(collide & (np.arange(model.ngeom) == number))}
    for name in filter(None, (scene.body(number).name for number in range(1, scene.nbody))):
        body = model.body(name).id
        result[name] = {"body": np.array([body])}
        result[name]["geom"] = np.flatnonzero(collide & (model.geom_bodyid == body))
        for kind in ("jnt", "dof"):
            result[name][kind] = np.flatnonzero(getattr(model, f"{kind}_bodyid") == body)
    return result


def _fall_faults(
    cfg: Config, model: mujoco.MjModel, expected: mujoco.MjModel, name: str
) -> Iterator[str]:
    """Let an object fall alone, under a force, and under a torque about each principal axis."""
    seconds = _STEPS * cfg.timing.physics_dt
    body = model.body(name).id
    data = mujoco.MjData(model)

    def velocity(force: float = 0.0, torque: Any = (0.0, 0.0, 0.0)) -> np.ndarray:
        """Velocities of the end: of the centre [m/s], about the principal axes [rad/s]."""
        mujoco.mj_resetData(model, data)
        data.joint(name).qpos[2] = _HEIGHT
        mujoco.mj_forward(model, data)
        axes = data.ximat[body].reshape(3, 3).copy()
        data.xfrc_applied[body] = [force, 0.0, 0.0, *axes @ torque]
        mujoco.mj_step(model, data, _STEPS)
        mujoco.mj_forward(model, data)
        result = np.empty(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, result, 0)
        return np.concatenate((result[3:], result[:3] @ axes))

    mass, inertia = float(expected.body(name).mass[0]), expected.body(name).inertia
    if not mass:
        yield f"{name} has no mass: its file keeps it in bodies that MuJoCo cannot make one"
        return
    fall = velocity()
    gravity = [*expected.opt.gravity, 0.0, 0.0, 0.0]
    yield from _fault(f"{name} falls with acceleration", fall / seconds, gravity)
    with np.errstate(all="ignore"):  # of an object that does not move
        pushed = mass / (velocity(force=mass / seconds) - fall)[0]
        torques = np.diag(inertia) / seconds
        turned = inertia / [(velocity(torque=t) - fall)[3 + k] for k, t in enumerate(torques)]
    yield from _fault(f"{name} as pushed: mass", pushed, mass, f"scene.objects.{name}.mass")
    yield from _fault(f"{name} as turned: inertia", turned, inertia)


def _fault(name: str, value: Any, expected: Any, key: str = "") -> Iterator[str]:
    least = 1e-9 * np.max(np.abs(expected), initial=0.0)
    if not np.allclose(value, expected, rtol=1e-6, atol=least):
        numbers = (np.where(np.abs(v) < least, 0.0, v).ravel() for v in (value, expected))
        text, configured = (" ".join(f"{number:.6g}" for number in row) for row in numbers)
        yield f"{name} {text}, configured {configured}{key and f' ({key})'}"
