"""Worlds that start from the rows of a file, and a file of how worlds have started."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from numpy import ndarray
from numpy.typing import ArrayLike
from torch import Tensor

from mjstack.errors import ArgumentError, ConfigError, ParameterError, suggest
from mjstack.files import read_npz, write_npz
from mjstack.managers.view import EnvView, offers, uses_fields
from mjstack.math import quat_mul
from mjstack.mdp.geometry import Pose, place_xy, pose_w, robot, write_robot
from mjstack.mdp.observation import fixture_pos, joint_pos
from mjstack.mdp.reset import ActuatorGains, ObjectFriction, ObjectMass
from mjstack.mdp.starts.placement import out_of_reach
from mjstack.mdp.starts.randomization import Randomized, bounds
from mjstack.robots.bodies import world_boxes
from mjstack.scene.index import joint_limits
from mjstack.sim.simulation import Columns

_FLAT = 1e-5  # [m], and of a quaternion: how far off upright an object on the table may be
_TOUCH = 1e-5  # [m] into each other: things that only touch
_OVER = 1e-6  # [m] how far an object may reach over the edge of the table
# What a file may have of the model, and which parameter has its ends
_RANDOMIZED: dict[Any, str] = {
    ObjectMass: "scale",
    ObjectFriction: "sliding",
    ActuatorGains: "scale",
}


class StartsTable:
    """The content of a starts file: an npz archive of arrays with a row for each of its ``worlds``,
    in ``arrays`` by name, float64, each of shape ``(worlds,)`` or ``(worlds, n)``.
    """

    def __init__(
        self,
        path: str,
        key: str,
        ranges: Mapping[str, tuple[ArrayLike, ArrayLike]],
        required: Sequence[str],
    ) -> None:
        """Read a file, which the configuration key ``starts`` or ``path`` of a term names, and
        check the name, the shape and the numbers of every array. ``ranges`` has the smallest and
        largest row of each array that a file may have; every file has the required ones.

        Raises:
            ConfigError: The file cannot be read, or an array is missing or wrong.
        """
        self._path = path
        self._error = ConfigError if key == "starts" else ParameterError
        self._key = key
        if Path(path).suffix == ".csv":
            expected = "an npz file; CSV is of version 0.1 and is not read any more"
            raise self.wrong(expected, "Make a new one with write_starts or numpy.savez")
        try:
            arrays = {name: np.atleast_1d(array) for name, array in read_npz(Path(path)).items()}
        except Exception as error:  # a file can be anything
            reason = getattr(error, "strerror", None) or "damaged, or of another format"
            expected = f"an npz file with a row per world; it cannot be read ({reason})"
            raise self.wrong(expected, "Name a file: starts=worlds.npz") from error
        if missing := [name for name in required if name not in arrays]:
            expected = f"arrays {', '.join(required)}; {', '.join(missing)} missing"
            raise self.wrong(expected, "Add the missing arrays")
        self.worlds = max(map(len, arrays.values()), default=0)
        for name, values in arrays.items():
            if name not in ranges:
                fix = suggest(name, ranges).rstrip(".")
                raise self.wrong(f"known names of arrays; {name!r} is none", fix)
            low, high = map(np.asarray, ranges[name])
            shape = (self.worlds, *low.shape)
            if values.shape != shape or values.dtype.kind not in "fiu":
                expected = f"numbers of shape {shape}, not {values.dtype} of shape {values.shape}"
                raise self.wrong(expected, "Correct it; row w is world w", names=[name])
            slack = 1e-6 * np.maximum(abs(low), abs(high))  # float32 does not hold the ends exactly
            # A joint may have no limit
            fits = np.isfinite(values) & (values >= low - slack) & (values <= high + slack)
            if not fits.all():
                world, *at = (int(n) for n in np.unravel_index(fits.argmin(), fits.shape))
                expected = f"{low[*at]:.6g} to {high[*at]:.6g}, it is {values[world, *at]:.6g}"
                fix = "Correct it; ranges of mass, friction and gain are in reset.starts.params"
                raise self.wrong(expected, fix, world, [name])
        self.arrays = {name: values.astype(np.float64) for name, values in arrays.items()}

    def take(self, names: Sequence[str]) -> ndarray:
        """Arrays side by side, NaN where the file has none, shape ``(worlds, n)``."""
        missing = np.full(self.worlds, np.nan)
        columns = [self.arrays.get(name, missing).reshape(self.worlds, -1) for name in names]
        return np.hstack([np.empty((self.worlds, 0)), *columns])

    def wrong(
        self, expected: str, fix: str, world: int | None = None, names: Sequence[str] = ()
    ) -> ConfigError:
        """The error that the file, or a world's row of some arrays, cannot be used."""
        where = [self._path, *([] if world is None else [f"world {world}"]), *names]
        return self._error(self._key, ", ".join(where), expected, fix)


