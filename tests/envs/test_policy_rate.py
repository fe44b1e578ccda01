"""A policy below the control rate: in training an environment holds its actions, and when it drives
worlds it repeats them. Both do the same.
"""

import pytest
import torch
from environments import Patch, actions, configure, few, on_new_sim, on_shared_sim, state_of
from policies import make_policy

from mjstack.adapters.rsl_rl import RslRlVecEnv
from mjstack.config.schema import Config
from mjstack.drivers.closed_loop import make_expert
from mjstack.drivers.policy import PolicyDriver
from mjstack.envs import driven_config
from mjstack.errors import ArgumentError

HELD = 5
REACH = ("task=reach", "~observation.policy.terms.last_action")


def held(*overrides: str, steps: int = HELD) -> Config:
    return configure(*REACH, f"timing.policy_decimation={steps}", *overrides)


def test_a_held_action_is_that_action_again_and_again() -> None:
    """Bit for bit, the observation's history included; rewards are summed."""
    env = on_new_sim("native", 3, held())
    single = on_new_sim("native", 3, held(steps=1))
    env.reset(seed=1)
    single.reset(seed=1)
    for move in actions(env, 4):
        obs, reward, *ends, _ = env.step(move)
        rewards = []
        for _ in range(HELD):
            wanted, one, *_ = single.step(move)
            rewards.append(one)
        assert all(torch.equal(obs[name], wanted[name]) for name in obs)
        torch.testing.assert_close(reward, torch.stack(rewards).sum(0))
        assert not torch.stack(ends).any()
    assert torch.equal(env.reward_manager.episode_sums, single.reward_manager.episode_sums)
    expected = state_of(single)
    for name in expected.keys() - {"previous_action"}:
        assert torch.equal(state_of(env)[name], expected[name]), name


@pytest.mark.parametrize(("history", "calls"), [(1, 1), (2, HELD)])
def test_held_steps_are_observed_for_a_history_alone(
    history: int, calls: int, monkeypatch: Patch
) -> None:
    term = "observation.policy.terms.grasp_point_to_goal"
    env = on_new_sim("native", 2, held(f"{term}.history={history}"))
    env.reset(seed=1)
    seen: list[int] = []
    compute = env.observation_manager.compute
    monkeypatch.setattr(env.observation_manager, "compute", lambda: seen.append(1) or compute())
    for number, move in enumerate(actions(env, 3)):
        env.step(move)
        assert len(seen) == calls * (number + 1)


@pytest.mark.parametrize(
    ("ends", "last", "success"),
    few(
        [
            (["task.episode_steps=7"], 7, 0.0),
            (["task.check.distance=10.0", "task.success.params.steps=3"], 3, 1.0),
        ],
        2,
    ),
    ids=["time out", "success"],
)
def test_an_episode_ends_within_a_decision(ends: list[str], last: int, success: float) -> None:
    """It counts up to the control step in which it ended, and the next one begins with the next
    decision.
    """
    forever = ["~termination.time_out", "~termination.success"]
    env = on_new_sim("native", 2, held(*ends))
    single = on_new_sim("native", 2, held(*ends, *forever, steps=1))
    env.reset(seed=4)
    single.reset(seed=4)
    moves = actions(env, 2)
    rewards = []
    for step in range(last):
        rewards.append(single.step(moves[step // HELD])[1])
    decisions = -(-last // HELD)
    for number in range(decisions):
        _, reward, terminated, truncated, extras = env.step(moves[number])
        over = number == decisions - 1
        assert terminated.tolist() == [over and success > 0.0] * 2
        assert truncated.tolist() == [over and success == 0.0] * 2
        wanted = torch.stack(rewards[HELD * number : HELD * (number + 1)]).sum(0)
        torch.testing.assert_close(reward, wanted)
    assert extras["success"].tolist() == [success > 0.0] * 2
    found = env.read_statistics()
    assert (found["episodes"], found["steps"], found["success"]) == (2.0, last, success)
    assert found["return"] == pytest.approx(float(torch.stack(rewards).sum(0).mean()), rel=1e-5)
    single.reset()
    assert env.episode_step.tolist() == [0, 0]
    assert torch.equal(env.sim.qpos, single.sim.qpos)


@pytest.mark.parametrize("action", few(["joint_delta", "ee_upright"], 2))
def test_a_policy_drives_as_it_was_trained(action: str) -> None:
    """With its own action terms, observed last action and rate: the same joint targets and states
    as in the environment of its training, bit for bit.
    """
    cfg = configure("task=reach", f"action={action}", f"timing.policy_decimation={HELD}")
    policy = make_policy(cfg, chunk=1, execute=HELD)
    trained = on_new_sim("native", 3, cfg)
    obs, _ = trained.reset(seed=2)
    driven = on_new_sim("native", 3, driven_config(cfg, action=policy.action))
    driven.reset(seed=2)
    driver = PolicyDriver(driven, policy)
    network = policy.network.double()
    for _ in range(4):
        answer = network(obs["policy"].double())[:, 0]
        answer = (torch.round(answer * 2.0**20) / 2.0**20).float()
        for _ in range(HELD):
            driven.action_manager.process(driver.command())
            driven.advance()
        obs, *_ = trained.step(answer)
        assert torch.equal(trained.sim.ctrl, driven.sim.ctrl)
        assert torch.equal(trained.sim.qpos, driven.sim.qpos)
    assert (trained.sim.ctrl - trained.sim.ctrl[:1]).abs().max() > 1e-4  # worlds differ


def test_runners_spread_the_ends_over_decisions() -> None:
    """A decision begins in a control step that is a multiple of its length, in any world."""
    env = RslRlVecEnv(on_shared_sim("native", 3, held()))
    env.episode_length_buf = torch.tensor([0, 7, 14])
    assert env.env.episode_step.tolist() == [0, 5, 10]
    env.step(torch.zeros(3, env.num_actions))
    assert env.episode_length_buf.tolist() == [5, 10, 15]


def test_drivers_decide_in_every_control_step() -> None:
    env = on_shared_sim("native", 2, held("action=joint_absolute"))
    env.reset(seed=0)
    with pytest.raises(ArgumentError, match="actions for 5 control steps, expected one for each"):
        make_expert(env)


def near_the_table(robot: str) -> list[str]:
    """Random starts at which the gripper can point down: high up the reBot's wrist cannot."""
    low = "robot.start=[0.0,-1.435,-2.022,1.6,0.0,0.0,0.04,0.04]"
    return ["reset=randomized", *([low] if robot == "rebot" else [])]
