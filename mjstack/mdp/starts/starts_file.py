"""Worlds that start from the rows of a file, and a file of how worlds have started."""

import csv
import math
import reprlib
from collections.abc import Iterable, Sequence
from pathlib import Path

import mujoco
import numpy as np
import torch
from torch import Tensor

from mjstack.errors import ArgumentError, ConfigError, ParameterError, suggest
from mjstack.files import to_csv, write_atomic
from mjstack.managers.view import EnvView, offers, uses_fields
from mjstack.mdp.geometry import Pose, place_xy, pose_w, robot, write_robot
from mjstack.mdp.observation import joint_pos
from mjstack.mdp.starts.placement import world_boxes
from mjstack.mdp.starts.randomization import (
    ObjectMasses,
    Quantity,
    ServoGains,
    SlidingFriction,
    bounds,
)
from mjstack.mdp.starts.reach import out_of_reach
from mjstack.scene.index import joint_limits

# [m], and of a quaternion: how far off upright an object on the table may be
_FLAT = 1e-5
_OVER = 1e-6  # [m] how far an object may reach over the edge of the table


class StartsTable:
    """The content of a file, a CSV with a header and one row per world.

    Attributes:
        columns: Values by column name, each ``(worlds,)``, float64, with world w in row w.
        lines: The line of each world in the file, ``(worlds,)``.
    """

    def __init__(
        self, path: str, key: str, required: Sequence[str], optional: Sequence[str]
    ) -> None:
        """Read a file and check it cell by cell.

        Args:
            path: The file.
            key: The configuration key that names it: ``starts``, or ``path`` of a term.
            required: Names of columns that every file has, beside ``world``.
            optional: Names of columns that a file may have.

        Raises:
            ConfigError: The file cannot be read, or a column, a cell or a world is wrong.
        """
        self._path = path
        self._error = ConfigError if key == "starts" else ParameterError
        self._key = key
        required = ["world", *required]
        try:
            with Path(path).open(encoding="utf-8-sig", newline="") as file:
                reader = csv.reader(file)
                header = [name.strip() for name in next(reader, [])]
                rows = [(reader.line_num, cells) for cells in reader if "".join(cells).strip()]
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            expected = "a CSV file with a header and one row per world; it cannot be read"
            reason = getattr(error, "strerror", None) or error
            raise self.wrong(f"{expected} ({reason})", "Name a file: starts=worlds.csv") from error

        known = [*required, *optional]
        for name in header:
            if name not in known or header.count(name) > 1:
                expected = f"columns separated by commas, each once; {reprlib.repr(name)} is wrong"
                raise self.wrong(expected, suggest(name, known).rstrip("."), 1)
        if lacking := [name for name in required if name not in header]:
            expected = f"columns {', '.join(required)}; {', '.join(lacking)} missing"
            raise self.wrong(expected, "Add the missing columns", 1)

        values = np.empty((len(rows), len(header)))
        for row, (line, cells) in enumerate(rows):
            if len(cells) != len(header):
                expected = f"{len(header)} cells as in the header, it has {len(cells)}"
                raise self.wrong(expected, "Correct it; the decimal mark is a point", line)
            for column, cell in enumerate(cells):
                try:
                    values[row, column] = float(cell)
                except ValueError:
                    values[row, column] = math.nan
                if not math.isfinite(values[row, column]):
                    expected = f"a finite number, {reprlib.repr(cell)} is none"
                    raise self.wrong(expected, "Correct it", line, [header[column]])

        table = dict(zip(header, values.T, strict=True))
        worlds = table.pop("world")
        if missing := set(range(max(1, len(rows)))).difference(worlds):
            expected = f"worlds numbered from 0, a row each; {min(missing)} is missing"
            raise self.wrong(expected, "Number the rows anew", columns=["world"])
        order = np.argsort(worlds)
        self.columns = {name: column[order] for name, column in table.items()}
        self.lines = np.array([line for line, _ in rows])[order]

    def take(self, columns: Sequence[str]) -> np.ndarray:
        """Columns side by side, NaN where the file has none, shape ``(worlds, n)``."""
        missing = np.full(len(self.lines), math.nan)
        return np.stack([self.columns.get(name, missing) for name in columns], axis=1)

    def misfit(self, world: int, columns: Sequence[str], expected: str, fix: str) -> ConfigError:
        """The error that some cells of a world's line cannot be used."""
        return self.wrong(expected, fix, self.lines[world], columns)

    def require_range(self, column: str, low: float, high: float, fix: str = "Correct it") -> None:
        """Refuse a value outside a range, if the file has the column.

        Raises:
            ConfigError: There is one; names its line.
        """
        values = self.columns.get(column, np.empty(0))
        slack = 1e-6 * max(abs(low), abs(high))  # float32 does not hold the ends exactly
        for world in np.flatnonzero((values < low - slack) | (values > high + slack)).tolist():
            expected = f"{low:.6g} to {high:.6g}, it is {values[world]:.6g}"
            raise self.misfit(world, [column], expected, fix)

    def wrong(
        self, expected: str, fix: str, line: int | None = None, columns: Sequence[str] = ()
    ) -> ConfigError:
        """The error that the file, or some columns of a line, cannot be used."""
        where = self._path if line is None else f"{self._path}, line {line}"
        if columns:
            where += f", column{'s' if len(columns) > 1 else ''} {', '.join(columns)}"
        return self._error(self._key, where, expected, fix)