@offers(reads_file=True)
@uses_fields(*(name for kind in _RANDOMIZED for name in kind.model_fields))
class FromStartsFile:
    """World w starts from row w of a file, at every reset.

    Joints without an array are at a pose of the robot. Masses, friction and gains without one are
    left alone, and places without one are drawn.
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
        """Read the file and check every number in it, and every world that is played.

        Args:
            env: The environment.
            path: The file; see `StartsTable`.
            pose: Of joints that have no array, ``home`` or ``start``.
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
            raise ConfigError("starts", "null", expected, "Set starts=worlds.npz")
        # What the file may have, each in its range
        quantities: list[Randomized] = [
            ObjectMass(env, scale=bounds("mass", mass)),
            ObjectFriction(env, sliding=bounds("friction", friction)),
            ActuatorGains(env, scale=bounds("gain", gain)),
        ]
        scene = env.cfg.scene
        objects = list(env.index.objects)
        model = env.sim.model
        fixtures = [model.joint(name).id for name in env.index.joints]
        joints = [f"joint_{name}" for name in (*env.cfg.robot.joints, *env.index.joints)]
        open_ended = ~model.jnt_limited[fixtures, None].astype(bool)
        spans = np.where(open_ended, [-np.inf, np.inf], model.jnt_range[fixtures]).T
        limits = np.hstack((joint_limits(model, env.cfg.robot), spans))
        ranges: dict[str, tuple[ArrayLike, ArrayLike]] = {}
        ranges |= zip(joints, map(tuple, limits.T), strict=True)
        for quantity in quantities:
            nominal = np.outer(quantity.nominal.cpu(), quantity.ends)
            ranges |= zip(quantity.columns, map(tuple, nominal), strict=True)
        regions = dict.fromkeys(objects, (scene.table_center[:2], scene.table_half[:2]))
        places = _drawn_places(env)
        regions |= {name: (scene.places[name].xy, scene.places[name].random_xy) for name in places}
        for name, region in regions.items():
            ranges[f"{name}_xy"] = (np.subtract(*region), np.add(*region))
        ranges |= {f"{name}_quat": (-np.ones(4), np.ones(4)) for name in objects}
        poses = [f"{name}_{part}" for name in objects for part in ("xy", "quat")]
        table = StartsTable(path, "starts" if path == env.cfg.starts else "path", ranges, poses)
        needed = max(env.nworld, env.cfg.nworld)
        if table.worlds < needed:
            fix = "Add rows" + f", or set nworld={table.worlds}" * bool(table.worlds)
            raise table.wrong(f"at least {needed} worlds, it has {table.worlds}", fix)

        # Starts, which have to be free and within reach
        values = table.take(joints)
        fallback = getattr(robot(env), pose).double().cpu().numpy()
        fallback = np.concatenate((fallback, model.qpos0[model.jnt_qposadr[fixtures]]))
        command = np.where(np.isnan(values), fallback, values)
        apart = np.abs(command - env.index.posture.agree(command))
        if apart.max(initial=0.0) > _FLAT:
            world, joint = (int(k) for k in np.unravel_index(apart.argmax(), apart.shape))
            expected = f"a position that the file's equalities allow, {apart.max():.4g} from there"
            raise table.wrong(expected, "Correct it", world, [joints[joint]])
        starts = table.take(poses).reshape(table.worlds, len(objects), 6)
        _check_worlds(env, table, starts[:needed], command[:needed])  # those that are played
        for number, name in enumerate(objects):
            if failure := out_of_reach(env, name, starts[:needed, number, :2]):
                world, problem = failure
                fix = "Move it closer; tools/reachability.py draws a map"
                expected = f"a place that the arm reaches; {problem}"
                raise table.wrong(expected, fix, world, [f"{name}_xy"])

        # All of it on the device
        self._command, self._fixtures = _on(env, command).tensor_split([len(env.index.ctrl)], 1)
        self._columns = Columns(model.jnt_qposadr[fixtures], env.device)
        self._poses = _on(env, starts)
        self._quantities = [
            (quantity, torch.from_numpy(table.take(quantity.columns)).to(env.device))
            for quantity in quantities
            if table.arrays.keys() & set(quantity.columns)
        ]
        for name in places:
            if f"{name}_xy" in table.arrays:
                env.given_places[name] = _on(env, table.arrays[f"{name}_xy"])

    def __call__(self, env: EnvView, mask: Tensor) -> None:
        """Write qpos, ctrl and the model fields that the file has arrays for."""
        write_robot(env, mask, self._command.index_select(0, env.world))
        fixtures = self._fixtures.index_select(0, env.world)
        self._columns.write_masked(env.sim.qpos, mask, fixtures)
        poses = self._poses.index_select(0, env.world)
        for number, (address, _) in enumerate(env.index.objects.values()):
            xy, quat = poses[:, number].split((2, 4), dim=1)
            view = env.sim.qpos[:, address : address + 7]
            pose = torch.cat((xy, view[:, 2:3], quat), dim=1)  # its height stays
            torch.where(mask[:, None], pose, view, out=view)
        for quantity, table in self._quantities:
            values = table.index_select(0, env.world)
            quantity.write(mask, torch.where(values.isnan(), quantity.read().double(), values))


