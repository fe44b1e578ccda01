"""A dataset of demonstrations that grows: worlds are played in batches, their episodes committed,
until enough are there.
"""

from __future__ import annotations

import json
import math
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import torch

from mjstack.config.fingerprint import config_hash
from mjstack.config.schema import Backend, CollectJobCfg, Config
from mjstack.datasets import DatasetWriter, EpisodeData, lerobot
from mjstack.envs import Env, build_env, demonstration_config
from mjstack.episodes.context import RunContext
from mjstack.episodes.rollout import NOMINAL
from mjstack.errors import ConfigError, UnwrittenError
from mjstack.files import write_atomic
from mjstack.jobs.collect_record import FILE, CollectedBatch, read_batches, write_batches
from mjstack.jobs.demonstration import (
    ACTION,
    STATE,
    Played,
    column_widths,
    play_demonstrations,
    steps_block,
)
from mjstack.jobs.demonstration_spec import episode_config, make_spec
from mjstack.jobs.runner import run_provenance
from mjstack.math import wilson_interval
from mjstack.report.collect import ColumnRange, to_markdown
from mjstack.report.record import GateResult, Status
from mjstack.scene.phases import build_phases
from mjstack.sim import Simulation

DATASET = "dataset"  # within the job's folder
_SPARE = 1.05  # worlds played over episodes that are missing: some fail
_GIVE_UP = 3  # batches in a row without an episode
_SEEDS = 1 << 32


