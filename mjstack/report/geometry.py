"""The geometry of a model as triangles, for pages."""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import mujoco
import numpy as np

_MESH = 1.5e-3  # m, the detail of meshes from files
_SECTIONS = 20  # of a circle
_BALL = (_SECTIONS // 2, _SECTIONS)  # sections from pole to pole, and around

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices [m] and faces."""


class Shapes:
    """The geometry of a model: for each body that moves by itself, its meshes by colour.

    Attributes:
        model: The model, with its visuals.
        bodies: Numbers of the bodies; the first is the world, which never moves.
        meshes: Number among the bodies, colour, and mesh of each.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        """Read the geoms that MuJoCo shows by default."""
        from trimesh.util import append_faces  # comes with viser

        self.model = model
        self._data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self._data)
        geoms: dict[int, dict[tuple[float, ...], list[Mesh]]] = {0: {}}
        for geom in range(model.ngeom):
            material = model.geom_matid[geom]
            rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
            if model.geom_group[geom] > 2 or rgba[3] == 0.0:
                continue
            if (mesh := _tessellate(model, geom)) is None:
                continue
            body = int(model.body_weldid[model.geom_bodyid[geom]])
            vertices, faces = mesh
            turn = self._data.geom_xmat[geom].reshape(3, 3)
            place = vertices @ turn.T + self._data.geom_xpos[geom] - self._data.xpos[body]
            placed = place @ self._data.xmat[body].reshape(3, 3), faces
            geoms.setdefault(body, {}).setdefault(tuple(rgba.tolist()), []).append(placed)
        self.bodies = sorted(geoms)
        self.meshes = [
            (number, rgba, append_faces(*zip(*meshes, strict=True)))
            for number, body in enumerate(self.bodies)
            for rgba, meshes in geoms[body].items()
        ]

    def poses(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses of the bodies in a state.

        Args:
            qpos: Positions of worlds, shape ``(n, nq)``.

        Returns:
            Positions [m], shape ``(n, bodies, 3)``, and quaternions (w, x, y, z), of shape ``(n,
            bodies, 4)``.
        """
        count = len(qpos)
        places = np.empty((count, len(self.bodies), 3))
        turns = np.empty((count, len(self.bodies), 4))
        data = self._data
        state, xpos, xquat = data.qpos, data.xpos, data.xquat  # each access makes a new array
        for world, row in enumerate(qpos):
            state[:] = row
            mujoco.mj_kinematics(self.model, data)
            xpos.take(self.bodies, 0, places[world])
            xquat.take(self.bodies, 0, turns[world])
        return places, turns

    @cached_property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of everything in the model's own state [m]."""
        mujoco.mj_resetData(self.model, self._data)
        mujoco.mj_kinematics(self.model, self._data)
        corners = []
        for number, _, (vertices, _) in self.meshes:
            body = self.bodies[number]
            turn = self._data.xmat[body].reshape(3, 3)
            corners.append(vertices @ turn.T + self._data.xpos[body])
        points = np.concatenate(corners)
        return points.min(0), points.max(0)


def _tessellate(model: mujoco.MjModel, geom: int) -> Mesh | None:
    """The mesh of a geom in its own frame; None for one that is not drawn, such as a plane."""
    from trimesh import creation

    size = model.geom_size[geom]
    radius, half, _ = size
    shapes: dict[mujoco.mjtGeom, Callable[[], Any]] = {
        mujoco.mjtGeom.mjGEOM_BOX: lambda: creation.box(2.0 * size),
        mujoco.mjtGeom.mjGEOM_CYLINDER: lambda: creation.cylinder(radius, 2.0 * half, _SECTIONS),
        mujoco.mjtGeom.mjGEOM_CAPSULE: lambda: creation.capsule(2.0 * half, radius, _BALL),
        mujoco.mjtGeom.mjGEOM_SPHERE: lambda: creation.uv_sphere(radius, _BALL),
        mujoco.mjtGeom.mjGEOM_ELLIPSOID: lambda: creation.uv_sphere(1.0, _BALL).apply_scale(size),
    }
    kind = mujoco.mjtGeom(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _mesh(model, int(model.geom_dataid[geom]))
    if kind not in shapes:
        return None
    mesh = shapes[kind]()
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def _mesh(model: mujoco.MjModel, mesh: int) -> Mesh:
    """A mesh of the model with less detail: vertices closer than some millimetres are one."""
    first = model.mesh_vertadr[mesh]
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    first = model.mesh_faceadr[mesh]
    faces = model.mesh_face[first : first + model.mesh_facenum[mesh]]
    cells, which = np.unique(np.round(vertices / _MESH), axis=0, return_inverse=True)
    faces = np.unique(which.ravel()[faces], axis=0)
    a, b, c = faces.T
    return _MESH * cells, faces[(a != b) & (b != c) & (c != a)]
