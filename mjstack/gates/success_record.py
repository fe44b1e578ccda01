"""What the success gate leaves of every episode: its verdict, where it started, and where it went wrong."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from mjstack.config.schema import Config
from mjstack.envs import Env
from mjstack.gates.batch_record import BatchRecord
from mjstack.gates.episode import Episode
from mjstack.gates.watch import FailureWatch, Sign
from mjstack.mdp.geometry import pose_w
from mjstack.sim import Simulation
from mjstack.tasks.evidence import Rule

STEM = "success"
REGIONS, PICTURE = "success_regions.csv", "success.png"
BOTH = "success_failing_worlds.csv"  # the failing episodes, where the batch gate has a table of its own


def start_places(env: Env) -> np.ndarray:
    """Where cubes stand, red first: x and y [m] and rotation about z [rad], on the host, shape ``(nworld, 2, 3)``."""
    poses = [pose_w(env, name).double().cpu().numpy() for name in env.index.objects]
    # Cubes stand flat at a start, so that all of a rotation is about z.
    return np.stack([np.column_stack((p[:, :2], 2.0 * np.arctan2(p[:, 6], p[:, 3]))) for p in poses], axis=1)


@dataclass(eq=False, kw_only=True, slots=True)
class SuccessRecord:
    """All episodes of one seed.

    Attributes:
        batch: Verdicts, what was measured, and positions at the start and at the end.
        places: Of the cubes at the start; see `start_places`.
        retries: Grasps that were tried again, shape ``(nworld,)``.
        unreachable: Whether a target was out of reach, shape ``(nworld,)``, bool.
        sign: Number of the first `Sign` of failure, shape ``(nworld,)``.
        phase: Number of the phase in which it was seen, -1 without one, shape ``(nworld,)``.
        frame: The frame likewise.
    """

    batch: BatchRecord
    places: np.ndarray
    retries: np.ndarray
    unreachable: np.ndarray
    sign: np.ndarray
    phase: np.ndarray
    frame: np.ndarray

    @classmethod
    def take(
        cls, seed: int, sim: Simulation, cfg: Config, episode: Episode, places: np.ndarray, watch: FailureWatch
    ) -> SuccessRecord:
        """Copies what there is to keep to the host."""
        sign, phase, frame = torch.stack((watch.sign, watch.phase, watch.frame)).cpu().numpy()
        return cls(
            batch=BatchRecord.take(seed, sim, episode),
            places=places,
            retries=episode.retries,
            unreachable=~(episode.waypoint_error <= cfg.controller.ik_tolerance),  # NaN is not reached
            sign=sign,
            phase=phase,
            frame=frame,
        )

    @property
    def accepted(self) -> np.ndarray:
        """Worlds that broke no rule, shape ``(nworld,)``, bool."""
        return self.batch.failed == 0

    def write(self, folder: Path, phases: list[str]) -> None:
        """Writes ``success_seed<seed>.npz`` in one step. ``phases`` are their names, for readers."""
        self.batch.write(
            folder,
            STEM,
            start_places=self.places,
            retries=self.retries,
            unreachable=self.unreachable,
            sign=self.sign,
            sign_phase=self.phase,
            sign_frame=self.frame,
            sign_names=np.array([sign.name for sign in Sign]),
            phase_names=np.array(phases),
        )

    def failing_rows(self, rules: type[Rule], phases: list[str]) -> list[str]:
        """A line of the table for every failing episode: rules, first sign, start, and all that was measured."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        for world in np.flatnonzero(~self.accepted).tolist():
            broken = " ".join(rule.name or "" for rule in rules if self.batch.failed[world] & int(rule))
            phase = phases[self.phase[world]] if self.phase[world] >= 0 else ""
            frame = self.frame[world] if self.frame[world] >= 0 else ""
            cells = [self.batch.seed, world, broken, Sign(self.sign[world]).name, phase, frame]
            cells += [self.retries[world], int(self.unreachable[world])]
            cells += [f"{number:.6g}" for number in self.places[world].ravel()]
            writer.writerow([*cells, *(f"{values[world]:.6g}" for values in self.batch.values.values())])
        return out.getvalue().splitlines()

    def header(self) -> str:
        """The table's first line."""
        places = [f"{cube}_{part}" for cube in ("red", "blue") for part in ("x_m", "y_m", "yaw_rad")]
        names = ["seed", "world", "rules", "sign", "phase", "frame", "retries", "unreachable", *places, *self.batch.values]
        return ",".join(names)


def layout_name(seed: int | str) -> str:
    """The file that says how the worlds of a seed started, for ``reset=layout``."""
    return f"layouts_seed{seed}.csv"


def clear_success(folder: Path, keep: Path | None) -> None:
    """Removes what an earlier run's gate left in the same folder, but not the layouts that this run is to start from."""
    names = (REGIONS, PICTURE, BOTH)
    found = [folder / name for name in names]
    for path in (*found, *folder.glob(f"{STEM}_seed*.npz"), *folder.glob(layout_name("*"))):
        if keep is None or path.resolve() != keep.resolve():
            path.unlink(missing_ok=True)
