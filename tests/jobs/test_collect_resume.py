"""Demonstrations that were stopped anywhere: what the next call leaves is what an uninterrupted one
does.
"""

import copy
import json
import os
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from dataset_checker import check_dataset, listed
from environments import Patch, configure, on_cuda, one_second_episode
from stubs import episodes_of, fake_batches, pairs

from mjstack.cli import run
from mjstack.config.fingerprint import config_content
from mjstack.config.schema import CollectJobCfg
from mjstack.datasets import lerobot
from mjstack.datasets.part import PartWriter
from mjstack.envs import build_env, demonstration_config
from mjstack.episodes.batches import play_batches
from mjstack.episodes.stage import Stage
from mjstack.errors import FolderError
from mjstack.jobs import collect as job
from mjstack.jobs import collect_plan
from mjstack.jobs.collect import Collection
from mjstack.jobs.collect_plan import BATCHES, CollectPlan
from mjstack.jobs.runner import run_provenance
from mjstack.report.record import GateResult, Status

pytestmark = pytest.mark.full

COMMAND = ["job=collect", "sim=native"]


def some_fail(seed: int, world: int) -> bool:
    return world % 4 == 1


_stage = cache(lambda *overrides: Stage(configure(*COMMAND, *overrides)))
_env = cache(
    lambda *overrides: build_env(demonstration_config(configure(*COMMAND, *overrides)), nworld=1)
)
_provenance = cache(lambda: run_provenance(Stage(configure(*COMMAND))))
_content = cache(
    lambda keep_failures: config_content(configure(*COMMAND, f"job.keep_failures={keep_failures}"))
)


def patch_all(monkeypatch: Patch) -> None:
    """No world is played; a data file has room for four episodes, so that a batch has several;
    what is slow is made once.
    """
    monkeypatch.setattr(lerobot, "DATA_MB", 1)
    monkeypatch.setattr(job, "play_batches", fake_batches(some_fail, noise=True))
    monkeypatch.setattr(collect_plan, "run_provenance", lambda stage: dict(_provenance()))
    monkeypatch.setattr(
        collect_plan,
        "config_content",
        lambda cfg, without: {
            key: copy.deepcopy(value)
            for key, value in _content(cfg.job.keep_failures).items()
            if key not in without
        },
    )


@pytest.fixture(autouse=True)
def _patched(monkeypatch: Patch) -> None:
    patch_all(monkeypatch)


def collection_at(
    home: Path, *overrides: str, nworld: int = 9, episodes: int = 10, keep_failures: bool = False
) -> Collection:
    """A collection, ready to play."""
    cfg = configure(*COMMAND, *overrides)
    assert isinstance(cfg.job, CollectJobCfg)
    cfg.nworld = nworld
    cfg.job.episodes = episodes
    cfg.job.keep_failures = keep_failures
    stage = Stage(cfg, _stage(*overrides).assets)
    home.mkdir(parents=True, exist_ok=True)
    return Collection(CollectPlan.from_stage(stage, home, _env(*overrides)), stage)


def collect(home: Path, *overrides: str, **kwargs: Any) -> GateResult:
    """Plays to the end."""
    collection = collection_at(home, *overrides, **kwargs)
    assert collection.play() == ""
    return collection.result(Status.passed, "")


def left_in(home: Path, result: GateResult) -> dict[str, Any]:
    """Everything that must not depend on interruptions: episodes, steps, records and figures."""
    steps: pa.Table = pq.read_table(home / "dataset" / "data").combine_chunks()
    of_the_call = ("dataset", "megabytes", "episodes_of_this_call", "episodes_per_s")
    return {
        "rows": episodes_of(home / "dataset"),
        "steps": {name: steps[name].combine_chunks() for name in steps.column_names},
        "statistics": json.loads((home / "dataset" / lerobot.STATS).read_text()),
        "batches": json.loads((home / BATCHES).read_text()),
        "metrics": {k: value for k, value in result.metrics.items() if k not in of_the_call},
        "details": result.details,
    }


def assert_same(left: dict[str, Any], expected: dict[str, Any]) -> None:
    for name, value in expected.items():
        assert left[name] == value, name


@pytest.fixture(scope="module", params=[False, True], ids=["successes", "all"])
def whole(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Any]:
    """What is left where nothing interrupts."""
    home = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as monkeypatch:
        patch_all(monkeypatch)
        expected = left_in(home, collect(home, keep_failures=request.param))
    return {"keep_failures": request.param, "left": expected}


successes_alone = pytest.mark.parametrize("whole", [False], ids=["successes"], indirect=True)


