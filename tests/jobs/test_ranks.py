"""A job in several ranks: world k is world k, one report, failures by rank, and runs that are gone
on with in another number of ranks.
"""

import logging
import os
import re
import shutil
import signal
import socket
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from compositions import load_config
from dataset_checker import check_dataset
from environments import Patch, few, one_second_episode, report_of
from policies import run_as_torchrun
from processes import PLAIN, SCRIPT, SHORT, play, rank_process, start, start_python

import mjstack
from mjstack.cli import run
from mjstack.config.schema import Backend, Config
from mjstack.datasets import read_dataset
from mjstack.distributed import Ranks, current_ranks, see_one_gpu
from mjstack.episodes.batches import BatchPlan, play_batches
from mjstack.episodes.record import EpisodeRecord
from mjstack.episodes.stage import Stage
from mjstack.errors import ArgumentError, ConfigError, MjstackError
from mjstack.gates import runner
from mjstack.gates.runner import log_error
from mjstack.jobs import check_ranks, count_devices
from mjstack.report.figure import Figure
from mjstack.report.record import GateResult, Status

ON_CUDA = (Backend.mjwarp, "cuda:0")
OF_CALL = {"seconds"}  # of a record

MEETING = """\
import torch

from mjstack.distributed import current_ranks, joined
from mjstack.errors import RankError

def refuse():
    raise ValueError("no")

with joined() as ranks:
    assert current_ranks() is ranks
    assert ranks.gather(10 * ranks.rank) == [0, 10]
    assert ranks.from_first(lambda: ranks.rank) == 0
    assert ranks.in_all(lambda: ranks.rank) == [0, 1]
    assert ranks.any(ranks.rank == 1) and not ranks.any(False)
    total = torch.tensor([1.0, ranks.rank])
    ranks.sum_(total)
    assert total.tolist() == [2.0, 1.0]
    try:
        ranks.in_all(lambda: ranks.rank and refuse())
    except RankError as error:
        assert "rank 1 of 2: ValueError: no" in str(error), error
        print("rank", ranks.rank, "silent" if error.printed else "prints")
"""

TRAP = """\
import os, signal

def spring(env, mask):
    if os.environ.get("RANK") == os.environ.get("TRAPPED", "1") and env.seed == 2:
        if "KILL" in os.environ:
            os.kill(os.getpid(), signal.SIGKILL)
        raise RuntimeError("the trap")
"""


def assert_same_episodes(one: Path, other: Path) -> None:
    """Records and tables of two runs agree bit for bit."""
    names = sorted(path.name for path in one.glob("*_seed*.npz"))
    assert names
    assert names == sorted(path.name for path in other.glob("*_seed*.npz"))
    for name in names:
        with np.load(one / name) as ours, np.load(other / name) as theirs:
            assert ours.files == theirs.files
            for key in set(ours.files) - OF_CALL:
                np.testing.assert_array_equal(ours[key], theirs[key], err_msg=f"{name}: {key}")
    for path in one.glob("*.csv"):
        assert path.read_bytes() == (other / path.name).read_bytes()


def test_a_line_has_the_sum_and_the_slowest_of_all_ranks() -> None:
    def rank(rate: float, status: Status = Status.passed) -> list[GateResult]:
        rates = {"world_steps": 10.0 * rate, "env_steps": rate}
        figures = [
            Figure(name, value, "/s", column="median", group="env_step")
            for name, value in rates.items()
        ]
        line = f"env_step: {rate:g} env-steps/s"
        return [GateResult(name="throughput", status=status, reason=line, figures=figures)]

    (joined,) = runner.join_ranks([rank(3000.0), rank(1000.0), rank(2000.0)])
    assert joined.reason == (
        "3 ranks: env_step 6,000 env-steps/s (rank 1, the slowest, 1,000);"
        " rank 0: env_step: 3000 env-steps/s"
    )
    assert joined.metrics["all_ranks.env_step.world_steps_per_s.median"] == 60_000.0
    (broken,) = runner.join_ranks([rank(3000.0), rank(1000.0, Status.failed)])
    assert broken.status is Status.failed
    assert broken.reason == "rank 1: env_step: 1000 env-steps/s"


