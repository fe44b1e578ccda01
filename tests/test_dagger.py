"""trainer=dagger: rounds of a small training, what it refuses, and how it goes on."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from policies import curve, interrupted, report, same

import mjstack.train.rounds as rounds
from mjstack.cli import run
from mjstack.drivers.driver import Driver
from mjstack.policy import load_policy
from mjstack.train.clone_learner import CloneLearner

TINY = (
    *("job=train", "task=reach", "sim=native", "nworld=4", "job.rounds=2"),
    *("job.episodes=4", "job.hidden=[32]", "job.batches=20", "job.batch_size=64"),
    "gate.success.rate=0.0",
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


def test_the_share_of_the_expert() -> None:
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

        def command(self) -> torch.Tensor:
            return self.value

    expert, policy = Constant(1.0), Constant(2.0)
    driver = rounds.MixedDriver(expert, policy, env, beta=0.5, alone=10, spell=25)
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
