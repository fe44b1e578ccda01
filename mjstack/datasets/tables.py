"""Files of a dataset, each read and checked by itself."""

import json
import math
import re
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.datasets import lerobot, parquet
from mjstack.datasets.lerobot import STATISTICS, is_foreign, numeric_columns, videos_of
from mjstack.datasets.spec import OWN_VALUES, VALUE_DTYPES
from mjstack.datasets.video import check_video
from mjstack.errors import FolderError
from mjstack.files import reading


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


def read_columns(path: Path, info: dict[str, Any], names: Iterable[str]) -> dict[str, np.ndarray]:
    """Columns of a data file, each shape ``(frames, numbers)``.

    Raises:
        Exception: It cannot be read; a number is missing or not finite; or mjstack wrote it and the
            type is another than info.json says.
    """
    features = info["features"]
    if not is_foreign(info):
        parquet.check_names(path, numeric_columns(info))
    columns = parquet.read_numbers(path, {n: math.prod(features[n]["shape"]) for n in names})
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
        names = parquet.open_file(path).schema_arrow.names
        text = "task" if "task" in names else next(n for n in names if n != "task_index")
        table = parquet.read_table(path, {text: 1, "task_index": 1})
        count = len(table) if is_foreign(info) else info["total_tasks"]
        columns = (table[name].to_pylist() for name in ("task_index", text))
        tasks = sorted(zip(*columns, strict=True))[:count]
        if [number for number, _ in tasks] != list(range(count)):
            raise ValueError(f"task_index does not count from 0 to {count - 1}")
        if not all(isinstance(task, str) for _, task in tasks):
            raise ValueError("a task is no text")
    return [task for _, task in tasks]


def read_lengths(folder: Path, info: dict[str, Any]) -> list[dict[str, Any]]:
    """Length and seed of every episode of a foreign dataset."""
    rows: list[dict[str, Any]] = []
    for path in data_files(folder, info, lerobot.EPISODES):
        with readable(path):
            names = {"length", *({"seed"} & {*parquet.open_file(path).schema_arrow.names})}
            rows += parquet.read_table(path, dict.fromkeys(names, 1)).to_pylist()
            if not all(type(value) is int for row in rows for value in row.values()):
                raise ValueError("a length or a seed is no whole number")
    return rows


def read_rows(folder: Path, info: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of every episode."""
    rows: list[dict[str, Any]] = []
    videos = videos_of(info)
    pixels = {f"{lerobot.PIXELS}/{name}" for name in videos}
    widths: dict[str, int] = {}
    for name, feature in info["features"].items():
        width = 3 if name in videos else math.prod(feature["shape"])
        widths |= {f"stats/{name}/{kind}": width for kind in STATISTICS}
        widths[f"stats/{name}/count"] = 1
    types = {**OWN_VALUES, **info["mjstack"]["values"]}
    place = partial(lerobot.episode_columns, videos, info["fps"])
    names = {"tasks", *types, *place(0, 0, 0, 0, 0)}
    for shard, path in enumerate(data_files(folder, info, lerobot.EPISODES)):
        with readable(path):
            columns = dict(widths)
            if not pixels.isdisjoint(parquet.open_file(path).schema_arrow.names):
                columns |= dict.fromkeys(pixels, 3 * 256)  # an earlier version left none
            parquet.check_names(path, names | columns.keys())
            numbers = parquet.read_numbers(path, columns)
            if not all(np.isfinite(values).all() for values in numbers.values()):
                raise ValueError("statistics that are not finite")
            counts = {name: numbers[name] for name in pixels & columns.keys()}
            for name, values in counts.items():
                sums = values.reshape(-1, 256).sum(1, dtype=float)
                possible = values.min() >= 0 and 1 <= sums.min() <= sums.max() < 2**40
                if values.dtype != np.int64 or not possible:
                    raise ValueError(f"{name} has other values than counts of pixels")
            first = start = rows[-1]["dataset_to_index"] if rows else 0
            table = parquet.read_table(path, dict.fromkeys(names, 1)).to_pylist()
            for k, row in enumerate(table):
                end = start + row["length"]
                _check_row(row, place(shard, len(rows), first, start, end), types)
                start = end
                rows.append(row | {name: values[k] for name, values in counts.items()})
        for video in videos:
            path = lerobot.shard_path(folder, lerobot.VIDEO, shard, video)
            with readable(path):
                check_video(path)
    return rows


def _check_row(row: Mapping[str, Any], places: Mapping[str, Any], types: Mapping[str, str]) -> None:
    """Raise an error of any kind where a row is not that of an episode at these places, or has
    values of other types.
    """
    number = places["episode_index"]
    for name, value in places.items():
        if row[name] != value:
            raise ValueError(f"row {number}: {name} is {row[name]!r:.60}, expected {value}")
    for name, dtype in types.items():
        if type(row[name]) is not VALUE_DTYPES[dtype][1]:
            raise ValueError(f"row {number}: {name} is {row[name]!r:.60}, expected {dtype}")
    if row["length"] < 1 or min(row["seed"], row["world"]) < 0 or len(row["tasks"]) != 1:
        raise ValueError(f"row {number} has no frames, no task, or a negative seed or world")