@pytest.mark.full
@pytest.mark.long
def test_ranks_play_what_one_plays(tmp_path: Path) -> None:
    """Five worlds, so that shares differ, with the feedback of the closed loop. Batch and success,
    whose starts are drawn; every gate has one result, and says where its worlds were.
    """
    args = [*PLAIN, "gates=[baseline,batch,success]", "nworld=5", "gate.batch.seeds=2"]
    args.append("controller=closed_loop")
    assert run([*args, f"hydra.run.dir={tmp_path}/one"]) == 1  # the episodes are too short
    text = play(0, [*args, "devices=2", f"hydra.run.dir={tmp_path}/two"], tmp_path, 1)
    assert_same_episodes(tmp_path / "one", tmp_path / "two")
    with np.load(tmp_path / "two/success_starts_seed0.npz") as starts:
        assert {len(array) for array in starts.values()} == {5}

    assert text.count("status: fail") == 1  # one process prints
    one, two = (report_of(tmp_path / name) for name in ("one", "two"))
    assert [gate["name"] for gate in two["gates"]] == ["baseline", "batch", "success"]
    for ours, theirs in zip(one["gates"][1:], two["gates"][1:], strict=True):
        speeds = {"episode_s", "world_steps_per_s"}
        assert {k: v for k, v in ours["metrics"].items() if k not in speeds} == {
            k: v for k, v in theirs["metrics"].items() if k not in speeds
        }
    assert two["gates"][0]["notes"]["ranks"] == "rank 0 alone"
    assert len(two["provenance"]["ranks"]) == 2


@pytest.mark.parametrize("size", few([2, 3], 2))
def test_shares_played_apart_join_to_the_whole(finished: Path, size: int) -> None:
    """Three worlds as ranks share them, in one process: bit for bit what one rank played."""
    cfg = load_config([*SHORT, "nworld=3"])
    stage = Stage(cfg)
    parts = []
    for rank in range(size):
        own = stage.with_config(stage.cfg, ranks=Ranks(rank, size))
        for batch in play_batches(own, [BatchPlan(1, own.worlds)]):
            parts.append(EpisodeRecord.from_batch(batch))
    joined = EpisodeRecord.join(parts)
    whole = EpisodeRecord.read(finished, 1)
    assert whole is not None
    assert len(np.unique(joined.worlds["start_qpos"], axis=0)) == 3
    assert joined.worlds.keys() <= whole.worlds.keys()
    for name, values in joined.worlds.items():
        np.testing.assert_array_equal(values, whole.worlds[name], err_msg=name)


@pytest.mark.full
def test_two_ranks_meet(tmp_path: Path) -> None:
    """What they gather, sum and do in turns; an error of one is an error of both."""
    (tmp_path / "meeting.py").write_text(MEETING)
    texts = run_as_torchrun([], tmp_path, program=[str(tmp_path / "meeting.py")])
    assert "rank 0 prints" in texts[0]
    assert "rank 1 silent" in texts[1]


