"""Actions: every group, the gripper and tilt, delays, and actions that are refused."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from env_cases import fails, native, split, without_ends
from environments import (
    REBOT_LATER,
    actions,
    assert_same_run,
    configure,
    on_new_sim,
    on_shared_sim,
    returned,
    zeros,
)
from ik_arm import Arm

from mjstack.config.schema import Config
from mjstack.envs import Env
from mjstack.errors import ArgumentError, FaultError, MjstackError, TermError


def assert_layout(env: Env, row: dict[str, torch.Tensor]) -> None:
    """Shapes, types and finiteness of what step or reset returned."""
    for name, value in row.items():
        assert value.device == env.device
        assert torch.isfinite(value).all(), name
        if name.startswith(("obs.", "final.")):
            group = name.partition(".")[2]
            assert value.shape == (env.nworld, env.observation_manager.group_dims[group])
            assert value.dtype is torch.float32
            assert all(part.shape[1] for part in split(env, group, value).values())
        else:
            assert value.shape == (env.nworld,)
            assert value.dtype is (torch.float32 if name == "reward" else torch.bool)


@pytest.mark.full
@pytest.mark.parametrize("action", ["joint_relative", "joint_absolute", "joint_delta", "ee_delta"])
def test_every_action_group_steps(backend: str, robot: str, action: str) -> None:
    cfg = without_ends(configure("task=stack", f"action={action}", "reset=jitter", robot=robot))
    env = on_shared_sim(backend, 3, cfg)
    n = len(env.cfg.robot.home)
    n_arm = len(env.cfg.robot.arm_joints)
    scale = cfg.action["arm"].params.get("scale")
    manager = env.action_manager
    assert manager.action_dim == {"joint_absolute": n, "ee_delta": 4}.get(action, n_arm + 1)
    assert manager.low.shape == manager.high.shape == (manager.action_dim,)
    assert (manager.low < manager.high).all()
    assert_layout(env, returned(env.reset(seed=0)))
    ctrl = torch.as_tensor(env.index.ctrl).to(env.device)
    limits = torch.as_tensor(env.index.ctrl_range).to(env.sim.ctrl)
    home = torch.as_tensor(env.cfg.robot.home).to(env.sim.ctrl)
    start = torch.as_tensor(env.cfg.robot.start).to(env.sim.ctrl)
    before = env.sim.ctrl[:, ctrl].clone()
    torch.testing.assert_close(before, home.expand(3, -1))
    rest = zeros(env)
    if action == "joint_absolute":
        rest[:] = home
    env.step(rest)  # the arm's commands stay where they are
    # Relative commands count from the start.
    held = start.expand(3, -1) if action == "joint_relative" else before
    torch.testing.assert_close(env.sim.ctrl[:, ctrl[:n_arm]], held[:, :n_arm], rtol=0, atol=1e-4)
    before = env.sim.ctrl[:, ctrl].clone()
    for move in actions(env, 6):
        assert_layout(env, returned(env.step(move)))
        assert_same_run(env.action, move.to(env.action.dtype), backend)
        command = env.sim.ctrl[:, ctrl]
        assert ((command >= limits[:, 0]) & (command <= limits[:, 1])).all()
        moved = (command - before)[:, :n_arm].abs()
        assert (moved.amax(1) > 1e-4).all()
        if action == "joint_delta":
            assert (moved <= scale + 1e-6).all()
        if action == "joint_relative":
            expected = start[:n_arm] + scale * move[:, :n_arm]
            expected = expected.clamp(limits[:n_arm, 0], limits[:n_arm, 1])
            torch.testing.assert_close(command[:, :n_arm], expected.to(command))
        if action == "joint_absolute":
            torch.testing.assert_close(command, move.to(command))
        else:  # the gripper's fraction of its way from closed to open
            closed = torch.tensor(env.cfg.robot.gripper_closed).to(command)
            opened = torch.tensor(env.cfg.robot.gripper_open).to(command)
            fingers = closed + 0.5 * (move[:, -1:] + 1.0) * (opened - closed)
            torch.testing.assert_close(command[:, n_arm:], fingers.to(command))
        before = command.clone()
    if action != "joint_absolute":  # more than one is one
        commands = []
        for size in (1.0, 3.0):
            env.reset(seed=0)
            env.step(size * torch.ones_like(rest))
            commands.append(env.sim.ctrl.clone())
        assert_same_run(*commands, backend)


@pytest.mark.full
def test_end_effector_delta_moves_the_commanded_grasp_point(backend: str, robot: str) -> None:
    """The command's forward kinematics, by native MuJoCo, moves by 1 cm along each axis in turn."""
    cfg = configure("task=stack", "action=ee_delta", "reset=jitter", robot=robot)
    env = on_shared_sim(backend, 3, cfg)
    env.reset(seed=0)
    arm = Arm(env.sim.model, env.cfg.robot)

    def commanded() -> np.ndarray:
        return arm.grasp_point(env.sim.ctrl[:, env.index.ctrl.tolist()].double().cpu().numpy())

    move = torch.zeros((3, 4), device=env.device)
    move[:, :3] = 0.8 * torch.eye(3, device=env.device)
    move[:, 2] -= 0.2
    # The commands are IK targets with the gripper where it was last: the gripper's own command
    # comes after the arm's.
    env.step(torch.cat((torch.zeros_like(move[:, :3]), torch.ones_like(move[:, 3:])), dim=1))
    move[:, 3] = 1.0
    for _ in range(3):
        before = commanded()
        env.step(move)
        expected = 0.01 * move[:, :3].cpu().numpy()
        np.testing.assert_allclose(commanded() - before, expected, atol=5e-4)


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (lambda env: zeros(env)[:2], ["shape (2, 6)", "(3, 6)"]),
        (lambda env: zeros(env).int(), ["a torch.int32 tensor", "a float32 or float64 tensor"]),
        (lambda env: zeros(env, device="meta"), ["on meta", "cpu"]),
        (lambda env: zeros(env).numpy(), ["ndarray", "a float32 or float64 tensor"]),
    ],
)
def test_action_of_the_wrong_kind(
    env: Env, action: Callable[[Env], object], words: list[str]
) -> None:
    fails(ArgumentError, lambda: env.step(action(env)), "action: found", "expected", *words)  # type: ignore[arg-type]