class Collection:
    """A dataset, and what it takes to add to it.

    A batch is one seed in as many worlds as are needed and fit; the next batch has the next seed,
    in later calls too. So a pair of seed and world is one episode, whatever nworld was.

    A batch's results and what is to be kept of it are noted beside the dataset before the first
    episode is added. So whatever stops it in between, the next call finds what is missing and
    begins with it: those worlds of that seed are played again, as many at a time as nworld then
    allows, and added in order. What was committed stays as it is. On CUDA two plays of a world
    agree only nearly: an episode that is judged otherwise than noted is left out, and the first
    result counts.

    Attributes:
        home: The job's folder.
        path: The dataset.
        spec: What it holds.
        batches: All that were played, in earlier calls too; read by `play`.
        committed: Episodes of the dataset.
        steps: Likewise.
    """

    def __init__(self, context: RunContext, home: Path) -> None:
        """Finds out what a step holds."""
        cfg = context.cfg
        self._context = context
        self._cfg = cfg
        self._job = cast(CollectJobCfg, cfg.job)
        shown = replace(
            demonstration_config(cfg), reset=NOMINAL
        )  # what a step holds, no start changes
        env = build_env(shown, nworld=1, model=context.model, backend=Backend.native, device="cpu")
        self._most = most_worlds(cfg, env)
        self._dim = sum(column_widths(env).values())
        provenance = run_provenance(cfg, context)
        del (
            provenance["date"],
            provenance["config_sha256"],
        )  # they differ between calls that make the same episodes
        self.spec = make_spec(env, cfg, provenance)
        env.close()
        self.home = home
        self.path = home / DATASET
        self.batches: list[CollectedBatch] = []
        self.committed = self.steps = self._before = 0
        self._seconds = {"simulation": 0.0, "copy": 0.0, "writing": 0.0}  # of this call
        self._sim: Simulation | None = None
        self._block: torch.Tensor | None = None

    def play(self) -> str:
        """Plays and writes until the episodes are there.

        Returns:
            What keeps it from that; empty if nothing does.

        Raises:
            DatasetError: The folder is somebody else's.
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
                    self._note(writer)
            self._close_worlds()

    def _play(self, writer: DatasetWriter) -> str:
        empty = 0
        while (wanted := self._job.episodes - len(writer.committed)) > 0:
            batch = next((batch for batch in self.batches if batch.missing), None)
            if batch is not None:
                seed = batch.seed
                worlds = list(batch.missing)[: min(self._most, wanted)]
                # In fewer of MJWarp's worlds a world could find less room in their common buffers
                # than it had.
                room = (
                    min(batch.worlds, self._most)
                    if self._context.backend[0] is Backend.mjwarp
                    else len(worlds)
                )
            else:
                seed = (
                    max(
                        [
                            self._cfg.seed - 1,
                            *(seed for seed, _ in writer.committed),
                            *(b.seed for b in self.batches),
                        ]
                    )
                    + 1
                )
                room = min(
                    self._most, wanted if self._job.keep_failures else math.ceil(_SPARE * wanted)
                )
                worlds = list(range(room))
            if seed >= _SEEDS:
                return (
                    f"the next seed would be {seed}, expected at most {_SEEDS - 1}: begin another"
                    " dataset with a smaller seed"
                )
            sim, block = self._worlds(room)
            played = play_demonstrations(self._context, sim, seed, block, worlds)
            if not self._unchanged():
                return (
                    f"the file of reset=starts_file changed while seed {seed} was played: restore"
                    " it, or begin another dataset"
                )
            done = f"{len(worlds)} worlds played again"
            if batch is None:
                batch = self._judge(played, wanted)
                self.batches.append(batch)
                done = f"{batch.succeeded} of {batch.worlds} worlds succeeded"
            self._spend(batch, "simulation", played.seconds)
            self._note(writer)
            self._add(writer, batch, played)
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

    def _unchanged(self) -> bool:
        """Whether a layout file still has the content that the dataset is of."""
        try:
            return config_hash(episode_config(self._cfg)) == self.spec.config_sha256
        except ConfigError:  # it cannot be read any more
            return False

    def _judge(self, played: Played, wanted: int) -> CollectedBatch:
        """What is to be noted of a seed that was played for the first time, with the episodes that
        are to be kept of it.
        """
        rules = self._context.check.rules
        keep_all = self._job.keep_failures
        good = (
            range(len(played.worlds)) if keep_all else np.flatnonzero(played.failed == 0).tolist()
        )
        keep = [place for place in good if played.finite(place)]
        return CollectedBatch(
            seed=played.seed,
            worlds=len(played.worlds),
            succeeded=int((played.failed == 0).sum()),
            missing={
                played.worlds[place]: rules.describe(int(played.failed[place]))
                for place in keep[:wanted]
            },
            not_finite=len(good) - len(keep),
            retries=int(played.retries.sum()),
            broken={
                rules.texts[name]: len(places)
                for name, places in rules.failing(played.failed).items()
            },
        )

    def _add(self, writer: DatasetWriter, batch: CollectedBatch, played: Played) -> None:
        """Commits the episodes of a batch that are missing, as far as they were played, and notes
        it.
        """
        places = [place for place, world in enumerate(played.worlds) if world in batch.missing]
        changed: list[int] = []
        began = time.perf_counter()
        for count, (place, arrays) in enumerate(played.episodes(places), 1):
            copied = time.perf_counter()
            self._spend(batch, "copy", copied - began)
            broken = self._context.check.rules.describe(int(played.failed[place]))
            if broken != batch.missing[played.worlds[place]] or not played.finite(place):
                changed.append(played.worlds[place])
            else:
                writer.add([self._episode(played, place, arrays, broken)])
            self._context.tell(f"episodes of seed {played.seed}", count, len(places))
            began = time.perf_counter()
            self._spend(batch, "writing", began - copied)
        writer.flush()
        self._spend(batch, "writing", time.perf_counter() - began)
        for world in changed:
            del batch.missing[world]
        batch.changed += len(changed)
        self._note(writer)

    def _spend(self, batch: CollectedBatch, name: str, seconds: float) -> None:
        """Counts time to a batch and to this call."""
        self._seconds[name] += seconds
        setattr(batch, f"{name}_s", getattr(batch, f"{name}_s") + seconds)

    def _note(self, writer: DatasetWriter) -> None:
        """Writes down what was played, and what of it is in the dataset."""
        for batch in self.batches:
            if batch.missing:
                batch.take_in(writer.committed)
        try:
            write_batches(self.home, self.batches)
        except OSError as error:
            raise UnwrittenError(str(self.home / FILE), error, len(writer.committed)) from error

    def _episode(
        self, played: Played, place: int, arrays: dict[str, np.ndarray], broken: str
    ) -> EpisodeData:
        """A world's steps and what is known of it. `next.success` is true in the last step of an
        succeeded episode alone.
        """
        last = np.arange(len(arrays[STATE])) == len(arrays[STATE]) - 1
        return EpisodeData(
            arrays={**arrays, "next.done": last, "next.success": last & (not broken)},
            task=self._cfg.task.instruction or self._cfg.task.name,
            success=not broken,
            seed=played.seed,
            world=played.worlds[place],
            values={
                "retries": int(played.retries[place]),
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
            if changed := sum(batch.changed for batch in self.batches):
                details.append(
                    f"{changed} episodes judged otherwise when they were played again are not in"
                    " the dataset"
                )
            details += [
                f"seed {batch.seed} is unfinished: {len(batch.missing)} of its episodes are still"
                " to come"
                for batch in self.batches
                if batch.missing
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


def most_worlds(cfg: Config, env: Env) -> int:
    """Worlds whose steps fit into the buffer, at most nworld.

    Args:
        cfg: The job's configuration.
        env: An environment of its demonstrations, with any number of worlds.

    Raises:
        ConfigError: Not even one world's do.
    """
    gib = cast(CollectJobCfg, cfg.job).buffer_gib
    world = 4.0 * build_phases(cfg)[-1].stop * sum(column_widths(env).values()) / 2**30
    if gib < world:
        raise ConfigError(
            "job.buffer_gib", gib, f"at least {world:.2g}, which the steps of one world take"
        )
    return min(cfg.nworld, int(gib / world))