@offers(reads_file=True)
@uses_fields(*ObjectMasses.fields, *SlidingFriction.fields, *ServoGains.fields)
class FromStartsFile:
    """World w starts from row w of a file, at every reset.

    Joints without a column are at a pose of the robot. Masses, friction and gains without one are
    left alone, and places without columns are drawn.
    """

    def __init__(
        self,
        env: EnvView,
        *,
        path: str | None,
        pose: Pose = "start",
        mass: Sequence[float] = (0.7, 1.3),
        friction: Sequence[float] = (0.8, 1.4),
        gain: Sequence[float] = (0.9, 1.1),
    ) -> None:
        """Read the file and check every world in it.

        Args:
            env: The environment.
            path: The file; see `StartsTable`.
            pose: Of joints that have no column, ``home`` or ``start``.
            mass: Smallest and largest mass of an object, over the model's own.
            friction: Smallest and largest coefficient. Where the file has any, the table gets the
                smallest.
            gain: Smallest and largest factor of a servo's gains.

        Raises:
            ConfigError: The file that ``starts`` names cannot be read, has too few worlds, or one
                that cannot be used.
            ParameterError: The same for a file that only this term names; or a range is none.
        """
        if path is None:
            expected = "a file with one row per world, which reset=starts_file reads"
            raise ConfigError("starts", "null", expected, "Set starts=worlds.csv")
        # The table
        ranges = {"mass": mass, "friction": friction, "gain": gain}
        ends = {name: bounds(name, values) for name, values in ranges.items()}
        quantities: dict[str, Quantity] = {
            "mass": ObjectMasses(env),
            "friction": SlidingFriction(env, ends["friction"][0]),
            "gain": ServoGains(env),
        }
        objects = list(env.index.objects)
        names = env.cfg.robot.joints
        joints = [f"joint_{name}" for name in names]
        drawn = {name: _xy(name) for name in _drawn_places(env)}
        columns = [column for held in quantities.values() for column in held.columns]
        required = [column for name in objects for column in (*_xy(name), f"{name}_yaw_rad")]
        optional = [*joints, *columns, *(column for pair in drawn.values() for column in pair)]
        file = StartsTable(path, "starts" if path == env.cfg.starts else "path", required, optional)
        table = file.columns
        rows = len(file.lines)
        needed = max(env.nworld, env.cfg.nworld)
        if rows < needed:
            fix = f"Add rows, or set nworld={rows}"
            raise file.wrong(f"at least {needed} worlds, it has {rows}", fix)

        # Values within their ranges
        for name, held in quantities.items():
            low, high = ends[name]
            fix = f"Correct it, or widen reset.starts.params.{name}"
            for column, nominal in zip(held.columns, held.nominal.tolist(), strict=True):
                file.require_range(column, nominal * low, nominal * high, fix)
        limits = joint_limits(env.sim.model, names)
        for column, low, high in zip(joints, *limits, strict=True):
            file.require_range(column, low, high)
        for name, pair in drawn.items():
            if not table.keys() & set(pair):
                continue
            place = env.cfg.scene.places[name]
            for column, at, width in zip(pair, place.xy, place.random_xy, strict=True):
                if column not in table:
                    raise file.misfit(0, pair, "both coordinates of a place", "Add a column")
                file.require_range(column, at - width, at + width)
            env.given_places[name] = _on(env, file.take(pair))

        # Starts, which have to be free and within reach
        given = file.take(joints)
        command = np.where(np.isnan(given), getattr(robot(env), pose).double().cpu().numpy(), given)
        poses = np.zeros((rows, len(objects), 6))  # x, y and the quaternion
        for number, name in enumerate(objects):
            half = 0.5 * table[f"{name}_yaw_rad"]
            poses[:, number, :2] = file.take(_xy(name))
            poses[:, number, 2] = np.cos(half)
            poses[:, number, 5] = np.sin(half)
        _check_worlds(env, file, poses, command)
        for number, name in enumerate(objects):
            if found := out_of_reach(env, name, poses[:, number, :2]):
                world, problem = found
                fix = "Move it closer; job=reachability draws a map"
                raise file.misfit(world, _xy(name), f"a place that the arm reaches; {problem}", fix)

        # All of it on the device
        self._command = _on(env, command)
        self._poses = _on(env, poses)
        self._given = [
            (held, torch.from_numpy(file.take(held.columns)).to(env.device))
            for held in quantities.values()
            if table.keys() & set(held.columns)
        ]

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Write qpos, ctrl and the model fields that the file has columns for."""
        write_robot(env, mask, self._command.index_select(0, env.world))
        poses = self._poses.index_select(0, env.world)
        for number, (address, _) in enumerate(env.index.objects.values()):
            xy, quat = poses[:, number].split((2, 4), dim=1)
            view = env.sim.qpos[:, address : address + 7]
            pose = torch.cat((xy, view[:, 2:3], quat), dim=1)  # its height stays
            torch.where(mask[:, None], pose, view, out=view)
        for held, table in self._given:
            values = table.index_select(0, env.world)
            held.write(mask, torch.where(values.isnan(), held.read().double(), values))


def write_starts(env: EnvView, path: str | Path) -> None:
    """Write how the worlds of an environment have just started, for ``reset=starts_file``.

    Masses, friction and gains have columns if they differ from the model's in some world.

    Args:
        env: An environment after `reset`, before its first step.
        path: The file. World k of the environment becomes world k of the file.

    Raises:
        ArgumentError: The worlds have moved on.
        OSError: The file cannot be written.
    """
    write_rows(start_rows(env), path)


def write_rows(rows: Iterable[dict[str, object]], path: str | Path) -> None:
    """Write rows of `start_rows`, of one environment or of several, one after the other.

    Raises:
        OSError: The file cannot be written.
    """
    numbered = [row | {"world": world} for world, row in enumerate(rows)]
    write_atomic(Path(path), to_csv(numbered))


def start_rows(env: EnvView) -> list[dict[str, object]]:
    """How the worlds of an environment have just started, by the columns of a starts file.

    Raises:
        ArgumentError: The worlds have moved on.
    """
    if bool((env.episode_step != 0).any()) or bool((env.episode < 0).any()):
        found = "worlds that have moved on, or not started"
        raise ArgumentError("env", found, "worlds at their start", "Call env.reset() before")
    table: dict[str, np.ndarray] = {"world": np.arange(env.nworld)}

    def add(columns: Sequence[str], values: Tensor) -> None:
        table.update(zip(columns, values.cpu().numpy().T, strict=True))

    for name, (address, _) in env.index.objects.items():
        pose = pose_w(env, name).cpu().numpy()
        off = np.abs(pose[:, [2, 4, 5]] - [env.sim.model.qpos0[address + 2], 0.0, 0.0]).max(axis=1)
        if off.max() > _FLAT:
            found = f"{name} of world {off.argmax()} off the table"
            raise ArgumentError("env", found, "objects that stand flat on it")
        add(_xy(name), pose_w(env, name)[:, :2])
        table[f"{name}_yaw_rad"] = _yaw(pose[:, 3], pose[:, 6])
    add([f"joint_{name}" for name in env.cfg.robot.joints], joint_pos(env))
    quantities: tuple[type[Quantity], ...] = (ObjectMasses, SlidingFriction, ServoGains)
    for quantity in quantities:
        if _varies(env, quantity.fields):
            held = quantity(env)
            add(held.columns, held.read())
    for name in _drawn_places(env):
        add(_xy(name), place_xy(env, name))
    # Python's and numpy's shortest text of a number is read back to the same bits.
    return [dict(zip(table, cells, strict=True)) for cells in zip(*table.values(), strict=True)]


def _drawn_places(env: EnvView) -> list[str]:
    """Names of the places that each episode draws."""
    return [name for name, place in env.cfg.scene.places.items() if any(place.random_xy)]


def _xy(name: str) -> list[str]:
    """The columns of a position."""
    return [f"{name}_x_m", f"{name}_y_m"]


def _on(env: EnvView, values: np.ndarray) -> Tensor:
    """Numbers on the device of an environment, in the type of its floats."""
    return torch.from_numpy(values).to(env.device, env.sim.qpos.dtype)


def _varies(env: EnvView, names: Sequence[str]) -> bool:
    """Whether the value of a field differs from the model's in some world."""
    return any(
        bool((field != torch.from_numpy(getattr(env.sim.model, name)).to(field)).any())
        for name, field in env.sim.fields.items()
        if name in names
    )


