"""The episodes of one data file, on their way into a dataset."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.datasets import lerobot
from mjstack.datasets.arrow import require_pyarrow
from mjstack.datasets.spec import INDICES, DatasetSpec, EpisodeData, typed_row
from mjstack.datasets.staging import Staging
from mjstack.datasets.statistics import episode_statistics


class Shard:
    """Frames go to the disk at once, into a hidden file; what is kept of an episode is its row.

    Attributes:
        number: Which shard of the dataset it is.
        rows: The episodes' columns that are no statistics.
        statistics: The episodes' statistics, over all features one after the other.
        staging: The files of the commit, the data file first.
    """

    def __init__(
        self, folder: Path, spec: DatasetSpec, number: int, episodes: int, frames: int
    ) -> None:
        """Begins a shard.

        Args:
            folder: The dataset.
            spec: What it holds.
            number: Which shard this is.
            episodes: Episodes before it.
            frames: Frames before it.
        """
        self.number = number
        self.rows: dict[str, list[Any]] = {}
        self.statistics: list[dict[str, np.ndarray]] = []
        self.staging = Staging()
        self._folder = folder
        self._spec = spec
        self._schema = lerobot.frames_schema(spec)
        self._episodes = episodes
        self._frames = frames
        self._file: Any = None
        self._parquet: Any = None

    def __len__(self) -> int:
        return len(self.statistics)

    @property
    def size(self) -> int:
        """Bytes of frames so far."""
        return self._file.tell() if self._file else 0

    def add(self, arrays: Mapping[str, np.ndarray], episode: EpisodeData, task: int) -> None:
        """Writes an episode as a row group of its own, so that it can be read without the others.

        Args:
            arrays: Its frames by feature, each ``(frames, dim)`` in the dataset's type.
            episode: What else there is of it.
            task: Index of its task.
        """
        if self._parquet is None:
            self._file = self.staging.open(lerobot.data_path(self._folder, self.number))
            # Few floats occur twice: a dictionary of them takes three times the time and half again
            # the room.
            self._parquet = require_pyarrow()[1].ParquetWriter(
                self._file, self._schema, compression="snappy", use_dictionary=list(INDICES)
            )
        number = self._episodes + len(self)
        length = len(next(iter(arrays.values())))
        frame = np.arange(length)
        indices: dict[str, np.ndarray] = {
            "timestamp": (frame / self._spec.fps).astype(np.float32),
            "frame_index": frame,
            "episode_index": np.full(length, number),
            "index": self._frames + frame,
            "task_index": np.full(length, task),
        }
        columns: dict[str, np.ndarray] = dict(arrays) | {
            name: values[:, None] for name, values in indices.items()
        }
        self._parquet.write_table(
            lerobot.frames_table(self._schema, columns), row_group_size=length
        )
        # In float64, which holds every type's values exactly, but int64's beyond 2^53.
        numbers = np.concatenate([columns[name].T for name in self._schema.names], dtype=np.float64)
        place = lerobot.shard_indices(self.number)
        row: dict[str, Any] = {"episode_index": number, "length": length}
        row |= {f"data/{name}": index for name, index in place.items()}
        row |= {"dataset_from_index": self._frames, "dataset_to_index": self._frames + length}
        row |= typed_row(self._spec, episode)
        row |= {f"meta/episodes/{name}": index for name, index in place.items()}
        for name, value in row.items():
            self.rows.setdefault(name, []).append(value)
        self.statistics.append(episode_statistics(numbers))
        self._frames += length

    def discard(self) -> None:
        """Removes what has not taken its place."""
        if self._parquet is not None:
            self._parquet.is_open = (
                False  # it would complete its file when it is collected, and that is closed by then
            )
        self.staging.discard()

    def finish(self, tasks: list[str] | None) -> None:
        """Completes the data file, and stages what says what is in it.

        Args:
            tasks: All tasks of the dataset, if there are new ones.
        """
        _, parquet = require_pyarrow()
        self._parquet.close()
        if tasks is not None:
            parquet.write_table(
                lerobot.tasks_table(tasks), self.staging.open(self._folder / lerobot.TASKS)
            )
        table = lerobot.episodes_table(self._spec, self.rows, self.statistics)
        parquet.write_table(
            table, self.staging.open(lerobot.episodes_path(self._folder, self.number))
        )
