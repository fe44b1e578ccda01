"""LeRobotDataset v3 on disk: where each file lies, and its content.

    meta/info.json                          what the dataset is, and how much of it counts: written
                                            last
    meta/stats.json                         statistics of all frames, by feature
    meta/tasks.parquet                      task texts and their indices
    meta/episodes/chunk-000/file-000.parquet  a row per episode: task, length, place, statistics
    data/chunk-000/file-000.parquet         the frames, a row group per episode
    videos/<name>/chunk-000/file-000.mp4    the images of the same frames, if there are any

A shard is a data file, the episodes file and the videos of the same number. Shards are never
changed once they count.
"""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mjstack.datasets.spec import INDICES, DatasetSpec
from mjstack.errors import MissingExtra

VERSION = "v3.0"
CHUNK = 1000  # files in a folder
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA = f"data/{FILE}.parquet"
EPISODES = f"meta/episodes/{FILE}.parquet"
VIDEO = f"videos/{{video_key}}/{FILE}.mp4"
DATA_MB = 100  # size at which a data file is full
VIDEO_MB = 200  # the same of a video
INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
# What pandas writes of a data frame of task indices whose index is the text
_PANDAS = (
    '{"index_columns": ["task"], "column_indexes": [{"name": null, "field_name": null,'
    ' "pandas_type": "unicode", "numpy_type": "object", "metadata": {"encoding": "UTF-8"}}],'
    ' "columns": [{"name": "task_index", "field_name": "task_index", "pandas_type": "int64",'
    ' "numpy_type": "int64", "metadata": null}, {"name": "task", "field_name": "task",'
    ' "pandas_type": "unicode", "numpy_type": "object", "metadata": null}],'
    ' "pandas_version": "2.3.3"}'
)
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


def shard_path(folder: Path, files: str, shard: int, video: str = "") -> Path:
    """Where a shard's frames (`DATA`), episodes (`EPISODES`) or images (`VIDEO`) are."""
    return folder / files.format(**shard_indices(shard), video_key=video)


def columns_of(spec: DatasetSpec) -> dict[str, tuple[str, int]]:
    """Type and dimension of every column of the frames, in the order of the files."""
    columns = {name: (feature.dtype, feature.dim) for name, feature in spec.features.items()}
    return columns | {name: (dtype, 1) for name, dtype in INDICES.items()}


def statistics_of(spec: DatasetSpec) -> dict[str, list[int]]:
    """Shape of the statistics of every column and, after those, of every video's channels."""
    shapes = {name: [dim] for name, (_, dim) in columns_of(spec).items()}
    return shapes | {name: [3, 1, 1] for name in spec.videos}