def _yaw(w: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Rotation about z [rad] of quaternions (w, 0, 0, z), so that its cosine and sine round to
    these very numbers.
    """
    # The half angles whose cosine rounds to w and those whose sine rounds to z overlap.
    ends = np.array([[-0.5], [0.5]])
    near_w = np.clip(w + ends * np.spacing(np.abs(w)), -1.0, 1.0)
    near_z = np.clip(z + ends * np.spacing(np.abs(z)), -1.0, 1.0)
    by_w = np.copysign(np.arccos(near_w), z)
    by_z = np.arcsin(near_z)
    by_z = np.where(w < 0.0, np.copysign(np.pi, z) - by_z, by_z)
    low = np.maximum(by_w.min(axis=0), by_z.min(axis=0))
    return low + np.minimum(by_w.max(axis=0), by_z.max(axis=0))


def _check_worlds(env: EnvView, file: StartsTable, poses: np.ndarray, command: np.ndarray) -> None:
    """Every object is above the table and touches nothing else."""
    model = env.sim.model
    scene = env.cfg.scene
    index = env.index
    data = mujoco.MjData(model)
    owner = {geom: name for name, geoms in index.geoms.items() for geom in geoms}
    table = model.geom("table").id
    for world, (objects, joints) in enumerate(zip(poses, command, strict=True)):
        data.qpos[:] = model.qpos0
        data.qpos[index.robot_qpos] = joints
        for (address, _), pose in zip(index.objects.values(), objects, strict=True):
            data.qpos[address : address + 2] = pose[:2]
            data.qpos[address + 3 : address + 7] = pose[2:]
        mujoco.mj_kinematics(model, data)
        for name in index.objects:
            centers, halves = world_boxes(data, index.geoms[name])
            over = np.abs(centers[:, :2] - scene.table_center[:2]) + halves[:, :2]
            beyond = (over - scene.table_half[:2]).max(axis=0)
            if beyond.max() > _OVER:
                expected = f"all of {name} above the table, {1e3 * beyond.max():.1f} mm are not"
                raise file.misfit(world, [_xy(name)[beyond.argmax()]], expected, "Move it")
        mujoco.mj_collision(model, data)
        for pair in data.contact.geom[: data.ncon].tolist():
            if table in pair or not owner.keys() & set(pair):
                continue
            names = [
                owner.get(g) or model.geom(g).name or model.body(model.geom_bodyid[g]).name
                for g in pair
            ]
            moved = [column for name in names if name in index.objects for column in _xy(name)]
            expected = (
                f"objects that touch nothing but the table; {' and '.join(names)} touch in world"
                f" {world}"
            )
            raise file.misfit(world, moved, expected, "Move them apart")
