"""A dataset of demonstrations that grows: worlds are played in batches, their episodes committed,
until enough are there.
"""

from __future__ import annotations

import json
import math
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch

from mjstack.config.schema import CollectJobCfg
from mjstack.datasets import DatasetSpec, DatasetWriter, EpisodeData, lerobot
from mjstack.envs import Env
from mjstack.episodes.context import RunContext
from mjstack.errors import UnwrittenError
from mjstack.files import write_atomic
from mjstack.jobs.collect_record import (
    FILE,
    CollectedBatch,
    count_kept,
    read_batches,
    write_batches,
)
from mjstack.jobs.demonstration import (
    ACTION,
    STATE,
    Played,
    column_widths,
    most_worlds,
    play_demonstrations,
    steps_block,
)
from mjstack.jobs.demonstration_spec import make_spec
from mjstack.jobs.runner import run_provenance
from mjstack.math import wilson_interval
from mjstack.report.collect import ColumnRange, to_markdown
from mjstack.report.record import GateResult, Status
from mjstack.scene.phases import build_phases
from mjstack.sim import Simulation

DATASET = "dataset"  # within the job's folder
_SPARE = 1.05  # worlds played over episodes that are missing: some fail
_GIVE_UP = 3  # batches in a row without an episode


@dataclass(frozen=True, kw_only=True, slots=True)
class CollectPlan:
    """A dataset to be collected.

    Attributes:
        context: Configuration, scene and plan.
        home: The job's folder.
        spec: The dataset's columns and provenance.
        most: Largest number of worlds of a batch.
        dim: Numbers in a step.
    """

    context: RunContext
    home: Path
    spec: DatasetSpec
    most: int
    dim: int

    @classmethod
    def of(cls, context: RunContext, home: Path, env: Env) -> CollectPlan:
        """Plan from an environment of the demonstrations, with any number of worlds.

        Raises:
            ConfigError: The steps of not even one world fit into the buffer, or a column's name is
                taken.
        """
        provenance = run_provenance(context.cfg, context)
        # They differ between calls that make the same episodes.
        del provenance["date"], provenance["config_sha256"]
        return cls(
            context=context,
            home=home,
            spec=make_spec(env, context.cfg, provenance),
            most=most_worlds(context.cfg, env),
            dim=sum(column_widths(env).values()),
        )


