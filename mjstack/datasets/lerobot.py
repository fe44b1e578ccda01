"""LeRobotDataset v3 on disk: where each file lies, and what is in it.

    meta/info.json                          what the dataset is, and how much of it counts: written
    last meta/stats.json                         statistics of all frames, by feature
    meta/tasks.parquet                      task texts and their indices
    meta/episodes/chunk-000/file-000.parquet  a row per episode: task, length, place, statistics
    data/chunk-000/file-000.parquet         the frames, a row group per episode

A shard is a data file and the episodes file of the same number. Shards are never changed once they
count.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.datasets.arrow import require_pyarrow
from mjstack.datasets.spec import INDICES, DatasetSpec, Feature
from mjstack.datasets.statistics import NAMES

VERSION = "v3.0"
CHUNK = 1000  # files in a folder
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA = f"data/{FILE}"
EPISODES = f"meta/episodes/{FILE}"
INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"


def shard_indices(shard: int) -> dict[str, int]:
    """Chunk and file index of a shard."""
    return {"chunk_index": shard // CHUNK, "file_index": shard % CHUNK}


def data_path(folder: Path, shard: int) -> Path:
    """Where a shard's frames are."""
    return folder / DATA.format(**shard_indices(shard))


def episodes_path(folder: Path, shard: int) -> Path:
    """Where a shard's episodes are."""
    return folder / EPISODES.format(**shard_indices(shard))


def all_features(features: Mapping[str, Feature]) -> dict[str, tuple[str, int]]:
    """Type and dimension of every column of the frames, in the order of info.json and of
    the files.
    """
    return {name: (f.dtype, f.dim) for name, f in features.items()} | {
        name: (dtype, 1) for name, dtype in INDICES.items()
    }


def make_info(
    spec: DatasetSpec,
    *,
    provenance: Sequence[Mapping[str, Any]] = (),
    file_mb: int = 100,
    episodes: int = 0,
    frames: int = 0,
    tasks: int = 0,
    shards: int = 0,
) -> dict[str, Any]:
    """The content of info.json. LeRobot does not read the block ``mjstack``.

    Args:
        spec: What the dataset is.
        provenance: Of each writer that differed from the one before, with its first episode.
        file_mb: Size of a data file at which the next begins [MiB].
        episodes: How many there are.
        frames: Likewise.
        tasks: Likewise.
        shards: Likewise; files with higher numbers do not count.
    """
    features: dict[str, Any] = {
        name: {"dtype": feature.dtype, "shape": [feature.dim], "names": list(feature.names)}
        for name, feature in spec.features.items()
    }
    features |= {
        name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in INDICES.items()
    }
    return {
        "codebase_version": VERSION,
        "robot_type": spec.robot_type,
        "fps": spec.fps,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": CHUNK,
        "data_files_size_in_mb": file_mb,
        "video_files_size_in_mb": (
            200
        ),  # LeRobot's default: a reader wants a number though there is no video
        "data_path": DATA,
        "video_path": None,
        "splits": {"train": f"0:{episodes}"},
        "features": features,
        "mjstack": {
            "config_sha256": spec.config_sha256,
            "shards": shards,
            "units": {name: list(feature.units) for name, feature in spec.features.items()},
            "values": dict(spec.values),
            "provenance": list(provenance),
        },
    }


def to_json(data: Mapping[str, Any]) -> bytes:
    """Text of a JSON file."""
    return (json.dumps(data, indent=4, ensure_ascii=False, allow_nan=False) + "\n").encode()


def frames_schema(spec: DatasetSpec) -> Any:
    """Arrow schema of the data files, with the types as Hugging Face `datasets` wants them told."""
    pa, _ = require_pyarrow()
    columns = []
    told = {}
    for name, (dtype, dim) in all_features(spec.features).items():
        scalar = _arrow_type(dtype)
        value = {"dtype": dtype, "_type": "Value"}
        columns.append(pa.field(name, scalar if dim == 1 else pa.list_(scalar, dim)))
        told[name] = value if dim == 1 else {"feature": value, "length": dim, "_type": "List"}
    return pa.schema(columns, metadata={"huggingface": json.dumps({"info": {"features": told}})})


def frames_table(schema: Any, columns: Mapping[str, np.ndarray]) -> Any:
    """The frames of an episode, each column ``(frames, dim)``."""
    pa, _ = require_pyarrow()
    arrays = []
    for field in schema:
        values = pa.array(columns[field.name].reshape(-1))
        many = pa.types.is_fixed_size_list(field.type)
        arrays.append(
            pa.FixedSizeListArray.from_arrays(values, type=field.type) if many else values
        )
    return pa.Table.from_arrays(arrays, schema=schema)


