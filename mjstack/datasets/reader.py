"""Reads a whole dataset and holds it to what its files say of each other."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.datasets import lerobot
from mjstack.datasets.arrow import require_pyarrow
from mjstack.datasets.resume import read_info, read_shards, read_tasks, readable, uncommitted
from mjstack.datasets.spec import INDICES, DatasetSpec, Feature
from mjstack.datasets.statistics import NAMES, RunningStatistics, episode_statistics
from mjstack.errors import DatasetError

TOLERANCE = (
    1e-9  # of statistics, relative to the largest value: sums in another order differ by rounding
)


@dataclass(eq=False, kw_only=True, slots=True)
class StoredDataset:
    """A dataset that was read and found consistent.

    Attributes:
        info: The content of info.json.
        spec: What it holds.
        tasks: Texts of the tasks, by index.
        episodes: Columns of the episodes but for statistics, each with an entry an episode.
        leftover: Files of an interrupted writer, which do not count.
    """

    info: dict[str, Any]
    spec: DatasetSpec
    tasks: list[str]
    episodes: dict[str, list[Any]]
    leftover: list[Path]


def read_dataset(folder: Path | str) -> StoredDataset:
    """Reads every file of a dataset, an episode at a time, and checks all that the layout promises.

    Types and dimensions are those of info.json; indices, timestamps and places run on without a
    gap; every number is finite; tasks, lengths and totals agree; the statistics of each episode and
    of all are those of its frames.

    Args:
        folder: The dataset.

    Raises:
        DatasetError: The first thing that is wrong.
    """
    require_pyarrow()
    folder = Path(folder)
    info = read_info(folder) if folder.is_dir() else None
    if info is None:
        raise DatasetError(f"{folder} has no {lerobot.INFO}, expected a dataset. Give its folder")
    spec = _read_spec(folder, info)
    tasks = read_tasks(folder, info)
    if len(set(tasks)) != info["total_tasks"]:
        raise DatasetError(
            f"{folder / lerobot.TASKS} has {len(set(tasks))} tasks, expected {info['total_tasks']}."
            " Write it anew"
        )
    total = RunningStatistics(sum(dim for _, dim in lerobot.all_features(spec.features).values()))
    episodes: dict[str, list[Any]] = {}
    for shard in read_shards(folder, info, spec):
        path = lerobot.data_path(folder, shard.number)
        lines = lerobot.episodes_path(folder, shard.number)
        _check_schema(path, shard.data.schema_arrow, lerobot.frames_schema(spec))
        if shard.data.num_row_groups != len(shard.statistics):
            raise _wrong(
                path,
                "row groups",
                shard.data.num_row_groups,
                f"{len(shard.statistics)}, one for each episode",
            )
        for number, recorded in enumerate(shard.statistics):
            row = {name: values[number] for name, values in shard.rows.items()}
            _check_row(lines, row, shard.number)
            with readable(path):
                frames = shard.data.read_row_group(number)
            _check_frames(path, frames, row, spec, tasks)
            if shard.counts[number] != {row["length"]}:
                raise _wrong(
                    lines,
                    f"count of episode {row['episode_index']}",
                    sorted(shard.counts[number]),
                    row["length"],
                )
            found = episode_statistics(_numbers(frames, spec))
            _check_statistics(lines, recorded, found, spec)
            total.add(row["length"], found)
        for name, values in shard.rows.items():
            episodes.setdefault(name, []).extend(values)
    leftover = uncommitted(folder, info["mjstack"]["shards"])
    if total.count:
        _check_totals(folder, total, spec, leftover)
    return StoredDataset(info=info, spec=spec, tasks=tasks, episodes=episodes, leftover=leftover)


def _read_spec(folder: Path, info: dict[str, Any]) -> DatasetSpec:
    own = info["mjstack"]
    try:
        units = own["units"]
        features = {
            name: Feature(
                dtype=feature["dtype"], names=tuple(feature["names"]), units=tuple(units[name])
            )
            for name, feature in info["features"].items()
            if name not in INDICES
        }
        spec = DatasetSpec(
            robot_type=info["robot_type"],
            fps=info["fps"],
            features=features,
            config_sha256=own["config_sha256"],
            values=own["values"],
            provenance={
                name: value
                for name, value in own["provenance"][-1].items()
                if name != "from_episode"
            },
        )
        expected = lerobot.make_info(
            spec,
            provenance=own["provenance"],
            file_mb=info["data_files_size_in_mb"],
            episodes=info["total_episodes"],
            frames=info["total_frames"],
            tasks=info["total_tasks"],
            shards=own["shards"],
        )
    except (KeyError, TypeError, IndexError) as error:
        raise DatasetError(
            f"{folder / lerobot.INFO} has no usable {error}, expected all of LeRobot's keys. Write"
            " it anew"
        ) from error
    for key in [*expected, *info]:
        if info.get(key) != expected.get(key):
            raise _wrong(folder / lerobot.INFO, key, info.get(key), expected.get(key))
    return spec


def _check_schema(path: Path, found: Any, expected: Any) -> None:
    if found.names != expected.names:
        raise _wrong(path, "columns", found.names, expected.names)
    for name in expected.names:
        if found.field(name).type != expected.field(name).type:
            raise _wrong(path, f"type of {name}", found.field(name).type, expected.field(name).type)
    told = [
        json.loads((schema.metadata or {}).get(b"huggingface", "null"))
        for schema in (found, expected)
    ]
    if told[0] != told[1]:
        raise _wrong(path, "types for Hugging Face datasets", *told)


def _check_row(path: Path, row: dict[str, Any], shard: int) -> None:
    place = lerobot.shard_indices(shard)
    expected = {f"data/{name}": index for name, index in place.items()}
    expected |= {f"meta/episodes/{name}": index for name, index in place.items()}
    expected |= {"dataset_to_index": row["dataset_from_index"] + row["length"]}
    for name, value in expected.items():
        if row[name] != value:
            raise _wrong(path, f"{name} of episode {row['episode_index']}", row[name], value)


def _check_frames(
    path: Path, frames: Any, row: dict[str, Any], spec: DatasetSpec, tasks: Sequence[str]
) -> None:
    number = row["episode_index"]
    length = row["length"]
    if len(frames) != length:
        raise _wrong(path, f"frames of episode {number}", len(frames), length)
    for name, (_, dim) in lerobot.all_features(spec.features).items():
        numbers = _values(frames, name, dim)
        if numbers.null_count or len(numbers) != length * dim:
            raise _wrong(
                path, f"{name} of episode {number}", "empty places", "a number in every place"
            )
    task = np.unique(frames["task_index"].to_numpy())
    if len(task) != 1 or not 0 <= task[0] < len(tasks) or row["tasks"] != [tasks[task[0]]]:
        raise _wrong(
            path, f"task_index of episode {number}", task.tolist(), f"that of {row['tasks']}"
        )
    frame = np.arange(length)
    expected = {
        "timestamp": (frame / spec.fps).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.full(length, number),
        "index": row["dataset_from_index"] + frame,
    }
    for name, values in expected.items():
        found = frames[name].to_numpy()
        if not np.array_equal(found, values):
            first = int(np.flatnonzero(found != values)[0])
            raise _wrong(
                path, f"{name} of episode {number}, frame {first}", found[first], values[first]
            )
    if not np.isfinite(_numbers(frames, spec)).all():
        raise _wrong(path, f"episode {number}", "numbers that are not finite", "finite ones")


def _numbers(frames: Any, spec: DatasetSpec) -> np.ndarray:
    """All numbers of some frames, shape ``(dim, frames)``, float64."""
    blocks = []
    for name, (_, dim) in lerobot.all_features(spec.features).items():
        values = _values(frames, name, dim).to_numpy(zero_copy_only=False)
        blocks.append(values.reshape(len(frames), dim).T)
    return np.concatenate(blocks, dtype=np.float64)


def _values(frames: Any, name: str, dim: int) -> Any:
    """A column's numbers one after the other."""
    column = frames[name].combine_chunks()
    return column.flatten() if dim > 1 else column


