"""Worlds in a browser: an episode as one HTML file with play and scrub, and the scene that the live
view shows. The only module that imports viser.
"""

import contextlib
import errno
import io
import logging
import math
import socket
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjstack.errors import ConfigError, MissingExtra
from mjstack.interrupt import check_interrupt

EPISODE = "episode.html"
MOST = 64  # worlds of a page
_RATE = 25.0  # frames per second
_LENGTH = 4.0 / 2**15  # m, to which positions are rounded
_TURN = 1.0 / 2**12  # of quaternions
_MESH = 1.5e-3  # m, the detail of meshes from files
_MARGIN = 0.12  # m between worlds
_SECTIONS = 20  # of a circle
_FAILED = np.array([0.86, 0.35, 0.32])
_TWIN = np.array([0.42, 0.60, 0.86])


@dataclass(frozen=True, kw_only=True, slots=True)
class World:
    """A world of a page.

    Attributes:
        label: Its text, short.
        qpos: Positions at frames, shape ``(frames, nq)``; NaN where it was not played.
        failed: Whether it failed, which colours its table.
        twin: Whether it is native MuJoCo's copy of the one before.
    """

    label: str
    qpos: np.ndarray
    failed: bool = False
    twin: bool = False


def lacks_viser() -> str:
    """Why there can be no page of an episode; empty if there can."""
    if find_spec("viser") is None:
        return str(MissingExtra(EPISODE, "viser", "web"))
    return ""


def frame_stride(step_dt: float) -> int:
    """Control steps per frame of a page."""
    return max(1, round(1.0 / (_RATE * step_dt)))


class Shapes:
    """The geometry of a model: for each body that moves by itself, its meshes by colour.

    Attributes:
        model: The model, with its visuals.
        bodies: Numbers of the bodies; the first is the world, which never moves.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        """Read the geoms that MuJoCo shows by default."""
        self.model = model
        self._data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self._data)
        geoms: dict[int, dict[tuple[float, ...], list[tuple[np.ndarray, np.ndarray]]]] = {0: {}}
        for geom in range(model.ngeom):
            material = model.geom_matid[geom]
            rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
            if model.geom_group[geom] > 2 or rgba[3] == 0.0:
                continue
            if (mesh := _tessellate(model, geom)) is None:
                continue
            body = int(model.body_weldid[model.geom_bodyid[geom]])
            vertices, faces = mesh
            placed = self._in_body(body, geom, vertices)
            geoms.setdefault(body, {}).setdefault(tuple(rgba.tolist()), []).append((placed, faces))
        self.bodies = sorted(geoms)
        self._meshes = {
            body: {rgba: _join(parts) for rgba, parts in geoms[body].items()} for body in geoms
        }

    def __iter__(self) -> Iterator[tuple[int, tuple[float, ...], np.ndarray, np.ndarray]]:
        """Number among the bodies, colour, vertices [m], and faces of every mesh."""
        for number, body in enumerate(self.bodies):
            for rgba, (vertices, faces) in self._meshes[body].items():
                yield number, rgba, vertices, faces

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
        for world, row in enumerate(qpos):
            self._data.qpos[:] = row
            mujoco.mj_kinematics(self.model, self._data)
            places[world] = self._data.xpos[self.bodies]
            turns[world] = self._data.xquat[self.bodies]
        return places, turns

    @cached_property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of everything in the model's own state [m]."""
        corners = []
        for number, _, vertices, _ in self:
            body = self.bodies[number]
            mujoco.mj_resetData(self.model, self._data)
            mujoco.mj_kinematics(self.model, self._data)
            turn = self._data.xmat[body].reshape(3, 3)
            corners.append(vertices @ turn.T + self._data.xpos[body])
        every = np.concatenate(corners) if corners else np.zeros((1, 3))
        return every.min(0), every.max(0)

    def _in_body(self, body: int, geom: int, vertices: np.ndarray) -> np.ndarray:
        """Vertices of a geom in the frame of a body."""
        turn = self._data.geom_xmat[geom].reshape(3, 3)
        world = vertices @ turn.T + self._data.geom_xpos[geom]
        return (world - self._data.xpos[body]) @ self._data.xmat[body].reshape(3, 3)


