"""Tests of the environment that need a GPU."""

from __future__ import annotations

import pytest
import torch

import mjstack

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here"),
]


@pytest.mark.parametrize("action", ["joint_relative", "joint_delta", "ee_delta"])
@pytest.mark.parametrize("task", ["stack", "reach"])
def test_a_step_reads_nothing_from_the_device(task: str, action: str) -> None:
    """Torch raises at every host read, also in steps that reset worlds."""
    overrides = [
        f"task={task}",
        f"action={action}",
        "reset=randomized",
        "sim=mjwarp",
        "termination.time_out.params.steps=5",
    ]
    env = mjstack.make_env(overrides, nworld=16)
    env.reset(seed=0)
    actions = 2.0 * torch.rand((12, 16, env.action_manager.action_dim), device=env.device) - 1.0
    env.step(actions[0])
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for one in actions[1:]:
            env.step(one)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert env.read_statistics()["episodes"] >= 32
    assert (env.episode >= 2).all()


def test_a_bad_action_is_named_within_the_window() -> None:
    env = mjstack.make_env(["task=reach", "sim=mjwarp"], nworld=4)
    env.reset(seed=0)
    action = torch.zeros((4, env.action_manager.action_dim), device=env.device)
    action[2, 0] = float("nan")
    env.step(action)
    with pytest.raises(
        mjstack.MjstackError, match=r"actions were not finite in 1 of 4 worlds \(2\)"
    ):
        env.raise_faults()
