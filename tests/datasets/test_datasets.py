"""Datasets in the layout of LeRobotDataset v3: what is on disk, and that nothing committed is ever
lost.
"""

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from dataset_checker import add, check_dataset, contents, listed, with_column
from environments import Patch

from mjstack.datasets import lerobot, part, read_dataset
from mjstack.datasets.lerobot import STATISTICS as NAMES
from mjstack.datasets.part import PartWriter
from mjstack.datasets.reader import uncommitted
from mjstack.datasets.spec import DatasetSpec, EpisodeData, Feature
from mjstack.datasets.writer import DatasetWriter
from mjstack.errors import FolderError, MissingExtra, UnknownName

GUIDE = Path(__file__).resolve().parents[2] / "docs" / "datasets.md"
JOINTS = ("shoulder", "elbow", "jaw")


def vector(*names: str, dtype: str = "float32", unit: str = "rad") -> Feature:
    return Feature(dtype=dtype, names=names, units=(unit,) * len(names))


SPEC = DatasetSpec(
    robot_type="so101",
    fps=50,
    task="stack",
    features={
        "observation.state": vector(*JOINTS),
        "action": vector("shoulder", "jaw"),
        "next.reward": vector("reward", unit="1"),
        "next.done": vector("done", dtype="bool", unit="1"),
        "count": vector("count", dtype="int32", unit="1"),
    },
    config_sha256="c" * 64,
    values={"xy_err": "float64", "peak": "int64", "settled": "bool", "note": "string"},
    provenance={"seed": 7, "versions": {"mujoco": "4.0.0"}},
)


def episode(world: int, *, frames: int = 0, seed: int = 7) -> EpisodeData:
    """Random frames that depend on the world alone; the number of frames too, unless it
    is given.
    """
    frames = frames or 20 + 3 * (world % 5)
    random = np.random.default_rng(world)
    arrays = {
        "observation.state": (
            random.normal(size=(frames, 3)) * (1.0, 1e-3, 100.0) + (0.0, 5.0, -3.0)
        ),
        "action": random.normal(size=(frames, 2)).astype(np.float32),
        "next.reward": random.random(frames),
        "next.done": np.arange(frames) == frames - 1,
        "count": np.arange(frames)[::-1],
    }
    row = {
        "success": world % 3 != 0,
        "seed": seed,
        "world": world,
        "xy_err": 1e-3 * world,
        "peak": world,
        "settled": world % 2 == 0,
        "note": f"w{world}",
    }
    return EpisodeData(arrays=arrays, row=row)


def write(folder: Path, worlds: range, *, batch: int = 3, spec: DatasetSpec = SPEC) -> None:
    """Adds worlds in batches, each committed."""
    with DatasetWriter(folder, spec) as writer:
        for first in range(worlds.start, worlds.stop, batch):
            add(writer, *map(episode, range(first, min(first + batch, worlds.stop))))


def worlds_of(folder: Path) -> list[int]:
    """Worlds of a dataset that is sound."""
    return [row["world"] for row in check_dataset(folder).episodes]


def leftover(folder: Path) -> list[Path]:
    """Files that do not count."""
    return uncommitted(folder, read_dataset(folder).info["mjstack"]["shards"])


def frames_of(table: pa.Table, name: str) -> np.ndarray:
    return np.array(table[name].to_pylist())


