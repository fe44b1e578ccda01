"""Files of a dataset before they are committed: several processes may write some each."""

import contextlib
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.datasets import lerobot
from mjstack.datasets.spec import INDICES, DatasetSpec, EpisodeData
from mjstack.datasets.video import VideoEncoder

IMAGES_GIB = 1.0  # images that may wait for being encoded


@dataclass(kw_only=True, slots=True)
class Part:
    """Complete hidden files, and a row for each of their episodes.

    Attributes:
        path: The data file.
        videos: The file of each video.
        rows: Rows of the episodes.
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
        part: What is written so far.
    """

    def __init__(
        self, folder: Path, spec: DatasetSpec, name: str, *, images_gib: float = IMAGES_GIB
    ) -> None:
        """Begin files, whose name tells the processes apart.

        Args:
            folder: The dataset.
            spec: Its columns and videos.
            name: Part of the names.
            images_gib: Images that may wait for being encoded [GiB].

        Raises:
            OSError: It cannot be written.
        """
        self._spec = spec
        path = lerobot.shard_path(folder, lerobot.DATA, 0)
        self.part = Part(path=path.with_name(f".file-{name}.parquet"))
        self.part.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = open(self.part.path, "wb")  # noqa: SIM115
        # Few floats occur twice: a dictionary of them takes three times the time, and more room.
        self._writer = lerobot.require_pyarrow()[1].ParquetWriter(
            self._file,
            lerobot.frames_schema(spec),
            compression="snappy",
            use_dictionary=list(INDICES),
        )
        for video in spec.videos:
            path = lerobot.shard_path(folder, lerobot.VIDEO, 0, video)
            self.part.videos[video] = path.with_name(f".file-{name}.mp4")
        most = images_gib * 2**30
        self._videos = VideoEncoder(spec.videos, spec.fps, self.part.videos, most)

    def is_full(self) -> bool:
        """Whether one more episode like these would make the data file larger than
        `lerobot.DATA_MB`, or a video larger than `lerobot.VIDEO_MB`.
        """
        data = self._file.tell() / (lerobot.DATA_MB * 2**20)
        share = max(data, self._videos.megabytes() / lerobot.VIDEO_MB)
        return share * (1.0 + 1.0 / len(self.part.rows)) > 1.0

    def write(
        self,
        episode: EpisodeData,
        task: int,
        facts: dict[str, Any],
        columns: dict[str, np.ndarray],
        number: int,
        start: int,
    ) -> None:
        """Write an episode as a row group, so that it can be read without the others.

        Args:
            episode: The episode.
            task: Number of its task in the dataset.
            facts: Values of its row.
            columns: Its frames, as the spec has them.
            number: Its number in the dataset.
            start: Number of its first frame there.
        """
        length = len(next(iter(columns.values())))
        frame = np.arange(length)
        indices: dict[str, np.ndarray] = {
            "timestamp": (frame / self._spec.fps).astype(np.float32),
            "frame_index": frame,
            "episode_index": np.full(length, number),
            "index": start + frame,
            "task_index": np.full(length, task),
        }
        columns = columns | {name: values[:, None] for name, values in indices.items()}
        table = lerobot.frames_table(self._writer.schema, columns)
        self._writer.write_table(table, row_group_size=length)
        self._videos.add(episode.images)
        # float64 holds every type's values exactly, but int64's beyond 2^53.
        joined = np.concatenate([columns[name] for name in table.column_names], axis=1, dtype=float)
        named = self._statistics(joined, episode)
        before = sum(row["length"] for row in self.part.rows)  # frames before it in the videos
        times = {
            "from_timestamp": before / self._spec.fps,
            "to_timestamp": (before + length) / self._spec.fps,
        }
        place = lerobot.shard_indices(0)  # the commit knows it
        self.part.rows.append(
            {
                "episode_index": number,
                "tasks": [episode.task],
                "length": length,
                **{f"data/{name}": index for name, index in place.items()},
                "dataset_from_index": start,
                "dataset_to_index": start + length,
                **{
                    f"videos/{name}/{key}": value
                    for name in self._spec.videos
                    for key, value in (place | times).items()
                },
                **facts,
                **{f"meta/episodes/{name}": index for name, index in place.items()},
                **{
                    f"stats/{name}/{kind}": values
                    for name, kinds in named.items()
                    for kind, values in kinds.items()
                },
            }
        )

    def _statistics(self, frames: np.ndarray, episode: EpisodeData) -> dict[str, dict[str, list]]:
        """Statistics of an episode's frames, shape ``(frames, dim)``, and of its images."""
        statistics = [lerobot.episode_statistics(frames)]
        counts = [len(frames)] * frames.shape[1]
        sampled = lerobot.sampled_frames(len(frames))
        for name in self._spec.videos:
            statistics.append(lerobot.image_statistics(episode.images[name][sampled]))
            counts += [len(sampled)] * 3
        joined = np.concatenate(statistics, axis=1)
        return lerobot.name_statistics(self._spec, joined, np.array(counts))

    def complete(self) -> Part:
        """Close the files; they are on the disk then."""
        self._writer.close()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        self._videos.complete()
        self.part.waited = self._videos.waited
        return self.part

    def abandon(self) -> None:
        """Close the files as they are."""
        self._videos.abandon()
        self._writer.is_open = False  # its destructor would complete the file
        with contextlib.suppress(OSError):  # closing writes what is buffered
            self._file.close()
