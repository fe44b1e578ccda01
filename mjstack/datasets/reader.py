"""Opening a dataset: to read it, or to go on with it."""

import json
import math
import re
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
from mjstack.errors import FolderError, require_names
from mjstack.files import reading

_USED = ("codebase_version", "fps", "features", "total_episodes", "total_frames")
_ORDER = ("episode_index", "frame_index")


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
        videos = _videos(self.info)
        require_names("video", [name], videos)
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
        require_names("feature", [name], features.keys() - videos.keys())
        dtype = features[name]["dtype"]
        parts = [np.empty((0, *features[name]["shape"]), dtype)]
        for path in data_files(self.folder, self.info):
            with readable(path):
                part = read_columns(path, self.info, [name])[name]
                if part.dtype != dtype:
                    raise ValueError(f"{name} is {part.dtype}")
                parts.append(part.reshape(-1, *parts[0].shape[1:]))
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
                name = file.relative_to(folder)
                expected = "expected a dataset or an empty folder. Give another"
                raise FolderError(f"{folder} has {name} and no {lerobot.INFO}, {expected}")
        return None
    with readable(path):
        info = json.loads(path.read_text(encoding="utf-8"))
        check_types(info)
    return info


def check_types(info: Any, *, written_here: bool = True) -> None:
    """Raise an error of any kind where info.json is not what `make_info` makes; of a dataset that
    mjstack has not written, where its features and counts are not.
    """
    empty = lerobot.make_info(DatasetSpec(robot_type="", fps=1, features={}, config_sha256=""))
    used = empty if written_here else {name: empty[name] for name in _USED}
    blocks = [(info, used)]
    if written_here:
        blocks.append((info["mjstack"], empty["mjstack"]))
    for block, model in blocks:
        for name, value in model.items():
            kinds = {"video_path": str | None, "fps": int | float}.get(name, type(value))
            if not isinstance(block[name], kinds) or isinstance(block[name], bool):
                raise ValueError(f"{name} is {block[name]!r:.60}")
    for name, feature in info["features"].items():
        if not all(type(number) is int and number > 0 for number in feature["shape"]):
            raise ValueError(f"the shape of {name} is {feature['shape']!r:.60}")
        if written_here and feature["dtype"] != "video":
            np.dtype(feature["dtype"])
    for entry in info["mjstack"]["provenance"] if written_here else ():
        if not 0 <= entry["from_episode"] <= info["total_episodes"]:
            raise ValueError(f"from_episode is {entry['from_episode']}")
    _videos(info)


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
        tasks = read_table(path, ["task"])["task"].to_pylist()[:count]
        if [type(task) for task in tasks] != [str] * count:
            raise ValueError(f"not {count} texts")
    return tasks


def read_rows(folder: Path, info: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of every episode that counts, in order.

    Raises:
        FolderError: A file is missing or damaged, or has other episodes or frames than it should.
    """
    rows: list[dict[str, Any]] = []
    for shard in range(info["mjstack"]["shards"]):
        path = lerobot.shard_path(folder, lerobot.EPISODES, shard)
        with readable(path):
            for row in read_table(path).to_pylist():
                start = rows[-1]["dataset_to_index"] if rows else 0
                place = (len(rows), start, start + row["length"])
                names = ("episode_index", "dataset_from_index", "dataset_to_index")
                if tuple(row[name] for name in names) != place or row["length"] < 1:
                    raise ValueError(f"row {len(rows)} is not of that episode")
                if min(row["seed"], row["world"]) < 0:
                    raise ValueError(f"row {len(rows)} has a negative seed or world")
                rows.append(row)
        for video in _videos(info):
            with readable(lerobot.shard_path(folder, lerobot.VIDEO, shard, video)):
                pass
    check_frames(folder, info, [row["length"] for row in rows])
    return rows


def data_files(folder: Path, info: dict[str, Any], files: str = lerobot.DATA) -> list[Path]:
    """The data files that count, or those of episodes (`lerobot.EPISODES`), in order. If some are
    missing, the first of them is among these.
    """
    there = sorted(folder.glob(re.sub(r"{.*?}", "*", files)))
    if "mjstack" not in info:
        return there
    shards = min(info["mjstack"]["shards"], len(there) + 1)
    return [lerobot.shard_path(folder, files, shard) for shard in range(shards)]


def check_frames(folder: Path, info: dict[str, Any], lengths: Sequence[int]) -> None:
    """Check that the frames are as many as info.json says, and those of each episode in one piece.

    Args:
        folder: The dataset.
        info: The content of info.json, as of `check_types`.
        lengths: Frames of each episode, as its row says.

    Raises:
        FolderError: Frames or episodes are missing, there twice or out of order.
    """
    parts = [np.empty((0, 2))]
    for path in data_files(folder, info):
        with readable(path):
            parts.append(np.hstack([*read_columns(path, info, _ORDER).values()]))
    episode, frame = np.concatenate(parts).T
    counts = (len(lengths), len(frame))
    total = (info["total_episodes"], info["total_frames"])
    if counts == total and min(lengths, default=1) > 0 and sum(lengths) == len(frame):
        steps = np.concatenate([np.arange(length) for length in (0, *lengths)])
        number = np.repeat(np.arange(len(lengths)), lengths)
        if np.array_equal(episode, number) and np.array_equal(frame, steps):
            return
    raise FolderError(
        f"{folder} has {counts[0]} rows of episodes and {counts[1]} frames of"
        f" {len(np.unique(episode))} episodes{', out of order' * (counts == total)}, expected"
        f" {total[0]} episodes and {total[1]} frames as {lerobot.INFO} says, each episode in one"
        " piece, as long as its row says and frame_index rising by one in it. Restore its files,"
        " or give another folder"
    )


def read_columns(path: Path, info: dict[str, Any], names: Sequence[str]) -> dict[str, np.ndarray]:
    """Columns of a data file, each shape ``(frames, numbers)``, in the file's types.

    Raises:
        Exception: It cannot be read, or a row has not as many numbers as info.json says.
    """
    table = read_table(path, names)
    columns = {}
    for name in names:
        column = table[name].combine_chunks()
        width = math.prod(info["features"][name]["shape"])
        if hasattr(column, "flatten"):
            if set(column.value_lengths().unique().to_pylist()) - {width}:  # a null has none
                raise ValueError(f"rows of {name} without {width} numbers")
            column = column.flatten()
        values = column.to_numpy(zero_copy_only=False)
        if values.dtype.kind not in "biuf":
            raise ValueError(f"{name} has other values than numbers")
        columns[name] = values.reshape(len(table), width)
    return columns


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


def read_table(path: Path, columns: Sequence[str] | None = None) -> Any:
    """A file as an Arrow table, or these of its columns."""
    return lerobot.require_pyarrow()[1].ParquetFile(path).read(columns=columns)


def readable(path: Path) -> AbstractContextManager[None]:
    """Raise a `FolderError` for whatever goes wrong with a file inside."""
    return reading(path, "Restore it, or give another folder")
