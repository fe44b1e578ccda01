"""trainer=clone from a dataset: what it reads, and which datasets it refuses."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from compositions import load_config, refusal
from dataset_checker import with_column
from environments import Refused
from policies import report

from mjstack.cli import run
from mjstack.distributed import Ranks
from mjstack.episodes.stage import Progress, Stage
from mjstack.jobs.train import check_train
from mjstack.train.dataset import read_demonstrations
from mjstack.train.demonstrations import Demonstrations
from mjstack.train.rounds import make_round
from mjstack.train.trainer import observed_widths

REACH = ("task=reach", "sim=native", "nworld=3")
TRAIN = (
    *("job=train", "trainer=clone", *REACH, "job.hidden=[16]", "job.batches=4"),
    *("job.batch_size=32", "job.save_every=2", "gate.success.rate=0.0", "web.episode=false"),
)

COLLECT = (
    *("job=collect", *REACH, "observation=real", "+observation.policy.noise=false"),
    "controller=closed_loop",
)
TASKS = "meta/tasks.parquet"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of job=collect, their observations without noise."""
    folder = tmp_path_factory.mktemp("demos")
    assert run([*COLLECT, "job.episodes=3", f"job.folder={folder}"]) == 0
    return folder / "dataset"


def test_a_dataset_has_what_the_expert_would_show(dataset: Path, tmp_path: Path) -> None:
    """The same starts, so the same steps; torchrun's processes share the episodes."""
    cfg = load_config([*TRAIN, "job.episodes=3", f"job.dataset={dataset}"])
    stage = Stage(cfg)
    played = make_round(stage, tmp_path, None, 0, None)
    read = read_demonstrations(stage, played.widths)
    assert torch.equal(read.ends, played.ends)
    torch.testing.assert_close(read.seen, played.seen)
    torch.testing.assert_close(read.labels, played.labels)
    parts = [
        read_demonstrations(part, played.widths)
        for part in (stage.with_config(cfg, ranks=Ranks(rank, 2)) for rank in range(2))
    ]
    assert [len(part.ends) for part in parts] == [2, 1]
    assert torch.equal(parts[1].seen, read.seen[150:300])


def as_lerobot(info: dict[str, Any]) -> None:
    """As somebody else's recorder has it, without our block."""
    del info["mjstack"]


@pytest.mark.parametrize(
    "change", [None, pytest.param(as_lerobot, marks=pytest.mark.full)], ids=["ours", "LeRobot's"]
)
def test_a_policy_learns_from_a_dataset(
    change: Callable[[dict], None] | None, dataset: Path, tmp_path: Path
) -> None:
    folder = copied(dataset, tmp_path, change)
    out = tmp_path / "out"
    assert run([*TRAIN, f"job.dataset={folder}", f"job.folder={out}"]) == 0
    train = report(out)["train"]
    assert train["metrics"]["episodes"] == 3
    assert train["notes"]["demonstrations"] == str(folder)


