"""A dataset of demonstrations that grows: worlds are played in batches, their episodes committed,
until enough are there.
"""

import json
import math
from collections import Counter
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import cast

import numpy as np

from mjstack.config.schema import CollectJobCfg
from mjstack.datasets import DatasetSpec, DatasetWriter, EpisodeData, lerobot
from mjstack.envs import Env
from mjstack.episodes.context import RunContext
from mjstack.errors import ConfigError, DatasetError
from mjstack.files import reading, write_atomic
from mjstack.jobs.demonstration import (
    STATE,
    Played,
    make_spec,
    play_demonstrations,
)
from mjstack.jobs.runner import run_provenance
from mjstack.math import wilson_interval
from mjstack.report.record import GateResult, Status
from mjstack.sim import Simulation

DATASET = "dataset"  # within the job's folder
FILE = "batches.json"
_SPARE = 1.05  # worlds played over episodes that are missing: some fail
_GIVE_UP = 3  # batches in a row without an episode


@dataclass(frozen=True, kw_only=True, slots=True)
class CollectPlan:
    """A dataset to be collected.

    Attributes:
        home: The job's folder.
        spec: The dataset's columns and provenance.
        most: Largest number of worlds of a batch: those whose steps fit into the buffer.
    """

    home: Path
    spec: DatasetSpec
    most: int

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
        world = context.episode_steps * step / 2**30
        if gib < world:
            expected = f"at least {world:.2g}, which the steps of one world take"
            raise ConfigError("job.buffer_gib", gib, expected)
        return cls(home=home, spec=spec, most=min(cfg.nworld, int(gib / world)))


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


