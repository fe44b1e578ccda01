"""The scene's own physics, held against its configuration before anything is judged."""

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import mujoco
import numpy as np

from mjstack.config.schema import Config
from mjstack.scene.build import TABLE, add_scene

_STEPS = 20  # of a fall
_HEIGHT = 10.0  # m: clear of everything
# Of mjModel: indices, values that follow from others, and looks
_IGNORED = re.compile(r".*(id|adr|num|user|plugin|sameframe|rgba|group|shadow|M0|invweight0)$")
_Elements = dict[tuple[str, str], slice]  # rows in arrays of mjModel, by kind and name


def scene_faults(cfg: Config, model: mujoco.MjModel) -> list[str]:
    """List where a compiled scene is not as configured, a line each.

    Options and all fields of its own bodies, geoms and joints are held against the scene compiled
    without the robot. Then each object falls, is pushed and turned, free of contact.
    """
    spec = mujoco.MjSpec()
    bare = replace(cfg.scene, cameras={})
    add_scene(spec, replace(cfg, robot=replace(cfg.robot, jaw_bodies=[]), scene=bare))
    expected = spec.compile()
    shapes = {TABLE: (cfg.scene.table_half, cfg.scene.table_friction)}
    for name, thing in cfg.scene.objects.items():
        shapes |= {name + end: (p.size, thing.friction) for end, p in thing.pieces.items()}
        if not thing.fixed and thing.mass is not None:
            expected.body(name).mass = thing.mass
    for name, (size, friction) in shapes.items():  # not as `add_scene` has understood them
        expected.geom(name).size[: len(size)] = size
        expected.geom(name).friction = friction
    faults = [*_field_faults(cfg, model, expected)]
    for name in cfg.scene.free:
        faults += _fall_faults(cfg, model, expected, name)
    return faults


def _field_faults(
    cfg: Config, model: mujoco.MjModel, expected: mujoco.MjModel
) -> Iterator[str]:
    for name in [name for name in dir(expected.opt) if not name.startswith("_")]:
        if getattr(cfg.solver, name, "") is not None:  # else the robot's file has it
            yield from _fault(
                f"option {name}", getattr(model.opt, name), getattr(expected.opt, name)
            )
    objects = cfg.scene.objects
    elements = _elements(model, expected)
    for (kind, owner), rows in _elements(expected, expected).items():
        if (found := elements.get((kind, owner))) is None:
            yield f"{kind} {owner} does not collide, configured to"
            continue
        for name in [name for name in dir(expected) if name.startswith(f"{kind}_")]:
            if not _IGNORED.match(name):
                values = getattr(model, name)[found], getattr(expected, name)[rows]
                key = name.removeprefix(f"{kind}_")
                key = f"scene.objects.{owner}.{key}" if hasattr(objects.get(owner), key) else ""
                yield from _fault(f"{owner} {name}", *values, key)
    bodies = {model.body(name).id for kind, name in elements if kind == "body"}
    geoms = {rows.start for (kind, _), rows in elements.items() if kind == "geom"}
    for signature in model.exclude_signature.tolist():
        pair = (signature >> 16, signature & 0xFFFF)
        if not bodies.isdisjoint(pair):
            yield f"contacts of {model.body(pair[0]).name} and {model.body(pair[1]).name} are off"
    for pair in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True):
        if not geoms.isdisjoint(pair):
            yield f"contacts of {model.geom(pair[0]).name} and {model.geom(pair[1]).name} are a pair"


def _elements(model: mujoco.MjModel, scene: mujoco.MjModel) -> _Elements:
    """Elements of a model that a scene without the robot has, too."""
    out: _Elements = {}
    geom_id = partial(mujoco.mj_name2id, model, mujoco.mjtObj.mjOBJ_GEOM)
    for name in filter(None, (scene.geom(number).name for number in range(scene.ngeom))):
        if (number := geom_id(name)) >= 0:
            out["geom", name] = slice(number, number + 1)
    for name in filter(None, (scene.body(number).name for number in range(1, scene.nbody))):
        body = model.body(name)
        out["body", name] = slice(body.id, body.id + 1)
        for kind in ("jnt", "dof"):
            first, count = (int(getattr(body, f"{kind}{end}")[0]) for end in ("adr", "num"))
            out[kind, name] = slice(first, first + count)
        # Geoms without a name come from a file, of which visual ones may have been discarded
        first, count = int(body.geomadr[0]), int(body.geomnum[0])
        collide = (model.geom_contype | model.geom_conaffinity)[first : first + count]
        unnamed = [n for n in first + np.flatnonzero(collide) if not model.geom(n).name]
        for k, number in enumerate(unnamed):
            out["geom", f"{name} geom {k}"] = slice(number, number + 1)
    return out


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
        data.qpos[int(model.joint(name).qposadr[0]) + 2] = _HEIGHT
        mujoco.mj_forward(model, data)
        axes = data.ximat[body].reshape(3, 3).copy()
        data.xfrc_applied[body] = [force, 0.0, 0.0, *axes @ torque]
        mujoco.mj_step(model, data, _STEPS)
        mujoco.mj_forward(model, data)
        out = np.empty(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, out, 0)
        return np.concatenate((out[3:], out[:3] @ axes))

    fall = velocity()
    gravity = [*expected.opt.gravity, 0.0, 0.0, 0.0]
    yield from _fault(f"{name} falls with acceleration", fall / seconds, gravity)
    mass = float(expected.body(name).mass[0])
    inertia = expected.body(name).inertia
    with np.errstate(divide="ignore"):  # of an object that does not move
        pushed = mass / (velocity(force=mass / seconds) - fall)[0]
        torques = np.diag(inertia) / seconds
        turned = inertia / [(velocity(torque=t) - fall)[3 + k] for k, t in enumerate(torques)]
    yield from _fault(f"{name} as pushed: mass", pushed, mass)
    yield from _fault(f"{name} as turned: inertia", turned, inertia)


def _fault(name: str, value: Any, expected: Any, key: str = "") -> Iterator[str]:
    least = 1e-9 * np.max(np.abs(expected), initial=0.0)
    if not np.allclose(value, expected, rtol=1e-6, atol=least):
        numbers = (np.where(np.abs(v) < least, 0.0, v).ravel() for v in (value, expected))
        found, wanted = (" ".join(f"{number:.6g}" for number in row) for row in numbers)
        yield f"{name} {found}, configured {wanted}{key and f' ({key})'}"
