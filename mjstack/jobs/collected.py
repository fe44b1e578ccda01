"""The plan of a dataset of demonstrations, and the record of the batches that were played."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import cast

from mjstack.config.schema import CollectJobCfg
from mjstack.datasets import DatasetSpec
from mjstack.envs import Env
from mjstack.episodes.context import RunContext
from mjstack.episodes.tally import rate_metrics
from mjstack.errors import ConfigError, DatasetError
from mjstack.files import reading
from mjstack.jobs.demonstration import make_spec
from mjstack.jobs.runner import run_provenance

FILE = "batches.json"


@dataclass(frozen=True, kw_only=True, slots=True)
class CollectPlan:
    """A dataset to be collected.

    Attributes:
        home: The job's folder.
        spec: The dataset's columns and provenance.
        most: Largest number of worlds of a batch: those whose steps fit into the buffers of all
            ranks.
        rank_most: Largest number of worlds whose steps fit into the buffer of a rank.
    """

    home: Path
    spec: DatasetSpec
    most: int
    rank_most: int

    @classmethod
    def of(cls, context: RunContext, home: Path, env: Env) -> "CollectPlan":
        """Plan from an environment of the demonstrations, with any number of worlds.

        Raises:
            ConfigError: The steps of not even one world fit into the buffer, or a column's name is
                taken.
        """
        cfg = context.cfg
        gib = cast(CollectJobCfg, cfg.job).buffer_gib
        provenance = run_provenance(context)
        # They differ between calls that make the same episodes.
        del provenance["date"], provenance["config_sha256"]
        spec = make_spec(env, cfg, provenance)
        step = 4 * sum(column.dim for column in spec.features.values() if column.dtype == "float32")
        if spec.videos:
            step += 4 * context.model.nq
        world = context.episode_steps * step / 2**30
        if gib < world:
            expected = f"at least {world:.2g}, which the steps of one world take"
            raise ConfigError("job.buffer_gib", gib, expected)
        room = int(gib / world)
        most = min(cfg.nworld, context.ranks.size * room)
        return cls(home=home, spec=spec, most=most, rank_most=room)


@dataclass(kw_only=True, slots=True)
class CollectedBatch:
    """One seed, played in some worlds.

    Attributes:
        seed: The seed.
        worlds: Number of worlds.
        keep: Number of episodes that are to be kept.
        succeeded: Number of worlds that the check passed.
        kept: Episodes of it that are in the dataset; fewer than ``keep`` if it is unfinished.
        retries: Grasps that were tried again, in all worlds.
        broken: How many worlds broke each rule, by its words; among them those that are left out
            only because a number in them is not finite.
    """

    seed: int
    worlds: int
    keep: int
    succeeded: int
    kept: int = 0
    retries: int = 0
    broken: dict[str, int] = field(default_factory=dict)


def read_batches(path: Path) -> list[CollectedBatch]:
    """The batches of earlier calls, ``kept`` as it was then.

    Raises:
        DatasetError: The file cannot be read.
    """
    if not path.exists():
        return []
    fix = (
        f"Remove {FILE}: the dataset stands, and the expert's success rate is counted from then on"
    )
    with reading(path, DatasetError, fix):
        batches = [CollectedBatch(**batch) for batch in json.loads(path.read_text())]
        for batch in batches:
            counts = asdict(batch) | batch.broken
            del counts["broken"]
            if any(type(count) is not int or count < 0 for count in counts.values()):
                raise ValueError(counts)
    return batches


def describe_batches(
    batches: Sequence[CollectedBatch], driver: str
) -> tuple[str, dict[str, float], list[str]]:
    """The success of the expert, or of another driver, in some batches.

    Returns:
        A sentence, figures, and remarks.
    """
    worlds = sum(batch.worlds for batch in batches)
    succeeded = sum(batch.succeeded for batch in batches)
    metrics = {
        "worlds_played": worlds,
        **rate_metrics(succeeded, worlds),
        "retries": sum(batch.retries for batch in batches),
    }
    share = f"{succeeded:,} of {worlds:,} worlds ({100.0 * succeeded / worlds:.4g} %)"
    broken = sum((Counter(batch.broken) for batch in batches), Counter())
    details = [f"{text}: {count} of {worlds} worlds" for text, count in broken.items()]
    details += [
        f"seed {batch.seed} is unfinished: {batch.keep - batch.kept} of its episodes are still to"
        " come"
        for batch in batches
        if batch.kept < batch.keep
    ]
    return f"the {driver} succeeded in {share}", metrics, details
