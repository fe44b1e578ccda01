"""Worlds that start as a file says, and a file that says how worlds started."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import torch

from mjstack.errors import ArgumentError, ConfigError, ParameterError
from mjstack.files import write_atomic
from mjstack.managers.view import EnvView, offers, uses_fields
from mjstack.mdp.geometry import joint_positions, named_pose, place_xy, pose_w, robot
from mjstack.mdp.starts.randomization import (
    FRICTION_FIELDS,
    GAIN_FIELDS,
    MASS_FIELDS,
    ObjectMasses,
    ServoGains,
    SlidingFriction,
    bounds,
)
from mjstack.mdp.starts.reach import out_of_reach
from mjstack.mdp.starts.table import StartsTable, column_names, read_starts_table

_ROUNDING = 1e-6  # of a range's ends, which float32 does not hold exactly
# [m], and of a quaternion: how far off upright an object on the table may be
_FLAT = 1e-5


@offers(reads_file=True)
@uses_fields(*MASS_FIELDS, *FRICTION_FIELDS, *GAIN_FIELDS)
class FromStartsFile:
    """World w starts as row w of a file says, at every reset.

    Joints without a column are at a pose of the robot's; masses, friction and gains without one are
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
            ParameterError: So it is with a file that only this term names, or a range is none.
        """
        if path is None:
            raise ConfigError(
                "starts",
                "null",
                "a file with one row per world, which reset=starts_file reads",
                "Set starts=worlds.csv",
            )
        try:
            self._read(env, path, pose, mass, friction, gain)
        except ParameterError as error:
            if error.key == "path" and path == env.cfg.starts:
                raise error.at("starts") from error
            raise

    def _read(
        self,
        env: EnvView,
        path: str,
        pose: str,
        mass: Sequence[float],
        friction: Sequence[float],
        gain: Sequence[float],
    ) -> None:
        ranges = {
            "mass": bounds("mass", mass),
            "friction": bounds("friction", friction),
            "gain": bounds("gain", gain),
        }
        self._masses = ObjectMasses(env)
        self._friction = SlidingFriction(env, ranges["friction"][0])
        self._gains = ServoGains(env)
        joints = [*env.cfg.robot.arm_joints, *env.cfg.robot.gripper_joints]
        objects = list(env.index.objects)
        file = read_starts_table(
            path, column_names(objects, joints, self._friction.names, drawn_places(env))
        )
        table = file.columns
        rows = len(next(iter(table.values())))
        needed = max(env.nworld, env.cfg.nworld)
        if rows < needed:
            raise ParameterError(
                "path",
                path,
                f"at least {needed} worlds, it has {rows}",
                f"Add rows, or set nworld={rows}",
            )
        nominal = self._masses.nominal.cpu().numpy()
        for name, kilograms in zip(objects, nominal, strict=True):
            _check_range(
                file, f"{name}_mass_kg", [kilograms * end for end in ranges["mass"]], "mass"
            )
        for name in self._friction.names:
            _check_range(file, f"{name}_friction", ranges["friction"], "friction")
        for name, low, high in zip(joints, *_joint_limits(env), strict=True):
            _check_range(file, f"gain_{name}", ranges["gain"], "gain")
            _check_range(file, f"joint_{name}", (low, high))

        command = np.tile(named_pose(env, pose).double().cpu().numpy(), (rows, 1))
        for k, name in enumerate(joints):
            command[:, k] = table.get(f"joint_{name}", command[:, k])
        places = np.stack(
            [
                np.stack([table[f"{name}_{part}"] for part in ("x_m", "y_m", "yaw_rad")], 1)
                for name in objects
            ],
            1,
        )
        for name in drawn_places(env):
            self._give_place(env, file, name)
        _check_on_table(env, file, places)
        _check_touching(env, file, places, command)
        _check_reach(env, file, places)

        self._command = self._keep(env, command)
        half = 0.5 * places[..., 2]
        zero = np.zeros_like(half)
        self._places = self._keep(env, places[..., :2])
        self._quats = self._keep(env, np.stack((np.cos(half), zero, zero, np.sin(half)), axis=-1))
        self._given = []
        for held, names in (
            (self._masses, [f"{name}_mass_kg" for name in objects]),
            (self._friction, [f"{name}_friction" for name in self._friction.names]),
            (self._gains, [f"gain_{name}" for name in joints]),
        ):
            if any(name in table for name in names):
                values = np.stack(
                    [table.get(name, np.full(rows, np.nan)) for name in names], axis=1
                )
                self._given.append((held, torch.from_numpy(values).to(env.device)))

    def __call__(self, env: EnvView, mask: torch.Tensor) -> None:
        """Writes qpos, ctrl and the model fields that the file has columns for."""
        tensors = robot(env)
        command = self._command.index_select(0, env.world)
        tensors.qpos.write_masked(env.sim.qpos, mask, command)
        tensors.ctrl.write_masked(env.sim.ctrl, mask, command)
        places = self._places.index_select(0, env.world)
        quats = self._quats.index_select(0, env.world)
        for number, name in enumerate(env.index.objects):
            view = pose_w(env, name)
            pose = torch.cat((places[:, number], view[:, 2:3], quats[:, number]), dim=1)
            torch.where(mask[:, None], pose, view, out=view)
        for held, table in self._given:
            values = table.index_select(0, env.world)
            held.write(mask, torch.where(values.isnan(), held.read().double(), values))

    def _give_place(self, env: EnvView, file: StartsTable, name: str) -> None:
        """Sets a drawn place to what the file has for it."""
        given = [column for column in _place(name) if column in file.columns]
        if not given:
            return
        if len(given) < 2:
            raise file.misfit(0, given, "both coordinates of a place", "Add the other column")
        place = env.cfg.scene.places[name]
        for column, at, half in zip(given, place.xy, place.random_xy, strict=True):
            _check_range(file, column, (at - half, at + half))
        xy = np.stack([file.columns[column] for column in given], axis=1)
        env.given_places[name] = self._keep(env, xy)

    @staticmethod
    def _keep(env: EnvView, values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values).to(env.device, env.sim.qpos.dtype)


def write_starts(env: EnvView, path: str | Path) -> None:
    """Writes how the worlds of an environment have just started, for ``reset=starts_file``.

    Masses, friction and gains have columns if some world's differ from the model's.

    Args:
        env: An environment after `reset`, before its first step.
        path: The file. World k of the environment becomes world k of the file.

    Raises:
        ArgumentError: The worlds have moved on, or the file cannot be written.
    """
    if bool((env.episode_step != 0).any()) or bool((env.episode < 0).any()):
        raise ArgumentError(
            "env",
            "worlds that have moved on, or not started",
            "worlds at their start",
            "Call env.reset() before",
        )
    joints = [*env.cfg.robot.arm_joints, *env.cfg.robot.gripper_joints]
    table: dict[str, np.ndarray] = {"world": np.arange(env.nworld)}
    for name, (address, _) in env.index.objects.items():
        pose = pose_w(env, name).cpu().numpy()
        off = np.abs(pose[:, [2, 4, 5]] - [env.sim.model.qpos0[address + 2], 0.0, 0.0]).max(axis=1)
        if off.max() > _FLAT:
            raise ArgumentError(
                "env",
                f"{name} of world {off.argmax()} off the table",
                "objects that stand flat on it",
            )
        table |= {
            f"{name}_x_m": pose[:, 0],
            f"{name}_y_m": pose[:, 1],
            f"{name}_yaw_rad": _yaw(pose[:, 3], pose[:, 6]),
        }
    at = joint_positions(env).cpu().numpy()
    table |= {f"joint_{name}": at[:, k] for k, name in enumerate(joints)}
    if _varies(env, MASS_FIELDS):
        masses = ObjectMasses(env).read().cpu().numpy()
        table |= {f"{name}_mass_kg": masses[:, k] for k, name in enumerate(env.index.objects)}
    if _varies(env, FRICTION_FIELDS):
        friction = SlidingFriction(env, 0.0)
        table |= {
            f"{name}_friction": v
            for name, v in zip(friction.names, friction.read().cpu().numpy().T, strict=True)
        }
    if _varies(env, GAIN_FIELDS):
        gains = ServoGains(env).read().cpu().numpy()
        table |= {f"gain_{name}": gains[:, k] for k, name in enumerate(joints)}
    for name in drawn_places(env):
        xy = place_xy(env, name).cpu().numpy()
        table |= {f"{name}_{axis}_m": xy[:, k] for k, axis in enumerate("xy")}
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(table)
    # Python's and numpy's shortest text of a number that is read back to the same bits.
    writer.writerows(
        zip(*([str(value) for value in column] for column in table.values()), strict=True)
    )
    try:
        write_atomic(Path(path), out.getvalue())
    except OSError as error:
        raise ArgumentError(
            "path", f"{path} ({error.strerror})", "a file in a folder that can be written"
        ) from error


def drawn_places(env: EnvView) -> list[str]:
    """Names of the places that each episode draws."""
    return [name for name, place in env.cfg.scene.places.items() if any(place.random_xy)]


def _varies(env: EnvView, names: Sequence[str]) -> bool:
    """Whether some world's value of some field differs from the model's."""
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
    yaw = 2.0 * np.arctan2(z.astype(float), w.astype(float))
    if w.dtype == np.float64:
        return yaw
    # A start was drawn as a float32 angle, one of the nearest. Else some angle within what rounding
    # has moved it does.
    ulps = np.arange(-4, 5)
    near = (
        yaw.astype(np.float32)[:, None] + np.spacing(np.abs(yaw).astype(np.float32))[:, None] * ulps
    ).astype(float)
    width = 2.0 * (np.abs(z) * np.spacing(np.abs(w)) + np.abs(w) * np.spacing(np.abs(z)))
    every = np.concatenate(
        (near, yaw[:, None] + width[:, None] * np.linspace(-1.0, 1.0, 401)), axis=1
    )
    fits = (np.cos(0.5 * every).astype(np.float32) == w[:, None]) & (
        np.sin(0.5 * every).astype(np.float32) == z[:, None]
    )
    return np.where(fits.any(axis=1), every[np.arange(len(yaw)), fits.argmax(axis=1)], yaw)


def _joint_limits(env: EnvView) -> tuple[np.ndarray, np.ndarray]:
    both = np.stack((env.index.robot_range, env.index.ctrl_range))
    return both[..., 0].max(axis=0), both[..., 1].min(axis=0)


def _check_range(file: StartsTable, name: str, ends: Sequence[float], parameter: str = "") -> None:
    if name not in file.columns:
        return
    values = file.columns[name]
    slack = _ROUNDING * max(abs(end) for end in ends)
    outside = np.flatnonzero((values < ends[0] - slack) | (values > ends[1] + slack))
    if outside.size:
        world = int(outside[0])
        fix = f"Correct it, or widen reset.starts.params.{parameter}" if parameter else "Correct it"
        raise file.misfit(
            world, [name], f"{ends[0]:.6g} to {ends[1]:.6g}, it is {values[world]:.6g}", fix
        )


def _check_on_table(env: EnvView, file: StartsTable, places: np.ndarray) -> None:
    """All of every object is above the table."""
    scene = env.cfg.scene
    yaw = places[..., 2]
    cos = np.abs(np.cos(yaw))
    sin = np.abs(np.sin(yaw))
    reach = np.empty((*yaw.shape, 2))
    for number, thing in enumerate(scene.free.values()):
        if thing.shape == "box":
            wide, deep = thing.size[:2]
            reach[:, number, 0] = wide * cos[:, number] + deep * sin[:, number]
            reach[:, number, 1] = wide * sin[:, number] + deep * cos[:, number]
        else:
            reach[:, number] = thing.footprint
    over = np.abs(places[..., :2] - scene.table_center[:2]) + reach - scene.table_half[:2]
    if over.max() > _ROUNDING:
        world, number, axis = np.argwhere(over > _ROUNDING)[0]
        name = list(env.index.objects)[number]
        room = scene.table_half[axis] - reach[world, number, axis]
        # Rounded towards the table, so that what is said succeeds.
        low = math.ceil(1e3 * (scene.table_center[axis] - room)) / 1e3
        high = math.floor(1e3 * (scene.table_center[axis] + room)) / 1e3
        raise file.misfit(
            world,
            [_place(name)[axis]],
            f"{low:.3f} to {high:.3f}, so that {name} is on the table, turned as it is;"
            f" {places[world, number, axis]:.6g} is {1e3 * over[world, number, axis]:.1f} mm over"
            " the edge",
            "Move it",
        )


def _check_touching(
    env: EnvView, file: StartsTable, places: np.ndarray, command: np.ndarray
) -> None:
    """No object touches anything but the table."""
    model = env.sim.model
    index = env.index
    data = mujoco.MjData(model)
    owner = {geom: name for name, geoms in index.geoms.items() for geom in geoms}
    allowed = {model.geom("table").id}
    for world, (objects, joints) in enumerate(zip(places, command, strict=True)):
        data.qpos[:] = model.qpos0
        data.qpos[index.robot_qpos] = joints
        for (address, _), (x, y, yaw) in zip(index.objects.values(), objects, strict=True):
            data.qpos[address : address + 2] = x, y
            data.qpos[address + 3 : address + 7] = (
                math.cos(0.5 * yaw),
                0.0,
                0.0,
                math.sin(0.5 * yaw),
            )
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        for first, second in data.contact.geom[: data.ncon].tolist():
            pair = {first, second}
            if pair & owner.keys() and not pair & allowed:
                names = [
                    owner.get(g) or model.geom(g).name or model.body(model.geom_bodyid[g]).name
                    for g in (first, second)
                ]
                touching = [name for name in names if name in index.objects]
                moved = [column for name in touching for column in _place(name)]
                expected = (
                    f"objects that touch nothing but the table; {' and '.join(names)} touch in"
                    f" world {world}"
                )
                raise file.misfit(
                    world, moved, expected, "Move them apart" if len(touching) > 1 else "Move it"
                )


def _check_reach(env: EnvView, file: StartsTable, places: np.ndarray) -> None:
    """The arm gets wherever the phases bring it at every object."""
    for number, name in enumerate(env.index.objects):
        if found := out_of_reach(env, name, places[:, number, :2]):
            world, what = found
            fix = "Move it closer; job=reachability draws a map"
            raise file.misfit(world, _place(name), f"a place that the arm reaches; {what}", fix)


def _place(name: str) -> list[str]:
    """The columns of an object's position."""
    return [f"{name}_{axis}_m" for axis in "xy"]
