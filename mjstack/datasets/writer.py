"""Adds episodes to a dataset, shard by shard: a kill or a full disk loses no episode that it has
committed.
"""

import contextlib
import io
import json
import os
import weakref
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.datasets import lerobot, reader
from mjstack.datasets.part import ShardFiles
from mjstack.datasets.reader import StoredDataset
from mjstack.datasets.spec import DatasetSpec
from mjstack.datasets.statistics import by_name, frame_statistics, image_statistics, sampled_frames
from mjstack.errors import FolderError
from mjstack.files import lock_folder, write_atomic


class DatasetWriter:
    """Writes a new dataset, or goes on with one that the same configuration has begun.

    Every `PartWriter` writes episodes into hidden files; `commit` puts these to their places.
    info.json is the last file to change in a commit and says how many files count: a kill or a
    Ctrl-C before it costs the episodes since the last commit, and the next writer clears away what
    they left. One writer has a dataset at a time. A ``with`` block closes it.

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
        self._described = 0  # frames that the statistics are of
        self._pixels = {name: np.zeros((3, 256), np.int64) for name in spec.videos}
        self._sampled = 0  # frames whose pixels are counted
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
            " committed episodes are kept, those since are not. Make room or correct it, and"
            " do the same again: it goes on after the last one kept."
        )

    def __enter__(self) -> "DatasetWriter":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Bring the statistics up to date, and let another writer in."""
        try:
            if self._open:
                with self.guarded():
                    self._write_statistics()
        finally:
            self._open = False
            self._unlock()

    def _resume(self) -> None:
        """Count what is committed, and clear away what is not."""
        stored = reader.read_begun(self.folder, self.spec)
        if stored is not None:
            self._shards = stored.info["mjstack"]["shards"]
            for row in stored.episodes:
                self._count(row)
            with reader.readable(self.folder / lerobot.INFO):
                for entry in stored.info["mjstack"]["provenance"]:
                    if entry["from_episode"] < len(self.committed):
                        self._provenance.append(entry)
            columns = [f"{lerobot.PIXELS}/{name}" for name in self._pixels]
            for path in reader.data_files(self.folder, stored.info, lerobot.EPISODES):
                with reader.readable(path):
                    self._count_pixels(reader.read_numbers(path, dict.fromkeys(columns, 3 * 256)))
        for path in reader.uncommitted(self.folder, self._shards):
            path.unlink()
        # Where the last writer and this one differ, such as in a version, both are on record.
        count = len(self.committed)
        provenance = json.loads(json.dumps(dict(self.spec.provenance)))
        *_, last = [{"from_episode": 0}, *self._provenance]
        if last != {"from_episode": last["from_episode"], **provenance}:
            self._provenance.append({"from_episode": count, **provenance})
        (self.folder / "meta").mkdir(exist_ok=True)
        write_atomic(self.folder / lerobot.INFO, lerobot.to_json(self._make_info()))

    def commit(self, complete: Sequence[ShardFiles]) -> None:
        """Put complete files, whose episodes follow one another, to their places, then what says
        what is in them, and info.json last.

        Raises:
            FolderError: It cannot be written; the writer is closed, and what was committed
                before is kept.
        """
        if not complete:
            return
        with self.guarded():
            self._write_table(lerobot.tasks_table(self.spec.task), self.folder / lerobot.TASKS)
            for shard, files in enumerate(complete, self._shards):
                moves = {lerobot.shard_path(self.folder, lerobot.DATA, shard): files.path}
                for name, hidden in files.videos.items():
                    moves[lerobot.shard_path(self.folder, lerobot.VIDEO, shard, name)] = hidden
                for path, hidden in moves.items():
                    path.parent.mkdir(parents=True, exist_ok=True)
                    os.replace(hidden, path)
                self.waited += files.waited
                first = self.frames
                for number, row in enumerate(files.rows, len(self.committed)):
                    end = self.frames + row["length"]
                    row |= lerobot.episode_columns(
                        self.spec, shard, number, first, self.frames, end
                    )
                    self._count(row)
                    self._count_pixels(row)
                rows = self._pa.Table.from_pylist(files.rows)
                self._write_table(rows, lerobot.shard_path(self.folder, lerobot.EPISODES, shard))
            self._shards += len(complete)
            if self.frames > 2 * self._described:  # all frames are read: not in every commit
                self._write_statistics()
            write_atomic(self.folder / lerobot.INFO, lerobot.to_json(self._make_info()))

    def _write_table(self, table: Any, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        buffer = io.BytesIO()
        self._parquet.write_table(table, buffer)
        write_atomic(path, buffer.getvalue())

    def _count(self, row: Mapping[str, Any]) -> None:
        """Count an episode by its row."""
        self.frames += row["length"]
        self._sampled += len(sampled_frames(row["length"]))
        self.committed.append((row["seed"], row["world"]))

    def _count_pixels(self, rows: Mapping[str, np.ndarray]) -> None:
        """Add the counts of pixels of some rows."""
        for name, counts in self._pixels.items():
            counts += rows[f"{lerobot.PIXELS}/{name}"].reshape(-1, *counts.shape).sum(0)

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
            shards=self._shards,
        )

    @contextlib.contextmanager
    def guarded(self) -> Iterator[None]:
        """If something goes wrong, close the writer and remove what is not committed. A FolderError
        if something cannot be written.
        """
        try:
            yield
        except BaseException as error:
            self._open = False
            info = reader.read_info(self.folder)
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
