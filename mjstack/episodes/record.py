"""The record of all episodes of one seed, as arrays."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mjstack.episodes.batches import Batch
from mjstack.episodes.failures import FailureMonitor, Sign
from mjstack.files import read_npz, reading

_SCALARS = ("seed", "backend", "device", "seconds", "steps")
_NAMES = ("object_names", "phase_names")


@dataclass(eq=False, kw_only=True, slots=True)
class EpisodeRecord:
    """All worlds of one seed after their episode. Some 500 bytes a world, for an episode of any
    length.

    Attributes:
        seed: The seed.
        backend: ``native`` or ``mjwarp``.
        device: Where they were stepped, such as ``cuda:0``.
        worlds: Arrays over the worlds by their name in the file: ``failed``, bits of the task's
            rules, ``(nworld,)``, int32; ``qpos`` and ``start_qpos``, positions at the end and at
            the start, ``(nworld, nq)``, in the backend's precision; measurements of the check
            (``value.<name>``) and others (``measured.<name>``), each ``(nworld,)``;
            ``start_places``, x and y [m] and rotation about z [rad] of `object_names`, NaN for a
            place, ``(nworld, objects, 3)``. Where circumstances are recorded also ``retries`` of
            grasps; ``unreachable``, whether a target was out of reach; ``sign``, the first `Sign`
            of failure, with ``sign_phase`` and ``sign_step``, -1 without one.
        object_names: Names of all that an episode may place, as of `start_places`.
        phase_names: Names of the phases, where circumstances are recorded.
        seconds: Wall time of the steps, in the slowest rank [s].
        steps: Physics steps of all worlds.
    """

    seed: int
    backend: str
    device: str
    worlds: dict[str, np.ndarray]
    object_names: list[str] = field(default_factory=list)
    phase_names: list[str] = field(default_factory=list)
    seconds: float = 0.0
    steps: int = 0

    @property
    def failed(self) -> np.ndarray:
        """Bits of the task's rules, shape ``(nworld,)``, int32."""
        return self.worlds["failed"]

    @property
    def succeeded(self) -> np.ndarray:
        """Worlds that broke no rule, shape ``(nworld,)``, bool."""
        return self.failed == 0

    @property
    def qpos(self) -> np.ndarray:
        """Final positions, shape ``(nworld, nq)``."""
        return self.worlds["qpos"]

    @property
    def values(self) -> dict[str, np.ndarray]:
        """The measurements of the check, by name with unit."""
        names = [name for name in self.worlds if name.startswith("value.")]
        return {name.removeprefix("value."): self.worlds[name] for name in names}

    @classmethod
    def from_batch(cls, batch: Batch, monitor: FailureMonitor | None = None) -> "EpisodeRecord":
        """The record of a batch that a rank has played, perhaps watched by a monitor."""
        sim = batch.env.sim
        episode = batch.episode
        worlds = {
            "failed": episode.failed,
            "qpos": sim.qpos.cpu().numpy().copy(),
            "start_qpos": episode.start,
            **{f"value.{name}": values for name, values in episode.values.items()},
            "measured.ik_error_m": episode.ik_error,
            "measured.peak_contacts": sim.peak_contacts.cpu().numpy().copy(),
            "measured.peak_constraint_rows": sim.peak_constraints.cpu().numpy().copy(),
        }
        if episode.places:
            worlds["start_places"] = np.stack([*episode.places.values()], 1)
        if monitor is not None:
            worlds["retries"] = episode.retries
            # NaN is not reached.
            worlds["unreachable"] = ~(episode.ik_error <= batch.env.cfg.controller.ik_tolerance)
            signs = torch.stack((monitor.sign, monitor.phase, monitor.step)).cpu().numpy()
            worlds |= zip(("sign", "sign_phase", "sign_step"), signs, strict=True)
        return cls(
            seed=batch.plan.seed,
            backend=sim.backend,
            device=str(sim.device),
            worlds=worlds,
            object_names=list(episode.places),
            phase_names=[phase.name for phase in monitor.driver.phases] if monitor else [],
            seconds=episode.timing.seconds,
            steps=int(sim.step_count.sum()),
        )

    @classmethod
    def join(cls, records: Sequence["EpisodeRecord"]) -> "EpisodeRecord":
        """The record of all worlds, from those of ranks, in the order of their worlds."""
        first = records[0]
        if len(records) == 1:
            return first
        return replace(
            first,
            worlds={
                name: np.concatenate([rank_record.worlds[name] for rank_record in records])
                for name in first.worlds
            },
            seconds=max(rank_record.seconds for rank_record in records),
            steps=sum(rank_record.steps for rank_record in records),
        )

    @classmethod
    def read(cls, folder: Path, seed: int, gate: str = "batch") -> "EpisodeRecord | None":
        """Read the record of a gate's seed in a run's folder; None if the gate did not get there.

        Raises:
            FolderError: The file cannot be read.
        """
        path = folder / record_name(gate, seed)
        if not path.exists():
            return None
        with reading(path, "Run the gate again"):
            arrays = read_npz(path)
            for name in ("sign_names", "rank_first_world", "rank_place"):  # those of earlier runs
                arrays.pop(name, None)
            record = cls(
                **{n: arrays.pop(n).item() for n in _SCALARS},
                **{n: _items(arrays.pop(n)) for n in _NAMES if n in arrays},
                worlds=arrays,
            )
            record._check()
        return record

    def _check(self) -> None:
        """Raise a `ValueError` where types or shapes are not those that a gate writes."""
        rows = (len(self.failed), self.qpos.shape[-1])
        shapes = {"qpos": rows, "start_qpos": rows}
        for name, array in self.worlds.items():
            shape = shapes.get(name, (*rows[:1], *array.shape[1:]))
            flat = name in shapes or array.ndim == 1 or name == "start_places"
            kinds = {"failed": "i", "qpos": "f", "start_qpos": "f"}.get(name, "biuf")
            if array.shape != shape or not flat or array.dtype.kind not in kinds:
                raise ValueError(f"{name} is {array.dtype} of shape {array.shape}")
        where = f"{self.backend} on {self.device}"
        if not re.fullmatch(r"(native|mjwarp) on (cpu|cuda:\d+)", where):
            raise ValueError(f"played by {where}")

    def arrays(self) -> dict[str, Any]:
        """The content of its file, `record_name`."""
        arrays: dict[str, Any] = self.worlds | {name: getattr(self, name) for name in _SCALARS}
        arrays["object_names"] = self.object_names
        if "sign" in arrays:
            arrays["phase_names"] = self.phase_names
            arrays["sign_names"] = [sign.name for sign in Sign]
        return arrays


def _items(array: np.ndarray) -> Any:
    """The items of a flat array, in Python's types."""
    return [item.item() for item in array]


def record_name(gate: str, seed: int) -> str:
    """Name of the file of a seed's record."""
    return f"{gate}_seed{seed}.npz"
