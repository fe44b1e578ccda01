"""The record of all episodes of one seed: arrays for programs, and rows of the failing ones for
people.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.failures import FailureMonitor, Sign
from mjstack.episodes.observers import Episode
from mjstack.episodes.rollout import Observer
from mjstack.errors import RunError
from mjstack.files import write_atomic
from mjstack.mdp.geometry import pose_w
from mjstack.sim import Simulation
from mjstack.tasks.check import CheckResult, Rules

STEMS = {"batch": "worlds", "success": "success"}
"""The beginning of the files of each gate."""
FAILING = "failing_worlds.csv"
SUCCESS_FAILING = "success_failing_worlds.csv"  # where the batch gate has the other one
REGIONS = "success_regions.csv"
PICTURE = "success.png"


class StartRecorder(Observer):
    """Keeps where objects start.

    Attributes:
        names: Names of the objects.
        poses: x and y [m] and rotation about z [rad] of each, shape ``(nworld, objects, 3)``.
    """

    names: tuple[str, ...]
    poses: np.ndarray

    def start(self, env: Env, driver: Driver) -> None:
        """See `Observer`."""
        self.names = tuple(env.index.objects)
        poses = [pose_w(env, name).double().cpu().numpy() for name in self.names]
        # Objects stand flat at a start, so that all of a rotation is about z.
        self.poses = np.stack(
            [np.column_stack((p[:, :2], 2.0 * np.arctan2(p[:, 6], p[:, 3]))) for p in poses], axis=1
        )


@dataclass(eq=False, kw_only=True, slots=True)
class Circumstances:
    """Where episodes started and where they went wrong.

    Attributes:
        objects: Names of the objects.
        phases: Names of the phases.
        starts: Of the objects; see `StartRecorder`.
        retries: Grasps that were tried again, shape ``(nworld,)``.
        unreachable: Whether a target was out of reach, shape ``(nworld,)``, bool.
        sign: Number of the first `Sign` of failure, shape ``(nworld,)``.
        phase: Number of the phase in which it was seen, -1 without one, shape ``(nworld,)``.
        step: The step, -1 without one, shape ``(nworld,)``.
    """

    objects: tuple[str, ...]
    phases: list[str]
    starts: np.ndarray
    retries: np.ndarray
    unreachable: np.ndarray
    sign: np.ndarray
    phase: np.ndarray
    step: np.ndarray

    @classmethod
    def of(
        cls,
        episode: Episode,
        starts: StartRecorder,
        monitor: FailureMonitor,
        phases: Sequence[str],
        tolerance: float,
    ) -> Circumstances:
        """Copy the arrays to the host. A target is reached within ``tolerance`` [m]."""
        sign, phase, step = torch.stack((monitor.sign, monitor.phase, monitor.step)).cpu().numpy()
        return cls(
            objects=starts.names,
            phases=list(phases),
            starts=starts.poses,
            retries=episode.retries,
            unreachable=~(episode.waypoint_error <= tolerance),  # NaN is not reached
            sign=sign,
            phase=phase,
            step=step,
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by their names in the file."""
        return {
            "start_places": self.starts,
            "retries": self.retries,
            "unreachable": self.unreachable,
            "sign": self.sign,
            "sign_phase": self.phase,
            "sign_step": self.step,
            "sign_names": np.array([sign.name for sign in Sign]),
            "phase_names": np.array(self.phases),
        }

    def header(self) -> list[str]:
        """Names of the columns that `cells` fills."""
        parts = ("x_m", "y_m", "yaw_rad")
        starts = [f"{name}_{part}" for name in self.objects for part in parts]
        return ["sign", "phase", "step", "retries", "unreachable", *starts]

    def cells(self, world: int) -> list[object]:
        """A world's cells of the table of failing episodes."""
        phase = self.phase[world]
        step = self.step[world]
        return [
            Sign(self.sign[world]).name,
            self.phases[phase] if phase >= 0 else "",
            step if step >= 0 else "",
            self.retries[world],
            int(self.unreachable[world]),
            *(f"{number:.6g}" for number in self.starts[world].ravel()),
        ]


