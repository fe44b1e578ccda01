"""The record of all episodes of one seed: arrays for programs, and rows of the failing ones for
people.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mjstack.episodes.failures import FailureMonitor, Sign
from mjstack.episodes.rollout import Episode
from mjstack.errors import RunError
from mjstack.files import reading, write_npz
from mjstack.tasks.check import Rules

STEMS = {"batch": "worlds", "success": "success"}
"""The beginning of the files of each gate."""
FAILING = "failing_worlds.csv"
SUCCESS_FAILING = "success_failing_worlds.csv"  # where the batch gate has the other one
REGIONS = "success_regions.csv"
PICTURE = "success.png"
_MEASURED = "measured."


@dataclass(eq=False, kw_only=True, slots=True)
class Circumstances:
    """Where episodes started and where they went wrong; named as in the file.

    Attributes:
        objects: Names of the objects.
        phase_names: Names of the phases.
        start_places: x and y [m] and rotation about z [rad] of each object at the start, shape
            ``(nworld, objects, 3)``.
        retries: Grasps that were tried again, shape ``(nworld,)``.
        unreachable: Whether a target was out of reach, shape ``(nworld,)``, bool.
        sign: Number of the first `Sign` of failure, shape ``(nworld,)``.
        sign_phase: Number of the phase in which it was seen, -1 without one, shape ``(nworld,)``.
        sign_step: The step, -1 without one, shape ``(nworld,)``.
    """

    objects: list[str]
    phase_names: list[str]
    start_places: np.ndarray
    retries: np.ndarray
    unreachable: np.ndarray
    sign: np.ndarray
    sign_phase: np.ndarray
    sign_step: np.ndarray

    @classmethod
    def of(cls, episode: Episode, monitor: FailureMonitor) -> "Circumstances":
        """Copy the arrays of an episode that the monitor has seen to the host."""
        cfg = monitor.env.cfg
        index = monitor.env.index
        # Objects stand flat at a start, so that all of a rotation is about z.
        places = []
        for at in index.object_qpos:
            x, y, _, w, _, _, z = episode.start[:, at : at + 7].astype(float).T
            places.append(np.column_stack((x, y, 2.0 * np.arctan2(z, w))))
        sign, phase, step = torch.stack((monitor.sign, monitor.phase, monitor.step)).cpu().numpy()
        return cls(
            objects=list(index.objects),
            phase_names=[phase.name for phase in monitor.driver.phases],
            start_places=np.stack(places, axis=1),
            retries=episode.retries,
            # NaN is not reached.
            unreachable=~(episode.waypoint_error <= cfg.controller.ik_tolerance),
            sign=sign,
            sign_phase=phase,
            sign_step=step,
        )

    def arrays(self) -> dict[str, Any]:
        """The arrays by their names in the file."""
        held = asdict(self) | {"sign_names": [sign.name for sign in Sign]}
        return held | {"object_names": held.pop("objects")}

    @classmethod
    def read(cls, held: Mapping[str, np.ndarray]) -> "Circumstances":
        """The circumstances in a file's arrays.

        Raises:
            KeyError: One is missing.
        """
        return cls(
            objects=held["object_names"].tolist(),
            phase_names=held["phase_names"].tolist(),
            **{name: held[name] for name in cls._columns()},
        )

    @classmethod
    def join(cls, parts: Sequence["Circumstances"]) -> "Circumstances":
        """Those of all worlds, from those of neighbours."""
        return cls(
            objects=parts[0].objects,
            phase_names=parts[0].phase_names,
            **{
                name: np.concatenate([getattr(part, name) for part in parts])
                for name in cls._columns()
            },
        )

    @classmethod
    def _columns(cls) -> list[str]:
        return [item.name for item in fields(cls) if item.name not in ("objects", "phase_names")]

    def cells(self, world: int) -> dict[str, object]:
        """A world's cells of the table of failing episodes, by column."""
        phase = self.sign_phase[world]
        step = self.sign_step[world]
        cells = {
            "sign": Sign(self.sign[world]).name,
            "phase": self.phase_names[phase] if 0 <= phase < len(self.phase_names) else "",
            "step": step if step >= 0 else "",
            "retries": self.retries[world],
            "unreachable": int(self.unreachable[world]),
        }
        for name, place in zip(self.objects, self.start_places[world], strict=True):
            for part, number in zip(("x_m", "y_m", "yaw_rad"), place, strict=True):
                cells[f"{name}_{part}"] = f"{number:.6g}"
        return cells


