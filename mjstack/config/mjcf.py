"""MJCF files, and the bodies of objects that come from one."""

import itertools
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import mjstack.report.gl  # noqa: F401  (before mujoco)
from mjstack.errors import MjstackError, first_line
from mjstack.files import MESHES

FREE = mujoco.mjtJoint.mjJNT_FREE
_DIRECTIONS = 128  # in which an object's farthest points are taken


@dataclass(frozen=True, slots=True)
class Solid:
    """The colliding geoms of an object's file, all of them where none collides, in the file's axes.

    Attributes:
        center: Middle of the box around them [m].
        half: Half sizes of that box [m].
        points: Points on their convex hull, from the middle [m], shape ``(n, 3)``.
    """

    center: list[float]
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


def describe(elements: list[Any]) -> str:
    """Kinds and names of elements of a file."""
    names = {f"{type(e).__name__[3:].lower()} {e.name}".strip() for e in elements}
    return ", ".join(sorted(names))


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
        others = (*world.bodies, *world.geoms, *world.sites, *world.cameras)
        extra += [element for element in others if element not in (*free, *extra)]
    left = describe(extra)
    joints = [joint for body in free if body not in extra for joint in body.joints]
    for element in (*extra, *(joint for joint in joints if joint.type == FREE)):
        spec.delete(element)
    if not fixed:
        for element in (*spec.excludes, *spec.sensors):  # bodies that they name would stay apart
            spec.delete(element)
        if len(free) > 1 or spec.joints:
            problem = "it has joints; with fixed: true it is a fixture"
            problem = f"{len(free)} of its bodies are free" if len(free) > 1 else problem
            raise MjstackError(f"{file}: expected one rigid body to move, {problem}.")
    return spec, left


def attach_guest(
    host: mujoco.MjSpec, guest: mujoco.MjSpec, frame: mujoco.MjsFrame, prefix: str
) -> None:
    """Attach a file's content to a scene, which keeps its own options."""
    for name in option_names(guest.option):
        setattr(guest.option, name, getattr(host.option, name))
    with without_prefix():
        host.attach(guest, frame=frame, prefix=prefix)


def option_names(option: object) -> list[str]:
    """Names of MuJoCo's options."""
    return [name for name in dir(option) if not name.startswith("_")]


def free_body(
    file: str, name: str, shift: list[float], density: float | None = None
) -> mujoco.MjSpec:
    """A scene with an object's file as one body with a free joint, both of a name, and the file's
    origin shifted in it [m]; of a density [kg/m3], if that is given.

    Raises:
        MjstackError: As of `read_object`.
    """
    spec, _ = read_object(file, fixed=False)
    total = spec.compiler.settotalmass
    if density is not None:
        total = 0.0
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
        for geom in spec.geoms:
            geom.mass = np.nan
            geom.density = density
    host = mujoco.MjSpec()
    body = host.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    attach_guest(host, spec, body.add_frame(pos=shift), f"{name}_")
    host.fuse_static()
    if total > 0.0:  # it counts all bodies of a compilation
        set_mass(host, name, total)
    return host


def set_mass(spec: mujoco.MjSpec, name: str, mass: float) -> None:
    """Give a body a mass [kg], and inertia in proportion."""
    body = spec.body(name)
    if not body.explicitinertial:
        spec.adopt_inertial(body)
    for field in ("inertia", "fullinertia"):
        setattr(body, field, np.multiply(getattr(body, field), mass / body.mass))
    body.mass = mass


@lru_cache(maxsize=64)
def measure(file: str, *, fixed: bool) -> Solid:
    """Measure an object's file, joints at their zeros. `measure.cache_clear` forgets earlier files.

    Raises:
        MjstackError: The file cannot be read or compiled, or is no object.
    """
    try:
        spec = read_object(file, fixed=True)[0] if fixed else free_body(file, "x", [0.0] * 3)
        model = compile_scene(spec)
    except ValueError as error:
        problem = ", ".join(str(error).removeprefix("Error: ").splitlines())
        raise MjstackError(f"{file}: {problem}. Correct the object's file") from error
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    if not (collides.any() or (fixed and model.ngeom)):
        raise MjstackError(f"{file}: expected a geom that collides, there is none.")
    geoms = np.flatnonzero(collides | ~collides.any())
    step = np.arange(_DIRECTIONS)
    z = np.linspace(-1.0, 1.0, _DIRECTIONS)  # of a spiral from pole to pole
    turn = np.pi * (1.0 + 5.0**0.5) * step
    spiral = np.sqrt(1.0 - z**2) * (np.cos(turn), np.sin(turn))
    around = np.concatenate((np.eye(3), -np.eye(3), np.vstack((spiral, z)).T))
    points = np.concatenate([_surface(data, geom, around) for geom in geoms])
    low, high = points.min(axis=0), points.max(axis=0)
    center = 0.5 * (low + high)
    farthest = points[np.unique(np.argmax(points @ around.T, axis=0))]
    return Solid(center.tolist(), (high - center).tolist(), (farthest - center).tolist())


def _surface(data: mujoco.MjData, geom: np.integer, around: np.ndarray) -> np.ndarray:
    """Points of a geom [m], shape ``(n, 3)``, in the world: of a round one those farthest in some
    directions, shape ``(m, 3)``; of a shape that objects do not have, corners of its box.
    """
    model = data.model
    kind = model.geom_type[geom]
    radius, half, _ = model.geom_size[geom]
    turn = data.geom_xmat[geom].reshape(3, 3)
    local = around @ turn
    ends = np.sign(local) * [0.0, 0.0, half]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
    elif kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE):
        points = radius * local + ends
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        local[:, 2] = 0.0
        points = radius * local / np.linalg.norm(local, axis=1, keepdims=True).clip(1e-9) + ends
    else:
        middle, sizes = model.geom_aabb[geom].reshape(2, 3)
        points = middle + sizes * list(itertools.product((-1.0, 1.0), repeat=3))
    return data.geom_xpos[geom] + points @ turn.T


def compile_scene(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a scene with a guest."""
    with without_prefix():
        return spec.compile()


@contextmanager
def without_prefix() -> Iterator[None]:
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