@dataclass(eq=False, kw_only=True, slots=True)
class EpisodeRecord:
    """All worlds of one seed after their episode. Some 500 bytes a world, whatever the episode's
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
    """

    seed: int
    backend: str
    device: str
    failed: np.ndarray
    values: dict[str, np.ndarray]
    qpos: np.ndarray
    start: np.ndarray
    circumstances: Circumstances | None = None

    @classmethod
    def of(
        cls,
        seed: int,
        sim: Simulation,
        episode: Episode,
        circumstances: Circumstances | None = None,
    ) -> EpisodeRecord:
        """Copy the results to the host."""
        return cls(
            seed=seed,
            backend=sim.backend,
            device=str(sim.device),
            failed=episode.result.failed.cpu().numpy(),
            values=measured_values(episode.result),
            qpos=sim.qpos.cpu().numpy().copy(),
            start=episode.start,
            circumstances=circumstances,
        )

    @classmethod
    def read(cls, folder: Path, seed: int, gate: str = "batch") -> EpisodeRecord | None:
        """Read the record of a gate's seed, without circumstances.

        Args:
            folder: The run's.
            seed: The seed.
            gate: The gate.

        Returns:
            The record, or None if the gate did not get there.

        Raises:
            RunError: The file cannot be read.
        """
        path = folder / _file_name(gate, seed)
        if not path.exists():
            return None
        try:
            with np.load(path) as held:
                values = [name for name in held.files if name.startswith("value.")]
                return cls(
                    seed=int(held["seed"]),
                    backend=str(held["backend"]),
                    device=str(held["device"]),
                    failed=held["failed"],
                    values={name.removeprefix("value."): held[name] for name in values},
                    qpos=held["qpos"],
                    start=held["start_qpos"],
                )
        except Exception as error:  # numpy and zipfile fail in their own ways
            raise RunError(
                f"{path}: cannot be read ({type(error).__name__}), expected what the gate wrote."
                " Run the gate again."
            ) from error

    @property
    def succeeded(self) -> np.ndarray:
        """Worlds that broke no rule, shape ``(nworld,)``, bool."""
        return self.failed == 0

    def write(self, folder: Path, gate: str = "batch") -> None:
        """Write the gate's file of this seed in one step."""
        arrays: dict[str, Any] = {
            "seed": self.seed,
            "backend": self.backend,
            "device": self.device,
            "failed": self.failed,
            "qpos": self.qpos,
            "start_qpos": self.start,
            **{f"value.{name}": values for name, values in self.values.items()},
            **({} if self.circumstances is None else self.circumstances.arrays()),
        }
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        write_atomic(folder / _file_name(gate, self.seed), buffer.getvalue())

    def header(self) -> list[str]:
        """Names of the columns of `failing_rows`."""
        more = [] if self.circumstances is None else self.circumstances.header()
        return ["seed", "world", "rules", *more, *self.values]

    def failing_rows(self, rules: Rules) -> list[list[object]]:
        """Cells of every failing episode: rules, circumstances, and all measurements."""
        return [
            [
                self.seed,
                world,
                " ".join(rules.broken(int(self.failed[world]))),
                *([] if self.circumstances is None else self.circumstances.cells(world)),
                *(f"{values[world]:.6g}" for values in self.values.values()),
            ]
            for world in np.flatnonzero(self.failed).tolist()
        ]


def measured_values(result: CheckResult) -> dict[str, np.ndarray]:
    """Measurements of the check, by name with unit, on the host; each of shape ``(nworld,)``."""
    return {name: value.double().cpu().numpy() for name, value in result.values.items()}


def write_failing(path: Path, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Replace a table of failing episodes in one step."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([header, *rows])
    write_atomic(path, out.getvalue())


def starts_name(seed: int | str) -> str:
    """Name of the file of a seed's starts, for ``reset=starts_file``."""
    return f"starts_seed{seed}.csv"


def clear_records(folder: Path, keep: Path | None = None) -> None:
    """Remove the files of an earlier run in the same folder, which would pass for this one's.

    Args:
        folder: The run's.
        keep: The starts file of this run, which may be among them.
    """
    files = [folder / name for name in (FAILING, SUCCESS_FAILING, REGIONS, PICTURE)]
    patterns = [*(_file_name(gate, "*") for gate in STEMS), starts_name("*")]
    for path in [*files, *(path for pattern in patterns for path in folder.glob(pattern))]:
        if keep is None or path.resolve() != keep.resolve():
            path.unlink(missing_ok=True)


def _file_name(gate: str, seed: int | str) -> str:
    return f"{STEMS[gate]}_seed{seed}.npz"