def write_starts(env: EnvView, path: str | Path) -> None:
    """Write how the worlds of an environment have just started, for ``reset=starts_file``: after
    `reset`, before its first step. World k of the environment becomes world k of the file.

    Raises:
        ArgumentError: The worlds have moved on.
        OSError: The file cannot be written.
    """
    write_npz(Path(path), start_arrays(env))


def start_arrays(env: EnvView) -> dict[str, ndarray]:
    """How the worlds of an environment have just started, by the arrays of a starts file.

    Masses, friction and gains have arrays if they differ from the model's in some world.

    Raises:
        ArgumentError: The worlds have moved on.
    """
    if bool((env.episode_step != 0).any()) or bool((env.episode < 0).any()):
        problem = "worlds that have moved on, or not started"
        raise ArgumentError("env", problem, "worlds at their start", "Call env.reset() before")
    out: dict[str, Tensor] = {}
    for name, (address, _) in env.index.objects.items():
        pose = pose_w(env, name)
        nominal = pose.new_tensor(env.sim.model.qpos0[address + 2 : address + 7])
        back = nominal[1:] * nominal.new_tensor([1.0, -1.0, -1.0, -1.0])
        tilt = quat_mul(pose[:, 3:], back.expand(len(pose), 4))[:, 1:3]
        off = torch.cat((pose[:, 2:3] - nominal[0], tilt), dim=1).abs().amax(1)
        if off.max() > _FLAT:
            problem = f"{name} of world {int(off.argmax())} off the table"
            raise ArgumentError("env", problem, "objects that stand flat on it")
        out[f"{name}_xy"] = pose[:, :2]
        out[f"{name}_quat"] = pose[:, 3:]
    joints = [f"joint_{name}" for name in env.cfg.robot.joints]
    out |= zip(joints, joint_pos(env).unbind(1), strict=True)
    out |= {f"joint_{name}": fixture_pos(env, joint=name) for name in env.index.joints}
    model = env.sim.model
    varying = {
        name
        for name, field in env.sim.fields.items()
        if bool((field != torch.from_numpy(getattr(model, name)).to(field)).any())
    }
    for kind, ends in _RANDOMIZED.items():
        fields = set(kind.model_fields)
        if varying & fields and fields <= env.sim.fields.keys():
            quantity = kind(env, **{ends: (1.0, 1.0)})  # to be read alone
            out |= zip(quantity.columns, quantity.read().unbind(1), strict=True)
    out |= {f"{name}_xy": place_xy(env, name) for name in _drawn_places(env)}
    return {name: values.double().cpu().numpy() for name, values in out.items()}


