"""Adds episodes to a dataset, shard by shard: a kill or a full disk loses no episode that it has
committed.
"""

import contextlib
import io
import itertools
import json
import os
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.datasets import lerobot, reader, tables
from mjstack.datasets.part import Part, PartWriter
from mjstack.datasets.spec import DatasetSpec, EpisodeData, typed_episode
from mjstack.datasets.statistics import (
    RunningStatistics,
    by_name,
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
        self._statistics: dict[str, RunningStatistics] = {}  # of the committed frames
        self._pixels: dict[str, np.ndarray] = {}  # of those of their images that are sampled
        self._sampled = 0
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
        checked = [typed_episode(self.spec, episode) for episode in episodes]
        for episode, (facts, columns) in zip(episodes, checked, strict=True):
            with self.guarded():
                if self._part is None:
                    self._part = PartWriter(self.folder, self.spec, f"{self._shards:06d}")
                rows = self._part.part.rows
                number = len(self.committed) + len(rows)
                start = rows[-1]["dataset_to_index"] if rows else self.frames
                task = self.number_task(episode.task)
                self._part.write(episode, task, facts, columns, number, start)
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
        finally:
            self._open = False
            self._unlock()

    def _resume(self) -> None:
        """Count what is committed, and clear away what is not."""
        stored = reader.read_begun(self.folder, self.spec)
        if stored is not None:
            self._tasks = {task: index for index, task in enumerate(stored.tasks)}
            self._provenance = stored.info["mjstack"]["provenance"]
            for shard, rows in itertools.groupby(stored.episodes, lerobot.shard_of):
                self._count(shard, rows, stored.pixels(shard))
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
        self._write_totals()

    def _commit(self, parts: Sequence[Part]) -> None:
        """Put the frames to their places, then what says what is in them, and info.json last."""
        for shard, part in enumerate(parts, self._shards):
            moves = {lerobot.shard_path(self.folder, lerobot.DATA, shard): part.path}
            for name, hidden in part.videos.items():
                moves[lerobot.shard_path(self.folder, lerobot.VIDEO, shard, name)] = hidden
            for path, hidden in moves.items():
                path.parent.mkdir(parents=True, exist_ok=True)
                os.replace(hidden, path)
            files = ["data", "meta/episodes", *(f"videos/{name}" for name in part.videos)]
            for row in part.rows:
                for name, index in lerobot.shard_indices(shard).items():
                    row |= {f"{file}/{name}": index for file in files}
            self.waited += part.waited
        self._write_table(lerobot.tasks_table(list(self._tasks)), self.folder / lerobot.TASKS)
        for shard, part in enumerate(parts, self._shards):
            pixels = {name: counts.tolist() for name, counts in part.pixels.items()}
            rows = self._pa.Table.from_pylist(part.rows)
            rows = rows.replace_schema_metadata({lerobot.PIXELS: json.dumps(pixels)})
            self._write_table(rows, lerobot.shard_path(self.folder, lerobot.EPISODES, shard))
            self._count(shard, part.rows, part.pixels)
        self._shards += len(parts)
        self._write_totals()

    def _write_table(self, table: Any, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        buffer = io.BytesIO()
        self._parquet.write_table(table, buffer)
        write_atomic(path, buffer.getvalue())

    def _count(
        self, shard: int, rows: Iterable[dict[str, Any]], pixels: Mapping[str, np.ndarray]
    ) -> None:
        """Count a shard, by its frames, its episodes' rows and the pixels of its videos."""
        path = lerobot.shard_path(self.folder, lerobot.DATA, shard)
        columns = lerobot.columns_of(self.spec)
        with tables.readable(path):
            frames = tables.read_columns(path, lerobot.make_info(self.spec), columns)
        for name, (_, dim) in columns.items():
            self._statistics.setdefault(name, RunningStatistics(dim)).add(frames[name])
        for name, counts in pixels.items():
            self._pixels[name] = self._pixels.get(name, 0) + counts
        for row in rows:
            self.frames += row["length"]
            self._sampled += len(sampled_frames(row["length"]))
            self.committed.append((row["seed"], row["world"]))

    def _write_totals(self) -> None:
        """Write statistics, and last the file that says what counts."""
        (self.folder / "meta").mkdir(exist_ok=True)
        if self._shards:
            stats = {
                name: by_name(running.statistics(), running.count)
                for name, running in self._statistics.items()
            }
            for name, pixels in self._pixels.items():
                stats[name] = by_name(image_statistics(pixels), self._sampled, video=True)
            write_atomic(self.folder / lerobot.STATS, lerobot.to_json(stats))
        info = lerobot.make_info(
            self.spec,
            provenance=self._provenance,
            episodes=len(self.committed),
            frames=self.frames,
            tasks=len(self._tasks),
            shards=self._shards,
        )
        write_atomic(self.folder / lerobot.INFO, lerobot.to_json(info))

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
            del self.committed[info["total_episodes"] :]
            self.frames = info["total_frames"]
            for path in reader.uncommitted(self.folder, info["mjstack"]["shards"]):
                path.unlink()
            if isinstance(error, OSError):
                raise self._unwritten(error) from error
            raise
