"""A dataset of demonstrations that grows: worlds are played in batches, their episodes committed,
until enough are there.
"""

import json
import math
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from typing import cast

import numpy as np

from mjstack.config.schema import CollectJobCfg
from mjstack.datasets import DatasetWriter, lerobot
from mjstack.datasets.part import FILE_MB, Part, PartWriter
from mjstack.datasets.spec import typed_episode
from mjstack.episodes.context import RunContext
from mjstack.files import write_atomic
from mjstack.jobs.collected import FILE, CollectedBatch, CollectPlan, describe_batches, read_batches
from mjstack.jobs.demonstration import STATE, Played, play_demonstrations
from mjstack.jobs.episode_source import EpisodeSource
from mjstack.report.record import GateResult, Status
from mjstack.sim import Simulation

DATASET = "dataset"  # within the job's folder
_SPARE = 1.05  # worlds played over episodes that are missing: some fail
_GIVE_UP = 3  # batches in a row without an episode


@dataclass(kw_only=True, slots=True)
class _Next:
    """The batch that is played next, as rank 0 tells the others; nothing is left to play if it has
    no worlds.
    """

    seed: int = 0
    worlds: int = 0
    problem: str = ""


class Collection:
    """A dataset, and the worlds that add to it.

    A batch is one seed in as many worlds as are needed and fit; the next batch has the next seed,
    in later calls too. So a pair of seed and world is one episode for any nworld.

    A batch's record is written beside the dataset before its first episode is added. If a call is
    stopped in between, the next one plays the whole batch again and adds the missing episodes.
    Committed ones do not change. On CUDA two plays of a world agree only nearly: the first play
    counts in the success rate, and every episode has the result of the play that recorded it.

    Several ranks share a batch's worlds. Each writes the episodes of its worlds into separate
    files, which rank 0 commits together. The episodes are those that one rank adds, in
    the same order.

    Images are drawn when a batch has been judged, and encoded while the next one is played. So its
    episodes are committed after that.

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
        self._source = EpisodeSource(context, plan.spec.config_sha256, plan.rank_most)
        self._writer: DatasetWriter | None = None
        if not context.ranks.writes:
            return
        if not (self.path / lerobot.INFO).exists():
            self._record_path.unlink(missing_ok=True)  # of a dataset that was removed
        self._writer = DatasetWriter(self.path, plan.spec, images_gib=self._job.buffer_gib)
        self._before = self.committed

    @property
    def writer(self) -> DatasetWriter:
        """The dataset's writer, of rank 0."""
        assert self._writer is not None
        return self._writer

    @property
    def committed(self) -> int:
        """Number of episodes of the dataset."""
        return len(self.writer.committed)

    def play(self) -> str:
        """Play and write until the episodes are there; what was committed is kept.

        Returns:
            Why that cannot be done; empty if it is done.

        Raises:
            UnwrittenError: The dataset cannot be written any further.
            OSError: The record of the batches cannot be written.
        """
        try:
            if self._writer is None:
                return self._play()
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
            self._source.close()

    def _play(self) -> str:
        ranks = self._context.ranks
        empty = 0
        while (then := ranks.from_first(partial(self._next, empty))).worlds:
            played = self._play_share(then)
            good = [each for one in played for each in self._usable(one)]
            bits = np.concatenate([one.failed for one in played]) if played else np.empty(0, int)
            retries = sum(int(one.retries.sum()) for one in played)
            every = ranks.gather((bits, retries, good))
            chosen = ranks.from_first(partial(self._choose, then, every))
            if ranks.size == 1:
                for one in played:
                    self._add(one, [world for world in chosen if world in one.worlds])
            else:
                place = ranks.from_first(self._place)
                parts = ranks.gather(self._write_parts(played, chosen, *place))
                ranks.from_first(partial(self._commit, parts))
            for one in played:
                one.drop()  # before the next batch takes as much memory
            empty = ranks.from_first(partial(self._tell, then, empty))
        return then.problem

    def _next(self, empty: int) -> _Next:
        """A batch that was begun, or the next seed."""
        added = self.writer.added
        wanted = self._job.episodes - len(added)
        if wanted <= 0:
            return _Next()
        if empty == _GIVE_UP:
            last = self.batches[-1]
            why = [f"{text} in {n} of {last.worlds}" for text, n in last.broken.items()]
            reason = f"{_GIVE_UP} seeds in a row brought no episode, the last because of: "
            return _Next(problem=f"{reason}{'; '.join(why)} worlds")
        begun = self._begun()
        if begun is not None:
            return _Next(seed=begun.seed, worlds=begun.worlds)
        seeds = [seed for seed, _ in added] + [b.seed for b in self.batches]
        seed = max([self._context.cfg.seed - 1, *seeds]) + 1
        spare = 1.0 if self._job.keep_failures else _SPARE
        return _Next(seed=seed, worlds=min(self._plan.most, math.ceil(spare * wanted)))

    def _begun(self) -> CollectedBatch | None:
        return next((batch for batch in self.batches if batch.kept < batch.keep), None)

    def _play_share(self, then: _Next) -> list[Played]:
        """Play this rank's worlds of a batch: in one go, unless the batch is of more ranks."""
        share = self._context.ranks.share(then.worlds)
        size = self._plan.rank_most
        out = []
        for first in range(share.start, share.stop, size):
            part = share[first - share.start : first - share.start + size]
            sim = self._worlds(len(part))
            played = play_demonstrations(self._context, sim, then.seed, part)
            if len(share) > size:  # the device has room for one
                played.to_host()
            out.append(played)
        return out

    def _usable(self, played: Played) -> list[tuple[int, bool]]:
        """Numbers of the worlds that succeeded, or all if failures are kept, and whether their
        numbers are finite.
        """
        good = np.flatnonzero((played.failed == 0) | self._job.keep_failures).tolist()
        return [(played.worlds[world], played.finite(world)) for world in good]

    def _choose(
        self, then: _Next, every: Sequence[tuple[np.ndarray, int, list[tuple[int, bool]]]]
    ) -> list[int]:
        """Record the batch, if it is new, and choose the worlds whose episodes are kept."""
        added = self.writer.added
        wanted = self._job.episodes - len(added)
        failed = np.concatenate([bits for bits, _, _ in every])
        good = [each for _, _, found in every for each in found]
        usable = [world for world, finite in good if finite]
        rules = self._context.check.rules
        failing = rules.failing(failed)
        broken = {rules.texts[name]: len(worlds) for name, worlds in failing.items()}
        if lost := len(good) - len(usable):
            broken["a number that is not finite"] = lost
        self._succeeded = int((failed == 0).sum())
        batch = self._begun()
        if batch is None:
            batch = CollectedBatch(
                seed=then.seed,
                worlds=len(failed),
                keep=min(len(usable), wanted),
                succeeded=self._succeeded,
                retries=sum(retries for _, retries, _ in every),
                broken=broken,
            )
            self.batches.append(batch)
            self._record()
        else:
            there = {world for other, world in added if other == then.seed}
            usable = [world for world in usable if world not in there]
            batch.keep = min(batch.keep, batch.kept + len(usable))
        return usable[: min(batch.keep - batch.kept, wanted)]

    def _add(self, played: Played, worlds: list[int]) -> None:
        """Add the episodes of some worlds, and record it. They are committed, but for images that
        are still encoded.
        """
        if self._plan.spec.videos:
            self.writer.flush()  # the batch before
        for count, data in enumerate(self._source.episodes(played, worlds), 1):
            self.writer.add([data])
            self._context.advance(f"episodes of seed {played.seed}", count, len(worlds))
        if not self._plan.spec.videos:
            self.writer.flush()
        self._record()

    def _place(self) -> tuple[int, int, int]:
        """Number of the next episode and of the next frame of the dataset, and of the task."""
        task = self._context.cfg.task
        return (
            self.committed,
            self.writer.frames,
            self.writer.number_task(task.instruction or task.name),
        )

    def _write_parts(
        self, played: Sequence[Played], chosen: list[int], episode: int, frame: int, task: int
    ) -> list[Part]:
        """Write this rank's episodes of those that are chosen into files."""
        parts: list[Part] = []
        before = {world: count for count, world in enumerate(chosen)}
        name = f"rank{self._context.ranks.rank:04d}"
        writer: PartWriter | None = None
        try:
            for one in played:
                mine = [world for world in one.worlds if world in before]
                for world, data in zip(mine, self._source.episodes(one, mine), strict=True):
                    if writer is None:
                        number = f"{name}-{len(parts)}"
                        room = self._job.buffer_gib
                        writer = PartWriter(self.path, self._plan.spec, number, images_gib=room)
                    writer.write(
                        data,
                        task,
                        *typed_episode(self._plan.spec, data),
                        episode + before[world],
                        frame + before[world] * len(data.arrays[STATE]),
                    )
                    if writer.is_full(FILE_MB):
                        parts.append(writer.complete())
                        writer = None
                    self._context.advance(f"episodes of seed {one.seed}", len(parts), len(mine))
            return [*parts, writer.complete()] if writer is not None else parts
        except BaseException:
            if writer is not None:
                writer.abandon()
            raise

    def _commit(self, parts: Sequence[Sequence[Part]]) -> None:
        """Commit the files of all ranks, in their order, and record it."""
        if files := [part for some in parts for part in some]:
            self.writer.commit(files)
        self._record()

    def _tell(self, then: _Next, empty: int) -> int:
        """Print what a batch has brought; return how many in a row have brought nothing."""
        batch = next(batch for batch in self.batches if batch.seed == then.seed)
        self._context.print_line(
            f"collect, seed {then.seed}: {self._succeeded} of {then.worlds} worlds succeeded,"
            f" {len(self.writer.added)} of {self._job.episodes} episodes there"
        )
        return 0 if batch.kept else empty + 1

    def _count_kept(self) -> None:
        counts = Counter(seed for seed, _ in self.writer.added)
        for batch in self.batches:
            batch.kept = counts[batch.seed]

    def _record(self) -> None:
        """Write the record of all batches."""
        self._count_kept()
        records = [asdict(batch) for batch in self.batches]
        write_atomic(self._record_path, json.dumps(records, indent=1) + "\n")

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
        steps = self.writer.frames
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
        details: list[str] = []

        if self.batches:
            notes["seeds"] = f"{self.batches[0].seed} to {self.batches[-1].seed}"
            driver = "expert" if self._context.phases else "policy"
            reason, found, details = describe_batches(self.batches, driver)
            reasons.append(reason)
            metrics |= found
        if unknown := self.committed - sum(batch.kept for batch in self.batches):
            metrics["episodes_without_note"] = unknown
            reasons.append(f"{unknown:,} episodes are of seeds that {FILE} does not have")

        # This call
        if new:
            metrics["episodes_per_s"] = new / seconds
            if self._plan.spec.videos:
                metrics["drawing_s"] = self._source.drawing
                metrics["encoding_wait_s"] = self.writer.waited
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