class Collection:
    """A dataset, and the worlds that add to it.

    A batch is one seed in as many worlds as are needed and fit; the next batch has the next seed,
    in later calls too. So a pair of seed and world is one episode, whatever nworld was.

    A batch's record is written beside the dataset before its first episode is added. If a call is
    stopped in between, the next one plays the whole batch again and adds the missing episodes. What
    was committed stays as it is. On CUDA two plays of a world agree only nearly: the first play
    counts in the success rate, and every episode has the result of its own play.

    Attributes:
        home: The job's folder.
        path: The dataset.
        spec: Its columns and provenance.
        batches: All that were played, in earlier calls too; read by `play`.
        committed: Number of episodes of the dataset.
        steps: Number of their steps.
    """

    def __init__(self, plan: CollectPlan, context: RunContext) -> None:
        """Takes a plan and the run's context."""
        self._context = context
        self._cfg = context.cfg
        self._job = cast(CollectJobCfg, context.cfg.job)
        self._most = plan.most
        self._dim = plan.dim
        self.spec = plan.spec
        self.home = plan.home
        self.path = plan.home / DATASET
        self.batches: list[CollectedBatch] = []
        self.committed = 0
        self.steps = 0
        self._before = 0
        self._seconds = {"simulation": 0.0, "copy": 0.0, "writing": 0.0}  # of this call
        self._sim: Simulation | None = None
        self._block: torch.Tensor | None = None

    def play(self) -> str:
        """Play and write until the episodes are there.

        Returns:
            Why that cannot be done; empty if it is done.

        Raises:
            DatasetError: The folder has another dataset.
            UnwrittenError: The dataset cannot be written any further; what was committed is kept.
        """
        if not (self.path / lerobot.INFO).exists():
            (self.home / FILE).unlink(missing_ok=True)  # of a dataset that was removed
        writer = DatasetWriter(self.path, self.spec)
        self._count(writer)
        self._before = self.committed
        try:
            with writer:
                self.batches = read_batches(self.home, writer.committed)
                return self._play(writer)
        finally:
            self._count(writer)
            if self.batches:
                with suppress(UnwrittenError):  # the next call counts again
                    self._record(writer)
            self._close_worlds()

    def _play(self, writer: DatasetWriter) -> str:
        empty = 0
        while (wanted := self._job.episodes - len(writer.committed)) > 0:
            begun = next((batch for batch in self.batches if batch.kept < batch.keep), None)
            if begun is not None:
                seed = begun.seed
                worlds = begun.worlds
            else:
                seeds = [seed for seed, _ in writer.committed] + [b.seed for b in self.batches]
                seed = max([self._cfg.seed - 1, *seeds]) + 1
                spare = 1.0 if self._job.keep_failures else _SPARE
                worlds = min(self._most, math.ceil(spare * wanted))
            sim, block = self._worlds(worlds)
            played = play_demonstrations(self._context, sim, seed, block, worlds)
            self._seconds["simulation"] += played.seconds

            batch, usable = self._judge(played, wanted)
            done = f"{batch.succeeded} of {batch.worlds} worlds succeeded"
            if begun is None:
                self.batches.append(batch)
                self._record(writer)
            else:
                batch = begun
                done = f"{worlds} worlds played again"
                there = {world for other, world in writer.committed if other == seed}
                usable = [world for world in usable if world not in there]
                batch.keep = min(batch.keep, batch.kept + len(usable))
            self._add(writer, played, usable[: min(batch.keep - batch.kept, wanted)])
            self._count(writer)
            self._context.say(
                f"collect, seed {seed}: {done}, {self.committed} of {self._job.episodes} episodes"
                " there"
            )
            empty = 0 if batch.kept else empty + 1
            if empty == _GIVE_UP:
                counts = batch.broken | (
                    {"a number that is not finite": batch.not_finite} if batch.not_finite else {}
                )
                why = "; ".join(
                    f"{text} in {count} of {batch.worlds} worlds" for text, count in counts.items()
                )
                return f"{_GIVE_UP} seeds in a row brought no episode, the last because of: {why}"
        return ""

    def _judge(self, played: Played, wanted: int) -> tuple[CollectedBatch, list[int]]:
        """The record of a batch, and the worlds whose episodes can be kept."""
        rules = self._context.check.rules
        good = np.flatnonzero((played.failed == 0) | self._job.keep_failures).tolist()
        usable = [world for world in good if played.finite(world)]
        batch = CollectedBatch(
            seed=played.seed,
            worlds=len(played.failed),
            keep=min(len(usable), wanted),
            succeeded=int((played.failed == 0).sum()),
            not_finite=len(good) - len(usable),
            retries=int(played.retries.sum()),
            broken={
                rules.texts[name]: len(worlds)
                for name, worlds in rules.failing(played.failed).items()
            },
        )
        return batch, usable

    def _add(self, writer: DatasetWriter, played: Played, worlds: list[int]) -> None:
        """Commit the episodes of some worlds, and record it."""
        began = time.perf_counter()
        for count, (world, arrays) in enumerate(played.episodes(worlds), 1):
            copied = time.perf_counter()
            self._seconds["copy"] += copied - began
            writer.add([self._episode(played, world, arrays)])
            self._context.tell(f"episodes of seed {played.seed}", count, len(worlds))
            began = time.perf_counter()
            self._seconds["writing"] += began - copied
        writer.flush()
        self._seconds["writing"] += time.perf_counter() - began
        self._record(writer)

    def _record(self, writer: DatasetWriter) -> None:
        """Write the record of all batches."""
        count_kept(self.batches, writer.committed)
        try:
            write_batches(self.home, self.batches)
        except OSError as error:
            raise UnwrittenError(str(self.home / FILE), error, len(writer.committed)) from error

    def _episode(self, played: Played, world: int, arrays: dict[str, np.ndarray]) -> EpisodeData:
        """A world's steps and its result. `next.success` is true in the last step of a successful
        episode alone.
        """
        broken = self._context.check.rules.describe(int(played.failed[world]))
        last = np.arange(len(arrays[STATE])) == len(arrays[STATE]) - 1
        return EpisodeData(
            arrays={**arrays, "next.done": last, "next.success": last & (not broken)},
            task=self._cfg.task.instruction or self._cfg.task.name,
            success=not broken,
            seed=played.seed,
            world=world,
            values={
                "retries": int(played.retries[world]),
                "failed_rules": broken,
                "config_sha256": self.spec.config_sha256,
            },
        )

    def _worlds(self, n: int) -> tuple[Simulation, torch.Tensor]:
        """As many worlds as are asked for, with room for their steps.

        MJWarp's are kept where there are more than that: fewer are hardly faster, and new ones have
        to be set up.
        """
        sim = self._sim
        block = self._block
        if (
            sim is None
            or block is None
            or not (sim.nworld == n or (sim.backend == "mjwarp" and sim.nworld > n))
        ):
            self._close_worlds()
            sim = self._sim = self._context.batch_simulation(n)
            block = self._block = steps_block(sim, build_phases(self._cfg)[-1].stop, self._dim)
        return sim, block

    def _close_worlds(self) -> None:
        if self._sim is not None:
            self._sim.close()
        self._sim = self._block = None

    def _count(self, writer: DatasetWriter) -> None:
        self.committed = len(writer.committed)
        self.steps = writer.frames

    def result(self, status: Status, problem: str, seconds: float) -> GateResult:
        """What there is now, as a result of the report.

        Args:
            status: How it ended.
            problem: Why, where it did not pass.
            seconds: Wall time of this call [s].
        """
        asked = self._job.episodes
        new = self.committed - self._before
        size = sum(path.stat().st_size for path in self.path.rglob("*") if path.is_file()) / 1e6
        notes = {"dataset": str(self.path), "config_sha256": self.spec.config_sha256}
        metrics: dict[str, float] = {
            "episodes": self.committed,
            "episodes_of_this_call": new,
            "steps": self.steps,
            "megabytes": size,
        }
        reason = (
            f"{self.committed:,} episodes, {asked:,} asked for ({self.steps:,} steps,"
            f" {size:.1f} MB)"
        )
        details = []
        if self.batches:
            worlds, succeeded = (
                sum(getattr(batch, key) for batch in self.batches)
                for key in ("worlds", "succeeded")
            )
            rate, (low, high) = succeeded / worlds, wilson_interval(succeeded, worlds)
            seeds = [batch.seed for batch in self.batches]
            notes["seeds"] = f"{min(seeds)} to {max(seeds)}"
            metrics |= {
                "worlds_played": worlds,
                "succeeded": succeeded,
                "success_rate": rate,
                "success_rate_low95": low,
                "success_rate_high95": high,
                "retries": sum(batch.retries for batch in self.batches),
            }
            reason += (
                f"; the expert succeeded in {succeeded:,} of {worlds:,} worlds"
                f" ({100.0 * rate:.4g} %)"
            )
            broken: dict[str, int] = {}
            for batch in self.batches:
                for text, count in batch.broken.items():
                    broken[text] = broken.get(text, 0) + count
            details += [f"{text}: {count} of {worlds} worlds" for text, count in broken.items()]
            if lost := sum(batch.not_finite for batch in self.batches):
                details.append(
                    f"{lost} episodes with a number that is not finite are not in the dataset"
                )
            details += [
                f"seed {batch.seed} is unfinished: {batch.keep - batch.kept} of its episodes are"
                " still to come"
                for batch in self.batches
                if batch.kept < batch.keep
            ]
        if unknown := self.committed - sum(batch.kept for batch in self.batches):
            metrics["episodes_without_note"] = unknown
            reason += (
                f"; {unknown:,} episodes are of seeds that {FILE} does not have, and in no success"
                " rate"
            )
        if new:
            metrics |= {f"{name}_s": value for name, value in self._seconds.items()} | {
                "episodes_per_s": new / seconds
            }
            times = ", ".join(f"{name} {value:.1f} s" for name, value in self._seconds.items())
            reason += f"; {times}, {new / seconds:.3g} episodes/s in all"
        elif self.committed >= asked:
            reason += "; they were there already"
        return GateResult(
            name="collect",
            status=status,
            reason=f"{problem}; {reason}" if problem else reason,
            seconds=seconds,
            thresholds={"episodes": asked},
            metrics=metrics,
            notes=notes,
            details=details,
        )

    def write_table(self, folder: Path, result: GateResult) -> bool:
        """Writes dataset.md, and says whether there was anything to write of."""
        if not self.committed:
            return False
        statistics = json.loads((self.path / lerobot.STATS).read_text())
        ranges = [
            ColumnRange(name=f"{name} {joint}", unit=unit, low=low, mean=mean, high=high)
            for name in (STATE, ACTION)
            for joint, unit, low, mean, high in zip(
                self.spec.features[name].names,
                self.spec.features[name].units,
                *(statistics[name][key] for key in ("min", "mean", "max")),
                strict=True,
            )
        ]
        title = f"{self._cfg.robot.title}, task {self._cfg.task.name}: demonstrations"
        write_atomic(
            folder / "dataset.md",
            to_markdown(title, {**result.notes, **result.metrics}, ranges, str(self.path)),
        )
        return True
