"""The collect job's record of its batches, beside the dataset: seeds and the expert's success."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from mjstack.errors import DatasetError
from mjstack.files import write_atomic

FILE = "batches.json"


@dataclass(kw_only=True, slots=True)
class CollectedBatch:
    """One seed, played in some worlds.

    The record is written before the first episode is added, so that a call that is stopped anywhere
    leaves neither a wrong figure nor a lost episode.

    Attributes:
        seed: The seed.
        worlds: Number of worlds.
        keep: Number of episodes that are to be kept.
        succeeded: Number of worlds that the check passed.
        kept: Episodes of it that are in the dataset; fewer than ``keep`` if it is unfinished.
        not_finite: Episodes that are left out only because a number in them is not finite.
        retries: Grasps that were tried again, in all worlds.
        broken: How many worlds broke each rule, by its words.
    """

    seed: int
    worlds: int
    keep: int
    succeeded: int
    kept: int = 0
    not_finite: int = 0
    retries: int = 0
    broken: dict[str, int] = field(default_factory=dict)


def count_kept(batches: Sequence[CollectedBatch], committed: Sequence[tuple[int, int]]) -> None:
    """Count each batch's episodes in the dataset, which has them as seed and world."""
    counts = Counter(seed for seed, _ in committed)
    for batch in batches:
        batch.kept = counts[batch.seed]


def read_batches(folder: Path, committed: Sequence[tuple[int, int]]) -> list[CollectedBatch]:
    """The batches of earlier calls, compared with the dataset.

    Args:
        folder: The job's folder.
        committed: Seed and world of every episode of the dataset.

    Raises:
        DatasetError: The file cannot be read, or is of other episodes.
    """
    path = folder / FILE
    if not path.exists():
        return []
    remedy = (
        f"Remove {FILE}: the dataset stands, and the expert's success rate is counted from then on"
    )
    try:
        batches = [CollectedBatch(**batch) for batch in json.loads(path.read_text())]
    except (OSError, ValueError, TypeError) as error:
        raise DatasetError(
            f"{path} cannot be read ({type(error).__name__}), expected what job=collect wrote."
            f" {remedy}"
        ) from error
    noted = [batch.kept for batch in batches]
    count_kept(batches, committed)
    for batch, kept in zip(batches, noted, strict=True):
        if kept >= batch.keep and batch.kept != kept:
            raise DatasetError(
                f"{path} has {kept} episodes of seed {batch.seed}, expected {batch.kept} as in the"
                f" dataset. Restore what was changed. Or: {remedy[0].lower()}{remedy[1:]}"
            )
    return batches


def write_batches(folder: Path, batches: Sequence[CollectedBatch]) -> None:
    """Replace the file in one step that outlasts a power cut."""
    text = json.dumps([asdict(batch) for batch in batches], indent=1)
    write_atomic(folder / FILE, text + "\n")