def change_table(folder: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    """Change the data file."""
    path = folder / "data/chunk-000/file-000.parquet"
    pq.write_table(change(pq.read_table(path)), path)


def as_mappings(info: dict[str, Any]) -> None:
    """The names of numbers in the two forms that are no list."""
    as_lerobot(info)
    seen, action = (info["features"][name] for name in ("observation.policy", "action"))
    names = seen["names"]
    seen["names"] = {"joints": names[:6], "scene": names[6:]}
    action["names"] = {name: k for k, name in reversed(list(enumerate(action["names"])))}


def test_somebody_elses_dataset_is_read(dataset: Path, tmp_path: Path) -> None:
    """From two files, and with names as mappings: the same numbers."""
    folder = copied(dataset, tmp_path, as_mappings)
    first = folder / "data/chunk-000/file-000.parquet"
    table = pq.read_table(first)
    pq.write_table(table.slice(300), folder / "data/chunk-000/file-001.parquet")
    pq.write_table(table.slice(0, 300), first)
    theirs, ours = read(folder), read(dataset)
    assert theirs.ends.tolist() == [150, 300, 450]
    assert torch.equal(theirs.seen, ours.seen)
    assert torch.equal(theirs.labels, ours.labels)


def reshape_rows(lengths: dict[int, int | None]) -> Callable[[pa.Table], pa.Table]:
    """Other lengths of some rows of the action; None: a null."""

    def change(table: pa.Table) -> pa.Table:
        rows = table["action"].to_pylist()
        for row, length in lengths.items():
            rows[row] = None if length is None else (2 * rows[row])[:length]
        return with_column(table, "action", pa.array(rows, pa.list_(pa.float32())))

    return change


def shuffle(table: pa.Table) -> pa.Table:
    return table.take(np.random.default_rng(0).permutation(len(table)))


SHAPES = "rows of action without 6 numbers"
DAMAGES: dict[str, tuple[Callable[[pa.Table], pa.Table], str]] = {
    "a null row and a double one": (reshape_rows({7: None, 8: 12}), SHAPES),
    "the end is missing": (lambda table: table.slice(0, 413), "3 rows of episodes and 413 frames"),
    "shuffled": (shuffle, "episode_index of frame 2 is 1, expected 0"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_dataset_that_still_reads_is_refused(
    damage: str, dataset: Path, tmp_path: Path
) -> None:
    """One of somebody else's; test_datasets.py has all damages of one of ours."""
    folder = copied(dataset, tmp_path, as_lerobot)
    change_table(folder, DAMAGES[damage][0])
    line = refusal_of([f"job.dataset={folder}"])
    assert DAMAGES[damage][1] in line
    assert str(folder) in line


LINKED = ("meta/stats.json", "meta", "data/chunk-000")


@pytest.mark.parametrize("name", ["data/chunk-000/file-000.parquet", *LINKED])
def test_collect_and_train_refuse_the_same_before_they_write(
    name: str, dataset: Path, tmp_path: Path, refused: Refused
) -> None:
    """A file that is cut; links, collect refuses alone."""
    folder = tmp_path / "demos" / "dataset"
    shutil.copytree(dataset, folder)
    path = folder / name
    if name in LINKED:
        path.rename(tmp_path / "moved")
        path.symlink_to(tmp_path / "moved")
        says = f"{path.name} is a link"
    else:
        path.write_bytes(path.read_bytes()[:5000])
        says = "file-000.parquet: cannot be read"
        assert says in refused(*TRAIN, "job.dataset=demos/dataset", "job.folder=out")
    assert says in refused(*COLLECT, "job.episodes=4", "job.folder=demos")


def test_a_file_that_is_there_twice_is_refused(dataset: Path, tmp_path: Path) -> None:
    """A dataset of ours says which files count."""
    for change in (None, as_lerobot):
        folder = copied(dataset, tmp_path / str(change is None), change)
        first = folder / "data/chunk-000/file-000.parquet"
        shutil.copy(first, first.with_name("file-001.parquet"))
        if change is None:
            assert len(read(folder).ends) == 3
        else:
            line = refusal_of([f"job.dataset={folder}"])
            assert "has 3 rows of episodes and 900 frames, expected 3 episodes and 450 fr" in line


def test_without_a_success_all_episodes_count(dataset: Path, tmp_path: Path) -> None:
    def fail_the_second(table: pa.Table) -> pa.Table:
        success = np.array(table["next.success"].to_pylist())
        success[299] = False
        column = pa.array(success.reshape(-1), table.schema.field("next.success").type)
        return with_column(table, "next.success", column)

    folder = copied(dataset, tmp_path, as_lerobot)
    change_table(folder, fail_the_second)
    lines: list[str] = []
    assert torch.equal(
        read(folder, lines).seen, read(dataset).seen[[*range(150), *range(300, 450)]]
    )
    assert lines == [f"train: 2 of 3 episodes of {folder} succeeded in the task"]
    info = json.loads((folder / "meta/info.json").read_text())
    del info["features"]["next.success"]
    (folder / "meta/info.json").write_text(json.dumps(info))
    change_table(folder, lambda table: table.drop_columns(["next.success"]))
    assert torch.equal(read(folder, lines).seen, read(dataset).seen)
    assert "3 of 3 episodes" in lines[1]
    assert "(none has next.success) are taken to succeed in the task" in lines[1]


def read(folder: Path, lines: list[str] | None = None) -> Demonstrations:
    """What the training reads."""
    cfg = load_config([*TRAIN, f"job.dataset={folder}"])
    stage = Stage(cfg, progress=Progress((lines if lines is not None else []).append))
    assert check_train(cfg)
    return read_demonstrations(stage, observed_widths(stage))


def copied(
    dataset: Path, tmp_path: Path, change: Callable[[dict[str, Any]], None] | None = None
) -> Path:
    """A copy of the dataset, its info.json changed."""
    folder = tmp_path / "copy"
    shutil.copytree(dataset, folder)
    if change is not None:
        path = folder / "meta/info.json"
        info = json.loads(path.read_text())
        change(info)
        path.write_text(json.dumps(info))
    return folder


def rename(info: dict[str, Any]) -> None:
    names = info["features"]["observation.policy"]["names"]
    names[names.index("headings.1")] = "yaw"


CHANGES: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "robot": (lambda i: i.update(robot_type="so100"), "has robot_type=so100, expected so101"),
    "LeRobot's units": (
        lambda i: i.update(robot_type="so_follower"),
        "has robot_type=so_follower, expected so101. Give one in rad and m: collect it without job",
    ),
    "rate": (lambda i: i.update(fps=30), "has fps=30, expected 50"),
    "version": (lambda i: i.update(codebase_version="v2.1"), "v2.1, expected v3.0"),
    "column": (rename, "has no column headings.1 in observation.policy"),
    "action": (lambda i: i["features"].pop("action"), "has no column shoulder_pan.pos in action"),
    "names": (
        lambda i: i["features"]["action"].update(names={"a": 1, "b": "x"}),
        "info.json: cannot be read (TypeError",
    ),
    "shape": (lambda i: i["features"]["action"].update(shape=[-6]), "the shape of action is [-6]"),
    "empty": (lambda i: i.update(total_episodes=0), "it has no episodes"),
}


def refusal_of(overrides: list[str]) -> str:
    """The check's one line."""
    return refusal(lambda: check_train(load_config([*TRAIN, *overrides])))


@pytest.mark.parametrize("name", CHANGES)
def test_a_dataset_that_does_not_fit_is_one_line(name: str, dataset: Path, tmp_path: Path) -> None:
    change, says = CHANGES[name]
    folder = copied(dataset, tmp_path, change)
    assert says in refusal_of([f"job.dataset={folder}"])


def test_no_dataset_and_others_terms_and_tasks(dataset: Path, tmp_path: Path) -> None:
    empty = [f"job.dataset={tmp_path}"]
    assert "has no meta/info.json, expected a LeRobotDataset v3" in refusal_of(empty)
    more = [f"job.dataset={dataset}", "job.leave_out=[]"]
    assert "has no column joint_vel.0 in observation.policy" in refusal_of(more)
    other = [f"job.dataset={dataset}", "task.instruction=Wave."]
    assert "has the task 'Bring the gripper over the red cube.'" in refusal_of(other)
    used = [f"job.dataset={dataset}", "job.test_seed=0"]
    assert "expected seeds that training does not use" in refusal_of(used)


def test_a_task_without_instruction_has_its_name_in_a_dataset(
    dataset: Path, tmp_path: Path
) -> None:
    folder = copied(dataset, tmp_path)
    named = with_column(pq.read_table(folder / TASKS), "task", pa.array(["reach"]))
    pq.write_table(named, folder / TASKS)
    overrides = [f"job.dataset={folder}", "task.instruction=null"]
    assert check_train(load_config([*TRAIN, *overrides])).title == "task reach, training"
    assert "has the task 'reach', expected 'Bring" in refusal_of(overrides[:1])


def test_a_source_that_does_not_exist_is_refused_without_a_dataset_too() -> None:
    assert "job.source: func=mine.SOURCE: module 'mine'" in refusal_of(["job.source=mine.SOURCE"])


def test_degrees_are_refused(dataset: Path, tmp_path: Path) -> None:
    def in_degrees(table: pa.Table) -> pa.Table:
        degrees = np.rad2deg(np.array(table["action"].to_pylist(), np.float32)).reshape(-1)
        column = pa.FixedSizeListArray.from_arrays(pa.array(degrees), 6)
        return with_column(table, "action", column)

    folder = copied(dataset, tmp_path)
    change_table(folder, in_degrees)
    assert "expected absolute joint targets within" in refusal_of([f"job.dataset={folder}"])
