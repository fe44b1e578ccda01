"""Opening a dataset: to read it, or to go on with it. Each file is read and checked by itself."""

import json
import math
import re
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.config.fingerprint import differences
from mjstack.datasets import lerobot
from mjstack.datasets.lerobot import is_foreign, numeric_columns, video_columns
from mjstack.datasets.spec import INDICES, DatasetSpec
from mjstack.errors import FolderError, require_names
from mjstack.files import reading, refuse_links

_FIX = "Restore its files, or give another folder"
_SLACK = 1e-4  # s: LeRobot lets no timestamp be off further
_WHOLE = {"length", "seed", "world"}  # columns of an episode's row


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
        for path in data_files(self.folder, self.info):
            with readable(path):
                columns.append(read_columns(path, self.info, [name])[name])
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
    info = read_info(folder)
    columns = [*INDICES, *used] if is_foreign(info) else numeric_columns(info)
    require_names("feature", columns, info["features"])
    _check_counts(folder, info)
    tasks = read_tasks(folder, info)
    rows = read_rows(folder, info)
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
    info = read_info(folder)
    if is_foreign(info):
        raise FolderError(f"{folder} was not written by mjstack", "Give another folder")
    with readable(folder / lerobot.INFO):
        stored = _identity(info)
    if changes := differences(stored, _identity(lerobot.make_info(spec, [spec.provenance]))):
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
        paths = data_files(folder, info, files)
        counts.append(sum(count_rows(path) for path in paths))
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
    for path in data_files(stored.folder, info):
        with readable(path):
            columns = read_columns(path, info, names)
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
    patterns = ("chunk-*/file-*", "chunk-*/.file-*", "meta/.*.*.*")
    paths = [path for pattern in patterns for path in folder.rglob(pattern)]
    return [path for path in paths if f"{path.parent.name}/{path.stem}" not in counted]


def readable(path: Path) -> AbstractContextManager[None]:
    """Raise a `FolderError` for whatever goes wrong with a file inside."""
    return reading(path, "Restore it, or give another folder")


def data_files(folder: Path, info: dict[str, Any], files: str = lerobot.DATA) -> list[Path]:
    """The data files that count, or those of episodes (`lerobot.EPISODES`), in order. If some are
    missing, the first of them is among these.
    """
    paths = sorted(folder.glob(re.sub(r"{.*?}", "*", files)))
    if is_foreign(info):
        return paths
    shards = min(info["mjstack"]["shards"], len(paths) + 1)
    return [lerobot.shard_path(folder, files, shard) for shard in range(shards)]


def read_info(folder: Path) -> dict[str, Any]:
    """The content of info.json.

    Raises:
        FolderError: It is missing, damaged, or of another version of LeRobot's.
    """
    lerobot.require_pyarrow()
    path = folder / lerobot.INFO
    if not path.is_file():
        problem = f"{folder} has no {lerobot.INFO}, expected a LeRobotDataset v3"
        raise FolderError(problem, "Give the folder dataset of job=collect")
    with readable(path):
        info = json.loads(path.read_text(encoding="utf-8"))
        version = str(info["codebase_version"])
        if not version.startswith("v3"):
            problem = f"{folder} is a LeRobotDataset {version:.20}, expected v3.0"
            raise FolderError(problem, "Convert it with LeRobot")
        lerobot.check_info(info)
    return info


def open_file(path: Path) -> Any:
    """A `ParquetFile`, whose footer is read; an exception if it is none."""
    return lerobot.require_pyarrow()[1].ParquetFile(path)


def count_rows(path: Path) -> int:
    """Rows of a file, as its footer has them; a FolderError if it cannot be read."""
    with readable(path):
        return open_file(path).metadata.num_rows


def read_numbers(path: Path, widths: Mapping[str, int]) -> dict[str, np.ndarray]:
    """Columns of numbers, each shape ``(rows, width)``, in the file's types. Raises if it cannot be
    read, or a row has not as many numbers as ``widths`` says.
    """
    table = open_file(path).read(columns=list(widths))
    columns = {}
    for name, width in widths.items():
        column = table[name].combine_chunks()
        even = True
        while even and hasattr(column, "flatten"):
            even = len(column.value_lengths().unique()) < 2  # a null has none
            column = column.flatten()
        if not even or len(column) != len(table) * width or column.null_count:
            raise ValueError(f"rows of {name} without {width} numbers")
        values = column.to_numpy(zero_copy_only=False)
        if values.dtype.kind not in "biuf":
            raise ValueError(f"{name} has other values than numbers")
        columns[name] = values.reshape(len(table), width)
    return columns


def read_columns(path: Path, info: dict[str, Any], names: Iterable[str]) -> dict[str, np.ndarray]:
    """Columns of a data file, each shape ``(frames, numbers)``.

    Raises:
        Exception: It cannot be read; a number is missing or not finite; or mjstack wrote it and the
            type is another than info.json says.
    """
    features = info["features"]
    columns = read_numbers(path, {n: math.prod(features[n]["shape"]) for n in names})
    for name, values in columns.items():
        if not is_foreign(info) and values.dtype != features[name]["dtype"]:
            raise ValueError(f"{name} is {values.dtype}, expected {features[name]['dtype']}")
        if not np.isfinite(values).all():
            raise ValueError(f"{name} has numbers that are not finite")
    return columns


def read_tasks(folder: Path, info: dict[str, Any]) -> list[str]:
    """Texts of the tasks that count, by index."""
    path = folder / lerobot.TASKS
    if not info.get("total_tasks", 1):
        return []
    with readable(path):
        table = open_file(path).read()
        names = table.column_names
        text = "task" if "task" in names else next(n for n in names if n != "task_index")
        count = len(table) if is_foreign(info) else info["total_tasks"]
        columns = (table[name].to_pylist() for name in ("task_index", text))
        tasks = sorted(zip(*columns, strict=True))[:count]
        if [number for number, _ in tasks] != list(range(count)):
            raise ValueError(f"task_index does not count from 0 to {count - 1}")
        if not all(isinstance(task, str) for _, task in tasks):
            raise ValueError("a task is no text")
    return [task for _, task in tasks]


def read_rows(folder: Path, info: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of every episode, without what is counted of their numbers."""
    rows: list[dict[str, Any]] = []
    for path in data_files(folder, info, lerobot.EPISODES):
        with readable(path):
            file = open_file(path)
            counts = ("stats/", f"{lerobot.PIXELS}/")
            names = [name for name in file.schema_arrow.names if not name.startswith(counts)]
            for row in file.read(columns=names).to_pylist():
                for name in _WHOLE & row.keys() | {"length"}:
                    if type(row[name]) is not int or row[name] < (name == "length"):
                        raise ValueError(f"row {len(rows)}: {name} is {row[name]!r:.60}")
                rows.append(row)
    for video in video_columns(info) if not is_foreign(info) else ():
        for path in data_files(folder, info, lerobot.VIDEO.replace("{video_key}", video)):
            with readable(path):
                pass  # it is there
    return rows