def test_an_action_of_float64_is_taken_as_its_float32(env: Env) -> None:
    """Both are what the message about other types expects."""
    seen = []
    for dtype in (torch.float32, torch.float64):
        env.reset(seed=3)
        action = torch.full((3, 6), 0.25).to(dtype)  # exact in both
        seen.append(env.step(action)[0]["policy"])
    assert torch.equal(*seen)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_action_that_is_not_finite_names_its_world(env: Env, bad: float) -> None:
    action = zeros(env)
    action[1, 4] = bad
    fails(ArgumentError, lambda: env.step(action), "action: found", "in world 1", "finite")


@pytest.mark.full
def test_action_that_the_simulation_cannot_hold_names_its_world(cfg: Config) -> None:
    env = on_shared_sim("mjwarp", 3, cfg)  # float32
    env.reset(seed=0)
    action = zeros(env).double()
    action[1, 4] = 1e300
    fails(ArgumentError, lambda: env.step(action), "1e+300", "in world 1", "finite")


@pytest.mark.parametrize("huge", [1e20, 1e38])
def test_a_reward_that_a_huge_action_breaks_names_the_action(env: Env, huge: float) -> None:
    env.step(zeros(env))
    clean = env.sim.qpos.clone()
    env.reset(seed=0)
    action = zeros(env)
    action[1, 4] = huge
    words = [
        "reward is not finite in 1 of 3 worlds (1)",
        f"after an action of {huge:.3g}",
        "policy",
    ]
    fails(FaultError, lambda: env.step(action), *words)
    assert torch.equal(env.sim.qpos[[0, 2]], clean[[0, 2]])


def build(cfg: Config) -> Env:
    return on_shared_sim("native", 3, cfg)


def refused(cfg: Config, *words: str, kind: type[MjstackError] = TermError) -> str:
    """No environment can be built."""
    return fails(kind, lambda: build(cfg), *words)


def test_action_that_is_no_action_term(cfg: Config) -> None:
    cfg.action["arm"].func = "mjstack.mdp.reward.lift"
    refused(cfg, "action.arm", "mjstack.mdp.reward.lift", "ActionTerm")


@pytest.mark.full
def test_an_action_with_a_gradient_leaves_none_behind() -> None:
    env = native()
    env.reset(seed=0)
    weight = torch.full_like(zeros(env), 0.1, requires_grad=True)
    env.step(2.0 * weight)
    _, reward, *_ = env.step(zeros(env))
    for tensor in (reward, env.action, env.sim.ctrl, env.sim.qpos):
        assert not tensor.requires_grad


@pytest.mark.full
def test_action_zero_holds_the_start() -> None:
    env = native(
        "task=stack", "action=joint_relative", "reset=randomized", "~reset.joints", "~reset.gains"
    )
    env.reset(seed=0)
    begin = env.sim.qpos[:, :5].clone()
    for _ in range(50):
        env.step(torch.cat((torch.zeros((2, 5)), torch.ones((2, 1))), dim=1))
    assert (env.sim.qpos[:, :5] - begin).abs().max() < 0.03


@pytest.mark.full
def test_two_actions_on_one_actuator_are_refused() -> None:
    words = r"action\.gripper: drives actuator 5, which action\.arm drives too"
    with pytest.raises(TermError, match=words):
        native("action.arm.params.joints=all")


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
