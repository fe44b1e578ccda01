"""Opening a dataset: to read it, or to go on with it."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.config.fingerprint import differences
from mjstack.datasets import lerobot, tables
from mjstack.datasets.lerobot import is_foreign, numeric_columns, videos_of
from mjstack.datasets.spec import INDICES, DatasetSpec
from mjstack.datasets.video import decode
from mjstack.errors import FolderError, require_names
from mjstack.files import refuse_links

_FIX = "Restore its files, or give another folder"
_SLACK = 1e-4  # s: LeRobot lets no timestamp be off further


@dataclass(frozen=True, kw_only=True)
class StoredDataset:
    """A dataset to read from.

    Attributes:
        folder: The dataset.
        info: The content of info.json.
        tasks: Texts of the tasks, by index.
        episodes: A row per episode: its columns but for the statistics.
    """

    folder: Path
    info: dict[str, Any]
    tasks: list[str]
    episodes: list[dict[str, Any]]

    def images(self, name: str, episode: int) -> np.ndarray:
        """Decode an episode's images.

        Args:
            name: Such as ``observation.images.front``.
            episode: Its number.

        Returns:
            Shape ``(frames, height, width, 3)``, uint8.

        Raises:
            UnknownName: There are no such images.
            IndexError: There is no such episode.
            FolderError: A file is missing or damaged.
        """
        videos = videos_of(self.info)
        require_names("video", [name], videos)
        row = self.episodes[episode]
        path = lerobot.shard_path(self.folder, lerobot.VIDEO, lerobot.shard_of(row), name)
        start = row[f"videos/{name}/from_timestamp"]
        with tables.readable(path):
            return decode(path, videos[name], start, row["length"], self.info["fps"])

    def frames(self, name: str) -> np.ndarray:
        """Every frame of a column. Those of an episode are the slice from its
        ``dataset_from_index`` to its ``dataset_to_index``.

        Args:
            name: Such as ``action``.

        Returns:
            Shape ``(frames, dim)``, in the dataset's type.

        Raises:
            UnknownName: There is no such column.
            FolderError: A file is missing or damaged.
        """
        features = self.info["features"]
        require_names("feature", [name], numeric_columns(self.info))
        shape = features[name]["shape"]
        columns = [np.empty((0, math.prod(shape)), features[name]["dtype"])]
        for path in tables.data_files(self.folder, self.info):
            with tables.readable(path):
                columns.append(tables.read_columns(path, self.info, [name])[name])
        return np.concatenate(columns).reshape(-1, *shape)


def read_dataset(folder: Path | str, used: Iterable[str] = ()) -> StoredDataset:
    """Open a dataset to read from it. Its files, but for images, are held to what they say of one
    another.

    Args:
        folder: The dataset.
        used: Columns that will be read. Of a dataset that mjstack has not written, others are not
            looked at.

    Raises:
        FolderError: There is none, or a file is missing or damaged.
    """
    folder = Path(folder)
    info = tables.read_info(folder)
    columns = [*INDICES, *used] if is_foreign(info) else numeric_columns(info)
    require_names("feature", columns, info["features"])
    _check_counts(folder, info)
    tasks = tables.read_tasks(folder, info)
    rows = tables.read_rows(folder, info)
    stored = StoredDataset(folder=folder, info=info, tasks=tasks, episodes=rows)
    _check_frames(stored, columns)
    return stored


def read_begun(folder: Path, spec: DatasetSpec) -> StoredDataset | None:
    """Open a dataset to go on with it; None where none has been begun.

    Raises:
        FolderError: It is damaged, as of `read_dataset`, or of another configuration; or there are
            other files, or links.
    """
    refuse_links(folder.rglob("*"), "Write into another folder")
    if not (folder / lerobot.INFO).exists():
        begun = f".{Path(lerobot.INFO).name}."
        for file in folder.rglob("*"):
            if file.is_file() and not file.name.startswith(begun):
                name = file.relative_to(folder)
                expected = "expected a dataset or an empty folder. Give another"
                raise FolderError(f"{folder} has {name} and no {lerobot.INFO}, {expected}")
        return None
    info = tables.read_info(folder)
    if is_foreign(info):
        raise FolderError(f"{folder} was not written by mjstack", "Give another folder")
    with tables.readable(folder / lerobot.INFO):
        begun = _identity(info)
    if changes := differences(begun, _identity(lerobot.make_info(spec, [spec.provenance]))):
        fix = "Set job.folder to another folder, or these keys back"
        raise FolderError(f"{folder} has episodes of another configuration: {changes}", fix)
    return read_dataset(folder)


def _identity(info: dict[str, Any]) -> dict[str, Any]:
    """Everything that stays while a dataset grows, the configuration first."""
    block = info["mjstack"]
    digest = {"config_sha256": block["config_sha256"]}
    config = [{}, *block["provenance"]][-1].get("config", digest)
    keys = ("codebase_version", "robot_type", "fps", "chunks_size", "features")
    same = {"units": block["units"], "values": block["values"]}
    return {**config, **same, **{key: info[key] for key in keys}}


def _check_counts(folder: Path, info: dict[str, Any]) -> None:
    """Check how many rows the files have, before any is read."""
    counts = []
    for files in (lerobot.EPISODES, lerobot.DATA):
        paths = tables.data_files(folder, info, files)
        counts.append(sum(tables.count_rows(path) for path in paths))
    total = [info["total_episodes"], info["total_frames"]]
    if counts != total:
        raise FolderError(
            f"{folder} has {counts[0]} rows of episodes and {counts[1]} frames, expected {total[0]}"
            f" episodes and {total[1]} frames as {lerobot.INFO} says. {_FIX}"
        )


def _check_frames(stored: StoredDataset, names: Iterable[str]) -> None:
    """Check columns of the frames: those of each episode are in one piece, in order.

    Raises:
        FolderError: A number is missing or not finite, or an index or a time is another.
    """
    info, tasks = stored.info, stored.tasks
    lengths = [row["length"] for row in stored.episodes]
    frames = info["total_frames"]
    if sum(lengths) != frames:
        problem = f"{stored.folder} has episodes of {sum(lengths)} frames, expected {frames}"
        raise FolderError(f"{problem} as {lerobot.INFO} says. {_FIX}")
    frame = np.arange(frames) - np.repeat(np.cumsum([0, *lengths])[:-1], lengths)
    expected = {
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "frame_index": frame,
        "index": np.arange(frames),
        "timestamp": (frame / info["fps"]).astype(np.float32),
    }
    start = 0
    for path in tables.data_files(stored.folder, info):
        with tables.readable(path):
            columns = tables.read_columns(path, info, names)
            stop = start + len(columns["index"])
            for name, values in expected.items():
                column, values = columns[name][:, 0], values[start:stop]
                differs = column != values
                if name == "timestamp":
                    differs = np.abs(column - values) > _SLACK + np.spacing(values)
                if differs.any():
                    k = int(differs.argmax())
                    problem = f"{name} of frame {start + k} is {column[k]}, expected {values[k]}"
                    raise ValueError(problem)
            task = columns["task_index"]
            if not ((task >= 0) & (task < len(tasks))).all():
                raise ValueError(f"task_index goes to {task.max()}, with {len(tasks)} tasks")
            start = stop


def uncommitted(folder: Path, shards: int) -> list[Path]:
    """Files that an interrupted writer left: shards from this number on, and hidden ones."""
    counted = {lerobot.FILE.format(**lerobot.shard_indices(shard)) for shard in range(shards)}
    places = {"data": "parquet", "meta/episodes": "parquet", "videos/*": "mp4"}
    patterns = [
        f"{place}/chunk-*/{name}"
        for place, ending in places.items()
        for name in (f"file-*.{ending}", f".file-*.{ending}*")
    ]
    totals = (lerobot.INFO, lerobot.STATS, lerobot.TASKS)
    patterns += [f"meta/.{Path(name).name}.*" for name in totals]
    paths = [path for pattern in patterns for path in folder.glob(pattern)]
    return [path for path in paths if f"{path.parent.name}/{path.stem}" not in counted]
