"""Adds episodes to a dataset, shard by shard: a kill or a full disk loses no episode that it has
committed.
"""

import contextlib
import io
import json
import os
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.datasets import lerobot, reader, tables
from mjstack.datasets.part import Part, PartWriter
from mjstack.datasets.reader import StoredDataset
from mjstack.datasets.spec import DatasetSpec, EpisodeData, typed_episode
from mjstack.datasets.statistics import (
    by_name,
    count_pixels,
    frame_statistics,
    image_statistics,
    sampled_frames,
)
from mjstack.errors import FolderError
from mjstack.files import lock_folder, write_atomic


class DatasetWriter:
    """Writes a new dataset, or goes on with one that the same configuration has begun.

    `add` writes episodes into a hidden file, one after the other, and keeps none of their frames;
    `flush` commits what was added. info.json is the last file to change in a commit and says how
    many files count: a kill or a Ctrl-C before it costs the episodes since the last commit, and the
    next writer clears away what they left. One writer has a dataset at a time.

    Images are encoded beside what goes on after `add`; `flush` waits for them.

        with DatasetWriter(folder, spec) as writer:
            for seed in seeds:
                writer.add(play(seed))
                writer.flush()

    Attributes:
        folder: The dataset.
        spec: Its columns and provenance.
        committed: Seed and world of every committed episode, in order.
        frames: Committed frames.
        waited: Time for which commits have waited for images to be encoded [s].
    """

    def __init__(self, folder: Path | str, spec: DatasetSpec) -> None:
        """Open the folder, and begin a dataset in it if there is none.

        Args:
            folder: The dataset's own folder.
            spec: Its columns and provenance.

        Raises:
            FolderError: Something else is there, or a dataset of another configuration; another
                process is writing it; or it cannot be written.
        """
        self._pa, self._parquet = lerobot.require_pyarrow()
        self.folder = Path(folder)
        self.spec = spec
        self.committed: list[tuple[int, int]] = []
        self.frames = 0
        self.waited = 0.0
        self._open = True
        self._shards = 0
        self._provenance: list[dict[str, Any]] = []
        self._tasks: dict[str, int] = {}
        self._described = 0  # frames that the statistics are of
        self._pixels = {name: np.zeros((3, 256), np.int64) for name in spec.videos}
        self._sampled = 0  # frames whose pixels are counted
        self._left_out: list[str] = []  # columns that an earlier version has not begun
        self._part: PartWriter | None = None  # since the last commit
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._unlock = weakref.finalize(self, os.close, lock_folder(self.folder))
            self._resume()
        except OSError as error:
            raise self._unwritten(error) from error

    def _unwritten(self, error: OSError) -> FolderError:
        """The error of a dataset that cannot be written any further, such as on a full disk."""
        return FolderError(
            f"{self.folder}: cannot be written ({error.strerror or error}): {len(self.committed)}"
            " committed episodes are kept, those added since are not. Make room or correct it, and"
            " do the same again: it goes on after the last one kept."
        )

    def __enter__(self) -> "DatasetWriter":
        return self

    def __exit__(self, *error: object) -> None:
        """Commit what was added, also after an error: those episodes are finished."""
        self.close()

    def add(self, episodes: Sequence[EpisodeData]) -> None:
        """Add finished episodes; a batch that does not fit is refused as a whole.

        Args:
            episodes: One or many; all of them are checked before the first is written.

        Raises:
            FolderError: An episode does not fit the spec, or has a number that is not finite.
            FolderError: It cannot be written; the writer is closed, and what was committed is
                kept.
        """
        for episode in episodes:
            typed_episode(self.spec, episode)
        for episode in episodes:
            with self.guarded():
                if self._part is None:
                    self._part = PartWriter(self.folder, self.spec, f"{self._shards:06d}")
                rows = self._part.part.rows
                number = len(self.committed) + len(rows)
                start = self.frames + sum(row["length"] for row in rows)
                task = self.number_task(episode.task)
                self._part.write(episode, task, number, start)
            if self._part.is_full():
                self.flush()

    def flush(self, parts: Sequence[Part] = ()) -> None:
        """Commit what was added.

        Args:
            parts: Files that other writers have completed, whose episodes follow those and one
                another.

        Raises:
            FolderError: It cannot be written; the writer is closed, and what was committed
                before is kept.
        """
        with self.guarded():
            if self._part is not None:
                parts = [self._part.complete(), *parts]
                self._part = None
            if parts:
                self._commit(parts)

    def number_task(self, task: str) -> int:
        """The number of a task in the dataset; a new one gets the next."""
        return self._tasks.setdefault(task, len(self._tasks))

    def close(self) -> None:
        """Commit what was added, and let another writer in."""
        try:
            if self._open:
                self.flush()
                with self.guarded():
                    self._write_statistics()
        finally:
            self._open = False
            self._unlock()

    def _resume(self) -> None:
        """Count what is committed, and clear away what is not."""
        stored = reader.read_begun(self.folder, self.spec)
        if stored is not None:
            self._tasks = {task: index for index, task in enumerate(stored.tasks)}
            self._provenance = stored.info["mjstack"]["provenance"]
            for row in stored.episodes:
                self._count(row, stored)
            pixels = [f"{lerobot.PIXELS}/{name}" for name in self.spec.videos]
            self._left_out = [n for n in pixels if any(n not in row for row in stored.episodes)]
            self._shards = stored.info["mjstack"]["shards"]
        for path in reader.uncommitted(self.folder, self._shards):
            path.unlink()
        # Where the last writer and this one differ, such as in a version, both are on record.
        count = len(self.committed)
        self._provenance = [p for p in self._provenance if p["from_episode"] < count]
        now = json.loads(json.dumps(dict(self.spec.provenance)))
        *_, last = [{"from_episode": 0}, *self._provenance]
        if last != {"from_episode": last["from_episode"], **now}:
            self._provenance.append({"from_episode": count, **now})
        (self.folder / "meta").mkdir(exist_ok=True)
        write_atomic(self.folder / lerobot.INFO, lerobot.to_json(self._make_info()))

    def _commit(self, parts: Sequence[Part]) -> None:
        """Put the frames to their places, then what says what is in them, and info.json last."""
        self._write_table(lerobot.tasks_table(list(self._tasks)), self.folder / lerobot.TASKS)
        for shard, part in enumerate(parts, self._shards):
            moves = {lerobot.shard_path(self.folder, lerobot.DATA, shard): part.path}
            for name, hidden in part.videos.items():
                moves[lerobot.shard_path(self.folder, lerobot.VIDEO, shard, name)] = hidden
            for path, hidden in moves.items():
                path.parent.mkdir(parents=True, exist_ok=True)
                os.replace(hidden, path)
            self.waited += part.waited
            first = self.frames
            for number, row in enumerate(part.rows, len(self.committed)):
                end = self.frames + row["length"]
                row |= lerobot.episode_columns(
                    self.spec.videos, self.spec.fps, shard, number, first, self.frames, end
                )
                self._count(row)
            rows = self._pa.Table.from_pylist(part.rows).drop_columns(self._left_out)
            self._write_table(rows, lerobot.shard_path(self.folder, lerobot.EPISODES, shard))
        self._shards += len(parts)
        if self.frames > 2 * self._described:  # all frames are read: not in every commit
            self._write_statistics()
        write_atomic(self.folder / lerobot.INFO, lerobot.to_json(self._make_info()))

    def _write_table(self, table: Any, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        buffer = io.BytesIO()
        self._parquet.write_table(table, buffer)
        write_atomic(path, buffer.getvalue())

    def _count(self, row: dict[str, Any], stored: StoredDataset | None = None) -> None:
        """Count an episode by its row. Where that has no counts of pixels, as an earlier version
        left none, they are of the images of ``stored``.
        """
        sampled = sampled_frames(row["length"])
        for name, counts in self._pixels.items():
            column = f"{lerobot.PIXELS}/{name}"
            if stored is None or column in row:
                counts += row[column].reshape(counts.shape)
            else:
                counts += count_pixels(stored.images(name, row["episode_index"])[sampled])
        self.frames += row["length"]
        self._sampled += len(sampled)
        self.committed.append((row["seed"], row["world"]))

    def _write_statistics(self) -> None:
        """Write statistics of all frames that are committed."""
        if not self.committed:
            return
        info = self._make_info()
        stored = StoredDataset(folder=self.folder, info=info, tasks=[], episodes=[])
        stats = {}
        for name in lerobot.numeric_columns(info):
            # Number by number: all of them in float64 may not fit into memory
            columns = [frame_statistics(values[:, None]) for values in stored.frames(name).T]
            stats[name] = by_name(np.concatenate(columns, axis=1), self.frames)
        for name, pixels in self._pixels.items():
            stats[name] = by_name(image_statistics(pixels), self._sampled, video=True)
        write_atomic(self.folder / lerobot.STATS, lerobot.to_json(stats))
        self._described = self.frames

    def _make_info(self) -> dict[str, Any]:
        return lerobot.make_info(
            self.spec,
            provenance=self._provenance,
            episodes=len(self.committed),
            frames=self.frames,
            tasks=len(self._tasks),
            shards=self._shards,
        )

    @contextlib.contextmanager
    def guarded(self) -> Iterator[None]:
        """If something goes wrong, close the writer and remove what is not committed.

        Raises:
            FolderError: The writer is closed, or something cannot be written.
        """
        if not self._open:
            problem = f"{self.folder}: the writer is closed, expected an open one"
            raise FolderError(problem, "Make another, which goes on")
        try:
            yield
        except BaseException as error:
            self._open = False
            if self._part is not None:
                self._part.abandon()
                self._part = None
            info = tables.read_info(self.folder)
            if info["total_frames"] == self.frames > self._described:  # not amid a commit
                with contextlib.suppress(OSError):
                    self._write_statistics()
            del self.committed[info["total_episodes"] :]
            self.frames = info["total_frames"]
            for path in reader.uncommitted(self.folder, info["mjstack"]["shards"]):
                path.unlink()
            if isinstance(error, OSError):
                raise self._unwritten(error) from error
            raise
