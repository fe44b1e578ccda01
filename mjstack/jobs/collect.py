"""Job *collect*: demonstrations of the expert as a dataset, batch by batch, until as many as asked
for are there.
"""

import json
import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np

from mjstack.config.schema import CollectJobCfg, Config
from mjstack.datasets import lerobot
from mjstack.datasets.part import ShardFiles
from mjstack.datasets.writer import DatasetWriter
from mjstack.envs import demonstration_config
from mjstack.episodes.batches import Batch, BatchPlan, play_batches
from mjstack.episodes.rollout import require_episode
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Stage
from mjstack.episodes.tally import rate_metrics
from mjstack.errors import RankError
from mjstack.files import write_atomic
from mjstack.jobs.collect_episodes import EpisodeSource, demonstration_channels
from mjstack.jobs.collect_plan import (
    BATCHES,
    DATASET,
    NAME,
    BatchRecord,
    CollectPlan,
    check_folder,
    plan_collection,
    read_batches,
)
from mjstack.jobs.gates import check_task
from mjstack.jobs.runner import CheckedJob, Job
from mjstack.report.figure import Figure, figures
from mjstack.report.record import GateResult, Status

_SPARE = 1.05  # worlds played over episodes that are missing: some fail
_MOST_EMPTY = 3  # batches in a row without an episode


def check_collect(cfg: Config) -> CheckedJob:
    """Raise for what cannot be done, before anything is written."""
    lerobot.require_pyarrow()
    require_episode(cfg)
    stage = Stage(cfg)
    check_task(stage)
    plan = plan_collection(stage)
    if stage.ranks.writes:  # it may have begun there when the others come
        check_folder(plan.home / DATASET, plan.spec)
    return CheckedJob(
        stage=stage,
        title=f"task {cfg.task.name}, {cfg.job.episodes:,} demonstrations",
        work=partial(run_collect, plan),
        folder=plan.home,
        resumes=NAME,
        spreads=True,
    )


def run_collect(plan: CollectPlan, run: Run, folder: Path) -> None:
    """Add the missing episodes to the dataset."""
    run.begin(NAME)
    ranks = run.stage.ranks
    collection = Collection(plan, run.stage)
    ranks.from_first(lambda: None)  # the dataset is open

    raised: BaseException | None = None
    try:
        problem = collection.play()
        status = Status.failed if problem else Status.passed
    except (Exception, KeyboardInterrupt) as error:
        raised = ranks.cause(error)
        if not isinstance(raised, KeyboardInterrupt | RankError):
            raise
        stopped = isinstance(raised, KeyboardInterrupt)
        status = Status.interrupted if stopped else Status.failed
        problem = "interrupted" if stopped else str(raised)
    if ranks.writes:
        if collection.committed:
            run.print_line(f"dataset: {collection.path}")
        run.record(collection.result(status, problem))
    if raised is not None:
        raise raised


