"""Files of a dataset, each read and checked by itself."""

import json
import math
import re
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.datasets import lerobot
from mjstack.datasets.lerobot import is_foreign
from mjstack.errors import FolderError
from mjstack.files import reading

_WHOLE = {"length", "seed", "world"}  # columns of an episode's row


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
            rows += file.read(columns=names).to_pylist()
            for number, row in enumerate(rows):
                for name in _WHOLE & row.keys() | {"length"}:
                    if type(row[name]) is not int or row[name] < (name == "length"):
                        raise ValueError(f"row {number}: {name} is {row[name]!r:.60}")
    for video in lerobot.videos_of(info) if not is_foreign(info) else ():
        for path in data_files(folder, info, lerobot.VIDEO.replace("{video_key}", video)):
            with readable(path):
                pass  # it is there
    return rows
