"""What the collect job remembers of its batches, beside the dataset: which seeds were played, and
how good the expert was.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from mjstack.datasets.staging import Staging
from mjstack.errors import DatasetError

FILE = "batches.json"


@dataclass(kw_only=True, slots=True)
class CollectedBatch:
    """One seed, played in some worlds.

    Worlds, results and retries are those of its first play. They are noted before the first episode
    is added, together with what is to come into the dataset, so that a call that is stopped
    anywhere leaves neither a wrong figure nor a lost episode.

    Attributes:
        seed: The seed.
        worlds: How many worlds.
        succeeded: Worlds that the check passed.
        kept: Episodes of it that are in the dataset.
        missing: Worlds whose episodes are still to come, in order, with the rules that each broke;
            empty once it is finished.
        changed: Episodes left out because their worlds, played again, were judged otherwise.
        not_finite: Episodes that were not kept only because a number in them is not finite.
        retries: Grasps that were tried again, in all worlds.
        broken: How many worlds broke each rule, by its words.
        simulation_s: Wall time of playing [s].
        copy_s: Of copying steps to the host [s].
        writing_s: Of writing them [s].
    """

    seed: int
    worlds: int
    succeeded: int
    kept: int = 0
    missing: dict[int, str] = field(default_factory=dict)
    changed: int = 0
    not_finite: int = 0
    retries: int = 0
    broken: dict[str, int] = field(default_factory=dict)
    simulation_s: float = 0.0
    copy_s: float = 0.0
    writing_s: float = 0.0

    def take_in(self, committed: Sequence[tuple[int, int]]) -> None:
        """Counts what is in the dataset: it is what holds where a call was stopped before
        its note.
        """
        there = {world for seed, world in committed if seed == self.seed}
        self.kept = len(there)
        self.missing = {world: rules for world, rules in self.missing.items() if world not in there}


def read_batches(folder: Path, committed: Sequence[tuple[int, int]]) -> list[CollectedBatch]:
    """The batches of earlier calls, held to the dataset.

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
        for batch in batches:
            batch.missing = {int(world): str(rules) for world, rules in batch.missing.items()}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise DatasetError(
            f"{path} cannot be read ({type(error).__name__}), expected what job=collect wrote."
            f" {remedy}"
        ) from error
    for batch in batches:
        noted = batch.kept
        begun = bool(batch.missing)
        batch.take_in(committed)
        if not begun and batch.kept != noted:
            raise DatasetError(
                f"{path} has {noted} episodes of seed {batch.seed}, expected {batch.kept} as in the"
                f" dataset. Restore what was changed. Or: {remedy[0].lower()}{remedy[1:]}"
            )
    return batches


def write_batches(folder: Path, batches: Sequence[CollectedBatch]) -> None:
    """Replaces the file in one step that outlasts a power cut: episodes are added only once their
    note is on the disk.
    """
    staging = Staging()
    try:
        staging.write(
            folder / FILE,
            (json.dumps([asdict(batch) for batch in batches], indent=1) + "\n").encode(),
        )
        staging.commit()
    finally:
        staging.discard()
