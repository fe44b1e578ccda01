"""What the batch gate leaves of every world: arrays for programs, and a table of the failing ones
for people.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.episodes.context import measured_values
from mjstack.episodes.observers import Episode
from mjstack.errors import RunError
from mjstack.files import write_atomic
from mjstack.sim import Simulation
from mjstack.tasks.check import Rules

FAILING = "failing_worlds.csv"
WORLDS = "worlds"  # the batch gate's files begin with this


@dataclass(eq=False, kw_only=True, slots=True)
class BatchRecord:
    """All worlds of one seed after their episode. Some 500 bytes a world, whatever the episode's
    length.

    Attributes:
        seed: The seed.
        backend: ``native`` or ``mjwarp``.
        device: Where they were stepped, such as ``cuda:0``.
        failed: Bits of the task's rules, shape ``(nworld,)``, int32.
        values: What the check measured, by name with unit, each ``(nworld,)``.
        qpos: Final positions, shape ``(nworld, nq)``, in the backend's precision.
        start: Positions at the start likewise; None in records of runs that did not keep them.
    """

    seed: int
    backend: str
    device: str
    failed: np.ndarray
    values: dict[str, np.ndarray]
    qpos: np.ndarray
    start: np.ndarray | None = None

    @classmethod
    def take(cls, seed: int, sim: Simulation, episode: Episode) -> BatchRecord:
        """Copies what there is to keep to the host."""
        return cls(
            seed=seed,
            backend=sim.backend,
            device=str(sim.device),
            failed=episode.result.failed.cpu().numpy(),
            values=measured_values(episode.result),
            qpos=sim.qpos.cpu().numpy().copy(),
            start=episode.start,
        )

    @classmethod
    def read(cls, folder: Path, seed: int, stem: str = WORLDS) -> BatchRecord | None:
        """What a run kept for one seed, or None if its gate did not get there.

        Args:
            folder: The run's.
            seed: The seed.
            stem: What the gate's files begin with.

        Raises:
            RunError: The file cannot be read.
        """
        path = folder / _file_name(seed, stem)
        if not path.exists():
            return None
        try:
            with np.load(path) as held:
                return cls(
                    seed=int(held["seed"]),
                    backend=str(held["backend"]),
                    device=str(held["device"]),
                    failed=held["failed"],
                    values={
                        name[len("value.") :]: held[name]
                        for name in held.files
                        if name.startswith("value.")
                    },
                    qpos=held["qpos"],
                    start=held["start_qpos"] if "start_qpos" in held.files else None,
                )
        except Exception as error:  # numpy and zipfile fail in their own ways
            raise RunError(
                f"{path}: cannot be read ({type(error).__name__}), expected what the gate wrote."
                " Run the gate again."
            ) from error

    def write(self, folder: Path, stem: str = WORLDS, **more: np.ndarray) -> None:
        """Writes ``<stem>_seed<seed>.npz`` in one step, with more arrays of the gate's own."""
        arrays: dict[str, Any] = {
            "seed": self.seed,
            "backend": self.backend,
            "device": self.device,
            "failed": self.failed,
            "qpos": self.qpos,
            **({} if self.start is None else {"start_qpos": self.start}),
            **{f"value.{name}": values for name, values in self.values.items()},
            **more,
        }
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        write_atomic(folder / _file_name(self.seed, stem), buffer.getvalue())

    def failing_rows(self, rules: Rules) -> list[str]:
        """A line of the table for every failing world: the rules that it broke, and all that was
        measured.
        """
        return [
            ",".join(
                (
                    str(self.seed),
                    str(world),
                    " ".join(rules.broken(self.failed[world])),
                    *(f"{values[world]:.6g}" for values in self.values.values()),
                )
            )
            for world in np.flatnonzero(self.failed).tolist()
        ]

    def header(self) -> str:
        """The table's first line."""
        return ",".join(("seed", "world", "rules", *self.values))


def write_failing(folder: Path, header: str, rows: Iterable[str], name: str = FAILING) -> None:
    """Replaces failing_worlds.csv, or another table like it, in one step."""
    write_atomic(folder / name, "\n".join((header, *rows)) + "\n")


def clear_records(folder: Path) -> None:
    """Removes the records of an earlier run in the same folder, which would pass for this one's."""
    for path in (folder / FAILING, *folder.glob(_file_name("*"))):
        path.unlink(missing_ok=True)


def _file_name(seed: int | str, stem: str = WORLDS) -> str:
    return f"{stem}_seed{seed}.npz"
