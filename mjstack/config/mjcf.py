"""MJCF files, and the bodies of objects that come from one."""

import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjstack.errors import MjstackError, first_line
from mjstack.files import MESHES

FREE = mujoco.mjtJoint.mjJNT_FREE
_DIRECTIONS = 128  # in which an object's farthest points are taken
_FAR = 10.0  # m


@dataclass(frozen=True, slots=True)
class Solid:
    """The colliding geoms of an object's file, all of them where none collides, in the file's axes.

    Attributes:
        center: Middle of the box around them [m].
        half: Half sizes of that box [m].
        points: Points on their convex hull [m], shape ``(n, 3)``: from the middle, or, where the
            object is fixed, from the file's origin.
    """

    center: np.ndarray
    half: list[float]
    points: list[list[float]]


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


def scenery(spec: mujoco.MjSpec) -> list[Any]:
    """Floors, lights and keyframes of a file, which stay behind where it is part of a scene."""
    world = spec.worldbody
    planes = [geom for geom in world.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE]
    return [*spec.keys, *world.lights, *planes]


def describe(elements: Iterable[Any]) -> str:
    """Kinds and names of elements of a file."""
    return ", ".join(sorted({f"{type(e).__name__[3:].lower()} {e.name}".strip() for e in elements}))


def read_object(file: str, *, fixed: bool) -> tuple[mujoco.MjSpec, str]:
    """An object's file without its surroundings and its free joint, and a line on these.

    A file with one free body is that body, and the object is all of any other file. Of a fixture's
    several bodies, free ones stay behind.

    Raises:
        MjstackError: The file cannot be read, or is not one rigid body and not fixed.
    """
    if file.lower().endswith(MESHES):
        spec = mujoco.MjSpec()
        mesh = spec.add_mesh(name="mesh", file=str(Path(file).absolute()))
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
        return spec, ""
    spec = read_mjcf(file, "Correct the object's file.")
    world = spec.worldbody
    free = [body for body in world.bodies if any(joint.type == FREE for joint in body.joints)]
    extra = scenery(spec)
    if fixed and len(world.bodies) > 1:
        extra += free
    elif free and not fixed:
        content = (*world.bodies, *world.geoms, *world.sites, *world.cameras)
        extra += [element for element in content if element not in (*free, *extra)]
    if not fixed:  # bodies that others name, or that float, would stay apart
        aimed = [light for light in spec.lights if light.targetbody and light not in extra]
        extra += [*spec.cameras, *aimed, *spec.equalities, *spec.excludes, *spec.sensors]
    left = describe(extra)
    joints = [joint for body in free if body not in extra for joint in body.joints]
    for element in (*extra, *(joint for joint in joints if joint.type == FREE)):
        spec.delete(element)
    for number, joint in enumerate(spec.joints):
        joint.name = joint.name or f"joint{number}"
    if not fixed:
        if any(body.gravcomp for body in spec.bodies):
            left += ", gravcomp" if left else "gravcomp"
        for body in spec.bodies:
            body.gravcomp = 0.0
        if len(free) > 1 or spec.joints:
            cause = f"{len(free)} free ones" if len(free) > 1 else f"joint {spec.joints[0].name}"
            problem = f"{file}: expected one rigid body, as the object moves; it has {cause}"
            raise MjstackError(problem, "Correct it, or set fixed=true for a fixture")
    if spec.compiler.settotalmass > 0.0:  # it counts all bodies of a compilation
        fix_masses(spec)
    return spec, left


def free_body(
    file: str, name: str, origin: Iterable[float], density: float | None = None
) -> mujoco.MjSpec:
    """A scene with an object's file as one body with a free joint, both of a name, which holds the
    file's origin at a position [m]; of a density [kg/m3], if that is given.

    Raises:
        MjstackError: As of `read_object`.
    """
    spec, _ = read_object(file, fixed=False)
    if density is not None:
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
        for geom in spec.geoms:
            geom.mass = np.nan
            geom.density = density
    scene = mujoco.MjSpec()
    body = scene.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    attach_guest(scene, spec, body.add_frame(pos=origin), f"{name}_")
    scene.fuse_static()
    if separate := [low.name.removeprefix(f"{name}_") for low in body.bodies]:
        problem = f"{file}: expected one rigid body; body {', '.join(separate)} cannot be fused"
        raise MjstackError(problem, "Correct it, or set fixed=true for a fixture")
    return scene


