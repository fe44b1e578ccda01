"""trainer=dagger: rounds of a small training, what it refuses, and how it goes on."""

import os
import signal
import time
from collections import Counter
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from browser import messages
from compositions import load_config
from environments import SHORT_REACH, Patch
from policies import curve, interrupted, report, run_as_torchrun, same
from processes import rank_process, start

import mjstack.train.rounds as rounds
from mjstack.cli import run
from mjstack.distributed import Ranks
from mjstack.drivers.driver import Driver
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError, FolderError
from mjstack.math import wilson_interval
from mjstack.policy import load_policy
from mjstack.policy.checkpoint import read_state
from mjstack.train.clone import _judge, check_clone
from mjstack.train.clone_learner import CloneLearner
from mjstack.train.demonstrations import Demonstrations
from mjstack.train.trainer import STATE

TINY = (
    *("job=train", "task=reach", "sim=native", "nworld=4", "job.rounds=2"),
    *("job.episodes=4", "job.hidden=[32]", "job.batches=20", "job.batch_size=64"),
    "gate.success.rate=0.0",
    *SHORT_REACH,
)


@pytest.mark.full
def test_rounds_leave_a_policy_and_go_on_bit_for_bit(tmp_path: Path) -> None:
    """Interrupted in the first round, when it is over, and in the second one."""
    whole = tmp_path / "whole"
    assert run([*TINY, f"job.folder={whole}"]) == 0
    gates = report(whole)
    figures = gates["train"]["metrics"]
    assert (figures["rounds"], figures["batches"], figures["episodes"]) == (2, 40, 8)
    rows = curve(whole)
    assert rows["round"].tolist() == [1.0, 2.0]
    policy = load_policy(whole / "last")
    assert (policy.network.chunk, policy.execute, policy.training["trainer"]) == (16, 8, "dagger")
    assert load_policy(whole / "best").training["success"] == rows["success"].max()
    assert not list(whole.glob("round-*"))

    parts = tmp_path / "parts"
    for number in (7, 20, 33):
        interrupted([*TINY, f"job.folder={parts}"], CloneLearner, number)
    assert run([*TINY, f"job.folder={parts}"]) == 0
    assert same(whole / "last", parts / "last")
    other = curve(parts)
    for name in ("success", "validation_loss"):
        assert rows[name].tolist() == other[name].tolist()


@pytest.mark.full
def test_the_report_of_a_training_that_fails(tmp_path: Path) -> None:
    """Success by round with its interval, the rules that failed, times, and failing worlds."""
    sizes = ["job.alone=0.5", "job.batches=1", "gate.success.rate=1"]
    assert run([*TINY, *sizes, f"job.folder={tmp_path}"]) == 1
    rows = curve(tmp_path)
    assert rows["judged"].tolist() == [2.0, 4.0]  # alone in all worlds of the last round
    for row in rows:
        successes, judged = round(row["success"] * row["judged"]), int(row["judged"])
        low, high = wilson_interval(successes, judged)
        assert (row["success_low95"], row["success_high95"]) == (low, high)
        assert row["failedREACHED"] == judged - successes  # genfromtxt leaves the dot out
    assert rows["failedREACHED"].sum() > 0.0
    assert (rows["played_s"] > 0.0).all()
    gates = report(tmp_path)
    tables = {table["title"]: table for table in gates["train"]["tables"]}
    broken = tables["Judged episodes that broke a rule"]
    assert broken["header"] == ["round", "judged", "REACHED"]
    assert [row[1] for row in broken["rows"]] == ["2", "4"]
    assert [row[0] for row in tables["Time"]["rows"]] == ["expert", "training", "judgement"]
    metrics = gates["train"]["metrics"]
    assert metrics["expert_s"] > rows["played_s"].sum()  # the expert's own round too
    assert gates["success"]["metrics"]["failed.REACHED"] > 0
    assert ": REACHED" in str(messages(tmp_path / "episode.html"))  # a failed world on the page


def test_rules_are_counted_over_batches_and_ranks() -> None:
    parts = [
        Demonstrations(
            **dict.fromkeys(("seen", "labels"), torch.zeros((1, 1))),
            ends=torch.ones(1, dtype=torch.int64),
            widths={},
            judged=4,
            succeeded=succeeded,
            broken=broken,
            seconds=seconds,
        )
        for succeeded, broken, seconds in ((1, {"A": 3}, 2.0), (3, {"A": 1, "B": 1}, 1.0))
    ]
    joined = Demonstrations.join(parts)
    assert (joined.judged, joined.succeeded, joined.broken) == (8, 4, {"A": 4, "B": 1})

    class Two(Ranks):
        def gather(self, value: Any) -> list[Any]:
            return [value, (3, 4, 5.0, Counter({"B": 1}))]

    stage = Stage(load_config(TINY), ranks=Two())
    figures = _judge(stage, "the policy", parts[0])
    assert (figures["success"], figures["judged"], figures["played_s"]) == (0.5, 8, 5.0)
    assert (figures["failed.A"], figures["failed.B"]) == (3, 1)


