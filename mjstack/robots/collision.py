"""How a robot's meshes collide: as its file says, as hulls of fewer vertices, or as primitives."""

import re
from typing import Any

import mujoco
import numpy as np
from numpy import ndarray

from mjstack.config.mjcf import compile_scene, unit_vectors
from mjstack.config.schema import RobotCfg
from mjstack.errors import ConfigError

_MESH = mujoco.mjtGeom.mjGEOM_MESH
_DIRECTIONS = 1024  # in which a hull is to be as wide as before
_FEWEST = 8
_THIN = 1e-3  # m: half of a primitive's thickness, at least
_CONTACT = (
    *("contype", "conaffinity", "condim", "priority", "friction", "solmix", "solref", "solimp"),
    *("margin", "gap", "adhesion", "surfacevel"),
)
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
_HIDDEN = 3  # group of geoms that are not drawn


def change_collision(spec: mujoco.MjSpec, robot: RobotCfg) -> list[str]:
    """Let a robot, which is changed in place, collide as ``robot.collision`` says, and list what is
    other than in its file, a line each.

    A mesh stays where it is, as a shape that has mass and is drawn; a geom in its place collides.

    Raises:
        ConfigError: ``robot.collision`` is none of its values.
    """
    value = str(robot.collision)
    number = re.fullmatch(r"hull (\d+)", value)
    limit = int(number[1]) if number else 0
    if value not in ("file", "primitives") and limit < _FEWEST:
        expected = f"file, primitives, or hull N with {_FEWEST} vertices or more, such as hull 64"
        raise ConfigError("robot.collision", robot.collision, expected)
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    geoms = [
        (number, geom)
        for number, geom in enumerate(spec.geoms)
        if geom.type == _MESH and (geom.contype or geom.conaffinity or {geom.name} & paired)
    ]
    if value == "file" or not geoms:
        return []
    model, ids = _compile(spec)
    points = {
        mesh: _hull_points(model, mesh) for mesh in {model.geom_dataid[ids[n]] for n, _ in geoms}
    }
    losses = {}
    shapes: dict[int, dict[str, Any]] = {}
    for mesh, hull in points.items():
        if not limit:
            shapes[mesh] = _primitive(hull)
        elif len(hull) > limit:
            nearest, losses[mesh] = _nearest(hull, limit)
            name = f"{model.mesh(mesh).name}_{value}"
            # The file's default would scale the points once more
            spec.add_mesh(name=name, uservert=nearest.ravel(), scale=[1.0, 1.0, 1.0])
            shapes[mesh] = {"type": _MESH, "meshname": name}
    for n, geom in geoms:
        pos, quat = model.geom_pos[ids[n]].copy(), model.geom_quat[ids[n]].copy()
        if not (shape := dict(shapes.get(model.geom_dataid[ids[n]], {}))):
            continue
        mujoco.mju_rotVecQuat(offset := np.zeros(3), shape.pop("center", np.zeros(3)), quat)
        mujoco.mju_mulQuat(quat, quat.copy(), shape.pop("turn", _UPRIGHT))
        contact = {name: getattr(geom, name) for name in _CONTACT}
        name, geom.name = geom.name, ""
        geom.contype = geom.conaffinity = 0
        place = {"pos": pos + offset, "quat": quat, "mass": 0.0, "group": _HIDDEN}
        geom.parent.add_geom(name=name, **shape, **place, **contact)
    if losses:
        count = max(len(points[mesh]) for mesh in losses)
        return [
            f"{len(losses)} meshes collide as hulls of {limit} vertices, not of up to {count:,}:"
            f" surfaces are up to {1e3 * max(losses.values()):.1f} mm inside the file's"
            f" (robot.collision={value})"
        ]
    if not limit:
        kinds = [shape["type"] for shape in shapes.values()]
        boxes = kinds.count(mujoco.mjtGeom.mjGEOM_BOX)
        excluded = _exclude_neighbours(spec, robot, _touching(model, robot))
        return [
            f"{boxes} meshes collide as boxes and {len(shapes) - boxes} as capsules around them"
            f" (robot.collision=primitives); {excluded} pairs of bodies that overlap at home do not"
        ]
    return []


def _compile(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, list[int]]:
    """The robot alone, with all of its bodies and geoms, and the geoms' numbers."""
    copied = spec.copy()
    copied.compiler.fusestatic = copied.compiler.discardvisual = False
    return compile_scene(copied), [geom.id for geom in copied.geoms]


def _hull_points(model: mujoco.MjModel, mesh: int) -> ndarray:
    """Vertices of a mesh's convex hull in the mesh's frame [m], shape ``(n, 3)``."""
    first = model.mesh_graphadr[mesh]
    count = model.mesh_graph[first]
    numbers = model.mesh_graph[first + 2 + count : first + 2 + 2 * count]
    return model.mesh_vert[model.mesh_vertadr[mesh] + numbers].astype(float)


def _nearest(points: ndarray, limit: int) -> tuple[ndarray, float]:
    """Those of a hull's vertices whose hull is nearest to it, one after the other, and how far it
    is inside [m].
    """
    heights = unit_vectors(_DIRECTIONS) @ points.T
    farthest = heights.argmax(axis=1)
    top = heights.max(axis=1)
    chosen = [int(farthest[0])]
    reached = heights[:, chosen[0]].copy()
    while len(chosen) < limit and (top - reached).max() > 0.0:
        chosen.append(int(farthest[(top - reached).argmax()]))
        np.maximum(reached, heights[:, chosen[-1]], out=reached)
    return points[chosen], float((top - reached).max())


def _primitive(points: ndarray) -> dict[str, Any]:
    """The smaller one of a box and a capsule around points."""
    low, high = points.min(axis=0), points.max(axis=0)
    center, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), _THIN)
    axis = np.eye(3)[half.argmax()]
    axial = (points - center) @ axis
    radial = np.linalg.norm(points - center - axial[:, None] * axis, axis=1)
    radius = max(float(radial.max()), _THIN)
    length = float(np.max(np.abs(axial) - np.sqrt(radius**2 - radial**2), initial=_THIN))
    if np.pi * radius**2 * (2.0 * length + 4.0 / 3.0 * radius) >= 8.0 * half.prod():
        return {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": half, "center": center}
    mujoco.mju_quatZ2Vec(turn := np.zeros(4), axis)
    size = [radius, length, 0.0]
    return {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "size": size, "center": center, "turn": turn}


def _touching(model: mujoco.MjModel, robot: RobotCfg) -> set[frozenset[str]]:
    """Pairs of bodies of a robot that touch at home."""
    data = mujoco.MjData(model)
    for name, value in zip(robot.joints, robot.home, strict=True):
        data.joint(name).qpos = value
    mujoco.mj_forward(model, data)
    bodies = model.geom_bodyid[data.contact.geom]
    return {frozenset(model.body(b).name for b in pair) for pair in bodies if pair.all()}


def _exclude_neighbours(spec: mujoco.MjSpec, robot: RobotCfg, contacts: set[frozenset[str]]) -> int:
    """Exclude pairs of bodies that touch at home, and did not before; returns their number."""
    new = _touching(_compile(spec)[0], robot) - contacts
    for first, second in sorted(map(sorted, new)):
        spec.add_exclude(bodyname1=first, bodyname2=second)
    return len(new)
