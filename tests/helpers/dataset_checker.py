"""Holds a whole dataset to what its files say of each other, in NumPy, beside the writer."""

import json
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mjstack.datasets import StoredDataset, read_dataset
from mjstack.datasets.part import PartWriter, ShardFiles
from mjstack.datasets.spec import EpisodeData
from mjstack.datasets.writer import DatasetWriter

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, by its path in it."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def listed(folder: Path) -> list[Path]:
    """Every file that LeRobot may list, hidden ones too: each of them opens."""
    paths = sorted([*folder.glob("**/*.parquet"), *folder.glob("**/*.mp4")])
    for path in paths:
        if path.suffix == ".parquet":
            pq.ParquetFile(path).read()
        else:
            assert b"moov" in path.read_bytes()
    return paths


def add(writer: DatasetWriter, *episodes: EpisodeData, commit: bool = True) -> ShardFiles:
    """Writes episodes into a file of their own, which counts once it is committed."""
    with writer.guarded():
        part = PartWriter(writer.folder, writer.spec, "rank0000-0", 1.0)
        frame = writer.frames
        for number, episode in enumerate(episodes, len(writer.committed)):
            part.write(episode, number, frame)
            frame += part.files.rows[-1]["length"]
        complete = part.complete()
    if commit:
        writer.commit([complete])
    return complete


def images_of(stored: StoredDataset, name: str, episode: int) -> np.ndarray:
    """Decodes an episode's images, shape ``(frames, height, width, 3)``, uint8."""
    row = stored.episodes[episode]
    place = {key: row[f"data/{key}"] for key in ("chunk_index", "file_index")}
    path = stored.folder / stored.info["video_path"].format(video_key=name, **place)
    fps = stored.info["fps"]
    seek = ["-ss", f"{max(0.0, row[f'videos/{name}/from_timestamp'] - 0.5 / fps):.6f}"]
    count = ["-frames:v", str(row["length"])]
    reader = imageio_ffmpeg.read_frames(path, input_params=seek, output_params=count)
    next(reader)  # what ffmpeg says of the file
    shape = (row["length"], *stored.info["features"][name]["shape"])
    return np.frombuffer(b"".join(reader), np.uint8).reshape(shape)


def with_column(table: pa.Table, name: str, values: Any) -> pa.Table:
    """A table with other values of a column."""
    return table.set_column(table.schema.get_field_index(name), name, values)


def check_dataset(folder: Path) -> StoredDataset:
    """Types and dimensions are those of info.json; indices, timestamps and places run on without a
    gap; every number is finite; tasks, lengths and totals agree; the statistics of each episode and
    of all are those of their frames.
    """
    stored = read_dataset(folder)
    features = stored.info["features"]
    every: list[dict[str, np.ndarray]] = []
    episode = frame = 0
    for shard in range(stored.info["mjstack"]["shards"]):
        place = {"chunk_index": shard // 1000, "file_index": shard % 1000}
        name = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet".format(**place)
        data = pq.ParquetFile(folder / "data" / name)
        rows = pq.read_table(folder / "meta/episodes" / name).to_pylist()
        assert data.schema_arrow.names == list(features)
        told = json.loads(data.schema_arrow.metadata[b"huggingface"])["info"]["features"]
        assert list(told) == list(features)
        assert data.num_row_groups == len(rows)
        for group, row in enumerate(rows):
            table = data.read_row_group(group)
            columns = {one: column(table, one, features[one]) for one in features}
            length = len(table)
            assert row["episode_index"] == episode
            assert (row["length"], row["dataset_from_index"]) == (length, frame)
            assert row["dataset_to_index"] == frame + length
            for key, index in place.items():
                assert row[f"data/{key}"] == row[f"meta/episodes/{key}"] == index
            assert {int(i) for i in columns["task_index"][:, 0]} == {
                stored.tasks.index(row["tasks"][0])
            }
            expected = {
                "timestamp": (np.arange(length) / stored.info["fps"]).astype(np.float32),
                "frame_index": np.arange(length),
                "episode_index": np.full(length, episode),
                "index": frame + np.arange(length),
            }
            for one, values in expected.items():
                assert np.array_equal(columns[one][:, 0], values), one
            for one, values in columns.items():
                found = {kind: row[f"stats/{one}/{kind}"] for kind in (*exact(values), *QUANTILES)}
                assert_close(found, exact(values) | quantiles_of(values), values)
                assert row[f"stats/{one}/count"] == [length]
            every.append(columns)
            episode += 1
            frame += length
    assert (episode, frame) == (stored.info["total_episodes"], stored.info["total_frames"])
    assert stored.info["total_tasks"] == len(stored.tasks)
    if every:
        stats = json.loads((folder / "meta/stats.json").read_text())
        assert list(stats) == list(features)
        for one in features:
            values = np.concatenate([columns[one] for columns in every])
            assert_close(stats[one], exact(values) | quantiles_of(values), values)
            assert stats[one]["count"] == [frame]
            assert np.array_equal(stored.frames(one), values)
    return stored


def column(table: pa.Table, name: str, feature: dict[str, Any]) -> np.ndarray:
    """A column's numbers, shape ``(frames, dim)``, in its type."""
    (dim,) = feature["shape"]
    kind = table.schema.field(name).type
    assert pa.types.is_fixed_size_list(kind) == (dim > 1)
    numbers = table[name].combine_chunks()
    if dim > 1:
        assert kind.list_size == dim
        numbers = numbers.flatten()
    assert numbers.null_count == 0
    values = numbers.to_numpy(zero_copy_only=False).reshape(len(table), dim)
    assert values.dtype == np.dtype(feature["dtype"])
    assert np.isfinite(values).all()
    return values


def exact(values: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics but for the quantiles."""
    numbers = values.astype(np.float64)
    return {
        "min": numbers.min(0),
        "max": numbers.max(0),
        "mean": numbers.mean(0),
        "std": numbers.std(0),
    }


def quantiles_of(values: np.ndarray) -> dict[str, np.ndarray]:
    """Quantiles, interpolated between two values."""
    return {
        kind: np.quantile(values.astype(float), quantile, axis=0)
        for kind, quantile in QUANTILES.items()
    }


def assert_close(
    found: dict[str, Any], expected: dict[str, np.ndarray], values: np.ndarray
) -> None:
    """Sums in another order differ by rounding."""
    scale = np.abs(values.astype(np.float64)).max(0)
    for kind, numbers in expected.items():
        assert np.all(np.abs(np.asarray(found[kind]) - numbers) <= 1e-9 * scale + 1e-300), kind
