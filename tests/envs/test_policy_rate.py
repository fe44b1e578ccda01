"""A policy below the control rate: in training an environment holds its actions, and when it drives
worlds it repeats them. Both do the same.
"""

import pytest
import torch
from environments import (
    REBOT_LATER,
    Patch,
    actions,
    configure,
    few,
    on_new_sim,
    on_shared_sim,
    state_of,
)
from policies import make_policy

from mjstack.adapters.rsl_rl import RslRlVecEnv
from mjstack.config.schema import Config
from mjstack.drivers.closed_loop import make_expert
from mjstack.drivers.policy import PolicyDriver
from mjstack.envs import driven_config
from mjstack.errors import ArgumentError, MjstackError

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


@REBOT_LATER
def test_the_upright_gripper_rolls_and_points_down(robot: str) -> None:
    """The grasp point goes where it is sent, and the roll joint turns by itself."""
    cfg = configure("action=ee_upright", *near_the_table(robot), robot=robot)
    env = on_shared_sim("native", 2, cfg)
    env.reset(seed=0)
    term = env.action_manager.terms["arm"]
    assert env.action_manager.action_dim == 5
    column = env.cfg.robot.joints.index(env.cfg.robot.roll_joint)
    before = env.sim.ctrl.clone()
    point, _, tilt = (each.clone() for each in term._ik.forward(before))
    up = 1.0 if robot == "so101" else -1.0  # the reBot's wrist turns down farther below
    action = torch.tensor([[0.0, 0.0, up, 1.0, 1.0], [0.5, 0.5, up, -1.0, 1.0]])
    for _ in range(10):
        env.step(action)
    turned = (env.sim.ctrl - before)[:, column]
    torch.testing.assert_close(turned, torch.tensor([0.3, -0.3]).double(), rtol=0.0, atol=1e-5)
    after, _, upright = term._ik.forward(env.sim.ctrl)
    moved = torch.tensor([[0.0, 0.0, 0.05 * up], [0.025, 0.025, 0.05 * up]])
    torch.testing.assert_close(after - point, moved, rtol=0.0, atol=3e-3)
    assert (upright[:, 2] <= tilt[:, 2] + 1e-3).all()
    assert (upright[:, 2] < -0.9).all()


@REBOT_LATER
def test_the_gripper_tilts_as_far_as_it_is_told(robot: str) -> None:
    """Away from the base, by a step at most, while the grasp point stays."""
    cfg = configure("action=ee_tilt", *near_the_table(robot), robot=robot)
    env = on_shared_sim("native", 3, cfg)
    env.reset(seed=0)
    term = env.action_manager.terms["arm"]
    assert env.action_manager.action_dim == 6
    before, _, _ = (each.clone() for each in term._ik.forward(env.sim.ctrl))
    action = torch.zeros((3, 6))
    action[:, 5] = 1.0  # where a jaw swings it moves the grasp point
    wanted = torch.tensor([0.4, 0.6, 0.8] if robot == "so101" else [0.6, 0.7, 0.8])
    action[:, 4] = wanted / 0.4 - 1.0
    tilts = []
    for _ in range(45):
        env.step(action)
        point, _, approach = term._ik.forward(env.sim.ctrl)
        away = point[:, :2] / point[:, :2].norm(dim=1, keepdim=True)
        tilts.append(torch.atan2((approach[:, :2] * away).sum(1), -approach[:, 2]))
    torch.testing.assert_close(tilts[-1], wanted, rtol=0.0, atol=0.03)
    assert torch.stack(tilts).diff(dim=0).abs().max() < 0.04
    torch.testing.assert_close(point[:, :2], before[:, :2], rtol=0.0, atol=2e-3)


def test_a_roll_needs_a_free_joint() -> None:
    says = r"roll=0\.03: expected 0, because robot\.roll_joint=None is not free"
    cfg = configure("action=ee_upright", "robot.roll_joint=null", "controller.yaw_alignment=0")
    with pytest.raises(MjstackError, match=says):
        on_shared_sim("native", 1, cfg)


