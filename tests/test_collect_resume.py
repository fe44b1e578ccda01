"""Demonstrations that were stopped anywhere: what the next call leaves is what an uninterrupted one
does.
"""

from __future__ import annotations

import copy
import json
import os
import shutil
from functools import cache, partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from dataset_checker import check_dataset
from environments import configure, one_second_episode
from stubs import episodes_of, fake_demonstrations, pairs

from mjstack import interrupt
from mjstack.cli import run
from mjstack.config.fingerprint import config_content
from mjstack.config.schema import CollectJobCfg
from mjstack.datasets import DatasetWriter, lerobot
from mjstack.datasets.part import PartWriter
from mjstack.envs import build_env, demonstration_config
from mjstack.episodes.context import RunContext
from mjstack.episodes.stage import Stage
from mjstack.errors import UnwrittenError
from mjstack.jobs import collected, collection, demonstration
from mjstack.jobs.collected import FILE, CollectPlan
from mjstack.jobs.collection import Collection
from mjstack.jobs.demonstration import play_demonstrations
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
_provenance = cache(lambda: run_provenance(RunContext(cfg=configure(*COMMAND))))
_content = cache(
    lambda keep_failures: config_content(configure(*COMMAND, f"job.keep_failures={keep_failures}"))
)


def patch_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody plays; a data file has room for four episodes, so batches are committed in between;
    what is slow is made once.
    """
    monkeypatch.setattr(collection, "DatasetWriter", partial(DatasetWriter, file_mb=1))
    monkeypatch.setattr(
        collection, "play_demonstrations", fake_demonstrations(some_fail, noise=True)
    )
    monkeypatch.setattr(collected, "run_provenance", lambda context: dict(_provenance()))
    monkeypatch.setattr(
        demonstration,
        "config_content",
        lambda cfg: copy.deepcopy(_content(cfg.job.keep_failures)),
    )


@pytest.fixture(autouse=True)
def _patched(monkeypatch: pytest.MonkeyPatch) -> None:
    patch_all(monkeypatch)


def collection_at(
    home: Path,
    *overrides: str,
    nworld: int = 9,
    episodes: int = 10,
    keep_failures: bool = False,
) -> Collection:
    """A collection, ready to play."""
    cfg = configure(*COMMAND, *overrides)
    assert isinstance(cfg.job, CollectJobCfg)
    cfg.nworld = nworld
    cfg.job.episodes = episodes
    cfg.job.keep_failures = keep_failures
    context = RunContext(cfg, _stage(*overrides))
    home.mkdir(parents=True, exist_ok=True)
    env = _env(*overrides)
    plan = CollectPlan.of(context, home, env)
    return Collection(plan, context)


def collect(home: Path, *overrides: str, **kwargs: Any) -> GateResult:
    """Plays to the end."""
    playing = collection_at(home, *overrides, **kwargs)
    assert playing.play() == ""
    return playing.result(Status.passed, "", 1.0)


def left_in(home: Path, result: GateResult) -> dict[str, Any]:
    """Everything that must not depend on interruptions: episodes, steps, notes and figures."""
    where = ("data/", "meta/episodes/")  # which of the files an episode is in does depend
    rows = [
        {name: value for name, value in row.items() if not name.startswith(where)}
        for row in episodes_of(home / "dataset")
    ]
    steps: pa.Table = pq.read_table(home / "dataset" / "data").combine_chunks()
    notes = json.loads((home / FILE).read_text())
    return {
        "rows": rows,
        "steps": {name: steps[name].combine_chunks() for name in steps.column_names},
        "statistics": json.loads((home / "dataset" / lerobot.STATS).read_text()),
        "notes": notes,
        "metrics": {
            name: value
            for name, value in result.metrics.items()
            if name
            not in (
                "dataset",
                "megabytes",
                "episodes_of_this_call",
                "episodes_per_s",
            )
        },
        "details": result.details,
    }


def assert_same(found: dict[str, Any], expected: dict[str, Any]) -> None:
    for name, value in expected.items():
        assert found[name] == value, name


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
    notes = whole["left"]["notes"]
    metrics = whole["left"]["metrics"]
    found = [
        (note["seed"], note["worlds"], note["succeeded"], note["kept"], note["keep"])
        for note in notes
    ]
    if whole["keep_failures"]:
        assert found == [(0, 9, 7, 9, 9), (1, 1, 1, 1, 1)]
        assert (metrics["worlds_played"], metrics["succeeded"], metrics["episodes"]) == (10, 8, 10)
    else:
        assert found == [(0, 9, 7, 7, 7), (1, 4, 3, 3, 3)]
        assert (metrics["worlds_played"], metrics["succeeded"], metrics["episodes"]) == (13, 10, 10)
    assert notes[0]["retries"] == sum(world % 3 for world in range(9))
    assert "episodes_without_note" not in metrics


def interrupt_at(call: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C comes while an episode is written."""
    add = PartWriter.write
    calls = []

    def interrupted(self: PartWriter, *args: Any) -> None:
        calls.append(args)
        if len(calls) == call:
            monkeypatch.setattr(interrupt, "_asked", True)  # as the command's handler does
        add(self, *args)

    monkeypatch.setattr(PartWriter, "write", interrupted)


