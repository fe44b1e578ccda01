"""Files of a dataset before they are committed: several processes may write some each."""

import contextlib
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.datasets import lerobot
from mjstack.datasets.spec import INDICES, DatasetSpec, EpisodeData
from mjstack.datasets.statistics import (
    by_name,
    count_pixels,
    frame_statistics,
    image_statistics,
    sampled_frames,
)
from mjstack.datasets.video import VideoEncoder


@dataclass(kw_only=True, slots=True)
class ShardFiles:
    """Complete hidden files, and a row for each of their episodes.

    Attributes:
        path: The data file.
        videos: The file of each video.
        rows: Rows of the episodes, without their places.
        waited: Time for which the writer has waited for encoders [s].
    """

    path: Path
    videos: dict[str, Path] = field(default_factory=dict)
    rows: list[dict[str, Any]] = field(default_factory=list)
    waited: float = 0.0


class PartWriter:
    """Writes episodes into hidden files, one after the other. It keeps none of their frames, but
    images until they are encoded.

    Attributes:
        files: What is written so far.
    """

    def __init__(self, folder: Path, spec: DatasetSpec, name: str, images_gib: float) -> None:
        """Begin files of a dataset with columns and videos as of ``spec``. ``name`` tells those of
        processes apart; ``images_gib`` is the most that images may take which wait for being
        encoded. An OSError if they cannot be written.
        """
        self._spec = spec
        path = lerobot.shard_path(folder, lerobot.DATA, 0)
        # Readers list names that end in .parquet and .mp4, hidden ones too.
        self.files = ShardFiles(path=path.with_name(f".file-{name}.parquet.part"))
        self.files.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = open(self.files.path, "xb")  # noqa: SIM115
        # Few floats occur twice: a dictionary of them takes three times the time, and more room.
        self._writer = lerobot.require_pyarrow()[1].ParquetWriter(
            self._file,
            lerobot.frames_schema(spec),
            compression="snappy",
            use_dictionary=list(INDICES),
        )
        for video in spec.videos:
            path = lerobot.shard_path(folder, lerobot.VIDEO, 0, video)
            self.files.videos[video] = path.with_name(f".file-{name}.mp4.part")
        self._videos = VideoEncoder(spec.videos, spec.fps, self.files.videos, images_gib * 2**30)

    def is_full(self) -> bool:
        """Whether one more episode like these would make the data file larger than
        `lerobot.DATA_MB`, or a video larger than `lerobot.VIDEO_MB`, or its footer too long.
        """
        data = self._file.tell() / (lerobot.DATA_MB * 2**20)
        rows = len(self.files.rows)
        share = max(data, self._videos.megabytes() / lerobot.VIDEO_MB, rows / lerobot.MOST_ROWS)
        return share * (1.0 + 1.0 / rows) > 1.0

    def write(self, episode: EpisodeData, number: int, start: int) -> None:
        """Write an episode as a row group, so that it can be read without the others: its number,
        that of its first frame (``start``) and of its task are those in the dataset. An OSError if
        it cannot be written.
        """
        columns = {
            name: np.asarray(episode.arrays[name], feature.dtype).reshape(-1, feature.dim)
            for name, feature in self._spec.features.items()
        }
        length = len(next(iter(columns.values())))
        frame = np.arange(length)
        indices: dict[str, np.ndarray] = {
            "timestamp": (frame / self._spec.fps).astype(np.float32),
            "frame_index": frame,
            "episode_index": np.full(length, number),
            "index": start + frame,
            "task_index": np.zeros(length, int),
        }
        columns |= {name: values[:, None] for name, values in indices.items()}
        table = lerobot.frames_table(self._writer.schema, columns)
        self._writer.write_table(table, row_group_size=length)
        self._videos.add(episode.images)
        statistics = {
            name: by_name(frame_statistics(columns[name]), length) for name in table.column_names
        }
        row: dict[str, Any] = {"length": length, "tasks": [self._spec.task], **episode.row}
        sampled = sampled_frames(length)
        for name in self._spec.videos:
            pixels = count_pixels(episode.images[name][sampled])
            statistics[name] = by_name(image_statistics(pixels), len(sampled), video=True)
            row[f"{lerobot.PIXELS}/{name}"] = pixels.ravel()
        for name, kinds in statistics.items():
            row |= {f"stats/{name}/{kind}": values for kind, values in kinds.items()}
        self.files.rows.append(row)

    def complete(self) -> ShardFiles:
        """Close the files; they are on the disk then."""
        self._writer.close()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        self._videos.complete()
        self.files.waited = self._videos.waited
        return self.files

    def abandon(self) -> None:
        """Close the files as they are."""
        self._videos.abandon()
        self._writer.is_open = False  # its destructor would complete the file
        with contextlib.suppress(OSError):  # closing writes what is buffered
            self._file.close()
