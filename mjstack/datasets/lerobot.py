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
MOST_ROWS = 5000  # episodes with which a file is full too: its footer tells of each
INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
STATISTICS = ("min", "max", "mean", "std", *QUANTILES)  # `count` stands beside them
PIXELS = "pixels"  # columns of an episode's row: counts of its images' values, of each video
# What pandas writes of a data frame of task indices whose index is the text
_PANDAS = (
    '{"index_columns": ["task"], "column_indexes": [{"name": null, "field_name": null,'
    ' "pandas_type": "unicode", "numpy_type": "object", "metadata": {"encoding": "UTF-8"}}],'
    ' "columns": [{"name": "task_index", "field_name": "task_index", "pandas_type": "int64",'
    ' "numpy_type": "int64", "metadata": null}, {"name": "task", "field_name": "task",'
    ' "pandas_type": "unicode", "numpy_type": "object", "metadata": null}],'
    ' "pandas_version": "2.3.3"}'
)


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


def make_info(
    spec: DatasetSpec,
    provenance: Sequence[Mapping[str, Any]] = (),
    *,
    episodes: int = 0,
    frames: int = 0,
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
        "total_tasks": min(1, episodes),
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


def episode_columns(
    spec: DatasetSpec, shard: int, number: int, first: int, start: int, end: int
) -> dict[str, Any]:
    """Columns of the row of an episode that say where it is: in a shard whose first frame is
    ``first``, from frame ``start`` to before ``end``.
    """
    columns = {
        "episode_index": number,
        "length": end - start,
        "dataset_from_index": start,
        "dataset_to_index": end,
    }
    folders = [f"videos/{name}" for name in spec.videos]
    for name, value in shard_indices(shard).items():
        columns |= {f"{files}/{name}": value for files in ("data", "meta/episodes", *folders)}
    times = {"from_timestamp": start - first, "to_timestamp": end - first}
    return columns | {
        f"{files}/{name}": time / spec.fps for files in folders for name, time in times.items()
    }


def is_foreign(info: Mapping[str, Any]) -> bool:
    """Whether mjstack has not written a dataset, so that there may be other columns and files."""
    return "mjstack" not in info


def check_info(info: Any) -> None:
    """Raise an error of any kind where counts and features of info.json cannot be used."""
    counts = {name: info[name] for name in ("fps", "total_episodes", "total_frames")}
    if not is_foreign(info):
        counts["shards"] = info["mjstack"]["shards"]
    for name, value in counts.items():
        if (type(value) is not int and name != "fps") or not 0 <= value < math.inf:
            raise ValueError(f"{name} is {value!r:.60}")
    if not info["fps"]:
        raise ValueError("fps is 0")
    for name, feature in info["features"].items():
        if not all(type(number) is int and number > 0 for number in feature["shape"]):
            raise ValueError(f"the shape of {name} is {feature['shape']!r:.60}")
    video_columns(info)


def video_columns(info: Mapping[str, Any]) -> list[str]:
    """The videos of info.json."""
    return [name for name, feature in info["features"].items() if feature["dtype"] == "video"]


def numeric_columns(info: Mapping[str, Any]) -> list[str]:
    """The columns of info.json but for the videos."""
    return [name for name, feature in info["features"].items() if feature["dtype"] != "video"]


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


def tasks_table(task: str) -> Any:
    """Task texts as a pandas data frame whose index is the text: so LeRobot reads them."""
    pa, _ = require_pyarrow()
    table = pa.table({"task_index": [0], "task": [task]})
    return table.replace_schema_metadata({"pandas": _PANDAS})