def test_figures_of_the_uninterrupted_one(whole: dict[str, Any]) -> None:
    """By hand: worlds 1 and 5 fail of the first nine; three episodes are missing then, for which
    four worlds are played.
    """
    batches = whole["left"]["batches"]
    metrics = whole["left"]["metrics"]
    figures = [(b["seed"], b["worlds"], b["succeeded"], b["episodes"]) for b in batches]
    if whole["keep_failures"]:
        assert figures == [(0, 9, 7, 9), (1, 1, 1, 1)]
        assert (metrics["worlds_played"], metrics["succeeded"], metrics["episodes"]) == (10, 8, 10)
    else:
        assert figures == [(0, 9, 7, 7), (1, 4, 3, 3)]
        assert (metrics["worlds_played"], metrics["succeeded"], metrics["episodes"]) == (13, 10, 10)
    assert batches[0]["retries"] == sum(world % 3 for world in range(9))
    assert max(row["data/file_index"] for row in whole["left"]["rows"]) >= 2


CTRL_C = KeyboardInterrupt()
FULL_DISK = OSError(28, "No space left on device")


def break_write(call: int, error: BaseException, monkeypatch: Patch) -> None:
    """Something goes wrong as the n-th episode is written."""
    write = PartWriter.write
    calls = []

    def broken(self: PartWriter, *args: Any) -> None:
        calls.append(args)
        if len(calls) == call:
            raise error
        write(self, *args)

    monkeypatch.setattr(PartWriter, "write", broken)


def play_broken(
    home: Path, call: int, error: BaseException, *overrides: str, **kwargs: Any
) -> Collection:
    """A collection in which an episode cannot be written."""
    collection = collection_at(home, *overrides, **kwargs)
    expected = KeyboardInterrupt if error is CTRL_C else FolderError
    with pytest.MonkeyPatch.context() as monkeypatch:
        break_write(call, error, monkeypatch)
        with pytest.raises(expected):
            collection.play()
    return collection


@pytest.mark.parametrize("error", [CTRL_C, FULL_DISK], ids=["Ctrl-C", "full disk"])
@pytest.mark.parametrize("call", [1, 6, 10])
def test_a_batch_is_kept_as_a_whole(
    call: int, error: BaseException, whole: dict[str, Any], tmp_path: Path
) -> None:
    """The next call plays an unfinished one again, and leaves what an uninterrupted one does."""
    kept = 0 if call < 8 else 9 if whole["keep_failures"] else 7
    collection = play_broken(tmp_path, call, error, keep_failures=whole["keep_failures"])
    assert collection.committed == kept
    if kept:
        assert episodes_of(tmp_path / "dataset") == whole["left"]["rows"][:kept]
    assert not list((tmp_path / "dataset").rglob(".file*"))
    result = collect(tmp_path, keep_failures=whole["keep_failures"])
    assert_same(left_in(tmp_path, result), whole["left"])
    check_dataset(tmp_path / "dataset")


@successes_alone
def test_a_kill_between_any_two_files(
    whole: dict[str, Any], tmp_path: Path, monkeypatch: Patch
) -> None:
    """What a kill would have left is copied before and after each file takes its place, and gone on
    with.
    """
    home = tmp_path / "home"
    copies = tmp_path / "copies"
    replace_file = os.replace
    write = PartWriter.write

    def copied() -> None:
        shutil.copytree(home, copies / str(len(list(copies.iterdir()))))

    def replaced(*args: Any) -> None:
        copied()
        replace_file(*args)

    def written(self: PartWriter, *args: Any) -> None:
        write(self, *args)
        copied()

    copies.mkdir()
    with monkeypatch.context() as inner:
        inner.setattr(os, "replace", replaced)
        inner.setattr(PartWriter, "write", written)
        collect(home)
    copied()
    committed = set()
    for path in copies.iterdir():
        listed(path / "dataset")
        has_some = (path / "dataset" / "meta/episodes").exists()
        committed.add(len(pairs(path / "dataset")) if has_some else 0)
        assert_same(left_in(path, collect(path)), whole["left"])
    assert {0, 7, 10} <= committed
    check_dataset(home / "dataset")


@successes_alone
@pytest.mark.parametrize("call", [1, 2])
def test_no_room_for_the_record(
    call: int, whole: dict[str, Any], tmp_path: Path, monkeypatch: Patch
) -> None:
    write = job.write_atomic
    calls = []

    def full(path: Path, content: str) -> None:
        calls.append(path.name)
        if len(calls) >= call:
            raise FULL_DISK
        write(path, content)

    collection = collection_at(tmp_path)
    with monkeypatch.context() as inner:
        inner.setattr(job, "write_atomic", full)
        with pytest.raises(OSError, match="No space left on device"):
            collection.play()
    assert calls == [BATCHES] * call
    assert_same(left_in(tmp_path, collect(tmp_path)), whole["left"])