def _drawn_places(env: EnvView) -> list[str]:
    """Names of the places that each episode draws."""
    return [name for name, place in env.cfg.scene.places.items() if any(place.random_xy)]


def _on(env: EnvView, values: ndarray) -> Tensor:
    """Numbers on the device of an environment, in the type of its floats."""
    return torch.from_numpy(values).to(env.device, env.sim.qpos.dtype)


def _check_worlds(env: EnvView, table: StartsTable, starts: ndarray, command: ndarray) -> None:
    """Every object stands upright above the table and touches nothing else."""
    model = env.sim.model
    scene = env.cfg.scene
    index = env.index
    data = mujoco.MjData(model)
    addresses = [*index.robot_qpos, *(qpos for qpos, _ in index.joints.values())]
    owner = {geom: name for name, geoms in index.geoms.items() for geom in geoms}
    ground = model.geom("table").id
    for world, (objects, joints) in enumerate(zip(starts, command, strict=True)):
        data.qpos[:] = index.posture.qpos(joints[: len(index.robot_qpos)])
        data.qpos[addresses] = joints
        for (name, (address, _)), start in zip(index.objects.items(), objects, strict=True):
            data.qpos[address : address + 2] = start[:2]
            data.qpos[address + 3 : address + 7] = start[2:]
            back = model.qpos0[address + 3 : address + 7] * [1.0, -1.0, -1.0, -1.0]
            turn = np.empty(4)
            mujoco.mju_mulQuat(turn, start[2:], back)
            if max(abs(turn[1]), abs(turn[2]), abs(np.linalg.norm(start[2:]) - 1.0)) > _FLAT:
                expected = f"w, 0, 0, z of length 1, a rotation about z, it is {start[2:]}"
                if env.cfg.scene.objects[name].turned != [1.0, 0.0, 0.0, 0.0]:
                    expected = f"its nominal orientation, turned about z, it is {start[2:]}"
                raise table.wrong(expected, "Correct it", world, [f"{name}_quat"])
        mujoco.mj_kinematics(model, data)
        for name in index.objects:
            centers, halves = world_boxes(data, index.geoms[name])
            over = np.abs(centers[:, :2] - scene.table_center[:2]) + halves[:, :2]
            beyond = (over - scene.table_half[:2]).max()
            if beyond > _OVER:
                expected = f"all of {name} above the table, {1e3 * beyond:.1f} mm are not"
                raise table.wrong(expected, "Move it", world, [f"{name}_xy"])
        mujoco.mj_collision(model, data)
        depths = data.contact.dist[: data.ncon]
        for pair, depth in zip(data.contact.geom[: data.ncon].tolist(), depths, strict=True):
            if depth > -_TOUCH or ground in pair or not owner.keys() & set(pair):
                continue
            names = [
                owner.get(g) or model.geom(g).name or model.body(model.geom_bodyid[g]).name
                for g in pair
            ]
            expected = f"objects that touch nothing but the table; {' and '.join(names)} touch"
            moved = [f"{name}_xy" for name in names if name in index.objects]
            raise table.wrong(expected, "Move them apart", world, moved)
