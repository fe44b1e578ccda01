"""What the success gate leaves of every episode: its result, where it started, and where it went
wrong.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from mjstack.config.schema import Config
from mjstack.envs import Env
from mjstack.episodes.batch_record import BatchRecord
from mjstack.episodes.failures import FailureMonitor, Sign
from mjstack.episodes.observers import Episode
from mjstack.mdp.geometry import pose_w
from mjstack.sim import Simulation
from mjstack.tasks.check import Rules

STEM = "success"
REGIONS = "success_regions.csv"
PICTURE = "success.png"
BOTH = (  # the failing episodes, where the batch gate has a table of its own
    "success_failing_worlds.csv"
)


def start_places(env: Env) -> np.ndarray:
    """Where objects stand: x and y [m] and rotation about z [rad], on the host, shape ``(nworld,
    objects, 3)``.
    """
    poses = [pose_w(env, name).double().cpu().numpy() for name in env.index.objects]
    # Objects stand flat at a start, so that all of a rotation is about z.
    return np.stack(
        [np.column_stack((p[:, :2], 2.0 * np.arctan2(p[:, 6], p[:, 3]))) for p in poses], axis=1
    )


@dataclass(eq=False, kw_only=True, slots=True)
class SuccessRecord:
    """All episodes of one seed.

    Attributes:
        batch: Results, what was measured, and positions at the start and at the end.
        places: Of the objects at the start; see `start_places`.
        retries: Grasps that were tried again, shape ``(nworld,)``.
        unreachable: Whether a target was out of reach, shape ``(nworld,)``, bool.
        sign: Number of the first `Sign` of failure, shape ``(nworld,)``.
        phase: Number of the phase in which it was seen, -1 without one, shape ``(nworld,)``.
        step: The step likewise.
    """

    batch: BatchRecord
    places: np.ndarray
    retries: np.ndarray
    unreachable: np.ndarray
    sign: np.ndarray
    phase: np.ndarray
    step: np.ndarray

    @classmethod
    def take(
        cls,
        seed: int,
        sim: Simulation,
        cfg: Config,
        episode: Episode,
        places: np.ndarray,
        watch: FailureMonitor,
    ) -> SuccessRecord:
        """Copies what there is to keep to the host."""
        sign, phase, step = torch.stack((watch.sign, watch.phase, watch.step)).cpu().numpy()
        return cls(
            batch=BatchRecord.take(seed, sim, episode),
            places=places,
            retries=episode.retries,
            unreachable=~(
                episode.waypoint_error <= cfg.controller.ik_tolerance
            ),  # NaN is not reached
            sign=sign,
            phase=phase,
            step=step,
        )

    @property
    def succeeded(self) -> np.ndarray:
        """Worlds that broke no rule, shape ``(nworld,)``, bool."""
        return self.batch.failed == 0

    def write(self, folder: Path, phases: list[str]) -> None:
        """Writes ``success_seed<seed>.npz`` in one step. ``phases`` are their names, for
        readers.
        """
        self.batch.write(
            folder,
            STEM,
            start_places=self.places,
            retries=self.retries,
            unreachable=self.unreachable,
            sign=self.sign,
            sign_phase=self.phase,
            sign_step=self.step,
            sign_names=np.array([sign.name for sign in Sign]),
            phase_names=np.array(phases),
        )

    def failing_rows(self, rules: Rules, phases: list[str]) -> list[str]:
        """A line of the table for every failing episode: rules, first sign, start, and all that was
        measured.
        """
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        for world in np.flatnonzero(~self.succeeded).tolist():
            broken = " ".join(rules.broken(self.batch.failed[world]))
            phase = phases[self.phase[world]] if self.phase[world] >= 0 else ""
            step = self.step[world] if self.step[world] >= 0 else ""
            cells = [self.batch.seed, world, broken, Sign(self.sign[world]).name, phase, step]
            cells += [self.retries[world], int(self.unreachable[world])]
            cells += [f"{number:.6g}" for number in self.places[world].ravel()]
            writer.writerow(
                [*cells, *(f"{values[world]:.6g}" for values in self.batch.values.values())]
            )
        return out.getvalue().splitlines()

    def header(self, objects: Iterable[str]) -> str:
        """The table's first line, for the names of the objects."""
        places = [f"{name}_{part}" for name in objects for part in ("x_m", "y_m", "yaw_rad")]
        names = [
            "seed",
            "world",
            "rules",
            "sign",
            "phase",
            "step",
            "retries",
            "unreachable",
            *places,
            *self.batch.values,
        ]
        return ",".join(names)


def starts_name(seed: int | str) -> str:
    """The file that says how the worlds of a seed started, for ``reset=starts_file``."""
    return f"starts_seed{seed}.csv"


def clear_success(folder: Path, keep: Path | None) -> None:
    """Removes what an earlier run's gate left in the same folder, but not the layouts that this run
    is to start from.
    """
    names = (REGIONS, PICTURE, BOTH)
    found = [folder / name for name in names]
    for path in (*found, *folder.glob(f"{STEM}_seed*.npz"), *folder.glob(starts_name("*"))):
        if keep is None or path.resolve() != keep.resolve():
            path.unlink(missing_ok=True)
