"""Opening a dataset to go on with it: whose it is, what of it counts, and what an earlier writer
left beside that.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.datasets import lerobot
from mjstack.datasets.arrow import require_pyarrow
from mjstack.datasets.spec import DatasetSpec
from mjstack.datasets.staging import temporary
from mjstack.errors import DatasetError


def lock_folder(folder: Path) -> int:
    """A descriptor that keeps other writers out until it is closed, also by the end of the process.

    Raises:
        DatasetError: Another writer has the folder.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(handle)
        raise DatasetError(
            f"{folder} is open in another writer, expected one at a time. Wait, or give another"
            " folder"
        ) from error
    except OSError:
        pass  # a file system without locks
    return handle


def read_info(folder: Path) -> dict[str, Any] | None:
    """The content of info.json, or None where no dataset has been begun.

    Raises:
        DatasetError: It cannot be read, was not written by mjstack, or is missing beside other
            files.
    """
    path = folder / lerobot.INFO
    if not path.is_file():
        begun = temporary(path)
        others = (
            found
            for found in folder.rglob("*")
            if found.is_file() and not found.name.startswith(begun)
        )
        other = next(others, None)
        if other is not None:
            raise DatasetError(
                f"{folder} has {other.relative_to(folder)} and no {lerobot.INFO}, expected a"
                " dataset or an empty folder. Give another"
            )
        return None
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
        own = info["mjstack"]
        counts = [info["total_episodes"], info["total_frames"], info["total_tasks"], own["shards"]]
        if not all(isinstance(count, int) for count in counts):
            raise TypeError(f"totals {counts}")
        own["config_sha256"], own["provenance"]
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{path} cannot be read as mjstack's ({type(error).__name__}: {error}), expected a"
            " dataset written by mjstack. Give another folder"
        ) from error
    return info


def check_same(folder: Path, info: dict[str, Any], spec: DatasetSpec) -> None:
    """Raises where a dataset is not the one that a spec describes.

    Raises:
        DatasetError: It has another configuration, or other columns.
    """
    theirs = info["mjstack"]
    ours = lerobot.make_info(spec)
    if theirs["config_sha256"] != spec.config_sha256:
        raise DatasetError(
            f"{folder} has episodes of configuration {theirs['config_sha256']}, expected"
            f" {spec.config_sha256}. Give another folder, or the configuration that it was begun"
            " with"
        )
    pairs = [
        (key, info.get(key), ours[key])
        for key in ("codebase_version", "robot_type", "fps", "chunks_size", "features")
    ]
    pairs += [(key, theirs.get(key), ours["mjstack"][key]) for key in ("units", "values")]
    for key, found, expected in pairs:
        if found != expected:
            if isinstance(expected, dict) and isinstance(found, dict):
                name = next(
                    name for name in [*expected, *found] if found.get(name) != expected.get(name)
                )
                key = f"{key}['{name}']"
                found = found.get(name)
                expected = expected.get(name)
            raise DatasetError(
                f"{folder} has {key}={found}, expected {expected}. Give another folder"
            )


def read_tasks(folder: Path, info: dict[str, Any]) -> list[str]:
    """Texts of the tasks that count, by index.

    Raises:
        DatasetError: The file is missing or damaged.
    """
    if not info["total_tasks"]:
        return []
    path = folder / lerobot.TASKS
    with readable(path):
        return (
            require_pyarrow()[1].read_table(path).slice(0, info["total_tasks"])["task"].to_pylist()
        )


def read_committed(folder: Path, info: dict[str, Any]) -> list[tuple[int, int]]:
    """Seed and world of every episode that counts, in order.

    Raises:
        DatasetError: A file is missing or damaged.
    """
    pairs: list[tuple[int, int]] = []
    for number in range(info["mjstack"]["shards"]):
        path = lerobot.episodes_path(folder, number)
        with readable(path):
            table = require_pyarrow()[1].ParquetFile(path).read(columns=["seed", "world"])
            pairs += zip(table["seed"].to_pylist(), table["world"].to_pylist(), strict=True)
    return pairs


