"""A data file of a dataset before it is committed: several processes may write one each."""

import contextlib
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.datasets import lerobot
from mjstack.datasets.spec import INDICES, DatasetSpec

FILE_MB = 100  # size of a data file at which the next one begins


@dataclass(kw_only=True, slots=True)
class Part:
    """A complete hidden file, and a row for each of its episodes."""

    path: Path
    rows: list[dict[str, Any]] = field(default_factory=list)


class PartWriter:
    """Writes episodes into a hidden file, one after the other, and keeps none of their frames.

    Attributes:
        part: What is written so far.
    """

    def __init__(self, folder: Path, spec: DatasetSpec, name: str) -> None:
        """Begin a file, whose name tells the processes apart.

        Raises:
            OSError: It cannot be written.
        """
        self._spec = spec
        path = lerobot.shard_path(folder, lerobot.DATA, 0)
        self.part = Part(path=path.with_name(f".file-{name}.parquet"))
        self.part.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = open(self.part.path, "wb")  # noqa: SIM115
        # Few floats occur twice: a dictionary of them takes three times the time and half again
        # the room.
        self._writer = lerobot.require_pyarrow()[1].ParquetWriter(
            self._file,
            lerobot.frames_schema(spec),
            compression="snappy",
            use_dictionary=list(INDICES),
        )

    def is_full(self, file_mb: int) -> bool:
        """Whether one more episode like these would make the file larger than that [MiB]."""
        return self._file.tell() * (1.0 + 1.0 / len(self.part.rows)) > file_mb * 2**20

    def write(
        self,
        task: tuple[int, str],
        facts: dict[str, Any],
        columns: dict[str, np.ndarray],
        number: int,
        start: int,
    ) -> None:
        """Write an episode as a row group, so that it can be read without the others.

        Args:
            task: Number of the task in the dataset, and its words.
            facts: Values of its row.
            columns: Its frames, as the spec has them.
            number: Its number in the dataset.
            start: Number of its first frame there.
        """
        length = len(next(iter(columns.values())))
        frame = np.arange(length)
        indices = {
            "timestamp": (frame / self._spec.fps).astype(np.float32),
            "frame_index": frame,
            "episode_index": np.full(length, number),
            "index": start + frame,
            "task_index": np.full(length, task[0]),
        }
        columns = dict(columns)
        for name, values in indices.items():
            columns[name] = np.asarray(values)[:, None]
        table = lerobot.frames_table(self._writer.schema, columns)
        self._writer.write_table(table, row_group_size=length)
        # float64 holds every type's values exactly, but int64's beyond 2^53.
        joined = np.concatenate([columns[name] for name in table.column_names], axis=1, dtype=float)
        named = lerobot.name_statistics(
            self._spec.features, lerobot.episode_statistics(joined), length
        )
        place = lerobot.shard_indices(0)  # the commit knows it
        self.part.rows.append(
            {
                "episode_index": number,
                "tasks": [task[1]],
                "length": length,
                **{f"data/{name}": index for name, index in place.items()},
                "dataset_from_index": start,
                "dataset_to_index": start + length,
                **facts,
                **{f"meta/episodes/{name}": index for name, index in place.items()},
                **{
                    f"stats/{name}/{kind}": values
                    for name, kinds in named.items()
                    for kind, values in kinds.items()
                },
            }
        )

    def complete(self) -> Part:
        """Close the file; it is on the disk then."""
        self._writer.close()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        return self.part

    def abandon(self) -> None:
        """Close the file as it is."""
        self._writer.is_open = False  # its destructor would complete the file
        with contextlib.suppress(OSError):  # closing writes what is buffered
            self._file.close()