class Stage:
    """Worlds side by side in a viser server's scene."""

    def __init__(
        self, server: Any, shapes: Shapes, labels: Sequence[str], tints: Sequence[np.ndarray | None]
    ) -> None:
        """Add the worlds.

        Args:
            server: A ``viser.ViserServer``.
            shapes: The geometry of each world.
            labels: The text of each world.
            tints: The colour of what does not move in each world; None for the model's own.
        """
        self._shapes = shapes
        count = len(labels)
        low, high = shapes.box
        self._offsets = _grid(count, high[:2] - low[:2] + _MARGIN)
        self._handles: list[tuple[int, Any]] = []
        places, turns = self._round(*shapes.poses(np.repeat(shapes.model.qpos0[None], count, 0)))
        self._last = (places, turns)
        for number, (body, rgba, vertices, faces) in enumerate(shapes):
            color = np.repeat(np.array(rgba[:3])[None], count, 0)
            if body == 0:
                color = np.array(
                    [own if tint is None else tint for own, tint in zip(color, tints, strict=True)]
                )
            handle = server.scene.add_batched_meshes_simple(
                f"/{number}",
                vertices.astype(np.float32),
                faces,
                turns[:, body],
                places[:, body],
                batched_colors=np.round(255.0 * color).astype(np.uint8),
                opacity=None if rgba[3] == 1.0 else rgba[3],
                flat_shading=True,
                cast_shadow=body > 0,
                lod="off",
            )
            self._handles.append((body, handle))

        # Texts, the floor, and where one looks from
        for world, text in enumerate(labels):
            edge = self._offsets[world] + np.array([high[0], 0.5 * (low[1] + high[1])])
            at = np.array([*edge, low[2]])
            server.scene.add_label(
                f"/label/{world}",
                text,
                position=at,
                anchor="top-center",
                font_size_mode="scene",
                font_scene_height=0.035,
            )
        span = np.ptp(self._offsets, 0) + (high - low)[:2]
        centre = np.array([*self._offsets.mean(0) + 0.5 * (low + high)[:2], 0.0])
        server.scene.add_grid(
            "/floor",
            width=float(span[0] + 2.0),
            height=float(span[1] + 2.0),
            cell_size=0.1,
            section_size=1.0,
            position=[centre[0], centre[1], low[2] - 1e-3],
        )
        reach = 0.3 + 0.56 * float(np.linalg.norm(span))
        server.scene.set_up_direction("+z")
        server.scene.configure_environment_map(None)
        server.scene.configure_default_lights(False)
        server.scene.add_light_hemisphere("/sky", intensity=1.6, ground_color=(120, 120, 130))
        server.scene.add_light_directional(
            "/sun", position=centre + np.array([1.0, -1.5, 3.0]), intensity=1.6, cast_shadow=True
        )
        server.initial_camera.position = centre + reach * np.array([0.75, -0.45, 0.6])
        server.initial_camera.look_at = centre + reach * np.array([0.1, -0.06, 0.0])

    def update(self, qpos: np.ndarray) -> None:
        """Move the worlds to positions of shape ``(worlds, nq)``; a body that rests costs
        nothing.
        """
        places, turns = self._round(*self._shapes.poses(qpos))
        old_places, old_turns = self._last
        for body, handle in self._handles:
            if not np.array_equal(old_places[:, body], places[:, body]):
                handle.batched_positions = places[:, body]
            if not np.array_equal(old_turns[:, body], turns[:, body]):
                handle.batched_wxyzs = turns[:, body]
        self._last = (places, turns)

    def _round(self, places: np.ndarray, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses in the scene, with as many bits as eyes need: the file is compressed."""
        moved = places.copy()
        moved[..., :2] += self._offsets[:, None]
        moved = _LENGTH * np.round(moved / _LENGTH)
        return moved.astype(np.float32), (_TURN * np.round(turns / _TURN)).astype(np.float32)


def choose_worlds(parts: Mapping[str, Sequence[World]]) -> list[World]:
    """At most 64 worlds of the parts of a run: those that were played alone, and equal shares of
    the rest.
    """
    alone = [part[0] for part in parts.values() if len(part) == 1][:MOST]
    batches = [part for part in parts.values() if len(part) > 1]
    share = (MOST - len(alone)) // max(1, len(batches))
    # An even number, and the others at the end: a copy stands in the same row as its world.
    return [*(world for part in batches for world in part[: share - share % 2]), *alone]


def save_episode(
    path: Path, model: mujoco.MjModel, worlds: Sequence[World], frame_dt: float
) -> None:
    """Write worlds in motion as one HTML file, which plays without a server.

    Args:
        path: The file.
        model: The scene with its visuals.
        worlds: They stand side by side; one that ends earlier stays.
        frame_dt: Time between two frames [s].

    Raises:
        OSError: The file cannot be written.
    """
    server = start_server("127.0.0.1", 0)
    try:
        tints = [_TWIN if world.twin else _FAILED if world.failed else None for world in worlds]
        stage = Stage(server, Shapes(model), [world.label for world in worlds], tints)
        qpos = np.stack([_fill(world, worlds) for world in worlds], axis=1)
        stage.update(qpos[0])
        scene = server.get_scene_serializer()
        for row in qpos[1:]:
            check_interrupt()
            scene.insert_sleep(frame_dt)
            stage.update(row)
        scene.insert_sleep(1.0)
        page = scene.as_html().replace("<title>Viser</title>", "<title>Episode</title>", 1)
        path.write_text(page, encoding="utf-8")
    finally:
        stop_server(server)


def check_address(host: str, port: int) -> None:
    """Raise where the live view cannot be served.

    Raises:
        MissingExtra: viser is not installed.
        ConfigError: The address is not this machine's, or another program has the port.
    """
    if find_spec("viser") is None:
        raise MissingExtra("view=web", "viser", "web")
    try:
        place = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_STREAM)[0][-1]
    except OSError as error:
        raise ConfigError("web.host", host, f"an address of this machine ({error})") from error
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(place)
        except OSError as error:
            if error.errno == errno.EADDRNOTAVAIL:
                expected = "an address of this machine, such as 127.0.0.1"
                raise ConfigError("web.host", host, expected) from error
            expected = f"a port that is free on {host} ({error.strerror})"
            raise ConfigError("web.port", port, expected, "Set another web.port") from error


def start_server(host: str, port: int) -> Any:
    """A viser server; port 0 is any that is free. Ask `check_address` of others: where one is in
    use, viser tries the next ones and then hangs.
    """
    import viser

    logging.getLogger("websockets").setLevel(logging.WARNING)
    with contextlib.redirect_stdout(io.StringIO()):  # its banner
        return viser.ViserServer(host=host, port=port, verbose=False)


def stop_server(server: Any) -> None:
    """End a server."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _fill(world: World, worlds: Sequence[World]) -> np.ndarray:
    """A world's positions at every frame of the page: it stays where it ended, or where numbers
    ceased.
    """
    count = max(len(other.qpos) for other in worlds)
    good = np.isfinite(world.qpos).all(1)
    last = np.maximum.accumulate(np.where(good, np.arange(len(good)), -1))
    last = np.where(last < 0, int(good.argmax()), last)
    rows = np.minimum(np.arange(count), len(good) - 1)
    return np.nan_to_num(world.qpos)[last[rows]]


def _grid(count: int, size: np.ndarray) -> np.ndarray:
    """Places of worlds of a size in x and y [m], shape ``(count, 2)``; an even number of columns,
    so that a twin stands beside its world.
    """
    columns = math.ceil(math.sqrt(count * size[0] / size[1]))
    columns = min(count, columns + columns % 2)
    number = np.arange(count)
    return np.column_stack((-size[0] * (number // columns), size[1] * (number % columns)))


def _join(parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [faces + start for (_, faces), start in zip(parts, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def _tessellate(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices [m] and faces of a geom in its own frame; None for one that is not drawn, such as a
    plane.
    """
    import trimesh  # comes with viser

    kind = mujoco.mjtGeom(model.geom_type[geom])
    size = model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _mesh(model, int(model.geom_dataid[geom]))
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        made = trimesh.creation.box(2.0 * size)
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        made = trimesh.creation.cylinder(size[0], 2.0 * size[1], sections=_SECTIONS)
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        made = trimesh.creation.capsule(2.0 * size[1], size[0], count=[_SECTIONS, _SECTIONS // 2])
        made.apply_translation([0.0, 0.0, -made.bounds.mean(0)[2]])
    elif kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        made = trimesh.creation.icosphere(subdivisions=2)
        made.apply_scale(size[[0, 0, 0]] if kind == mujoco.mjtGeom.mjGEOM_SPHERE else size)
    else:
        return None
    return np.asarray(made.vertices), np.asarray(made.faces)


def _mesh(model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """A mesh of the model with less detail: vertices closer than some millimetres are one."""
    first = model.mesh_vertadr[mesh]
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    first = model.mesh_faceadr[mesh]
    faces = model.mesh_face[first : first + model.mesh_facenum[mesh]]
    cells, which = np.unique(np.round(vertices / _MESH), axis=0, return_inverse=True)
    faces = np.unique(which.ravel()[faces], axis=0)
    a, b, c = faces.T
    return _MESH * cells, faces[(a != b) & (b != c) & (c != a)]