@dataclass(eq=False, kw_only=True, slots=True)
class StoredShard:
    """A shard that counts.

    Attributes:
        number: Which one.
        rows: The episodes' columns that are no statistics.
        statistics: The episodes' statistics, over all features one after the other.
        counts: The frames that each feature's statistics are of, for each episode.
        data: The open data file, a `pyarrow.parquet.ParquetFile`.
    """

    number: int
    rows: dict[str, list[Any]]
    statistics: list[dict[str, np.ndarray]]
    counts: list[set[int]]
    data: Any


def read_shards(folder: Path, info: dict[str, Any], spec: DatasetSpec) -> Iterator[StoredShard]:
    """Every shard that counts, one after the other.

    Args:
        folder: The dataset.
        info: Its info.json.
        spec: What it holds.

    Raises:
        DatasetError: A file is missing or damaged, or has other episodes or frames than it should.
    """
    _, parquet = require_pyarrow()
    episodes = frames = 0
    for number in range(info["mjstack"]["shards"]):
        path = lerobot.episodes_path(folder, number)
        data = lerobot.data_path(folder, number)
        with readable(path):
            table = parquet.ParquetFile(path).read()
            for name, kind in lerobot.episodes_types(spec).items():
                if table.schema.field(name).type != kind:
                    raise ValueError(f"{name} is {table.schema.field(name).type}, not {kind}")
            rows = {
                name: table[name].to_pylist()
                for name in table.column_names
                if not name.startswith("stats/")
            }
            statistics = lerobot.statistics_of(table, spec.features)
            counts = lerobot.counts_of(table, spec.features)
        numbers = rows["episode_index"]
        lengths = rows["length"]
        if not numbers or numbers != list(range(episodes, episodes + len(numbers))):
            raise DatasetError(
                f"{path} has other episodes than from {episodes} on. Restore it, or give another"
                " folder"
            )
        episodes = episodes + len(numbers)
        frames = frames + sum(lengths)
        with readable(data):
            file = parquet.ParquetFile(data)
        if file.metadata.num_rows != sum(lengths) or rows["dataset_to_index"][-1] != frames:
            raise DatasetError(
                f"{data} has {file.metadata.num_rows} frames up to {frames}, expected"
                f" {sum(lengths)} up to {rows['dataset_to_index'][-1]}. Restore it, or give another"
                " folder"
            )
        yield StoredShard(number=number, rows=rows, statistics=statistics, counts=counts, data=file)
        file.close()
    if (episodes, frames) != (info["total_episodes"], info["total_frames"]):
        raise DatasetError(
            f"{folder} has {episodes} episodes and {frames} frames, expected"
            f" {info['total_episodes']} and {info['total_frames']} as {lerobot.INFO} says. Restore"
            " its files, or give another folder"
        )


def uncommitted(folder: Path, shards: int) -> list[Path]:
    """Files that an interrupted writer left: shards that do not count, and what was on its way.

    Args:
        folder: The dataset.
        shards: How many count.
    """
    names = [temporary(folder / name) for name in (lerobot.INFO, lerobot.STATS, lerobot.TASKS)]
    left = [path for path in sorted(folder.glob("meta/.*")) if path.name.startswith(tuple(names))]
    for place in (lerobot.DATA, lerobot.EPISODES):
        for path in sorted(folder.glob(f"{Path(place).parts[0]}/**/chunk-*/*")):
            match = re.fullmatch(r"(\.?)file-(\d+)\.parquet(\..*)?", path.name)
            chunk = re.fullmatch(r"chunk-(\d+)", path.parent.name)
            if (
                match
                and chunk
                and (match[1] or int(chunk[1]) * lerobot.CHUNK + int(match[2]) >= shards)
            ):
                left.append(path)
    return left


@contextlib.contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turns what pyarrow says of a bad file into one line."""
    pa, _ = require_pyarrow()
    try:
        yield
    except FileNotFoundError as error:
        raise DatasetError(
            f"{path} is missing, expected a file of the dataset. Restore it, or give another folder"
        ) from error
    except (OSError, KeyError, ValueError, pa.ArrowException) as error:
        text = (
            error.args[0] if isinstance(error, KeyError) else error
        )  # a KeyError's own text is quoted
        reason = str(text).partition("\n")[0].rstrip(".")
        raise DatasetError(
            f"{path} is damaged ({reason}), expected it as it was written. Restore it, or give"
            " another folder"
        ) from error