def play_interrupted(home: Path, call: int, *overrides: str, **kwargs: Any) -> GateResult:
    """What a call leaves in which Ctrl-C comes during an episode."""
    playing = collection_at(home, *overrides, **kwargs)
    playing._context.advance = lambda *_: interrupt.check_interrupt()
    with pytest.MonkeyPatch.context() as monkeypatch:
        interrupt_at(call, monkeypatch)
        with pytest.raises(KeyboardInterrupt):
            playing.play()
    return playing.result(Status.interrupted, "interrupted", 1.0)


@pytest.mark.parametrize("call", [1, 6, 9])
def test_ctrl_c_in_an_episode(call: int, whole: dict[str, Any], tmp_path: Path) -> None:
    result = play_interrupted(tmp_path, call, keep_failures=whole["keep_failures"])
    assert len(pairs(tmp_path / "dataset")) == call  # the one in which it came is finished too
    found = left_in(tmp_path, result)
    assert found["rows"] == whole["left"]["rows"][:call]
    assert result.metrics["succeeded"] >= sum(row["success"] for row in found["rows"])  # type: ignore[operator]
    assert sum(note["kept"] for note in found["notes"]) == call
    unfinished = [note for note in found["notes"] if note["kept"] < note["keep"]]
    assert sum("is unfinished" in line for line in result.details) == len(unfinished)
    assert_same(
        left_in(tmp_path, collect(tmp_path, keep_failures=whole["keep_failures"])), whole["left"]
    )
    check_dataset(tmp_path / "dataset")


def test_ctrl_c_after_ctrl_c(tmp_path: Path) -> None:
    """And each time with another nworld: the seed that was begun has the worlds that it was begun
    with.
    """
    one = left_in(tmp_path / "whole", collect(tmp_path / "whole", nworld=16, episodes=20))
    home = tmp_path / "parts"
    played = []
    play = fake_demonstrations(some_fail, noise=True)

    def told(context: Any, sim: Any, seed: int, worlds: range) -> Any:
        played.append((seed, sim.nworld))
        return play(context, sim, seed, worlds)

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(collection, "play_demonstrations", told)
        play_interrupted(home, 3, nworld=16, episodes=20)
        play_interrupted(home, 4, nworld=3, episodes=20)
        result = collect(home, nworld=16, episodes=20)
    assert played[:3] == [(0, 16)] * 3
    assert_same(left_in(home, result), one)


def test_fewer_and_more_episodes_in_between(tmp_path: Path) -> None:
    """A seed that was begun brings the episodes that it was begun for, whatever is asked for in
    between.
    """
    one = left_in(tmp_path / "whole", collect(tmp_path / "whole", nworld=16, episodes=20))
    home = tmp_path / "parts"
    play_interrupted(home, 3, nworld=16, episodes=20)
    assert collect(home, nworld=16, episodes=2).metrics["episodes"] == 3
    assert collect(home, nworld=16, episodes=5).metrics["episodes"] == 5
    assert_same(left_in(home, collect(home, nworld=16, episodes=20)), one)