@dataclass(eq=False, kw_only=True, slots=True)
class EpisodeRecord:
    """All worlds of one seed after their episode. Some 500 bytes a world, for an episode of any
    length.

    Attributes:
        seed: The seed.
        backend: ``native`` or ``mjwarp``.
        device: Where they were stepped, such as ``cuda:0``.
        failed: Bits of the task's rules, shape ``(nworld,)``, int32.
        values: Measurements of the check, by name with unit, each ``(nworld,)``.
        qpos: Final positions, shape ``(nworld, nq)``, in the backend's precision.
        start: Positions at the start, of the same shape.
        circumstances: Starts, retries and signs of failure; None where nothing looked on.
        measured: Measurements beside the check's, by name with unit, each ``(nworld,)``.
        seconds: Wall time of the steps, in the slowest rank [s].
        steps: Physics steps of all worlds.
        ranks: The first world of each rank that has played some, and its host and device.
    """

    seed: int
    backend: str
    device: str
    failed: np.ndarray
    values: dict[str, np.ndarray]
    qpos: np.ndarray
    start: np.ndarray
    circumstances: Circumstances | None = None
    measured: dict[str, np.ndarray] = field(default_factory=dict)
    seconds: float = 0.0
    steps: int = 0
    ranks: dict[int, str] = field(default_factory=dict)

    @classmethod
    def join(cls, parts: Sequence["EpisodeRecord"]) -> "EpisodeRecord":
        """The record of all worlds, from those of ranks, in the order of their worlds."""
        first = parts[0]
        if len(parts) == 1:
            return first
        seen = [part.circumstances for part in parts if part.circumstances is not None]

        def joined(name: str) -> dict[str, np.ndarray]:
            held = [getattr(part, name) for part in parts]
            return {key: np.concatenate([each[key] for each in held]) for key in held[0]}

        return cls(
            seed=first.seed,
            backend=first.backend,
            device=first.device,
            failed=np.concatenate([part.failed for part in parts]),
            values=joined("values"),
            qpos=np.concatenate([part.qpos for part in parts]),
            start=np.concatenate([part.start for part in parts]),
            circumstances=Circumstances.join(seen) if seen else None,
            measured=joined("measured"),
            seconds=max(part.seconds for part in parts),
            steps=sum(part.steps for part in parts),
            ranks={world: where for part in parts for world, where in part.ranks.items()},
        )

    @classmethod
    def read(
        cls, folder: Path, seed: int, gate: str = "batch", *, whole: bool = False
    ) -> "EpisodeRecord | None":
        """Read the record of a gate's seed in a run's folder; None if the gate did not get there.

        Args:
            folder: The folder.
            seed: The seed.
            gate: The gate.
            whole: With all that the gate's result needs, which records of old versions lack.

        Raises:
            RunError: The file cannot be read.
        """
        path = folder / _file_name(gate, seed)
        if not path.exists():
            return None
        with reading(path, RunError, "Run the gate again"), np.load(path) as held:
            values = [name for name in held.files if name.startswith("value.")]
            record = cls(
                **{name: held[name].item() for name in ("seed", "backend", "device")},
                failed=held["failed"],
                values={name.removeprefix("value."): held[name] for name in values},
                qpos=held["qpos"],
                start=held["start_qpos"],
            )
            if whole:
                record._read_rest(held)
            record._check()
        return record

    def _check(self) -> None:
        """Raise a `ValueError` where types or shapes are not those that a gate writes."""
        rows = (len(self.failed), self.qpos.shape[-1])
        shapes = {"qpos": rows, "start": rows, "failed": rows[:1]}
        for name, array in (self.values | self.measured).items():
            if array.shape != rows[:1]:
                raise ValueError(f"{name} is of shape {array.shape}")
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array.shape != shape or array.dtype.kind != ("i" if name == "failed" else "f"):
                raise ValueError(f"{name} is {array.dtype} of shape {array.shape}")
        where = f"{self.backend} on {self.device}"
        if not re.fullmatch(r"(native|mjwarp) on (cpu|cuda:\d+)", where):
            raise ValueError(f"played by {where}")

    def _read_rest(self, held: Mapping[str, np.ndarray]) -> None:
        """Take from a file's arrays what a replay does not need."""
        self.measured = {
            name.removeprefix(_MEASURED): held[name] for name in held if name.startswith(_MEASURED)
        }
        self.seconds = held["seconds"].item()
        self.steps = held["steps"].item()
        self.ranks = dict(
            zip(held["rank_first_world"].tolist(), held["rank_place"].tolist(), strict=True)
        )
        if "sign" in held:
            self.circumstances = Circumstances.read(held)

    @property
    def succeeded(self) -> np.ndarray:
        """Worlds that broke no rule, shape ``(nworld,)``, bool."""
        return self.failed == 0

    def write(self, folder: Path, gate: str = "batch") -> None:
        """Write the gate's file of this seed in one step."""
        names = ("seed", "backend", "device", "failed", "qpos", "seconds", "steps")
        arrays: dict[str, Any] = {
            **{name: getattr(self, name) for name in names},
            "start_qpos": self.start,
            **{f"value.{name}": values for name, values in self.values.items()},
            **{f"{_MEASURED}{name}": values for name, values in self.measured.items()},
            "rank_first_world": list(self.ranks),
            "rank_place": list(self.ranks.values()),
            **({} if self.circumstances is None else self.circumstances.arrays()),
        }
        write_npz(folder / _file_name(gate, self.seed), arrays)

    def failing_rows(self, rules: Rules) -> list[dict[str, object]]:
        """Cells of every failing episode by column: rules, circumstances, and all measurements."""
        return [
            {
                "seed": self.seed,
                "world": world,
                "rules": " ".join(rules.broken(int(self.failed[world]))),
                **({} if self.circumstances is None else self.circumstances.cells(world)),
                **{name: f"{values[world]:.6g}" for name, values in self.values.items()},
            }
            for world in np.flatnonzero(self.failed).tolist()
        ]


def starts_name(seed: int | str) -> str:
    """Name of the file of a seed's starts, for ``reset=starts_file``."""
    return f"starts_seed{seed}.csv"


def _file_name(gate: str, seed: int | str) -> str:
    return f"{STEMS[gate]}_seed{seed}.npz"