def set_range(joint: mujoco.MjsJoint, ends: Sequence[float]) -> None:
    """Limit a hinge or a slide [rad, m]."""
    turns = joint.type == mujoco.mjtJoint.mjJNT_HINGE and joint.compiler.degree
    joint.range = np.degrees(ends) if turns else ends
    joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE


def fix_masses(spec: mujoco.MjSpec) -> None:
    """Give bodies the masses and inertias that they have when the file is compiled alone, with its
    total mass.
    """
    standalone = spec.copy()
    standalone.compiler.fusestatic = False  # the same bodies
    standalone.compiler.settotalmass = -1.0
    model = standalone.compile()
    mujoco.mj_setTotalmass(model, spec.compiler.settotalmass)
    for body, twin in zip(spec.bodies[1:], standalone.bodies[1:], strict=True):
        body.explicitinertial = True
        body.mass = model.body_mass[twin.id]
        for name in ("inertia", "ipos", "iquat"):
            setattr(body, name, getattr(model, f"body_{name}")[twin.id])
        body.fullinertia = [np.nan, *[0.0] * 5]  # none
    spec.compiler.settotalmass = -1.0
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO


@lru_cache(maxsize=64)
def measure(file: str, *, fixed: bool) -> Solid:
    """Measure an object's file, joints at their zeros. `measure.cache_clear` forgets earlier files.

    Raises:
        MjstackError: The file cannot be read or compiled, or is no object.
    """
    try:
        spec = read_object(file, fixed=True)[0] if fixed else free_body(file, "x", [0.0] * 3)
        probe = spec.worldbody.add_geom(size=[1e-6] * 3, contype=0, conaffinity=0)
        model = compile_scene(spec)
    except ValueError as error:
        raise MjstackError(f"{file}: {mujoco_lines(error)}. Correct the object's file") from error
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    if not collides.any() and (not fixed or model.ngeom == 1):
        raise MjstackError(f"{file}: expected a geom that collides, there is none.")
    geoms = np.flatnonzero(collides if collides.any() else np.arange(model.ngeom) != probe.id)
    # The point of an object that lies farthest in a direction is nearest to one far away there
    directions = unit_vectors(_DIRECTIONS)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    ends = np.empty((len(directions), len(geoms), 6))
    for row, direction in zip(ends, directions, strict=True):
        data.geom_xpos[probe.id] = _FAR * direction
        for end, geom in zip(row, geoms, strict=True):
            mujoco.mj_geomDistance(model, data, geom, probe.id, 2.0 * _FAR, end)
    points = ends[..., :3]
    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    center = 0.5 * (low + high)
    farthest = np.argmax(np.einsum("nki,ni->nk", points, directions), axis=1)
    hull = np.unique(points[np.arange(len(directions)), farthest].round(9), axis=0)
    return Solid(center, (high - center).tolist(), (hull - center * (not fixed)).tolist())


def unit_vectors(count: int) -> np.ndarray:
    """Unit vectors to all sides, shape ``(6 + count, 3)``: the axes', and a spiral's."""
    z = np.linspace(-1.0, 1.0, count)
    turn = np.pi * (1.0 + 5.0**0.5) * np.arange(count)
    spiral = np.stack((np.cos(turn), np.sin(turn), z), axis=1)
    spiral[:, :2] *= np.sqrt(1.0 - z**2)[:, None]
    return np.concatenate((np.eye(3), -np.eye(3), spiral))


def attach_guest(
    host: mujoco.MjSpec, guest: mujoco.MjSpec, frame: mujoco.MjsFrame, prefix: str
) -> None:
    """Attach a file's content to a scene, which keeps its own options."""
    for name in option_names(guest.option):
        setattr(guest.option, name, getattr(host.option, name))
    with _without_prefix():
        host.attach(guest, frame=frame, prefix=prefix)


def option_names(option: object) -> list[str]:
    """Names of MuJoCo's options."""
    return [name for name in dir(option) if not name.startswith("_")]


def compile_scene(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a scene with a guest."""
    with _without_prefix():
        return spec.compile()


@contextmanager
def _without_prefix() -> Iterator[None]:
    """Silence MuJoCo's warning that names without a prefix may spoil a file that is written: none
    is written.
    """
    hook = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Attaching a spec with an empty prefix")
            yield
    finally:
        mujoco.set_mju_user_warning(hook)


def mujoco_lines(error: ValueError) -> str:
    """An error of MuJoCo's compiler in one line."""
    return ", ".join(str(error).removeprefix("Error: ").splitlines())