@successes_alone
def test_a_kill_between_any_two_files(
    whole: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a kill would have left is copied before and after each file takes its place, and gone on
    with.
    """
    home = tmp_path / "home"
    copies = tmp_path / "copies"
    replace_file = os.replace
    add = PartWriter.write

    def copied() -> None:
        shutil.copytree(home, copies / str(len(list(copies.iterdir()))))

    def replaced(*args: Any) -> None:
        copied()
        replace_file(*args)

    def added(self: PartWriter, *args: Any) -> None:
        add(self, *args)
        copied()

    copies.mkdir()
    with monkeypatch.context() as context:
        context.setattr(os, "replace", replaced)
        context.setattr(PartWriter, "write", added)
        collect(home, keep_failures=whole["keep_failures"])
    copied()
    found = sorted(copies.iterdir(), key=lambda path: int(path.name))
    committed = [
        len(pairs(path / "dataset")) if (path / "dataset" / "meta/episodes").exists() else 0
        for path in found
    ]
    assert len(set(committed)) >= 4  # the first batch has more than one file
    for path in found:
        assert_same(
            left_in(path, collect(path, keep_failures=whole["keep_failures"])), whole["left"]
        )
    check_dataset(found[0] / "dataset")


@successes_alone
@pytest.mark.parametrize("call", [1, 6, 10])
def test_a_full_disk_in_a_batch(
    call: int, whole: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add = PartWriter.write
    calls = []

    def full(self: PartWriter, *args: Any) -> None:
        calls.append(args)
        if len(calls) == call:
            raise OSError(28, "No space left on device")
        add(self, *args)

    playing = collection_at(tmp_path, keep_failures=whole["keep_failures"])
    with monkeypatch.context() as context:
        context.setattr(PartWriter, "write", full)
        with pytest.raises(UnwrittenError, match="No space left"):
            playing.play()
    kept = pairs(tmp_path / "dataset") if playing.committed else []
    assert len(kept) == playing.committed == sum(batch.kept for batch in playing.batches)
    if call == 6:
        assert 0 < len(kept) < 5  # the first file is committed, what was in the second is lost
    assert_same(
        left_in(tmp_path, collect(tmp_path, keep_failures=whole["keep_failures"])), whole["left"]
    )


@successes_alone
@pytest.mark.parametrize("call", [1, 2, 3, 4])
def test_no_room_for_the_notes(
    call: int, whole: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither before a batch's episodes nor after them."""
    write = collection.write_atomic
    calls = []

    def full(path: Path, content: str) -> None:
        calls.append(path.name)
        if len(calls) >= call:
            raise OSError(28, "No space left on device")
        write(path, content)

    playing = collection_at(tmp_path, keep_failures=whole["keep_failures"])
    with monkeypatch.context() as context:
        context.setattr(collection, "write_atomic", full)
        with pytest.raises(OSError, match="No space left on device"):
            playing.play()
    assert calls == [FILE] * (call + 1)  # it is tried once more on the way out
    assert_same(
        left_in(tmp_path, collect(tmp_path, keep_failures=whole["keep_failures"])), whole["left"]
    )


@pytest.mark.parametrize("keep_failures", [False, True])
def test_worlds_that_are_judged_otherwise_the_second_time(
    keep_failures: bool, tmp_path: Path
) -> None:
    """As on CUDA: what is committed stays, the first play counts in the success rate, and every
    episode has the result of its own play.
    """
    play_interrupted(tmp_path, 3, keep_failures=keep_failures)
    first = episodes_of(tmp_path / "dataset")
    flipped = {0, 4, 5}  # one that is committed, one that succeeded, and one that was rejected
    otherwise = fake_demonstrations(
        lambda seed, world: some_fail(seed, world) != (seed == 0 and world in flipped), noise=True
    )
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(collection, "play_demonstrations", otherwise)
        result = collect(tmp_path, keep_failures=keep_failures)
    rows = episodes_of(tmp_path / "dataset")
    assert rows[:3] == first
    notes = left_in(tmp_path, result)["notes"]
    assert (notes[0]["worlds"], notes[0]["succeeded"]) == (9, 7)
    left_out = set() if keep_failures else {1, 4}
    assert {row["world"] for row in rows if row["seed"] == 0} == set(range(9)) - left_out
    for row in rows[3:]:
        flip = row["seed"] == 0 and row["world"] in flipped
        assert row["success"] == (some_fail(row["seed"], row["world"]) == flip)
    assert len(rows) == 10 == sum(note["kept"] for note in notes)
    assert all(note["kept"] == note["keep"] for note in notes)


@pytest.mark.parametrize(
    "world", [0, 1]
)  # succeeded: its own physics is well, and a term's number is not; and failed
def test_what_is_not_finite_is_left_out(
    world: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert some_fail(0, world) is bool(world)

    def diverge(seed: int, values: torch.Tensor) -> None:
        if seed == 0 and values.shape[1] == 9:
            values[3, world] = torch.nan

    monkeypatch.setattr(
        collection, "play_demonstrations", fake_demonstrations(some_fail, diverge, noise=True)
    )
    expected = left_in(tmp_path / "whole", collect(tmp_path / "whole", keep_failures=True))
    lost = [note["broken"].get("a number that is not finite", 0) for note in expected["notes"]]
    assert lost == [1, 0]
    play_interrupted(tmp_path / "parts", 2, keep_failures=True)
    assert_same(
        left_in(tmp_path / "parts", collect(tmp_path / "parts", keep_failures=True)), expected
    )


def test_notes_that_were_removed(tmp_path: Path) -> None:
    """The dataset stands and goes on with the next seed, and it is said that some episodes are in
    no success rate.
    """
    play_interrupted(tmp_path, 3)
    (tmp_path / FILE).unlink()
    result = collect(tmp_path)
    found = pairs(tmp_path / "dataset")
    assert found[:3] == [(0, 0), (0, 2), (0, 3)]
    assert [seed for seed, _ in found[3:]] == [1] * 6 + [2]
    assert result.metrics["episodes_without_note"] == 3
    assert "; 3 episodes are of seeds that batches.json does not have" in result.reason
    assert (result.metrics["worlds_played"], result.metrics["succeeded"]) == (10, 7)


def test_a_dataset_that_was_removed(tmp_path: Path) -> None:
    """Its notes go with it."""
    collect(tmp_path)
    shutil.rmtree(tmp_path / "dataset")
    result = collect(tmp_path, episodes=2)
    assert pairs(tmp_path / "dataset") == [(0, 0), (0, 2)]
    assert (result.metrics["worlds_played"], result.metrics["succeeded"]) == (3, 2)


@pytest.fixture
def _in_tmp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_real_worlds_are_the_same_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No pretence: the second of two worlds is added by another call, with another nworld."""
    monkeypatch.setattr(collection, "play_demonstrations", play_demonstrations)
    quick = one_second_episode()
    options: dict[str, Any] = {"episodes": 2, "keep_failures": True}
    expected = left_in(tmp_path / "whole", collect(tmp_path / "whole", *quick, nworld=2, **options))
    play_interrupted(tmp_path / "parts", 1, *quick, nworld=2, **options)
    assert_same(
        left_in(tmp_path / "parts", collect(tmp_path / "parts", *quick, nworld=1, **options)),
        expected,
    )


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
@pytest.mark.usefixtures("_in_tmp")
def test_ctrl_c_on_cuda() -> None:
    """Two plays agree only nearly there: what was committed stays, and every figure is of the
    dataset.
    """
    args = [
        "job=collect",
        "job.folder=demos",
        "job.episodes=8",
        "nworld=16",
        "sim=mjwarp",
        "sim.device=cuda:0",
    ]
    home = Path("demos")
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(collection, "play_demonstrations", play_demonstrations)
        monkeypatch.setattr(demonstration, "config_content", config_content)
        with pytest.MonkeyPatch.context() as inner:
            interrupt_at(3, inner)
            assert run(args) == 130
        first = episodes_of(home / "dataset")
        data = (home / "dataset/data/chunk-000/file-000.parquet").read_bytes()
        assert len(first) == 3
        assert run(args) == 0
    assert episodes_of(home / "dataset")[:3] == first
    assert (home / "dataset/data/chunk-000/file-000.parquet").read_bytes() == data
    found = pairs(home / "dataset")
    notes = json.loads((home / FILE).read_text())
    assert len(set(found)) == len(found) == 8
    assert all(note["kept"] == note["keep"] <= note["worlds"] for note in notes)
    assert [note["kept"] for note in notes] == [
        sum(seed == note["seed"] for seed, _ in found) for note in notes
    ]
    check_dataset(home / "dataset")