def test_the_files_are_those_of_lerobot(tmp_path: Path) -> None:
    """What LeRobotDataset v3.0 writes for such features, file by file (from a dataset that lerobot
    0.6.1 wrote).
    """
    write(tmp_path, range(5))
    assert set(contents(tmp_path)) == {
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
        *(
            f"{kind}/chunk-000/file-00{shard}.parquet"
            for kind in ("data", "meta/episodes")
            for shard in (0, 1)
        ),
    }
    info = json.loads((tmp_path / "meta/info.json").read_text())
    own = info.pop("mjstack")
    features = info.pop("features")
    frames = sum(20 + 3 * (world % 5) for world in range(5))
    assert info == {
        "codebase_version": "v3.0",
        "robot_type": "so101",
        "fps": 50,
        "total_episodes": 5,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "splits": {"train": "0:5"},
    }
    state = {"dtype": "float32", "shape": [3], "names": list(JOINTS)}
    assert features["observation.state"] == state
    assert features["next.done"] == {"dtype": "bool", "shape": [1], "names": ["done"]}
    indices = "timestamp frame_index episode_index index task_index"
    assert list(features)[-5:] == indices.split()
    assert features["timestamp"] == {"dtype": "float32", "shape": [1], "names": None}
    assert own["config_sha256"] == "c" * 64
    assert own["units"]["action"] == ["rad", "rad"]
    assert own["provenance"] == [{"from_episode": 0, "seed": 7, "versions": {"mujoco": "4.0.0"}}]

    schema = pq.read_schema(tmp_path / "data/chunk-000/file-000.parquet")
    assert schema.names == list(features)
    assert schema.field("observation.state").type == pa.list_(pa.float32(), 3)
    types = [str(schema.field(name).type) for name in ("next.reward", "next.done", "index")]
    assert types == ["float", "bool", "int64"]
    known = json.loads(schema.metadata[b"huggingface"])["info"]["features"]
    value = {"dtype": "float32", "_type": "Value"}
    assert known["action"] == {"feature": value, "length": 2, "_type": "List"}
    assert known["next.done"] == {"dtype": "bool", "_type": "Value"}

    tasks = pq.read_table(tmp_path / "meta/tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "stack"}]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]

    rows = pq.read_table(tmp_path / "meta/episodes")
    statistics = [f"stats/{name}/{kind}" for name in features for kind in (*NAMES, "count")]
    own_columns = ["success", "seed", "world", "xy_err", "peak", "settled", "note"]
    places = [
        f"{kind}/{index}_index" for kind in ("data", "meta/episodes") for index in ("chunk", "file")
    ]
    ranges = ["dataset_from_index", "dataset_to_index"]
    assert sorted(rows.column_names) == sorted(
        ["episode_index", "tasks", "length", *ranges, *places, *own_columns, *statistics]
    )
    assert {str(rows.schema.field(name).type) for name in statistics} == {
        "list<element: double>",
        "list<element: int64>",
    }
    assert rows["tasks"].to_pylist() == [["stack"]] * 5
    assert rows["data/file_index"].to_pylist() == [0, 0, 0, 1, 1]
    assert rows["note"].to_pylist() == [f"w{world}" for world in range(5)]


def test_what_is_read_is_what_was_added(tmp_path: Path) -> None:
    write(tmp_path, range(4))
    table = pq.read_table(tmp_path / "data")
    start = 0
    for world in range(4):
        added = episode(world)
        length = len(added.arrays["action"])
        part = table.slice(start, length)
        for name, array in added.arrays.items():
            expected = array.astype(SPEC.features[name].dtype)
            assert np.array_equal(frames_of(part, name), expected)
        assert np.array_equal(
            frames_of(part, "timestamp"), (np.arange(length) / 50).astype(np.float32)
        )
        assert part["episode_index"].unique().to_pylist() == [world]
        start += length
    assert table["index"].to_pylist() == list(range(start))
    stored = check_dataset(tmp_path)
    assert [row["world"] for row in stored.episodes] == [0, 1, 2, 3]
    assert [row["success"] for row in stored.episodes] == [False, True, True, False]
    assert stored.frames("action").shape == (start, 2)
    assert stored.frames("next.done").dtype == bool
    with pytest.raises(UnknownName, match="Did you mean 'action'"):
        stored.frames("acton")


@pytest.mark.full
def test_a_dataset_without_an_episode_has_no_frames(tmp_path: Path) -> None:
    write(tmp_path, range(0))
    stored = read_dataset(tmp_path)
    assert stored.frames("action").shape == (0, 2)
    assert stored.frames("next.done").dtype == bool


def test_statistics_are_those_of_all_frames(tmp_path: Path) -> None:
    """Episodes of unequal length, over several commits and a resumed writer; a column far from zero
    that hardly moves.
    """
    write(tmp_path, range(4))
    write(tmp_path, range(4, 11))
    check_dataset(tmp_path)
    stats = json.loads((tmp_path / "meta/stats.json").read_text())
    median = np.median(read_dataset(tmp_path).frames("next.done"))
    assert stats["next.done"]["q50"] == [median] == [0.0]
    assert stats["episode_index"]["q99"] == [10.0]


def test_statistics_keep_up_with_commits(tmp_path: Path) -> None:
    """A kill leaves those of more than half of the committed frames, an error those of all."""
    counts = []
    with DatasetWriter(tmp_path, SPEC) as writer:
        for world in range(9):
            add(writer, episode(world, frames=20))
            stats = json.loads((tmp_path / STATS).read_text())
            counts.append(stats["action"]["count"][0] // 20)
        with pytest.raises(KeyboardInterrupt), writer.guarded():
            raise KeyboardInterrupt
    assert counts == [1, 1, 3, 3, 3, 3, 7, 7, 7]
    check_dataset(tmp_path)


def test_a_resumed_dataset_is_the_uninterrupted_one(tmp_path: Path) -> None:
    write(tmp_path / "one", range(9))
    for worlds in (range(3), range(3, 6), range(6, 9)):
        write(tmp_path / "three", worlds)
    assert contents(tmp_path / "one") == contents(tmp_path / "three")


def test_writers_that_differ_are_on_record(tmp_path: Path) -> None:
    write(tmp_path, range(2))
    newer = replace(SPEC, provenance={"seed": 7, "versions": {"mujoco": "4.1.0"}})
    with DatasetWriter(tmp_path, newer):  # adds nothing: whoever comes next takes its place
        pass
    newest = replace(SPEC, provenance={"seed": 7, "versions": {"mujoco": "4.2.0"}})
    write(tmp_path, range(2, 3), spec=newest)
    write(tmp_path, range(3, 4), spec=newest)
    found = read_dataset(tmp_path).info["mjstack"]["provenance"]
    versions = [(facts["from_episode"], facts["versions"]["mujoco"]) for facts in found]
    assert versions == [(0, "4.0.0"), (2, "4.2.0")]


def test_chunks_follow_one_another(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr(lerobot, "CHUNK", 2)
    write(tmp_path, range(3), batch=1)
    assert [
        str(path.relative_to(tmp_path / "data")) for path in sorted(tmp_path.glob("data/*/*"))
    ] == ["chunk-000/file-000.parquet", "chunk-000/file-001.parquet", "chunk-001/file-000.parquet"]
    assert read_dataset(tmp_path).info["total_episodes"] == 3


@pytest.mark.full
def test_a_kill_at_any_moment_keeps_what_was_committed(tmp_path: Path, monkeypatch: Patch) -> None:
    """What one would have left is copied before each file of the second commit takes its place:
    data, tasks, episodes, statistics, info; and after.
    """
    whole = tmp_path / "whole"
    copies: list[Path] = []
    replaced = os.replace

    def copied(*paths: Any) -> None:
        copies.append(Path(shutil.copytree(whole, tmp_path / str(len(copies)))))
        if paths:
            replaced(*paths)

    with DatasetWriter(whole, SPEC) as writer:
        add(writer, *map(episode, range(3)))
        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", copied)
            add(writer, *(episode(world) for world in range(3, 6)))
            copied()
    assert len(copies) == 6
    for folder in copies:
        kept = 6 if folder == copies[-1] else 3
        assert [row["world"] for row in read_dataset(folder).episodes] == list(range(kept))
        assert bool(leftover(folder)) == (kept == 3)
        assert len(listed(folder)) >= 3
        with DatasetWriter(folder, SPEC) as writer:
            assert writer.committed == [(7, world) for world in range(kept)]
            assert not leftover(folder)
            if kept < 6:
                add(writer, *(episode(world) for world in range(kept, 6)))
        assert contents(folder) == contents(whole)


class FullDisk:
    """Files that take so many bytes in all, and then say that there is no room."""

    def __init__(self, monkeypatch: Patch, room: int) -> None:
        self.room = room
        fdopen = os.fdopen
        monkeypatch.setattr(os, "fdopen", lambda *args: self.wrap(fdopen(*args)))
        opened = lambda *args: self.wrap(open(*args))  # noqa: E731, SIM115
        monkeypatch.setattr(part, "open", opened, raising=False)

    def wrap(self, file: Any) -> Any:
        disk = self

        class File:
            def write(self, data: bytes) -> int:
                disk.room -= memoryview(data).nbytes
                if disk.room < 0:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                return file.write(data)

            def __enter__(self) -> Any:
                return self

            def __exit__(self, *error: object) -> None:
                file.close()

            def __getattr__(self, name: str) -> Any:
                return getattr(file, name)

        return File()


def second_batch(writer: DatasetWriter) -> None:
    add(writer, *(episode(world, frames=300) for world in range(3, 6)))


@pytest.mark.full
def test_a_full_disk_keeps_what_was_committed(tmp_path: Path) -> None:
    """Wherever in the second batch the room ends: in each of its frames' files and in each of the
    small ones.
    """
    write(tmp_path / "probe", range(3))
    with DatasetWriter(tmp_path / "probe", SPEC) as writer, pytest.MonkeyPatch.context() as patch:
        disk = FullDisk(patch, 10**9)
        second_batch(writer)
        needed = 10**9 - disk.room
    failed = 0
    rooms = [*np.linspace(0, needed - 1, 12).astype(int), needed - 2000, needed]
    for number, room in enumerate(rooms):
        folder = tmp_path / str(number)
        write(folder, range(3))
        before = contents(folder)
        writer = DatasetWriter(folder, SPEC)
        with pytest.MonkeyPatch.context() as patch:
            FullDisk(patch, int(room))
            if room >= needed:
                second_batch(writer)
                break
            full = r"No space left on device\): 3 committed episodes are kept"
            with pytest.raises(FolderError, match=full) as caught:
                second_batch(writer)
            assert "\n" not in str(caught.value)
        failed += 1
        assert len(writer.committed) == 3
        writer.close()
        # Small files that follow from the others may be newer; the next writer puts them right.
        newer = (lerobot.STATS, lerobot.TASKS)
        found = contents(folder)
        assert found.keys() == before.keys()
        assert all(found[name] == before[name] for name in before if name not in newer)
        with DatasetWriter(folder, SPEC) as again:
            second_batch(again)
        assert contents(folder) == contents(tmp_path / "probe")
    assert failed == 13


def test_ctrl_c_in_a_script_keeps_what_is_committed(tmp_path: Path, monkeypatch: Patch) -> None:
    """It comes in the middle of the second of three, of which the first was committed."""
    write_part = PartWriter.write
    calls = []

    def interrupted(self: PartWriter, *args: Any) -> None:
        calls.append(args)
        if len(calls) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        write_part(self, *args)

    monkeypatch.setattr(PartWriter, "write", interrupted)
    # A shell's background jobs start with it ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with DatasetWriter(tmp_path, SPEC) as writer:
            add(writer, episode(0))
            with pytest.raises(KeyboardInterrupt):
                add(writer, episode(1), episode(2))
    finally:
        signal.signal(signal.SIGINT, before)
    assert worlds_of(tmp_path) == [0]
    assert not leftover(tmp_path)


def test_another_configuration_is_refused(tmp_path: Path) -> None:
    write(tmp_path, range(1))
    before = contents(tmp_path)

    def with_feature(name: str, feature: Feature) -> dict[str, Any]:
        return {"features": {**SPEC.features, name: feature}}

    others: list[tuple[dict[str, Any], str]] = [
        (
            {"config_sha256": "d" * 64},
            "configuration: config_sha256=c.*, expected d+. Set job.folder to",
        ),
        ({"fps": 25}, "configuration: fps=50, expected 25"),
        ({"robot_type": "rebot"}, "configuration: robot_type=so101, expected rebot"),
        (
            with_feature("action", vector("shoulder", "hand")),
            r"configuration: features\.action\.names=.*jaw",
        ),
        (
            with_feature("next.success", vector("s")),
            r"configuration: .*features\.next\.success\.shape=missing",
        ),
        (
            with_feature("action", vector("shoulder", "jaw", unit="m")),
            r"configuration: units\.action=",
        ),
        ({"values": {}}, "configuration: values"),
    ]
    for changes, message in others:
        with pytest.raises(FolderError, match=message):
            DatasetWriter(tmp_path, replace(SPEC, **changes))
    assert contents(tmp_path) == before


COUNTS = {"total_episodes": 0, "total_frames": 0}
FOREIGN = json.dumps({"codebase_version": "v3.0", "fps": 30, "features": {}, **COUNTS})


def test_other_folders_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(FolderError, match=r"cannot be written \(File exists\)"):
        DatasetWriter(tmp_path / "file", SPEC)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").write_text("x")
    with pytest.raises(FolderError, match=r"has cat.jpg and no meta/info.json"):
        DatasetWriter(tmp_path / "photos", SPEC)
    for name, text, message in [
        ("lerobot", '{"codebase_version": "v3.0", "total_episodes": 1}', "KeyError"),
        ("foreign", FOREIGN, "was not written by mjstack"),
        ("older", '{"codebase_version": "v2.1"}', "is a LeRobotDataset v2.1, expected v3.0"),
        ("broken", '{"codebase', "JSONDecodeError"),
        ("list", "[]", "TypeError"),
    ]:
        path = tmp_path / name / "meta" / "info.json"
        path.parent.mkdir(parents=True)
        path.write_text(text)
        with pytest.raises(FolderError, match=message) as caught:
            DatasetWriter(tmp_path / name, SPEC)
        assert "\n" not in str(caught.value)
        assert contents(tmp_path / name) == {"meta/info.json": text.encode()}


def test_a_writer_at_a_time(tmp_path: Path) -> None:
    with DatasetWriter(tmp_path, SPEC) as writer:
        with pytest.raises(FolderError, match="is open in another writer"):
            DatasetWriter(tmp_path, SPEC)
        add(writer, episode(0))
    write(tmp_path, range(1, 2))
    assert worlds_of(tmp_path) == [0, 1]


def test_without_pyarrow_one_line_says_what_to_install(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    for use in (lambda: DatasetWriter(tmp_path / "new", SPEC), lambda: read_dataset(tmp_path)):
        with pytest.raises(MissingExtra, match=re.escape("pip install 'mjstack[datasets]'")):
            use()
    assert not (tmp_path / "new").exists()


def edit_table(path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    """Writes a parquet file anew, changed, with its row groups as they were."""
    file = pq.ParquetFile(path)
    groups = [file.read_row_group(k) for k in range(file.num_row_groups)]
    file.close()
    table = change(pa.concat_tables(groups))
    if len(table) > 69:
        pq.write_table(table, path)
        return
    with pq.ParquetWriter(path, table.schema) as writer:
        start = 0
        for group in groups:
            writer.write_table(table.slice(start, len(group)), row_group_size=len(group))
            start += len(group)


def set_column(name: str, value: Any) -> Callable[[pa.Table], pa.Table]:
    """Puts one value into every row of a column."""
    return lambda table: with_column(table, name, [[value] * len(table)])


def change_column(
    name: str, change: Callable[[np.ndarray], np.ndarray]
) -> Callable[[pa.Table], pa.Table]:
    """Changes the numbers of a column."""

    def changed(table: pa.Table) -> pa.Table:
        with np.errstate(all="ignore"):
            return with_column(table, name, pa.array(change(np.array(table[name]))))

    return changed


DATA = "data/chunk-000/file-000.parquet"
ROWS = "meta/episodes/chunk-000/file-000.parquet"
INFO = lerobot.INFO
STATS = lerobot.STATS
OTHER = "cannot be read"
# By name: the file, what is done to it (None: it gets 100,000 brackets), and the message
DAMAGE: dict[str, tuple[str, Any, str]] = {
    "frames": (
        DATA,
        lambda table: table.slice(0, 66),
        "3 rows of episodes and 66 frames, expected 3 episodes and 69 frames",
    ),
    "rows": (
        ROWS,
        lambda table: table.slice(0, 2),
        "2 rows of episodes and 69 frames, expected 3 e",
    ),
    "shuffled": (
        DATA,
        lambda table: table.take([1, 0, *range(2, 69)]),
        "frame_index of frame 0 is 1, expected 0",
    ),
    "null index": (DATA, set_column("frame_index", None), OTHER),
    "robot": (INFO, lambda info: info.pop("robot_type"), "cannot be read .*'robot_type'"),
    "dtype": (
        INFO,
        lambda info: info["features"]["action"].update(dtype="evil"),
        "action.dtype=evil|cannot be read",
    ),
    "values": (INFO, lambda info: info["mjstack"].update(values=["x"]), "values=.'x'., expected"),
    "shards": (INFO, lambda info: info["mjstack"].update(shards=1.5), OTHER),
    "many shards": (
        INFO,
        lambda info: info["mjstack"].update(shards=10**30),
        "file-001.parquet: cannot be read .No such file",
    ),
    "length": (ROWS, set_column("length", None), OTHER),
    "lengths": (
        ROWS,
        change_column("length", lambda n: n[[1, 0, 2]]),
        "of frame 20 is 1, expected 0",
    ),
    "no length": (ROWS, change_column("length", lambda n: n - n[0]), OTHER),
    "seed": (ROWS, set_column("seed", None), OTHER),
    "task": (lerobot.TASKS, set_column("task", None), OTHER),
    "task numbers": (lerobot.TASKS, set_column("task_index", 10**9), "task_index does not count"),
    "times": (DATA, change_column("timestamp", lambda t: 7 * t), "timestamp of frame 1 is 0.14"),
    "no time": (DATA, change_column("timestamp", lambda t: t * np.nan), "not finite"),
    "backwards": (DATA, change_column("index", lambda i: i[::-1]), "index of frame 0 is 68, ex"),
    "far task": (DATA, change_column("task_index", lambda i: i + 10**9), "goes to 1000000000, w"),
    "null": (DATA, set_column("observation.state", None), "rows of observation.state without 3"),
    "infinite": (DATA, change_column("next.reward", lambda r: r / 0), "reward has .* not finite"),
    "precision": (DATA, change_column("next.reward", lambda r: r.astype(float)), "float64, expec"),
    "negative": (INFO, lambda info: info["mjstack"].update(shards=-1), "shards is -1"),
    "rate": (INFO, lambda info: info.update(fps=0), "fps is 0"),
    "nested": (
        DATA,
        lambda table: with_column(table, "action", [[[0.0] * 900]] * 69),
        "rows of action without 2 numbers",
    ),
    "deep": (INFO, None, OTHER),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_and_a_strangers_files_are_one_line(name: str, tmp_path: Path) -> None:
    write(tmp_path, range(3))
    file, change, message = DAMAGE[name]
    path = tmp_path / file
    if change is None:
        path.write_text("[" * 100_000)
    elif file == INFO:
        info = json.loads(path.read_text())
        change(info)
        path.write_text(json.dumps(info))
    else:
        edit_table(path, change)
    before = contents(tmp_path)
    uses = (lambda folder: DatasetWriter(folder, SPEC), read_dataset)
    for use in uses[: 1 + (name not in ("robot", "values"))]:  # a writer's alone
        with pytest.raises(FolderError, match=message) as caught:
            use(tmp_path)
        assert "\n" not in str(caught.value)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("file", [DATA, ROWS, lerobot.TASKS, INFO])
def test_missing_and_cut_files_are_named(file: str) -> None:
    with tempfile.TemporaryDirectory() as folder:  # its path is short enough for a line
        check_missing_and_cut(file, Path(folder))


def check_missing_and_cut(file: str, tmp_path: Path) -> None:
    write(tmp_path, range(3))
    whole = (tmp_path / file).read_bytes()
    (tmp_path / file).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FolderError, match=re.escape(file)):
        read_dataset(tmp_path)
    (tmp_path / file).unlink()
    for use in (read_dataset, lambda folder: DatasetWriter(folder, SPEC)):
        with pytest.raises(FolderError, match=re.escape(file)):
            use(tmp_path)


@pytest.mark.parametrize(("first", "second"), [(None, [1.0, 2.0, 3.0, 4.0]), ([1.0], [1.0] * 3)])
def test_every_row_has_its_features_shape(first: Any, second: Any, tmp_path: Path) -> None:
    """Numbers of one row are not taken for another's where they are as many in all."""
    write(tmp_path, range(3))
    path = tmp_path / DATA
    table = pq.read_table(path)
    rows = [first, second, *table["action"].to_pylist()[2:]]
    pq.write_table(with_column(table, "action", pa.array(rows, pa.list_(pa.float32()))), path)
    with pytest.raises(FolderError, match="rows of action without 2 numbers"):
        read_dataset(tmp_path).frames("action")


def test_a_writer_follows_no_link_out_of_the_dataset(tmp_path: Path) -> None:
    folder = tmp_path / "dataset"
    write(folder, range(3))
    (folder / "data").rename(tmp_path / "elsewhere")
    (folder / "data").symlink_to(tmp_path / "elsewhere")
    stale = tmp_path / "elsewhere" / "chunk-000" / "file-007.parquet"
    stale.write_bytes(b"somebody's")
    with pytest.raises(FolderError, match="data is a link, and what it leads to"):
        DatasetWriter(folder, SPEC)
    assert stale.read_bytes() == b"somebody's"


def test_a_hard_link_is_not_written_through(tmp_path: Path) -> None:
    folder = tmp_path / "dataset"
    write(folder, range(3))
    names = [STATS, INFO, lerobot.TASKS, DATA, ROWS]
    for number, name in enumerate(names):
        os.link(folder / name, tmp_path / str(number))
    before = [(tmp_path / str(number)).read_bytes() for number in range(len(names))]
    write(folder, range(3, 5))
    assert [(tmp_path / str(number)).read_bytes() for number in range(len(names))] == before


def test_what_an_earlier_version_left_is_cleared_away(tmp_path: Path) -> None:
    """It wrote into hidden files whose names end as those of complete ones."""
    write(tmp_path, range(3))
    before = contents(tmp_path)
    for name in (".file-rank0000-0.parquet", ".file-rank0001-0.parquet"):
        (tmp_path / DATA).with_name(name).write_bytes(b"PAR1")
    DatasetWriter(tmp_path, SPEC).close()
    assert contents(tmp_path) == before


def test_nothing_unfinished_is_listed(tmp_path: Path) -> None:
    """LeRobot lists hidden files too."""
    with DatasetWriter(tmp_path, SPEC) as writer:
        add(writer, episode(0))
        before = listed(tmp_path)
        add(writer, episode(1), commit=False)
        assert leftover(tmp_path)
        assert listed(tmp_path) == before


def test_statistics_that_were_removed_are_written_anew(tmp_path: Path) -> None:
    write(tmp_path, range(3))
    before = contents(tmp_path)
    (tmp_path / STATS).unlink()
    DatasetWriter(tmp_path, SPEC).close()
    assert contents(tmp_path) == before


def test_the_guides_lines_read_it_in_another_process(tmp_path: Path) -> None:
    """The guide's reading lines, and nothing else, on a dataset in the folder that they name."""
    blocks = re.findall(r"```python\n(.*?)```", GUIDE.read_text(), re.S)
    (lines,) = [block for block in blocks if "read_dataset" not in block]
    assert "mjstack" not in re.sub(r'info\["mjstack"\]', "", lines)
    (folder,) = re.findall(r'^folder = Path\("(.+)"\)$', lines, re.M)
    write(tmp_path / folder, range(3))
    done = subprocess.run(
        [sys.executable, "-c", lines], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    first, second = done.stdout.splitlines()
    assert first == "{'episode_index': 0, 'length': 20, 'success': False, 'seed': 7, 'world': 0}"
    assert second == f"(23, 3) {list(JOINTS)} {['rad'] * 3}"