def test_a_gripper_with_a_step_stays_as_it_is_until_it_is_told() -> None:
    """So a world that starts with an object in the hand keeps it."""
    env = on_shared_sim("native", 3, configure("action=ee_tilt", "reset=randomized"))
    env.reset(seed=0)
    travel = env.cfg.robot.gripper_open[0] - env.cfg.robot.gripper_closed[0]
    opened = []
    for told in (-1.0, 1.0):
        action = torch.zeros((3, 6))
        action[:, 5] = torch.tensor([0.0, 0.5, 1.0]) * told
        for _ in range(30):
            env.step(action)
            opened.append((env.sim.ctrl[:, -1] - env.cfg.robot.gripper_closed[0]) / travel)
    wanted = {0: [1.0, 0.98, 0.96], 29: [1.0, 0.4, 0.0], 30: [1.0, 0.42, 0.04], 59: [1.0, 1.0, 1.0]}
    for step, values in wanted.items():
        torch.testing.assert_close(opened[step].tolist(), values, rtol=0.0, atol=1e-6)


def test_a_late_command_moves_the_arm_as_the_same_command_later() -> None:
    """And after the reset of one world, which holds its start again, to the bit."""
    late = 3
    plain = ("action=joint_absolute", "reset=randomized")
    cfg = configure(*plain, f"timing.command_delay={late}")
    delayed = on_new_sim("native", 2, cfg)
    direct = on_new_sim("native", 2, configure(*plain))
    for env in (delayed, direct):
        env.reset(seed=5)
    start = direct.sim.ctrl.clone()
    waiting = [start.clone() for _ in range(late)]
    generator = torch.Generator().manual_seed(0)
    for step in range(12):
        action = start + 0.1 * torch.rand(start.shape, generator=generator)
        if step == 7:
            mask = torch.tensor([True, False])
            for env in (delayed, direct):
                env.reset(mask=mask)
            for command in waiting:
                command[0] = direct.sim.ctrl[0]
        delayed.step(action)
        assert torch.equal(delayed.sim.ctrl, action.to(start.dtype))  # terms see what was given
        waiting.append(action.to(start.dtype))
        direct.step(waiting.pop(0))
        assert torch.equal(delayed.sim.qpos, direct.sim.qpos), step
    assert not torch.equal(delayed.sim.ctrl, direct.sim.ctrl)


def test_each_world_has_a_delay_of_its_own_the_same_on_both_backends() -> None:
    """A world moves as one whose delay is the same in every world, to the bit, and draws a new one
    for its next episode.
    """
    plain = ("action=joint_absolute", "reset=randomized", "timing.command_delay=1")
    drawn: list[list[int]] = []
    for backend in ("native", "mjwarp"):
        env = on_new_sim(backend, 16, configure(*plain, "timing.random_delay=3"))
        env.reset(seed=5)
        late = env.command_delay.steps.clone()
        assert set(late.tolist()) == {1, 2, 3, 4}
        generator = torch.Generator().manual_seed(0)
        moves = 0.1 * torch.rand((8, *env.sim.ctrl.shape), generator=generator)
        start = env.sim.ctrl.clone()
        ends = []
        for move in moves:
            env.step(start.float() + move)
            ends.append(env.sim.qpos.clone())
        env.reset(mask=late == 2)
        drawn += [late.tolist(), env.command_delay.steps.tolist()]
        assert torch.equal(env.command_delay.steps[late != 2], late[late != 2])
        if backend == "native":
            for steps in range(1, 5):
                same = on_new_sim("native", 16, configure(*plain, f"timing.command_delay={steps}"))
                same.reset(seed=5)
                for move, end in zip(moves, ends, strict=True):
                    same.step(start.float() + move)
                    assert torch.equal(same.sim.qpos[late == steps], end[late == steps])
    assert drawn[:2] == drawn[2:]
    assert drawn[0] != drawn[1]