@pytest.fixture(scope="module")
def trap(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Overrides of a run in which one rank, by default the second, breaks under seed 2."""
    folder = tmp_path_factory.mktemp("trap")
    (folder / "conf").mkdir()
    (folder / "trap.py").write_text(TRAP)
    more = ["nworld=5", "gate.batch.seeds=4", "+reset.trap={func: trap.spring}"]
    return [*PLAIN, "--config-dir", str(folder / "conf"), *more]


@pytest.fixture(scope="module")
def untrapped(trap: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of that run in one process, which nothing breaks."""
    folder = tmp_path_factory.mktemp("untrapped")
    assert run([*trap, f"hydra.run.dir={folder}/whole"]) == 1
    return folder / "whole"


@pytest.mark.full
@pytest.mark.parametrize(("env", "why"), [({}, "the trap"), ({"KILL": "1"}, "was killed")])
def test_a_rank_that_breaks(
    env: dict[str, str], why: str, trap: list[str], untrapped: Path, tmp_path: Path
) -> None:
    """The run fails with the rank and the reason, within seconds; finished seeds are kept."""
    folder = tmp_path / "run"
    began = time.monotonic()
    text = play(2, [*trap, f"hydra.run.dir={folder}"], tmp_path, 1, **env)
    assert time.monotonic() - began < 60.0
    (gate,) = report_of(folder)["gates"]
    assert gate["status"] == "fail"
    assert re.match(r"rank 1 of 2 \(.*\).*" + why, gate["reason"])
    assert f"mjstack: {gate['reason'].split('.')[0]}" in text
    # The finished seeds are there to be read.
    assert {path.name for path in folder.glob("*_seed*.npz")} == {
        "batch_seed0.npz",
        "batch_seed1.npz",
    }
    for seed in (0, 1):
        ours, theirs = (EpisodeRecord.read(one, seed) for one in (untrapped, folder))
        assert ours is not None
        assert theirs is not None
        np.testing.assert_array_equal(ours.qpos, theirs.qpos)


@pytest.mark.parametrize(
    ("visible", "count", "rank", "expected"),
    [
        (None, 4, "1", "1"),
        ("5,7", 2, "1", "7"),
        ("GPU-a, GPU-b", 2, "3", "GPU-b"),
        ("6", 1, "1", "6"),
        (None, 0, "1", None),
    ],
)
def test_a_rank_sees_its_own_gpu_alone(
    monkeypatch: Patch, visible: str | None, count: int, rank: str, expected: str | None
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible or "")
    if visible is None:
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    monkeypatch.setenv("LOCAL_RANK", rank)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    see_one_gpu()
    assert os.environ.get("CUDA_VISIBLE_DEVICES") == expected


def test_a_rank_without_a_log_prints_the_traceback(
    monkeypatch: Patch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(runner, "current_ranks", lambda: Ranks(1, 2))
    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # as in a rank
    with pytest.raises(ValueError, match="no") as caught:
        raise ValueError("no")
    assert re.fullmatch(
        r"ValueError: no \(test_ranks.py:\d+; stderr has the traceback\)", log_error(caught.value)
    )
    assert capsys.readouterr().err.count("Traceback") == 1
    assert log_error(MjstackError("seen")) == "seen."
    assert not capsys.readouterr().err


@pytest.mark.full
@pytest.mark.parametrize("script", [False, True], ids=["devices=2", "torchrun scripts/run.py"])
def test_a_killed_first_rank_is_named(script: bool, trap: list[str], tmp_path: Path) -> None:
    """It would have said so itself: the lowest rank that is left does, alone, and the command that
    has started the ranks gives the signal.
    """
    folder = tmp_path / "run"
    args = [*trap, f"hydra.run.dir={folder}"]
    launcher = ["-m", "torch.distributed.run", "--nproc-per-node=3", str(SCRIPT)]
    command = [*launcher, *args] if script else ["-m", "mjstack", "devices=2", *args]
    process = start_python(command, tmp_path, TRAPPED="0", KILL="1")
    text, _ = process.communicate(timeout=400)
    assert process.returncode == 1, text
    killed = r"mjstack: rank 1: rank 0 of [23] \(.*, process \d+\) was killed"
    assert len(re.findall(killed, text)) == 1
    assert "mjstack: rank 2" not in text
    assert ("mjstack: rank 0 of 2 was killed (SIGKILL, process " in text) == (not script)
    assert report_of(folder)["status"] == "interrupted"
    assert EpisodeRecord.read(folder, 1) is not None


@pytest.mark.full
@pytest.mark.skipif(not Path("/proc").exists(), reason="a system without /proc")
@pytest.mark.parametrize(("rank", "delay"), [(0, 0.5), (1, 2.0)])
def test_a_rank_killed_while_ranks_start_is_a_failure(
    rank: int, delay: float, tmp_path: Path
) -> None:
    """It is no interruption; the command that has started the ranks names it."""
    process = start(0, [*PLAIN, "devices=2", "nworld=4", f"hydra.run.dir={tmp_path}/run"], tmp_path)
    killed = rank_process(process.pid, rank)
    time.sleep(delay)
    os.kill(killed, signal.SIGKILL)
    text, _ = process.communicate(timeout=120)
    assert process.returncode == 1, text
    assert f"mjstack: rank {rank} of 2 was killed (SIGKILL, process {killed})" in text
    assert "interrupted" not in text


@pytest.mark.full
def test_ctrl_c_stops_all_ranks(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    args = [*PLAIN, "nworld=4", "gate.batch.seeds=10000", f"hydra.run.dir={folder}", "devices=2"]
    process = start(0, args, tmp_path)
    until = time.monotonic() + 120.0
    while not (folder / "batch_seed1.npz").exists() and time.monotonic() < until:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    began = time.monotonic()
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 130, text
    assert time.monotonic() - began < 20.0
    assert text.count("interrupted") == 2  # the line, and the status
    assert "Traceback" not in text
    assert report_of(folder)["status"] == "interrupted"


# Records


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of two seeds of batch and one of success."""
    folder = tmp_path_factory.mktemp("resume") / "run"
    args = [*SHORT, "gates=[batch,success]", "nworld=3", "gate.batch.seeds=2"]
    assert run([*args, f"hydra.run.dir={folder}"]) == 1
    return folder


def test_a_record_of_an_older_version_is_refused(finished: Path, tmp_path: Path) -> None:
    """It lacks what a result needs."""
    with np.load(finished / "batch_seed0.npz") as held:
        rest = {key: held[key] for key in held.files if not key.startswith("measured.")}
        del rest["steps"]
    np.savez(tmp_path / "batch_seed0.npz", **rest)
    with pytest.raises(MjstackError, match="cannot be read"):
        EpisodeRecord.read(tmp_path, 0)


def test_an_environment_of_later_worlds_starts_and_ends_like_them() -> None:
    overrides = ["sim=native", "reset=randomized", "termination.time_out.params.steps=2"]
    found = []
    for own in ({"nworld": 4}, {"nworld": 2, "first_world": 2}):
        env = mjstack.make_env(overrides, seed=3, **own)
        zeros = torch.zeros((env.nworld, env.action_manager.action_dim))
        steps = [env.reset(seed=3)[0], *(env.step(zeros)[0] for _ in range(3))]
        env.close()
        found.append([{name: group[-2:] for name, group in obs.items()} for obs in steps])
    for ours, theirs in zip(*found, strict=True):
        for name in ours:
            assert torch.equal(ours[name], theirs[name]), name
    with pytest.raises(ArgumentError, match="first_world: found -1, expected an integer of at"):
        mjstack.make_env(overrides, nworld=2, first_world=-1)


# Ranks that do not fit together


@pytest.mark.parametrize(("count", "size"), [(7, 1), (7, 2), (7, 3), (3, 3), (65536, 8)])
def test_shares(count: int, size: int) -> None:
    """Every world is in one share, and no share has two more than another."""
    shares = [Ranks(rank, size).share(count) for rank in range(size)]
    assert [world for share in shares for world in share] == list(range(count))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


class Others(Ranks):
    """Two ranks, of which the other one tells something else."""

    change: dict[str, dict[str, str]]

    def gather(self, value: tuple) -> list:  # type: ignore[override]
        host, facts, gpu = value
        return [value, (host, facts | self.change, gpu)]


def test_unequal_versions_are_refused() -> None:
    Others.change = {}
    stage = Stage(load_config(["sim=native"]), ranks=Others(0, 2))
    check_ranks(stage)
    Others.change = {"versions": {"torch": "1.0"}}
    with pytest.raises(MjstackError, match=r"rank 1 \(.*\) has versions.torch=1\.0, expected \d"):
        check_ranks(stage)
    Others.change = {}
    stage = stage.with_config(replace(stage.cfg, nworld=1))
    with pytest.raises(ConfigError, match="nworld=1: expected at least 2, a world for each rank"):
        check_ranks(stage)


@pytest.mark.parametrize("value", ["0", "some", "-1", "1.5"])
def test_devices_is_a_number_or_all(value: str) -> None:
    with pytest.raises(ConfigError, match=f"devices={value}: expected all, or a number"):
        load_config([f"devices={value}"])


def test_more_devices_than_there_are(monkeypatch: Patch) -> None:
    def cfg(value: str) -> Config:
        return load_config(["sim=native", f"devices={value}"])

    assert count_devices(cfg("1")) == 1
    assert count_devices(cfg("all")) == 1  # on a CPU one process uses all cores
    with pytest.raises(ConfigError, match=r"devices=9999: expected at most \d+, the cores"):
        count_devices(cfg("9999"))
    monkeypatch.setattr("mjstack.jobs.runner.resolve_backend", lambda cfg: ON_CUDA)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    assert [count_devices(cfg(value)) for value in ("all", "2", "1")] == [2, 2, 1]
    says = "devices=3: expected at most 2, the CUDA devices that this machine has for sim=mjwarp"
    with pytest.raises(ConfigError, match=says):
        count_devices(cfg("3"))


def test_two_ranks_on_one_gpu_are_refused(monkeypatch: Patch) -> None:
    monkeypatch.setattr(Stage, "backend", ON_CUDA)
    monkeypatch.setattr("mjstack.jobs.runner.cuda_uuid", lambda device: "GPU-7")
    monkeypatch.setattr(Others, "change", {}, raising=False)
    with pytest.raises(MjstackError, match=r"ranks 0 and 1 \(.*\) have one GPU, GPU-7, expected"):
        check_ranks(Stage(load_config([]), ranks=Others(0, 2)))


@pytest.mark.full
def test_a_port_in_use_is_one_line(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("0.0.0.0", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        own = {"RANK": "0", "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
        text = play(0, SHORT, tmp_path, 2, **own)
    lines = [line for line in text.splitlines() if line.startswith("mjstack:")]
    assert len(lines) == 1
    assert f"the 2 ranks did not meet at 127.0.0.1:{port}" in lines[0]
    assert current_ranks() == Ranks()
    assert not list(tmp_path.iterdir())


@pytest.mark.full
def test_ranks_collect_one_dataset(tmp_path: Path) -> None:
    """Two begin it, three go on, and it has what one rank collects, in the same order."""
    args = ["job=collect", "sim=native", "nworld=5", "job.keep_failures=true"]
    args += one_second_episode()
    several = [*args, f"job.folder={tmp_path}/several"]
    play(2, [*several, "job.episodes=7"], tmp_path)
    shutil.copytree(tmp_path / "several", tmp_path / "one")
    assert run([*args, f"job.folder={tmp_path}/one", "job.episodes=12"]) == 0
    text = play(3, [*several, "job.episodes=12"], tmp_path)
    assert text.count("12 of 12 episodes there") == 1
    found, expected = (read_dataset(tmp_path / name / "dataset") for name in ("several", "one"))
    for key in ("seed", "world", "length", "success", "retries", "failed_rules"):
        assert [row[key] for row in found.episodes] == [row[key] for row in expected.episodes]
    for name in ("observation.state", "action", "episode_index", "index", "timestamp"):
        np.testing.assert_array_equal(found.frames(name), expected.frames(name))
    assert found.info["mjstack"]["shards"] > expected.info["mjstack"]["shards"]
    check_dataset(tmp_path / "several" / "dataset")
