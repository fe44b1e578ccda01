"""Opening a dataset to go on with it: whose it is, what of it counts, and what an earlier writer left beside that."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mjstack.datasets import layout
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
            f"{folder} is open in another writer, expected one at a time. Wait, or give another folder"
        ) from error
    except OSError:
        pass  # a file system without locks
    return handle


def read_info(folder: Path) -> dict[str, Any] | None:
    """The content of info.json, or None where no dataset has been begun.

    Raises:
        DatasetError: It cannot be read, was not written by mjstack, or is missing beside other files.
    """
    path = folder / layout.INFO
    if not path.is_file():
        begun = temporary(path)
        others = (found for found in folder.rglob("*") if found.is_file() and not found.name.startswith(begun))
        other = next(others, None)
        if other is not None:
            raise DatasetError(
                f"{folder} has {other.relative_to(folder)} and no {layout.INFO}, expected a dataset or an empty folder. "
                "Give another"
            )
        return None
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
        own = info["mjstack"]
        own["shards"], own["config_sha256"], info["total_episodes"], info["total_frames"], info["total_tasks"], info["features"]
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{path} cannot be read as mjstack's ({type(error).__name__}: {error}), expected a dataset written by mjstack. "
            "Give another folder"
        ) from error
    return info


def check_same(folder: Path, info: dict[str, Any], spec: DatasetSpec) -> None:
    """Raises where a dataset is not the one that a spec describes.

    Raises:
        DatasetError: It has another configuration, or other columns.
    """
    theirs, ours = info["mjstack"], layout.make_info(spec, file_mb=1)
    if theirs["config_sha256"] != spec.config_sha256:
        raise DatasetError(
            f"{folder} has episodes of configuration {theirs['config_sha256']}, expected {spec.config_sha256}. Give another "
            "folder, or the configuration that it was begun with"
        )
    pairs = [(key, info.get(key), ours[key]) for key in ("codebase_version", "robot_type", "fps", "chunks_size", "features")]
    pairs += [(key, theirs.get(key), ours["mjstack"][key]) for key in ("units", "values")]
    for key, found, expected in pairs:
        if found != expected:
            if isinstance(expected, dict) and isinstance(found, dict):
                name = next(name for name in [*expected, *found] if found.get(name) != expected.get(name))
                key, found, expected = f"{key}['{name}']", found.get(name), expected.get(name)
            raise DatasetError(f"{folder} has {key}={found}, expected {expected}. Give another folder")


def read_tasks(folder: Path, info: dict[str, Any]) -> list[str]:
    """Texts of the tasks that count, by index.

    Raises:
        DatasetError: The file is missing or damaged.
    """
    if not info["total_tasks"]:
        return []
    path = folder / layout.TASKS
    with readable(path):
        return require_pyarrow()[1].read_table(path).slice(0, info["total_tasks"])["task"].to_pylist()


def read_shards(folder: Path, info: dict[str, Any], columns: list[str] | None = None) -> Iterator[tuple[int, Any, Any]]:
    """Every shard that counts: its number, its episodes as a table, and its data file.

    Args:
        folder: The dataset.
        info: Its info.json.
        columns: Columns of the episodes; all of them if None.

    Raises:
        DatasetError: A file is missing or damaged, or has other episodes or frames than it should.
    """
    _, parquet = require_pyarrow()
    episodes = frames = 0
    for shard in range(info["mjstack"]["shards"]):
        path = layout.episodes_path(folder, shard)
        with readable(path):
            table = parquet.ParquetFile(path).read(columns=columns)
            first, ends, lengths = (
                table["episode_index"].to_pylist(),
                table["dataset_to_index"].to_pylist(),
                table["length"].to_pylist(),
            )
        if first != list(range(episodes, episodes + len(first))) or not first:
            raise DatasetError(f"{path} has other episodes than from {episodes} on. Restore it, or give another folder")
        data = layout.data_path(folder, shard)
        with readable(data):
            file = parquet.ParquetFile(data)
        episodes, frames = episodes + len(first), frames + sum(lengths)
        if file.metadata.num_rows != sum(lengths) or ends[-1] != frames:
            raise DatasetError(
                f"{data} has {file.metadata.num_rows} frames up to {frames}, expected {sum(lengths)} up to {ends[-1]}. "
                "Restore it, or give another folder"
            )
        yield shard, table, file
        file.close()
    if (episodes, frames) != (info["total_episodes"], info["total_frames"]):
        raise DatasetError(
            f"{folder} has {episodes} episodes and {frames} frames, expected {info['total_episodes']} and "
            f"{info['total_frames']} as {layout.INFO} says. Restore its files, or give another folder"
        )


def uncommitted(folder: Path, shards: int) -> list[Path]:
    """Files that an interrupted writer left: shards that do not count, and what was on its way.

    Args:
        folder: The dataset.
        shards: How many count.
    """
    names = [temporary(folder / name) for name in (layout.INFO, layout.STATS, layout.TASKS)]
    left = [path for path in sorted(folder.glob("meta/.*")) if path.name.startswith(tuple(names))]
    for place in (layout.DATA, layout.EPISODES):
        for path in sorted(folder.glob(f"{Path(place).parts[0]}/**/chunk-*/*")):
            match = re.fullmatch(r"(\.?)file-(\d+)\.parquet(\..*)?", path.name)
            chunk = re.fullmatch(r"chunk-(\d+)", path.parent.name)
            if match and chunk and (match[1] or int(chunk[1]) * layout.CHUNK + int(match[2]) >= shards):
                left.append(path)
    return left


@contextlib.contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turns what pyarrow says of a bad file into one line."""
    pa, _ = require_pyarrow()
    try:
        yield
    except (OSError, KeyError, pa.ArrowException) as error:
        reason = (
            "missing"
            if isinstance(error, FileNotFoundError)
            else f"damaged ({(str(error).splitlines() or ['?'])[0].rstrip('.')})"
        )
        raise DatasetError(
            f"{path} is {reason}, expected a parquet file of a dataset. Restore it, or give another folder"
        ) from error