def make_info(
    spec: DatasetSpec,
    *,
    provenance: Sequence[Mapping[str, Any]] = (),
    episodes: int = 0,
    frames: int = 0,
    tasks: int = 0,
    shards: int = 0,
) -> dict[str, Any]:
    """The content of info.json. LeRobot does not read the block ``mjstack``.

    ``provenance`` is that of each writer that differed from the one before, with its first episode.
    Files with numbers from ``shards`` on do not count.
    """
    names = {name: list(feature.names) for name, feature in spec.features.items()}
    features: dict[str, Any] = {
        name: {"dtype": dtype, "shape": [dim], "names": names.get(name)}
        for name, (dtype, dim) in columns_of(spec).items()
    }
    for name, video in spec.videos.items():
        size = {"height": video.height, "width": video.width, "channels": 3}
        coding = {"codec": video.codec, "pix_fmt": "yuv420p", "fps": spec.fps}
        features[name] = {
            "dtype": "video",
            "shape": list(size.values()),
            "names": list(size),
            "info": {f"video.{key}": value for key, value in (size | coding).items()}
            | {"has_audio": False, "is_depth_map": False},
        }
    return {
        "codebase_version": VERSION,
        "robot_type": spec.robot_type,
        "fps": spec.fps,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": CHUNK,
        "data_files_size_in_mb": DATA_MB,
        "video_files_size_in_mb": VIDEO_MB,  # LeRobot wants a number without videos too
        "data_path": DATA,
        "video_path": VIDEO if spec.videos else None,
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
    for name, (dtype, dim) in columns_of(spec).items():
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
    """Task texts as a pandas data frame whose index is the text: so LeRobot reads them."""
    pa, _ = require_pyarrow()
    table = pa.table({"task_index": range(len(tasks)), "task": list(tasks)})
    return table.replace_schema_metadata({"pandas": _PANDAS})


def episode_statistics(frames: np.ndarray) -> np.ndarray:
    """Statistics of every number over one episode.

    Args:
        frames: Shape ``(frames, dim)``, float64.

    Returns:
        Shape ``(statistics, dim)``, in the order of `STATISTICS`; std is that of these frames
        (divided by n), quantiles interpolate.
    """
    quantiles = np.quantile(frames, [*QUANTILES.values()], axis=0)
    return np.stack([frames.min(0), frames.max(0), frames.mean(0), frames.std(0), *quantiles])


def sampled_frames(frames: int) -> np.ndarray:
    """The frames of an episode whose images statistics are of, as LeRobot chooses them."""
    count = max(min(100, frames), min(int(frames**0.75), 10_000))
    return np.round(np.linspace(0, frames - 1, count)).astype(int)


def image_statistics(images: np.ndarray) -> np.ndarray:
    """Statistics of red, green and blue in 0 to 1, over all pixels of some images.

    Args:
        images: Shape ``(n, height, width, 3)``, uint8.

    Returns:
        Shape ``(statistics, 3)``, in the order of `STATISTICS`.
    """
    side = max(images.shape[1:3])
    if side >= 300:  # LeRobot leaves pixels of large images out
        images = images[:, :: side // 150, :: side // 150]
    values = np.arange(256.0)
    statistics = []
    for channel in range(3):
        pixels = torch.from_numpy(np.ascontiguousarray(images[..., channel]))
        counts = torch.bincount(pixels.flatten(), minlength=256).numpy()  # NumPy's: six times it
        present = np.flatnonzero(counts)
        mean = np.average(values, weights=counts)
        std = math.sqrt(np.average((values - mean) ** 2, weights=counts))
        quantiles = np.searchsorted(np.cumsum(counts) / counts.sum(), list(QUANTILES.values()))
        statistics.append([present[0], present[-1], mean, std, *quantiles])
    return np.array(statistics).T / 255.0


def merge_statistics(*parts: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Statistics of all frames, exact but for the quantiles, and the number of frames of each
    number, shape ``(dim,)``.

    The quantiles are the parts' quantiles weighted by frames, as LeRobot has them: those of all
    frames would need all frames.

    Args:
        parts: Statistics of each part, as `episode_statistics` returns them, and frames of each
            number, shape ``(dim,)``.
    """
    stacked = np.stack([statistics for statistics, _ in parts])
    frames = np.stack([counts for _, counts in parts])
    weights = frames / frames.sum(0)
    merged = (weights[:, None] * stacked).sum(0)
    lows, highs, means, stds = stacked[:, :4].swapaxes(0, 1)
    merged[0] = lows.min(0)
    merged[1] = highs.max(0)
    merged[3] = np.sqrt((weights * (stds**2 + (means - merged[2]) ** 2)).sum(0))
    return merged, frames.sum(0)


def name_statistics(
    spec: DatasetSpec, statistics: np.ndarray, counts: np.ndarray
) -> dict[str, dict[str, list]]:
    """Statistics ``(statistics, dim)`` by feature and name, and the number of frames that they are
    of, shape ``(dim,)``: the content of stats.json.
    """
    named: dict[str, dict[str, list]] = {}
    start = 0
    for name, shape in statistics_of(spec).items():
        values = statistics[:, start : start + shape[0]].reshape(-1, *shape).tolist()
        named[name] = dict(zip(STATISTICS, values, strict=True))
        named[name]["count"] = [int(counts[start])]
        start += shape[0]
    return named


def row_statistics(spec: DatasetSpec, row: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Statistics of an episode from its row, as `episode_statistics` returns them, and the number
    of frames that each number's are of, shape ``(dim,)``.

    Raises:
        Exception: The row has others.
    """
    shapes = statistics_of(spec)
    rows = [[np.ravel(row[f"stats/{name}/{kind}"]) for name in shapes] for kind in STATISTICS]
    statistics = np.array([np.concatenate(values) for values in rows], dtype=float)
    counts = np.concatenate([row[f"stats/{name}/count"] * shapes[name][0] for name in shapes])
    dims = sum(shape[0] for shape in shapes.values())
    whole = statistics.shape == (len(STATISTICS), dims) and counts.shape == (dims,)
    if not whole or not np.isfinite(statistics).all() or counts.min() < 1:
        raise ValueError(f"statistics of episode {row['episode_index']}")
    return statistics, counts
