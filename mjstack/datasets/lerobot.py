"""LeRobotDataset v3 on disk: where each file lies, and its content.

    meta/info.json                          what the dataset is, and how much of it counts: written
                                            last
    meta/stats.json                         statistics of all frames, by feature
    meta/tasks.parquet                      task texts and their indices
    meta/episodes/chunk-000/file-000.parquet  a row per episode: task, length, place, statistics
    data/chunk-000/file-000.parquet         the frames, a row group per episode

A shard is a data file and the episodes file of the same number. Shards are never changed once they
count.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.datasets.spec import INDICES, DatasetSpec, Feature
from mjstack.errors import MissingExtra

VERSION = "v3.0"
CHUNK = 1000  # files in a folder
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA = f"data/{FILE}"
EPISODES = f"meta/episodes/{FILE}"
INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
STATISTICS = ("min", "max", "mean", "std", *QUANTILES)  # `count` stands beside them


def require_pyarrow() -> tuple[Any, Any]:
    """`pyarrow` and `pyarrow.parquet`, loaded when a dataset is opened, and not before.

    Raises:
        MissingExtra: pyarrow is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MissingExtra("a dataset", "pyarrow", "datasets") from error
    return pyarrow, pyarrow.parquet


def shard_indices(shard: int) -> dict[str, int]:
    """Chunk and file index of a shard."""
    return {"chunk_index": shard // CHUNK, "file_index": shard % CHUNK}


def shard_path(folder: Path, files: str, shard: int) -> Path:
    """Where a shard's frames (`DATA`) or episodes (`EPISODES`) are."""
    return folder / files.format(**shard_indices(shard))


def all_features(features: Mapping[str, Feature]) -> dict[str, tuple[str, int]]:
    """Type and dimension of every column of the frames, in the order of info.json and of
    the files.
    """
    own = {name: (feature.dtype, feature.dim) for name, feature in features.items()}
    return own | {name: (dtype, 1) for name, dtype in INDICES.items()}


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

    ``provenance`` is that of each writer that differed from the one before, with its first episode.
    Files with numbers from ``shards`` on do not count.
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
        "video_files_size_in_mb": 200,  # LeRobot's default: it wants a number without videos too
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


def to_json(data: Mapping[str, Any]) -> str:
    """Text of a JSON file."""
    return json.dumps(data, indent=4, ensure_ascii=False, allow_nan=False) + "\n"


def frames_schema(spec: DatasetSpec) -> Any:
    """Arrow schema of the data files, with the types as Hugging Face `datasets` expects them."""
    pa, _ = require_pyarrow()
    columns = []
    types = {}
    for name, (dtype, dim) in all_features(spec.features).items():
        scalar = pa.bool_() if dtype == "bool" else getattr(pa, dtype)()
        value = {"dtype": dtype, "_type": "Value"}
        columns.append(pa.field(name, scalar if dim == 1 else pa.list_(scalar, dim)))
        types[name] = value if dim == 1 else {"feature": value, "length": dim, "_type": "List"}
    return pa.schema(columns, metadata={"huggingface": json.dumps({"info": {"features": types}})})


def frames_table(schema: Any, columns: Mapping[str, np.ndarray]) -> Any:
    """The frames of an episode, each column ``(frames, dim)``."""
    pa, _ = require_pyarrow()
    arrays = []
    for field in schema:
        values = pa.array(columns[field.name].reshape(-1))
        if pa.types.is_fixed_size_list(field.type):
            values = pa.FixedSizeListArray.from_arrays(values, type=field.type)
        arrays.append(values)
    return pa.Table.from_arrays(arrays, schema=schema)


def tasks_table(tasks: Sequence[str]) -> Any:
    """Task texts as pandas keeps a data frame whose index is the text, which is how LeRobot reads
    them.
    """
    pa, _ = require_pyarrow()
    fields = ("name", "field_name", "pandas_type", "numpy_type", "metadata")
    columns = (
        ("task_index", "task_index", "int64", "int64", None),
        ("task", "task", "unicode", "object", None),
    )
    label = (None, None, "unicode", "object", {"encoding": "UTF-8"})
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [dict(zip(fields, label, strict=True))],
        "columns": [dict(zip(fields, column, strict=True)) for column in columns],
        "pandas_version": "2.3.3",
    }
    table = pa.table({"task_index": range(len(tasks)), "task": list(tasks)})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def episode_statistics(frames: np.ndarray) -> np.ndarray:
    """Statistics of every number over one episode.

    Args:
        frames: Shape ``(frames, dim)``, float64.

    Returns:
        Shape ``(statistics, dim)``, in the order of `STATISTICS`; std is that of these frames
        (divided by n), quantiles interpolate.
    """
    ranked = np.sort(frames, axis=0)
    at = np.array([*QUANTILES.values()]) * (len(frames) - 1)
    below = at.astype(int)
    above = np.minimum(below + 1, len(frames) - 1)
    quantiles = ranked[below] + (at - below)[:, None] * (ranked[above] - ranked[below])
    return np.stack([ranked[0], ranked[-1], frames.mean(0), frames.std(0), *quantiles])


def merge_statistics(parts: Sequence[np.ndarray], counts: Sequence[int]) -> np.ndarray:
    """Statistics of all frames, exact but for the quantiles.

    Those are the parts' quantiles weighted by frames, as LeRobot has them: those of all frames
    would need all frames.

    Args:
        parts: Statistics of each part, as `episode_statistics` returns them.
        counts: Frames of each.
    """
    stacked = np.stack(parts)
    weights = np.array(counts) / sum(counts)
    merged = np.tensordot(weights, stacked, 1)
    lows, highs, means, stds = stacked[:, :4].swapaxes(0, 1)
    merged[0] = lows.min(0)
    merged[1] = highs.max(0)
    merged[3] = np.sqrt(weights @ (stds**2 + (means - merged[2]) ** 2))
    return merged


def name_statistics(
    features: Mapping[str, Feature], statistics: np.ndarray, count: int
) -> dict[str, dict[str, list]]:
    """Statistics ``(statistics, dim)`` by feature and name, and the number of frames that they are
    of: the content of stats.json.
    """
    named = {}
    start = 0
    for name, (_, dim) in all_features(features).items():
        values = statistics[:, start : start + dim].tolist()
        named[name] = dict(zip(STATISTICS, values, strict=True)) | {"count": [count]}
        start += dim
    return named


def row_statistics(features: Mapping[str, Feature], row: Mapping[str, Any]) -> np.ndarray:
    """Statistics of an episode from its row, as `episode_statistics` returns them.

    Raises:
        Exception: The row has others.
    """
    found = np.array(
        [
            np.concatenate([row[f"stats/{name}/{kind}"] for name in all_features(features)])
            for kind in STATISTICS
        ],
        dtype=float,
    )
    dims = sum(dim for _, dim in all_features(features).values())
    if found.shape != (len(STATISTICS), dims) or not np.isfinite(found).all():
        raise ValueError(f"statistics of episode {row['episode_index']}")
    return found