def _check_statistics(
    path: Path, found: dict[str, np.ndarray], expected: dict[str, np.ndarray], spec: DatasetSpec
) -> None:
    scale = np.maximum(np.maximum(np.abs(expected["min"]), np.abs(expected["max"])), 1e-300)
    for kind in NAMES:
        wrong = np.flatnonzero(~(np.abs(found[kind] - expected[kind]) <= TOLERANCE * scale))
        if len(wrong):
            name = next(
                name
                for name, part in lerobot.feature_slices(spec.features).items()
                if wrong[0] < part.stop
            )
            raise _wrong(path, f"{kind} of {name}", found[kind][wrong[0]], expected[kind][wrong[0]])


def _check_totals(
    folder: Path, total: RunningStatistics, spec: DatasetSpec, leftover: Sequence[Path]
) -> None:
    path = folder / lerobot.STATS
    try:
        stats = json.loads(path.read_text(encoding="utf-8"))
        found = {
            kind: np.concatenate(
                [stats[name][kind] for name in lerobot.feature_slices(spec.features)]
            )
            for kind in NAMES
        }
        counts = {stats[name]["count"][0] for name in stats}
    except (OSError, ValueError, KeyError) as error:
        raise DatasetError(
            f"{path} cannot be read ({error}), expected statistics of every feature. Write it anew"
        ) from error
    if leftover and counts != {total.count}:
        return  # a kill between the two last files: the next writer puts it right
    if counts != {total.count}:
        raise _wrong(path, "count", sorted(counts), total.count)
    _check_statistics(path, found, total.read(), spec)


def _wrong(path: Path, what: str, found: object, expected: object) -> DatasetError:
    return DatasetError(
        f"{path}: {what}: found {found}, expected {expected}. Restore the file, or write the"
        " dataset anew"
    )