class Collection:
    """A dataset, and the batches of worlds that add to it.

    A batch is one seed in as many worlds as are needed and fit; the next batch has the next seed,
    in later calls too. So a pair of seed and world is one episode for any nworld.

    A batch is in the dataset as a whole or not at all: its episodes go into hidden files, which are
    committed at once. Its record is written beside the dataset before that; a later call drops the
    record of a batch that was not committed, and plays its seed again.

    Several ranks share a batch's worlds. Each writes the episodes of its worlds into separate
    files. The episodes are those that one rank adds, in the same order.

    Attributes:
        path: The dataset.
        batches: All that were played, in earlier calls too; of rank 0.
        writer: Of the dataset, of rank 0.
    """

    writer: DatasetWriter

    def __init__(self, plan: CollectPlan, stage: Stage) -> None:
        """Open the dataset of a plan; raises as `DatasetWriter` does."""
        self._began = time.perf_counter()
        self._stage = stage
        self._plan = plan
        self._job: CollectJobCfg = stage.cfg.job
        self._record_path = plan.home / BATCHES
        self.path = plan.home / DATASET
        self._source = EpisodeSource(stage, plan.spec, self.path)
        self.batches: list[BatchRecord] = []
        self._batches_before = 0
        if not stage.ranks.writes:
            return
        if not (self.path / lerobot.INFO).exists():
            self._record_path.unlink(missing_ok=True)  # of a dataset that was removed
        self.writer = DatasetWriter(self.path, plan.spec)
        self._episodes_before = self.committed
        # Those that are in the dataset, or brought no episode
        episodes = Counter(seed for seed, _ in self.writer.committed)
        for batch in read_batches(self._record_path):
            if not batch.episodes or episodes[batch.seed]:
                batch.episodes = episodes[batch.seed]
                self.batches.append(batch)
        self._batches_before = len(self.batches)

    @property
    def committed(self) -> int:
        """Number of episodes of the dataset."""
        return len(self.writer.committed)

    def play(self) -> str:
        """Play and write until the episodes are there; what was committed is kept.

        Returns:
            Why that cannot be done; empty if it is done.

        Raises:
            FolderError: The dataset cannot be written any further.
            OSError: The record of the batches cannot be written.
        """
        stage = self._stage
        cfg = demonstration_config(stage.cfg, stage.action)
        batches = play_batches(stage, self._batch_plans(), demonstration_channels(stage), cfg=cfg)
        writer = self.writer if stage.ranks.writes else nullcontext()
        with closing(self._source), writer, closing(batches):
            for batch in batches:
                self._add(batch)
        return self._problem()

    def _problem(self) -> str:
        """Why the last seeds of this call brought no episode; empty if they did."""
        last = self.batches[self._batches_before :][-_MOST_EMPTY:]
        if len(last) < _MOST_EMPTY or any(batch.episodes for batch in last):
            return ""
        rules = [
            f"{text} in {count} of {last[-1].worlds}" for text, count in last[-1].broken.items()
        ]
        return (
            f"{_MOST_EMPTY} seeds in a row brought no episode, the last because of:"
            f" {'; '.join(rules)} worlds"
        )

    def _batch_plans(self) -> Iterator[BatchPlan]:
        """This rank's worlds of the batches, as long as episodes are missing."""
        ranks = self._stage.ranks
        while (plan := ranks.from_first(self._next_plan)) is not None:
            yield BatchPlan(plan.seed, ranks.share(len(plan.worlds)))

    def _next_plan(self) -> BatchPlan | None:
        """The worlds of the next seed; None if enough episodes are there, or none is to come."""
        missing = self._job.episodes - self.committed
        if missing <= 0 or self._problem():
            return None
        seeds = [seed for seed, _ in self.writer.committed] + [b.seed for b in self.batches]
        seed = max([self._stage.cfg.seed - 1, *seeds]) + 1
        spare = 1.0 if self._job.keep_failures else _SPARE
        count = min(self._plan.most, math.ceil(spare * missing))
        return BatchPlan(seed, range(max(self._stage.ranks.size, count)))

    def _add(self, batch: Batch) -> None:
        """Add a batch's episodes to the dataset."""
        ranks = self._stage.ranks
        finite = batch.finite().cpu().numpy()
        outcomes = ranks.gather((batch.episode.failed, finite, int(batch.episode.retries.sum())))
        chosen, *counts = ranks.from_first(partial(self._choose, batch.plan.seed, outcomes))
        with self.writer.guarded() if ranks.writes else nullcontext():
            files = ranks.gather(self._source.write(batch, chosen, *counts))
        ranks.from_first(partial(self._commit, [file for group in files for file in group]))

    def _choose(
        self, seed: int, outcomes: Sequence[tuple[np.ndarray, np.ndarray, int]]
    ) -> tuple[list[int], int, int]:
        """Record a batch, and choose the worlds whose episodes are kept.

        Returns:
            These worlds, and the numbers of the next episode and of the next frame of the dataset.
        """
        failed = np.concatenate([bits for bits, _, _ in outcomes])
        finite = np.concatenate([flags for _, flags, _ in outcomes])
        candidates = (failed == 0) | self._job.keep_failures
        missing = self._job.episodes - self.committed
        chosen = np.flatnonzero(candidates & finite)[:missing].tolist()
        rules = self._stage.check.rules
        broken = {rules.texts[n]: len(worlds) for n, worlds in rules.failing(failed).items()}
        if lost := int((candidates & ~finite).sum()):
            broken["a number that is not finite"] = lost
        record = BatchRecord(
            seed=seed,
            worlds=len(failed),
            succeeded=int((failed == 0).sum()),
            episodes=len(chosen),
            retries=sum(retries for _, _, retries in outcomes),
            broken=broken,
        )
        self.batches.append(record)
        records = [asdict(batch) for batch in self.batches]
        write_atomic(self._record_path, json.dumps(records, indent=1) + "\n")
        return chosen, self.committed, self.writer.frames

    def _commit(self, files: Sequence[ShardFiles]) -> None:
        """Commit the files of all ranks, and print what the batch has brought."""
        self.writer.commit(files)
        batch = self.batches[-1]
        self._stage.progress.print_line(
            f"collect, seed {batch.seed}: {batch.succeeded} of {batch.worlds} worlds succeeded,"
            f" {self.committed} of {self._job.episodes} episodes there"
        )

    def result(self, status: Status, problem: str) -> GateResult:
        """The dataset and the expert's success as a result, with why it did not pass."""
        seconds = time.perf_counter() - self._began
        new = self.committed - self._episodes_before
        size = sum(path.stat().st_size for path in self.path.rglob("*") if path.is_file()) / 1e6
        result = GateResult(
            name=NAME,
            status=status,
            seconds=seconds,
            figures=[
                Figure("episodes", self.committed, low=self._job.episodes, limit="episodes"),
                *figures(episodes_of_this_call=new, steps=self.writer.frames, megabytes=size),
            ],
            notes={"dataset": str(self.path), "config_sha256": self._plan.spec.config_sha256},
        )
        asked = f"{self.committed:,} episodes, {self._job.episodes:,} asked for"
        reasons = [problem, f"{asked} ({self.writer.frames:,} steps, {size:.1f} MB)"]

        if self.batches:
            result.notes["seeds"] = f"{self.batches[0].seed} to {self.batches[-1].seed}"
            worlds = sum(batch.worlds for batch in self.batches)
            succeeded = sum(batch.succeeded for batch in self.batches)
            result.figures += figures(
                worlds_played=worlds,
                **rate_metrics(succeeded, worlds),
                retries=sum(batch.retries for batch in self.batches),
            )
            driver = self._stage.driver_class.noun
            share = f"{succeeded:,} of {worlds:,} worlds ({100.0 * succeeded / worlds:.4g} %)"
            reasons.append(f"the {driver} succeeded in {share}")
            broken = sum((Counter(batch.broken) for batch in self.batches), Counter())
            result.details = [f"{text}: {n} of {worlds} worlds" for text, n in broken.items()]

        # This call
        if new:
            result.figures.append(Figure("episodes", new / seconds, "/s"))
            if self._plan.spec.videos:
                result.figures += [
                    Figure("drawing", self._source.drawing, "s"),
                    Figure("encoding_wait", self.writer.waited, "s"),
                ]
            reasons.append(f"{new / seconds:.3g} episodes/s in all")
        elif self.committed >= self._job.episodes:
            reasons.append("they were there already")
        result.reason = "; ".join(filter(None, reasons))
        return result


JOB = Job(check_collect)