def tasks_table(tasks: Sequence[str]) -> Any:
    """Task texts as pandas keeps a data frame whose index is the text, which is how LeRobot reads
    them.
    """
    pa, _ = require_pyarrow()
    label = {
        "name": None,
        "field_name": None,
        "pandas_type": "unicode",
        "numpy_type": "object",
        "metadata": {"encoding": "UTF-8"},
    }
    columns = [
        {
            "name": "task_index",
            "field_name": "task_index",
            "pandas_type": "int64",
            "numpy_type": "int64",
            "metadata": None,
        },
        {
            "name": "task",
            "field_name": "task",
            "pandas_type": "unicode",
            "numpy_type": "object",
            "metadata": None,
        },
    ]
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [label],
        "columns": columns,
        "pandas_version": "2.3.3",
    }
    schema = pa.schema(
        [("task_index", pa.int64()), ("task", pa.string())], metadata={"pandas": json.dumps(pandas)}
    )
    return pa.table({"task_index": list(range(len(tasks))), "task": list(tasks)}, schema=schema)


def episodes_table(
    spec: DatasetSpec,
    rows: Mapping[str, Sequence[Any]],
    statistics: Sequence[Mapping[str, np.ndarray]],
) -> Any:
    """The rows of some episodes.

    Args:
        spec: What the dataset is.
        rows: The columns that are no statistics.
        statistics: Each episode's, over all features one after the other.
    """
    pa, _ = require_pyarrow()
    columns: dict[str, Any] = dict(rows)
    stacked = {kind: np.stack([episode[kind] for episode in statistics]) for kind in NAMES}
    starts = np.arange(len(statistics) + 1, dtype=np.int32)
    lengths = pa.array(np.asarray(rows["length"], dtype=np.int64))
    for name, part in feature_slices(spec.features).items():
        for kind in NAMES:
            values = pa.array(np.ascontiguousarray(stacked[kind][:, part]).reshape(-1))
            columns[f"stats/{name}/{kind}"] = pa.ListArray.from_arrays(
                starts * (part.stop - part.start), values
            )
        columns[f"stats/{name}/count"] = pa.ListArray.from_arrays(starts, lengths)
    return pa.table(columns, schema=pa.schema(list(episodes_types(spec).items())))


def episodes_types(spec: DatasetSpec) -> dict[str, Any]:
    """Arrow types of the episodes' columns, in the order of the files."""
    pa, _ = require_pyarrow()
    own = {"success": pa.bool_(), "seed": pa.int64(), "world": pa.int64()}
    types = {
        "episode_index": pa.int64(),
        "tasks": pa.list_(pa.string()),
        **dict.fromkeys(
            (
                "length",
                "data/chunk_index",
                "data/file_index",
                "dataset_from_index",
                "dataset_to_index",
            ),
            pa.int64(),
        ),
        **own,
        **{name: _arrow_type(dtype) for name, dtype in spec.values.items()},
        **dict.fromkeys(("meta/episodes/chunk_index", "meta/episodes/file_index"), pa.int64()),
    }
    for name in all_features(spec.features):
        types |= {f"stats/{name}/{kind}": pa.list_(pa.float64()) for kind in NAMES}
        types[f"stats/{name}/count"] = pa.list_(pa.int64())
    return types


def feature_slices(features: Mapping[str, Feature]) -> dict[str, slice]:
    """Where each feature's numbers lie in statistics over all features."""
    out = {}
    start = 0
    for name, (_, dim) in all_features(features).items():
        out[name] = slice(start, start + dim)
        start += dim
    return out


def statistics_of(table: Any, features: Mapping[str, Feature]) -> list[dict[str, np.ndarray]]:
    """Each episode's statistics from its row, over all features one after the other."""
    parts = {
        kind: [
            table[f"stats/{name}/{kind}"]
            .combine_chunks()
            .flatten()
            .to_numpy()
            .reshape(len(table), part.stop - part.start)
            for name, part in feature_slices(features).items()
        ]
        for kind in NAMES
    }
    joined = {kind: np.concatenate(blocks, axis=1) for kind, blocks in parts.items()}
    return [{kind: joined[kind][row] for kind in NAMES} for row in range(len(table))]


def counts_of(table: Any, features: Mapping[str, Feature]) -> list[set[int]]:
    """The frames that each episode's statistics are of, as each feature has them."""
    columns = [table[f"stats/{name}/count"].to_pylist() for name in all_features(features)]
    return [{count for counted in row for count in counted} for row in zip(*columns, strict=True)]


def stats_json(
    features: Mapping[str, Feature], count: int, statistics: Mapping[str, np.ndarray]
) -> bytes:
    """The content of stats.json."""
    return to_json(
        {
            name: {kind: statistics[kind][part].tolist() for kind in NAMES} | {"count": [count]}
            for name, part in feature_slices(features).items()
        }
    )


def _arrow_type(dtype: str) -> Any:
    pa, _ = require_pyarrow()
    return {"bool": pa.bool_(), "string": pa.string()}.get(dtype) or getattr(pa, dtype)()
