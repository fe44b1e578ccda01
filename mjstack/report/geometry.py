"""The geometry of worlds as triangles, for pages."""

import copy
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from typing import Any, NamedTuple

import mujoco
import numpy as np

_MESH = 1.5e-3  # m, the detail of meshes from files
_SECTIONS = 20  # of a circle
_BALL = (_SECTIONS // 2, _SECTIONS)  # sections from pole to pole, and around
_SAME = 1e-6  # [m], and of rotation matrices and colours: less is rounding, which backends do
_HALVES = {  # columns of the size that are half the box around a geom
    mujoco.mjtGeom.mjGEOM_BOX: [0, 1, 2],
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: [0, 1, 2],
    mujoco.mjtGeom.mjGEOM_SPHERE: [0, 0, 0],
    mujoco.mjtGeom.mjGEOM_CYLINDER: [0, 0, 1],
    mujoco.mjtGeom.mjGEOM_CAPSULE: [0, 0, 1],
}
_POSES = ("qpos0", "body_pos", "body_quat", "jnt_pos", "jnt_axis", "geom_pos", "geom_quat")
_VISIBLE = (*_POSES, "geom_size", "geom_rgba", "site_", "cam_", "light_", "mat_")  # beginnings
_UNCOLORED = (0.5, 0.5, 0.5, 1.0)  # of a geom, with which MuJoCo shows its material's colour

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices [m] and faces."""
Fields = Mapping[str, np.ndarray]
"""Model fields of a world, by MuJoCo's name."""


def write_fields(model: mujoco.MjModel, fields: Fields) -> None:
    """Write a world's model fields; boxes around primitive geoms follow their sizes."""
    for name, values in fields.items():
        getattr(model, name)[:] = values
    if "geom_size" in fields:
        for kind, columns in _HALVES.items():
            rows = model.geom_type == kind
            model.geom_aabb[rows, 3:] = model.geom_size[rows][:, columns]
        rows = model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE
        model.geom_aabb[rows, 5] += model.geom_size[rows, 0]


def with_fields(model: mujoco.MjModel, fields: Fields) -> mujoco.MjModel:
    """A copy of a model with a world's fields."""
    changed = copy.copy(model)
    write_fields(changed, fields)
    return changed


def is_visible(field: str) -> bool:
    """Whether a model field changes pictures of a state."""
    return field.startswith(_VISIBLE)


def match_geoms(model: mujoco.MjModel, visual: mujoco.MjModel) -> list[int]:
    """Numbers of a model's geoms in the same model with visuals, which has more of them."""

    def rows(model: mujoco.MjModel) -> np.ndarray:
        structure = (model.geom_bodyid, model.geom_type, model.geom_contype, model.geom_conaffinity)
        return np.column_stack((*structure, model.geom_pos, model.geom_quat, model.geom_size))

    candidates = enumerate(rows(visual))  # the order is the same
    return [
        next(number for number, candidate in candidates if np.allclose(row, candidate))
        for row in rows(model)
    ]


def geom_colors(model: mujoco.MjModel) -> np.ndarray:
    """Colours of the geoms as MuJoCo shows them, shape ``(ngeom, 4)``."""
    rgba = model.geom_rgba.copy()
    plain = (rgba == _UNCOLORED).all(1) & (model.geom_matid >= 0)
    rgba[plain] = model.mat_rgba[model.geom_matid[plain]]
    return rgba


class Shape(NamedTuple):
    """A mesh in some worlds.

    Attributes:
        pose: Number of its pose among those of `Shapes.poses`.
        worlds: Numbers of the worlds.
        rgba: Its colour in each of them, shape ``(worlds, 4)``.
        mesh: The mesh, in the frame of its pose.
        table: Whether it is the table, or all that stands still in every world alike.
    """

    pose: int
    worlds: np.ndarray
    rgba: np.ndarray
    mesh: Mesh
    table: bool


class Shapes:
    """The geometry of worlds. Geoms that are the same in all worlds are one mesh for each colour of
    each body that moves by itself. A geom whose size, colour or place in its body differs has a
    pose of its own, and a mesh for each size.

    Attributes:
        rest: Positions in the model's own state, shape ``(worlds, nq)``.
        meshes: The meshes.
        missing: Names of geoms that differ and are not drawn, such as a plane.
    """

    def __init__(self, model: mujoco.MjModel, worlds: Sequence[Fields] = ({},)) -> None:
        """Read the geoms of a model with visuals that MuJoCo shows by default. ``worlds`` are the
        fields of each world that are not those of the model.
        """
        from trimesh.util import append_faces  # comes with viser

        self._model = copy.copy(model)
        self._data = mujoco.MjData(model)
        nominal = {name: getattr(model, name).copy() for fields in worlds for name in fields}
        self._worlds = [nominal | dict(fields) for fields in worlds]
        self.rest = np.stack([fields.get("qpos0", model.qpos0) for fields in self._worlds])
        self.missing: list[str] = []
        pieces: dict[tuple[int, bytes, bytes], list[Mesh]] = {}
        visible = np.flatnonzero(model.geom_group <= 2)
        states = np.stack([self._geom_states(world)[visible] for world in range(len(worlds))])
        differs = (np.abs(states - states[0]) > _SAME).any((0, 2))
        for number, geom in enumerate(visible.tolist()):
            place, turn, sizes, rgba = np.split(states[:, number], (3, 12, 15), axis=1)
            rendered = np.flatnonzero(rgba[:, 3] > 0.0)
            distinct, which = np.unique(sizes[rendered].round(6), axis=0, return_inverse=True)
            meshes = [_tessellate(model, geom, size) for size in distinct]
            if None in meshes and differs[number]:
                self.missing.append(model.geom(geom).name or f"geom {geom}")
            for row, mesh in enumerate(filter(None, meshes)):
                pose = model.nbody + geom
                if not differs[number]:
                    pose = int(model.body_weldid[model.geom_bodyid[geom]])
                    mesh = mesh[0] @ turn[0].reshape(3, 3).T + place[0], mesh[1]
                rows = rendered[which.ravel() == row]
                key = (pose, rows.tobytes(), rgba[rows].tobytes())
                pieces.setdefault(key, []).append(mesh)
        # Bodies by number, then geoms; the first is the world, which never moves
        self._poses = sorted({0, *(pose for pose, *_ in pieces)})
        table = (0, model.nbody + mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "table"))
        self.meshes = [
            Shape(
                self._poses.index(pose),
                np.frombuffer(rows, int),
                np.frombuffer(rgba).reshape(-1, 4),
                append_faces(*zip(*meshes, strict=True)),
                pose in table,
            )
            for (pose, rows, rgba), meshes in sorted(pieces.items(), key=lambda item: item[0][0])
        ]

    def _geom_states(self, world: int) -> np.ndarray:
        """Place and rotation matrix in the body that moves it, size and colour of each geom in a
        world, shape ``(ngeom, 19)``.
        """
        model, data = self._model, self._data
        write_fields(model, self._worlds[world])
        data.qpos[:] = self.rest[world]
        mujoco.mj_kinematics(model, data)
        owner = model.body_weldid[model.geom_bodyid]
        inverse = data.xmat[owner].reshape(-1, 3, 3).swapaxes(1, 2)
        place = inverse @ (data.geom_xpos - data.xpos[owner])[..., None]
        turn = inverse @ data.geom_xmat.reshape(-1, 3, 3)
        count = model.ngeom
        return np.hstack(
            (place[..., 0], turn.reshape(count, 9), model.geom_size, geom_colors(model))
        )

    def poses(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses of the bodies and geoms in a state of each world, or in any number of states of a
        single one, shape ``(n, nq)``.

        Returns:
            Positions [m], shape ``(n, poses, 3)``, and quaternions (w, x, y, z), of shape ``(n,
            poses, 4)``.
        """
        model, data = self._model, self._data
        places = np.empty((len(qpos), len(self._poses), 3))
        turns = np.empty((len(qpos), len(self._poses), 4))
        bodies = [pose for pose in self._poses if pose < model.nbody]
        geoms = [pose - model.nbody for pose in self._poses[len(bodies) :]]
        for world, (row, fields) in enumerate(zip(qpos, cycle(self._worlds), strict=False)):
            write_fields(model, fields)
            data.qpos[:] = row
            mujoco.mj_kinematics(model, data)
            places[world] = *data.xpos[bodies], *data.geom_xpos[geoms]
            turns[world, : len(bodies)] = data.xquat[bodies]
            for number, geom in enumerate(geoms, len(bodies)):
                mujoco.mju_mat2Quat(turns[world, number], data.geom_xmat[geom])
        return places, turns

    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of everything in the model's own state [m]."""
        places, turns = self.poses(self.rest)
        matrix = np.empty(9)
        corners = []
        for shape in self.meshes:
            for world in shape.worlds:
                mujoco.mju_quat2Mat(matrix, turns[world, shape.pose])
                points = shape.mesh[0] @ matrix.reshape(3, 3).T + places[world, shape.pose]
                corners += [points.min(0), points.max(0)]
        return np.min(corners, 0), np.max(corners, 0)


def _tessellate(model: mujoco.MjModel, geom: int, size: np.ndarray) -> Mesh | None:
    """The mesh of a geom of some size in its own frame; None for one that is not drawn, such as a
    plane.
    """
    from trimesh import creation

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
