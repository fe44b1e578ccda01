"""Tests of the environment that need a GPU."""

import math

import pytest
import torch
from environments import CUDA, no_host_reads

import mjstack

pytestmark = CUDA


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
    with no_host_reads():
        for one in actions[1:]:
            env.step(one)
    assert env.read_statistics()["episodes"] >= 32
    assert (env.episode >= 2).all()


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e20, 1e38])
def test_a_bad_action_is_named_and_stays_in_its_world(value: float) -> None:
    """Its CPU twins are in test_actions.py."""
    env = mjstack.make_env(["task=reach", "sim=mjwarp"], nworld=2048)
    ends = []
    for spoilt in (False, True):
        env.reset(seed=0)
        generator = torch.Generator().manual_seed(0)
        for step in range(6):  # the second is captured
            draw = torch.rand((2048, env.action_manager.action_dim), generator=generator)
            action = (2.0 * draw - 1.0).to(env.device)
            if spoilt and step == 5:
                action[2, 0] = value
            env.step(action)
        ends.append(env.sim.qpos.clone())
        if not spoilt:
            env.faults.raise_first()
    cause = "the reward is not finite" if math.isfinite(value) else "actions were not finite"
    with pytest.raises(mjstack.MjstackError, match=rf"{cause} in 1 of 2048 worlds \(2\)") as caught:
        env.faults.raise_first()
    assert ("after an action of" in str(caught.value)) is math.isfinite(value)
    others = [end[torch.arange(2048, device=env.device) != 2] for end in ends]
    assert ((others[0] - others[1]).abs().amax(1) < 1e-3).float().mean() > 0.99
    env.close()