@pytest.mark.parametrize("world", [0, 1])
def test_what_is_not_finite_is_left_out(world: int, tmp_path: Path, monkeypatch: Patch) -> None:
    """In a world that succeeded, where a term's number is not finite, and in one that failed."""
    assert some_fail(0, world) is bool(world)

    def diverge(seed: int, values: torch.Tensor) -> None:
        if seed == 0:
            values[3, world] = torch.nan

    monkeypatch.setattr(job, "play_batches", fake_batches(some_fail, diverge, noise=True))
    left = left_in(tmp_path, collect(tmp_path, keep_failures=True))
    lost = [batch["broken"].get("a number that is not finite", 0) for batch in left["batches"]]
    assert lost == [1, 0]
    assert (0, world) not in pairs(tmp_path / "dataset")
    assert len(left["rows"]) == 10


def test_records_that_were_removed(tmp_path: Path) -> None:
    """The dataset stands and goes on with the next seed, from which the success rate counts."""
    collect(tmp_path, episodes=3)
    (tmp_path / BATCHES).unlink()
    result = collect(tmp_path)
    assert [seed for seed, _ in pairs(tmp_path / "dataset")] == [0] * 3 + [1] * 6 + [2]
    assert result.notes["seeds"] == "1 to 2"
    assert (result.metrics["worlds_played"], result.metrics["succeeded"]) == (10, 7)


def test_a_batch_that_is_not_in_the_dataset_has_not_been_played(tmp_path: Path) -> None:
    collect(tmp_path, episodes=3)
    (record,) = json.loads((tmp_path / BATCHES).read_text())
    (tmp_path / BATCHES).write_text(json.dumps([record, record | {"seed": 1}]))
    result = collect(tmp_path, episodes=4)
    assert [seed for seed, _ in pairs(tmp_path / "dataset")] == [0] * 3 + [1]
    batches = json.loads((tmp_path / BATCHES).read_text())
    assert [(batch["seed"], batch["episodes"]) for batch in batches] == [(0, 3), (1, 1)]
    assert result.metrics["worlds_played"] == sum(batch["worlds"] for batch in batches)


def test_a_dataset_that_was_removed(tmp_path: Path) -> None:
    """Its records go with it."""
    collect(tmp_path)
    shutil.rmtree(tmp_path / "dataset")
    result = collect(tmp_path, episodes=2)
    assert pairs(tmp_path / "dataset") == [(0, 0), (0, 2)]
    assert (result.metrics["worlds_played"], result.metrics["succeeded"]) == (3, 2)


def test_real_worlds_are_the_same_again(tmp_path: Path, monkeypatch: Patch) -> None:
    """No pretence: both worlds are played again after Ctrl-C in the second one's episode."""
    monkeypatch.setattr(job, "play_batches", play_batches)
    quick = one_second_episode()
    options: dict[str, Any] = {"nworld": 2, "episodes": 2, "keep_failures": True}
    expected = left_in(tmp_path / "whole", collect(tmp_path / "whole", *quick, **options))
    play_broken(tmp_path / "parts", 2, CTRL_C, *quick, **options)
    assert_same(
        left_in(tmp_path / "parts", collect(tmp_path / "parts", *quick, **options)), expected
    )


@on_cuda
def test_ctrl_c_on_cuda(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(job, "play_batches", play_batches)
    monkeypatch.setattr(collect_plan, "config_content", config_content)
    command = ["job=collect", "job.folder=demos", "nworld=8", "sim=mjwarp", "sim.device=cuda:0"]
    args = [*command, "job.episodes=12", "job.keep_failures=true"]
    with pytest.MonkeyPatch.context() as inner:
        break_write(11, CTRL_C, inner)
        assert run(args) == 130
    first = episodes_of(Path("demos/dataset"))
    assert [(row["seed"], row["world"]) for row in first] == [(0, world) for world in range(8)]
    assert run(args) == 0
    assert episodes_of(Path("demos/dataset"))[:8] == first
    check_dataset(Path("demos/dataset"))
    batches = json.loads(Path("demos", BATCHES).read_text())
    assert [(batch["seed"], batch["episodes"]) for batch in batches] == [(0, 8), (1, 4)]
