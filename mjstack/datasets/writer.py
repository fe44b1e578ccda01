"""Adds episodes to a dataset, shard by shard, so that whatever stops it loses no episode that it
has committed.
"""

from __future__ import annotations

import contextlib
import json
import os
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from mjstack.datasets import lerobot
from mjstack.datasets.arrow import require_pyarrow
from mjstack.datasets.resume import (
    check_same,
    lock_folder,
    read_info,
    read_shards,
    read_tasks,
    uncommitted,
)
from mjstack.datasets.shard import Shard
from mjstack.datasets.spec import DatasetSpec, EpisodeData, typed_arrays, typed_row
from mjstack.datasets.staging import Staging, interrupts_deferred
from mjstack.datasets.statistics import RunningStatistics
from mjstack.errors import ArgumentError, DatasetError, UnwrittenError


class DatasetWriter:
    """Writes a new dataset, or goes on with one that the same configuration has begun.

    `add` writes episodes into a hidden file, one after the other, and keeps none of their frames;
    `flush` commits what was added. info.json is the last file to change in a commit and says how
    many files count: a kill before it costs the episodes since the last commit, and the next writer
    clears away what they left. One writer has a dataset at a time.

        with DatasetWriter(folder, spec) as writer:
            for seed in seeds:
                writer.add(play(seed))
                writer.flush()

    Attributes:
        folder: The dataset.
        spec: What it holds.
        committed: Seed and world of every committed episode, in order.
        frames: Committed frames.
    """

    def __init__(self, folder: Path | str, spec: DatasetSpec, *, file_mb: int = 100) -> None:
        """Opens the folder, and begins a dataset in it if there is none.

        Args:
            folder: The dataset's own folder.
            spec: What it holds.
            file_mb: Size of a data file at which it is committed and the next one begins [MiB].

        Raises:
            DatasetError: Something else is there, or a dataset of another configuration, or another
                process is writing it.
            UnwrittenError: The folder cannot be written.
        """
        require_pyarrow()
        if file_mb < 1:
            raise ArgumentError("file_mb", file_mb, "at least 1 MiB")
        self.folder = Path(folder)
        self.spec = spec
        self.committed: list[tuple[int, int]] = []
        self.frames = 0
        self._file_mb = file_mb
        self._shards = 0
        self._open = True
        self._provenance: list[dict[str, Any]] = []
        self._tasks: dict[str, int] = {}
        self._tasks_committed = 0
        self._statistics = RunningStatistics(
            sum(dim for _, dim in lerobot.all_features(spec.features).values())
        )
        try:
            if self.folder.exists() and not self.folder.is_dir():
                raise DatasetError(f"{folder} is a file, expected a folder. Give another")
            self.folder.mkdir(parents=True, exist_ok=True)
            self._unlock = weakref.finalize(self, os.close, lock_folder(self.folder))
            self._resume()
        except OSError as error:
            raise UnwrittenError(str(folder), error, len(self.committed)) from error
        self._shard = self._next_shard()

    def __enter__(self) -> DatasetWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Commits what was added, also where something else went wrong: those episodes are
        finished.
        """
        self.close()

    @property
    def pending(self) -> int:
        """Episodes that were added and are not committed yet."""
        return len(self._shard)

    def add(self, episodes: Sequence[EpisodeData]) -> None:
        """Adds finished episodes; a batch that does not fit is refused as a whole.

        Args:
            episodes: One or many; all of them are checked before the first is written.

        Raises:
            DatasetError: An episode does not fit the spec, or has a number that is not finite.
            UnwrittenError: It cannot be written; the writer is closed, and what was committed is
                kept.
        """
        self._check_open()
        for episode in episodes:
            typed_row(self.spec, episode)
            typed_arrays(self.spec, episode)
        for episode in episodes:
            arrays = typed_arrays(self.spec, episode)
            with interrupts_deferred(), self._guarded():
                self._shard.add(
                    arrays, episode, self._tasks.setdefault(episode.task, len(self._tasks))
                )
            if (
                self._shard.size * (1.0 + 1.0 / self.pending) > self._file_mb * 2**20
            ):  # one more like these is too much
                self.flush()

    def flush(self) -> None:
        """Commits what was added.

        Raises:
            UnwrittenError: It cannot be written; the writer is closed, and what was committed
                before is kept.
        """
        self._check_open()
        if self.pending:
            with interrupts_deferred(), self._guarded():
                self._commit()

    def close(self) -> None:
        """Commits what was added, and lets another writer in."""
        try:
            if self._open:
                self.flush()
        finally:
            self._open = False
            self._unlock()

    def _resume(self) -> None:
        """Takes in what is committed, and clears away what is not."""
        info = read_info(self.folder)
        if info is not None:
            check_same(self.folder, info, self.spec)
            self._tasks = {task: index for index, task in enumerate(read_tasks(self.folder, info))}
            self._provenance = info["mjstack"]["provenance"]
            for shard in read_shards(self.folder, info, self.spec):
                self._take_in(shard.rows, shard.statistics)
        for path in uncommitted(self.folder, self._shards):
            path.unlink()
        # Where the last writer and this one differ, such as in a version, both are on record.
        while self._provenance and self._provenance[-1]["from_episode"] == len(self.committed):
            del self._provenance[-1]
        now = json.loads(json.dumps(dict(self.spec.provenance)))
        if not self._provenance or {**self._provenance[-1], "from_episode": 0} != {
            **now,
            "from_episode": 0,
        }:
            self._provenance.append({"from_episode": len(self.committed), **now})
        staging = Staging()
        try:
            self._stage_totals(staging)
            staging.commit()
        finally:
            staging.discard()

    def _next_shard(self) -> Shard:
        return Shard(self.folder, self.spec, self._shards, len(self.committed), self.frames)

    def _commit(self) -> None:
        shard = self._shard
        shard.finish(list(self._tasks) if len(self._tasks) > self._tasks_committed else None)
        self._take_in(shard.rows, shard.statistics)
        self._stage_totals(shard.staging)
        shard.staging.commit()
        self._shard = self._next_shard()

    def _take_in(
        self, rows: dict[str, list[Any]], statistics: Sequence[dict[str, np.ndarray]]
    ) -> None:
        """Counts a shard's episodes."""
        for length, episode in zip(rows["length"], statistics, strict=True):
            self._statistics.add(length, episode)
        self.frames += sum(rows["length"])
        self.committed += zip(rows["seed"], rows["world"], strict=True)
        self._tasks_committed = len(self._tasks)
        self._shards += 1

    def _stage_totals(self, staging: Staging) -> None:
        """Statistics, and last the file that says what counts."""
        if self.committed:
            staging.write(
                self.folder / lerobot.STATS,
                lerobot.stats_json(
                    self.spec.features, self._statistics.count, self._statistics.read()
                ),
            )
        info = lerobot.make_info(
            self.spec,
            provenance=self._provenance,
            file_mb=self._file_mb,
            episodes=len(self.committed),
            frames=self.frames,
            tasks=self._tasks_committed,
            shards=self._shards,
        )
        staging.write(self.folder / lerobot.INFO, lerobot.to_json(info))

    def _check_open(self) -> None:
        if not self._open:
            raise DatasetError(
                f"{self.folder}: the writer is closed, expected an open one. Make another, which"
                " goes on"
            )

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        """Closes the writer if something goes wrong in the middle of a file, and removes what was
        on its way.
        """
        kept = len(self.committed)
        frames = self.frames
        try:
            yield
        except BaseException as error:
            self._open = False
            self._shard.discard()
            del self.committed[kept:]
            self.frames, self._shard = frames, self._next_shard()
            if isinstance(error, OSError):
                raise UnwrittenError(str(self.folder), error, kept) from error
            raise