@pytest.mark.full
@pytest.mark.long
def test_two_ranks_give_one_policy_and_go_on_bit_for_bit(tmp_path: Path) -> None:
    """The second one is killed when the first one has written its part of a round."""
    sizes = ["nworld=5", "job.episodes=5", "job.batches=60", "job.save_every=10"]
    args = [*TINY, *sizes, "web.episode=false"]
    texts = run_as_torchrun([*args, f"job.folder={tmp_path}/whole"], tmp_path)
    assert "".join(texts).count("round 2: the policy alone succeeded in") == 1
    assert report(tmp_path / "whole")["train"]["metrics"]["episodes"] == 10
    assert read_state(tmp_path / "whole" / STATE)[1]["made_with"]["processes"] == 2

    command = [*args, f"job.folder={tmp_path}/parts"]
    process = start(0, [*command, "devices=2"], tmp_path)
    rank = rank_process(process.pid, 1)
    until = time.monotonic() + 120.0
    while not (tmp_path / "parts/round-1-0.safetensors").exists():
        assert time.monotonic() < until
        time.sleep(0.005)
    os.kill(rank, signal.SIGKILL)
    process.communicate(timeout=120)
    assert process.returncode == 1
    done = read_state(tmp_path / "parts" / STATE)[1]["done"]
    assert 0 < done < 120
    again = tmp_path / "again"
    again.mkdir()
    run_as_torchrun(command, again)
    assert same(tmp_path / "whole/last", tmp_path / "parts/last")
    assert not list((tmp_path / "parts").glob("round-*"))
    rows = [curve(tmp_path / name) for name in ("whole", "parts")]
    for name in ("success", "validation_loss"):
        assert rows[0][name].tolist() == rows[1][name].tolist()


def test_a_round_of_another_number_of_ranks_is_refused(tmp_path: Path) -> None:
    stage = Stage(load_config([*TINY, "nworld=2", "job.episodes=2"]))
    rounds.make_round(stage, tmp_path, None, 0, None)
    other = stage.with_config(stage.cfg, ranks=Alone(0, 2))
    with pytest.raises(FolderError, match=r"'processes': 1\}, and this one has .*'processes': 2\}"):
        rounds.make_round(other, tmp_path, None, 0, None)
    with pytest.raises(ConfigError, match="episodes=2: expected at least 4, because one of each"):
        check_clone(other)


class Alone(Ranks):
    """One of two ranks, whose flags are those of both."""

    def any(self, flag: bool) -> bool:
        return flag


def test_gradients_are_cut_and_the_learning_rate_rises(tmp_path: Path, monkeypatch: Patch) -> None:
    """A round begins with the small moments of the one before, so a full rate would leap."""
    stage = Stage(load_config([*TINY, "job.warm_up=0.5", "job.max_grad_norm=0.001"]))
    played = rounds.make_round(stage, tmp_path, None, 0, None)
    rates, lengths = [], []
    with closing(CloneLearner(stage, played, tmp_path, None)) as learner:
        cut = learner._optimizer.step

        def step() -> None:
            rates.append(float(learner._optimizer.param_groups[0]["lr"]))
            gradients = [w.grad.norm() for w in learner._trained if w.grad is not None]
            lengths.append(float(torch.stack(gradients).norm()))
            cut()

        monkeypatch.setattr(learner._optimizer, "step", step)
        learner.learn()
    np.testing.assert_allclose(lengths, 0.001, rtol=1e-3)
    share = np.arange(20) / 20
    cosine = 0.001 * (1.0 + np.cos(np.pi * share)) / 2
    np.testing.assert_allclose(rates, cosine * np.minimum(1.0, 2 * share), rtol=1e-5)


def test_the_share_of_the_expert(monkeypatch: pytest.MonkeyPatch) -> None:
    """Worlds in which the policy drives alone get its targets; in the others the expert drives for
    about its share of the spells.
    """
    import mjstack

    cfg = ["task=reach", "action=joint_absolute", "sim=native"]
    env = mjstack.make_env(cfg, nworld=40)
    env.reset(seed=0)

    class Constant(Driver):
        def __init__(self, value: float) -> None:
            super().__init__(40, 150, env.device)
            self.value = torch.full((40, len(env.index.ctrl)), value)
            self.query_images = None

        def command(self) -> torch.Tensor:
            return self.value

    expert, policy = Constant(1.0), Constant(2.0)
    monkeypatch.setattr(rounds, "PolicyDriver", lambda *args: policy)
    job = SimpleNamespace(length=0.5, spell=25 * env.cfg.timing.step_dt, execute=1)
    scene = SimpleNamespace(cameras={})
    stage: Any = SimpleNamespace(
        cfg=SimpleNamespace(job=job, scene=scene), driver=lambda env: expert
    )
    trained: Any = policy
    driver = rounds.MixedDriver(stage, env, trained, beta=0.5, alone=10)
    assert driver.steps == 75
    seen = []
    for step in range(0, 1000, 25):
        env.episode_step.fill_(step)
        seen.append(driver.command()[:, 0].clone())
        env.episode_step.add_(24)
        assert torch.equal(driver.command()[:, 0], seen[-1])
        assert torch.equal(driver.driven == 1, seen[-1] == 1.0)
    share = (torch.stack(seen) == 1.0).float().mean(0)
    assert (share[:10] == 0.0).all()
    assert abs(float(share[10:].mean()) - 0.5) < 0.05
    assert torch.equal(driver.label, expert.value)
    env.close()