class Collection:
    """A dataset, and the worlds that add to it.

    A batch is one seed in as many worlds as are needed and fit; the next batch has the next seed,
    in later calls too. So a pair of seed and world is one episode for any nworld.

    A batch's record is written beside the dataset before its first episode is added. If a call is
    stopped in between, the next one plays the whole batch again and adds the missing episodes.
    Committed ones do not change. On CUDA two plays of a world agree only nearly: the first play
    counts in the success rate, and every episode has the result of the play that recorded it.

    Attributes:
        path: The dataset.
        batches: All that were played, in earlier calls too; read by `play`.
    """

    def __init__(self, plan: CollectPlan, context: RunContext) -> None:
        """Open the dataset of a plan; raises as `DatasetWriter` does."""
        self._context = context
        self._plan = plan
        self._job = cast(CollectJobCfg, context.cfg.job)
        self._record_path = plan.home / FILE
        self.path = plan.home / DATASET
        self.batches: list[CollectedBatch] = []
        self._sim: Simulation | None = None
        if not (self.path / lerobot.INFO).exists():
            self._record_path.unlink(missing_ok=True)  # of a dataset that was removed
        self._writer = DatasetWriter(self.path, plan.spec)
        self._before = self.committed

    @property
    def committed(self) -> int:
        """Number of episodes of the dataset."""
        return len(self._writer.committed)

    def play(self) -> str:
        """Play and write until the episodes are there; what was committed is kept.

        Returns:
            Why that cannot be done; empty if it is done.

        Raises:
            UnwrittenError: The dataset cannot be written any further.
            OSError: The record of the batches cannot be written.
        """
        try:
            with self._writer:
                self.batches = read_batches(self._record_path)
                self._count_kept()
                return self._play()
        finally:
            if self.batches:
                with suppress(OSError):  # the next call counts again
                    self._record()
            if self._sim is not None:
                self._sim.close()

    def _play(self) -> str:
        committed = self._writer.committed
        empty = 0
        while (wanted := self._job.episodes - len(committed)) > 0:
            # A batch that was begun, or the next seed
            begun = next((batch for batch in self.batches if batch.kept < batch.keep), None)
            if begun is not None:
                seed = begun.seed
                worlds = begun.worlds
            else:
                seeds = [seed for seed, _ in committed] + [b.seed for b in self.batches]
                seed = max([self._context.cfg.seed - 1, *seeds]) + 1
                spare = 1.0 if self._job.keep_failures else _SPARE
                worlds = min(self._plan.most, math.ceil(spare * wanted))
            played = play_demonstrations(self._context, self._worlds(worlds), seed)

            # The episodes that are kept
            batch, usable = self._judge(played, wanted)
            if begun is None:
                self.batches.append(batch)
                self._record()
            else:
                batch = begun
                there = {world for other, world in committed if other == seed}
                usable = [world for world in usable if world not in there]
                batch.keep = min(batch.keep, batch.kept + len(usable))
            self._add(played, usable[: min(batch.keep - batch.kept, wanted)])
            del played.steps.values  # the device's memory, before the next batch takes as much
            self._context.print_line(
                f"collect, seed {seed}: {batch.succeeded} of {worlds} worlds succeeded,"
                f" {len(committed)} of {self._job.episodes} episodes there"
            )
            empty = 0 if batch.kept else empty + 1
            if empty == _GIVE_UP:
                why = [f"{text} in {n} of {batch.worlds}" for text, n in batch.broken.items()]
                reason = f"{_GIVE_UP} seeds in a row brought no episode, the last because of: "
                return f"{reason}{'; '.join(why)} worlds"
        return ""

    def _judge(self, played: Played, wanted: int) -> tuple[CollectedBatch, list[int]]:
        """The record of a batch, and the worlds whose episodes can be kept."""
        rules = self._context.check.rules
        good = np.flatnonzero((played.failed == 0) | self._job.keep_failures).tolist()
        usable = [world for world in good if played.finite(world)]
        failing = rules.failing(played.failed)
        broken = {rules.texts[name]: len(worlds) for name, worlds in failing.items()}
        if lost := len(good) - len(usable):
            broken["a number that is not finite"] = lost
        batch = CollectedBatch(
            seed=played.seed,
            worlds=len(played.failed),
            keep=min(len(usable), wanted),
            succeeded=int((played.failed == 0).sum()),
            retries=int(played.retries.sum()),
            broken=broken,
        )
        return batch, usable

    def _add(self, played: Played, worlds: list[int]) -> None:
        """Commit the episodes of some worlds, and record it."""
        for count, (world, arrays) in enumerate(played.episodes(worlds), 1):
            self._writer.add([self._episode(played, world, arrays)])
            self._context.advance(f"episodes of seed {played.seed}", count, len(worlds))
        self._writer.flush()
        self._record()

    def _count_kept(self) -> None:
        counts = Counter(seed for seed, _ in self._writer.committed)
        for batch in self.batches:
            batch.kept = counts[batch.seed]

    def _record(self) -> None:
        """Write the record of all batches."""
        self._count_kept()
        records = [asdict(batch) for batch in self.batches]
        write_atomic(self._record_path, json.dumps(records, indent=1) + "\n")

    def _episode(self, played: Played, world: int, arrays: dict[str, np.ndarray]) -> EpisodeData:
        """A world's steps and its result. `next.success` is true in the last step of a successful
        episode alone.
        """
        task = self._context.cfg.task
        broken = self._context.check.rules.describe(int(played.failed[world]))
        last = np.arange(len(arrays[STATE])) == len(arrays[STATE]) - 1
        return EpisodeData(
            arrays={**arrays, "next.done": last, "next.success": last & (not broken)},
            task=task.instruction or task.name,
            success=not broken,
            seed=played.seed,
            world=world,
            values={
                "retries": int(played.retries[world]),
                "failed_rules": broken,
                "config_sha256": self._plan.spec.config_sha256,
            },
        )

    def _worlds(self, n: int) -> Simulation:
        if self._sim is None or self._sim.nworld != n:
            if self._sim is not None:
                self._sim.close()
            self._sim = self._context.batch_simulation(n)
        return self._sim

    def result(self, status: Status, problem: str, seconds: float) -> GateResult:
        """The dataset and the expert's success, as a result of the report.

        ``problem`` says why it did not pass; ``seconds`` is the wall time of this call.
        """
        asked = self._job.episodes
        new = self.committed - self._before
        steps = self._writer.frames
        size = sum(path.stat().st_size for path in self.path.rglob("*") if path.is_file()) / 1e6
        notes = {"dataset": str(self.path), "config_sha256": self._plan.spec.config_sha256}
        metrics: dict[str, float] = {
            "episodes": self.committed,
            "episodes_of_this_call": new,
            "steps": steps,
            "megabytes": size,
        }
        reasons = [problem] if problem else []
        there = f"{steps:,} steps, {size:.1f} MB"
        reasons.append(f"{self.committed:,} episodes, {asked:,} asked for ({there})")
        details = []

        # The expert, in the batches that are on record
        if self.batches:
            worlds = sum(batch.worlds for batch in self.batches)
            succeeded = sum(batch.succeeded for batch in self.batches)
            low, high = wilson_interval(succeeded, worlds)
            notes["seeds"] = f"{self.batches[0].seed} to {self.batches[-1].seed}"
            metrics |= {
                "worlds_played": worlds,
                "succeeded": succeeded,
                "success_rate": succeeded / worlds,
                "success_rate_low95": low,
                "success_rate_high95": high,
                "retries": sum(batch.retries for batch in self.batches),
            }
            share = f"{succeeded:,} of {worlds:,} worlds ({100.0 * succeeded / worlds:.4g} %)"
            driver = "expert" if self._context.phases else "policy"
            reasons.append(f"the {driver} succeeded in {share}")
            broken = sum((Counter(batch.broken) for batch in self.batches), Counter())
            details += [f"{text}: {count} of {worlds} worlds" for text, count in broken.items()]
            details += [
                f"seed {batch.seed} is unfinished: {batch.keep - batch.kept} of its episodes are"
                " still to come"
                for batch in self.batches
                if batch.kept < batch.keep
            ]
        if unknown := self.committed - sum(batch.kept for batch in self.batches):
            metrics["episodes_without_note"] = unknown
            reasons.append(f"{unknown:,} episodes are of seeds that {FILE} does not have")

        # This call
        if new:
            metrics["episodes_per_s"] = new / seconds
            reasons.append(f"{new / seconds:.3g} episodes/s in all")
        elif self.committed >= asked:
            reasons.append("they were there already")
        return GateResult(
            name="collect",
            status=status,
            reason="; ".join(reasons),
            seconds=seconds,
            thresholds={"episodes": asked},
            metrics=metrics,
            notes=notes,
            details=details,
        )
