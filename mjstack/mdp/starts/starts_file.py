"""Worlds that start from the rows of a file, and a file of how worlds have started."""

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import torch
from torch import Tensor

from mjstack.errors import ArgumentError, ConfigError, ParameterError
from mjstack.files import to_csv, write_atomic
from mjstack.managers.view import EnvView, offers, uses_fields
from mjstack.mdp.geometry import (
    joint_limits,
    joint_positions,
    named_pose,
    place_xy,
    pose_w,
    robot,
    robot_joints,
)
from mjstack.mdp.starts.placement import world_boxes
from mjstack.mdp.starts.randomization import (
    ObjectMasses,
    Quantity,
    ServoGains,
    SlidingFriction,
    bounds,
)
from mjstack.mdp.starts.reach import out_of_reach
from mjstack.mdp.starts.table import StartsTable, read_starts_table

# [m], and of a quaternion: how far off upright an object on the table may be
_FLAT = 1e-5
_OVER = 1e-6  # [m] how far an object may reach over the edge of the table


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
        pose: str = "start",
        mass: Sequence[float] = (0.7, 1.3),
        friction: Sequence[float] = (0.8, 1.4),
        gain: Sequence[float] = (0.9, 1.1),
    ) -> None:
        """Reads the file and checks every world in it.

        Args:
            env: The environment.
            path: The file; see `mjstack.mdp.starts.table`.
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
        ranges = {
            "mass": bounds("mass", mass),
            "friction": bounds("friction", friction),
            "gain": bounds("gain", gain),
        }
        self._quantities: dict[str, Quantity] = {
            "mass": ObjectMasses(env),
            "friction": SlidingFriction(env, ranges["friction"][0]),
            "gain": ServoGains(env),
        }
        try:
            self._read(env, path, pose, ranges)
        except ParameterError as error:
            if error.key == "path" and path == env.cfg.starts:
                raise error.at("starts") from error
            raise

    def _read(
        self, env: EnvView, path: str, pose: str, ranges: dict[str, tuple[float, float]]
    ) -> None:
        # The table
        objects = list(env.index.objects)
        joints = [f"joint_{name}" for name in robot_joints(env)]
        drawn = {name: _xy(name) for name in _drawn_places(env)}
        columns = [column for held in self._quantities.values() for column in held.columns]
        required = [column for name in objects for column in (*_xy(name), f"{name}_yaw_rad")]
        optional = [*joints, *columns, *(column for pair in drawn.values() for column in pair)]
        file = read_starts_table(path, required, optional)
        table = file.columns
        rows = len(file.lines)
        needed = max(env.nworld, env.cfg.nworld)
        if rows < needed:
            fix = f"Add rows, or set nworld={rows}"
            raise ParameterError("path", path, f"at least {needed} worlds, it has {rows}", fix)

        # Values within their ranges
        for name, held in self._quantities.items():
            low, high = ranges[name]
            fix = f"Correct it, or widen reset.starts.params.{name}"
            for column, nominal in zip(held.columns, held.nominal.tolist(), strict=True):
                file.require_range(column, nominal * low, nominal * high, fix)
        limits = torch.stack(joint_limits(env), dim=1).tolist()
        for column, (low, high) in zip(joints, limits, strict=True):
            file.require_range(column, low, high)
        for name, pair in drawn.items():
            if not table.keys() & set(pair):
                continue
            place = env.cfg.scene.places[name]
            for column, at, width in zip(pair, place.xy, place.random_xy, strict=True):
                if column not in table:
                    raise file.misfit(0, pair, "both coordinates of a place", "Add a column")
                file.require_range(column, at - width, at + width)
            env.given_places[name] = _on(env, np.stack([table[column] for column in pair], axis=1))

        # Starts, which have to be free and within reach
        command = np.tile(named_pose(env, pose).double().cpu().numpy(), (rows, 1))
        for number, column in enumerate(joints):
            command[:, number] = table.get(column, command[:, number])
        poses = np.zeros((rows, len(objects), 6))  # x, y and the quaternion
        for number, name in enumerate(objects):
            x, y = _xy(name)
            half = 0.5 * table[f"{name}_yaw_rad"]
            poses[:, number, 0] = table[x]
            poses[:, number, 1] = table[y]
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
        missing = np.full(rows, np.nan)
        self._given = []
        for held in self._quantities.values():
            if table.keys() & set(held.columns):
                values = np.stack([table.get(column, missing) for column in held.columns], axis=1)
                self._given.append((held, torch.from_numpy(values).to(env.device)))

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Writes qpos, ctrl and the model fields that the file has columns for."""
        command = self._command.index_select(0, env.world)
        robot(env).qpos.write_masked(env.sim.qpos, mask, command)
        robot(env).ctrl.write_masked(env.sim.ctrl, mask, command)
        poses = self._poses.index_select(0, env.world)
        for number, name in enumerate(env.index.objects):
            view = pose_w(env, name)
            at = poses[:, number]
            pose = torch.cat((at[:, :2], view[:, 2:3], at[:, 2:]), dim=1)
            torch.where(mask[:, None], pose, view, out=view)
        for held, table in self._given:
            values = table.index_select(0, env.world)
            held.write(mask, torch.where(values.isnan(), held.read().double(), values))


def write_starts(env: EnvView, path: str | Path) -> None:
    """Writes how the worlds of an environment have just started, for ``reset=starts_file``.

    Masses, friction and gains have columns if they differ from the model's in some world.

    Args:
        env: An environment after `reset`, before its first step.
        path: The file. World k of the environment becomes world k of the file.

    Raises:
        ArgumentError: The worlds have moved on, or the file cannot be written.
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
    add([f"joint_{name}" for name in robot_joints(env)], joint_positions(env))
    quantities: tuple[type[Quantity], ...] = (ObjectMasses, SlidingFriction, ServoGains)
    for quantity in quantities:
        if _varies(env, quantity.fields):
            held = quantity(env)
            add(held.columns, held.read())
    for name in _drawn_places(env):
        add(_xy(name), place_xy(env, name))
    # Python's and numpy's shortest text of a number is read back to the same bits.
    rows = [dict(zip(table, cells, strict=True)) for cells in zip(*table.values(), strict=True)]
    try:
        write_atomic(Path(path), to_csv(rows))
    except OSError as error:
        found = f"{path} ({error.strerror})"
        raise ArgumentError("path", found, "a file in a folder that can be written") from error


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
    for name in names:
        if name in env.sim.fields:
            field = env.sim.fields[name]
            if bool((field != torch.from_numpy(getattr(env.sim.model, name)).to(field)).any()):
                return True
    return False


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
