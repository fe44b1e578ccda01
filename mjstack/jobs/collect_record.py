"""What the collect job remembers of its batches, beside the dataset: which seeds were played, and how good the expert was."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from mjstack.errors import DatasetError
from mjstack.report.record import write_atomic

FILE = "batches.json"


@dataclass(kw_only=True, slots=True)
class CollectedBatch:
    """One seed, played in some worlds.

    Attributes:
        seed: The seed.
        worlds: How many worlds.
        accepted: Worlds that the acceptance passed.
        kept: Episodes that went into the dataset.
        not_finite: Failed episodes that were not kept because a number in them is not finite.
        retries: Grasps that were tried again, in all worlds.
        broken: How many worlds broke each rule, by its words.
        simulation_s: Wall time of playing [s].
        copy_s: Of copying frames to the host [s].
        writing_s: Of writing them [s].
    """

    seed: int
    worlds: int
    accepted: int
    kept: int = 0
    not_finite: int = 0
    retries: int = 0
    broken: dict[str, int] = field(default_factory=dict)
    simulation_s: float = 0.0
    copy_s: float = 0.0
    writing_s: float = 0.0


def read_batches(folder: Path) -> list[CollectedBatch]:
    """The batches of earlier calls.

    Raises:
        DatasetError: The file cannot be read.
    """
    path = folder / FILE
    if not path.exists():
        return []
    try:
        return [CollectedBatch(**batch) for batch in json.loads(path.read_text())]
    except (OSError, ValueError, TypeError) as error:
        raise DatasetError(
            f"{path} cannot be read ({type(error).__name__}), expected what job=collect wrote. Remove it: the dataset stands, "
            "and the expert's success rate is counted from then on"
        ) from error


def write_batches(folder: Path, batches: Sequence[CollectedBatch]) -> None:
    """Replaces the file in one step."""
    write_atomic(folder / FILE, json.dumps([asdict(batch) for batch in batches], indent=1) + "\n")
