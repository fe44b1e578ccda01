"""Opening a dataset: to read it, or to go on with it."""

import json
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.config.fingerprint import differences
from mjstack.datasets import lerobot
from mjstack.datasets.spec import DatasetSpec, Video
from mjstack.datasets.video import decode
from mjstack.errors import FolderError, UnknownName
from mjstack.files import reading


@dataclass(frozen=True, kw_only=True, slots=True)
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
        videos = _videos(self.info)
        if name not in videos:
            raise UnknownName("video", name, videos)
        row = self.episodes[episode]
        place = {key: row[f"videos/{name}/{key}"] for key in ("chunk_index", "file_index")}
        path = self.folder / lerobot.VIDEO.format(video_key=name, **place)
        start = row[f"videos/{name}/from_timestamp"]
        with readable(path):
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
        videos = _videos(self.info)
        features = self.info["features"]
        if name not in features or name in videos:
            raise UnknownName("feature", name, features.keys() - videos.keys())
        dtype = features[name]["dtype"]
        shape = features[name]["shape"]
        parts = [np.empty((0, *shape), dtype)]
        for shard in range(self.info["mjstack"]["shards"]):
            path = lerobot.shard_path(self.folder, lerobot.DATA, shard)
            with readable(path):
                column = _read_table(path, [name])[name]
                values = column.combine_chunks()
                values = values if shape == [1] else values.flatten()
                part = values.to_numpy(zero_copy_only=False).reshape(len(column), *shape)
                if part.dtype != dtype:
                    raise ValueError(f"{name} is {part.dtype}")
                parts.append(part)
        return np.concatenate(parts)


def read_dataset(folder: Path | str) -> StoredDataset:
    """Open a dataset to read from it.

    Raises:
        FolderError: There is none, or a file is missing or damaged.
    """
    lerobot.require_pyarrow()
    folder = Path(folder)
    info = read_info(folder)
    if info is None:
        raise FolderError(f"{folder} has no {lerobot.INFO}, expected a dataset. Give its folder")
    rows = [
        {name: value for name, value in row.items() if not name.startswith("stats/")}
        for row in read_rows(folder, info)
    ]
    return StoredDataset(folder=folder, info=info, tasks=read_tasks(folder, info), episodes=rows)


def read_info(folder: Path) -> dict[str, Any] | None:
    """The content of info.json, or None where no dataset has been begun.

    Raises:
        FolderError: It cannot be read, was not written by mjstack, or is missing beside other
            files.
    """
    path = folder / lerobot.INFO
    if not path.is_file():
        begun = f".{path.name}."
        for file in folder.rglob("*"):
            if file.is_file() and not file.name.startswith(begun):
                raise FolderError(
                    f"{folder} has {file.relative_to(folder)} and no {lerobot.INFO}, expected a"
                    " dataset or an empty folder. Give another"
                )
        return None
    with readable(path):
        info = json.loads(path.read_text(encoding="utf-8"))
        _check_types(info)
    return info


def _check_types(info: Any) -> None:
    """Raise an error of any kind where info.json is not what `make_info` makes."""
    empty = lerobot.make_info(DatasetSpec(robot_type="", fps=1, features={}, config_sha256=""))
    for block, model in ((info, empty), (info["mjstack"], empty["mjstack"])):
        for name, value in model.items():
            kinds = type(value) if name != "video_path" else str | None
            if not isinstance(block[name], kinds) or isinstance(block[name], bool):
                raise ValueError(f"{name} is {block[name]!r:.60}")
    _videos(info)
    for feature in info["features"].values():
        dtype = "uint8" if feature["dtype"] == "video" else feature["dtype"]
        np.empty(feature["shape"], dtype)
    for entry in info["mjstack"]["provenance"]:
        if not 0 <= entry["from_episode"] <= info["total_episodes"]:
            raise ValueError(f"from_episode is {entry['from_episode']}")


def _videos(info: dict[str, Any]) -> dict[str, Video]:
    """The videos of info.json."""
    return {
        name: Video(height=int(feature["shape"][0]), width=int(feature["shape"][1]))
        for name, feature in info["features"].items()
        if feature["dtype"] == "video"
    }


def check_same(folder: Path, info: dict[str, Any], spec: DatasetSpec) -> None:
    """Raise where a dataset is not the one that a spec describes.

    Raises:
        FolderError: It has another configuration, or other columns.
    """
    if changes := differences(_identity(info), _identity(lerobot.make_info(spec))):
        raise FolderError(
            f"{folder} has {changes}", "Give another folder, or what it was begun with"
        )


def _identity(info: dict[str, Any]) -> dict[str, Any]:
    """Everything of info.json that stays while a dataset grows."""
    block = {key: info["mjstack"][key] for key in ("config_sha256", "units", "values")}
    keys = ("codebase_version", "robot_type", "fps", "chunks_size", "features")
    return block | {key: info[key] for key in keys}


def read_tasks(folder: Path, info: dict[str, Any]) -> list[str]:
    """Texts of the tasks that count, by index.

    Raises:
        FolderError: The file is missing or damaged.
    """
    count = info["total_tasks"]
    if not count:
        return []
    path = folder / lerobot.TASKS
    with readable(path):
        tasks = _read_table(path, ["task"])["task"].to_pylist()[:count]
        if [type(task) for task in tasks] != [str] * count:
            raise ValueError(f"not {count} texts")
    return tasks


def read_rows(folder: Path, info: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of every episode that counts, in order.

    Raises:
        FolderError: A file is missing or damaged, or has other episodes or frames than it should.
    """
    rows: list[dict[str, Any]] = []
    frames = 0
    for shard in range(info["mjstack"]["shards"]):
        path = lerobot.shard_path(folder, lerobot.EPISODES, shard)
        with readable(path):
            for row in _read_table(path).to_pylist():
                start = rows[-1]["dataset_to_index"] if rows else 0
                place = (len(rows), start, start + row["length"])
                names = ("episode_index", "dataset_from_index", "dataset_to_index")
                if tuple(row[name] for name in names) != place or row["length"] < 1:
                    raise ValueError(f"row {len(rows)} is not of that episode")
                if min(row["seed"], row["world"]) < 0:
                    raise ValueError(f"row {len(rows)} has a negative seed or world")
                rows.append(row)
        path = lerobot.shard_path(folder, lerobot.DATA, shard)
        for video in _videos(info):
            images = lerobot.shard_path(folder, lerobot.VIDEO, shard, video)
            with readable(images):
                images.stat()
        with readable(path):
            frames += lerobot.require_pyarrow()[1].read_metadata(path).num_rows
    episodes = info["total_episodes"]
    if (len(rows), frames) != (episodes, info["total_frames"]):
        raise FolderError(
            f"{folder} has {len(rows)} episodes and {frames} frames, expected {episodes} and"
            f" {info['total_frames']} as {lerobot.INFO} says. Restore its files, or give another"
            " folder"
        )
    return rows


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


def _read_table(path: Path, columns: Sequence[str] | None = None) -> Any:
    return lerobot.require_pyarrow()[1].ParquetFile(path).read(columns=columns)


def readable(path: Path) -> AbstractContextManager[None]:
    """Raise a `FolderError` for whatever goes wrong with a file inside."""
    return reading(path, "Restore it, or give another folder")
