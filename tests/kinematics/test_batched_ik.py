"""Batched inverse kinematics against native MuJoCo's forward kinematics, and against mink."""

import gc
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from compositions import load_config
from environments import CUDA, GetStage
from ik_arm import Arm, results, tensors

from mjstack.episodes.stage import Stage
from mjstack.kinematics.mink_ik import GraspIk
from mjstack.robots import robot_spec
from mjstack.sim.warp_setup import torch_stream_scope

MINK = 300  # targets that mink solves, one after the other
TOLERANCE = 0.0005  # m, as the driver's
TABLE = "on and above the table"


def above_table(stage: Stage, arm: Arm, n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random commands, and where they bring the grasp point: up to 25 cm above the table."""
    center = np.array(stage.cfg.scene.table_center)
    half = np.array(stage.cfg.scene.table_half)
    commands: list[np.ndarray] = []
    points: list[np.ndarray] = []
    while sum(map(len, points)) < n:
        tried = arm.anywhere(4000, seed)
        at = arm.grasp_point(tried)
        height = at[:, 2] - center[2] - half[2]
        inside = (np.abs(at - center)[:, :2] <= half[:2]).all(1) & (height > 0.0) & (height < 0.25)
        commands.append(tried[inside])
        points.append(at[inside])
        seed += 1
    return np.concatenate(commands)[:n], np.concatenate(points)[:n]


@pytest.fixture(scope="module")
def get_arm(get_stage: GetStage) -> Callable[[str], Arm]:
    return lambda robot: Arm(get_stage(robot).model, get_stage(robot).cfg.robot)


@pytest.fixture
def arm(robot: str, get_arm: Callable[[str], Arm]) -> Arm:
    return get_arm(robot)


@pytest.fixture(scope="module")
def workspace(
    get_stage: GetStage, get_arm: Callable[[str], Arm]
) -> Callable[[str], tuple[np.ndarray, np.ndarray]]:
    return cache(lambda robot: above_table(get_stage(robot), get_arm(robot), 1000))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_forward_kinematics_are_native_mujocos(arm: Arm, device: str, dtype: torch.dtype) -> None:
    commands = np.random.default_rng(1).uniform(arm.low, arm.high, (200, len(arm.names)))
    commands[100:, len(arm.robot.arm_joints) :] = arm.robot.gripper_open  # else it may be shut
    ik = arm.solver(200, device)
    found = ik.forward(torch.as_tensor(commands, dtype=dtype, device=device))
    assert {(part.shape, part.dtype) for part in found} == {((200, 3), torch.float32)}
    point, *directions = (part.cpu().numpy() for part in found)
    assert np.abs(point - arm.grasp_point(commands)).max() <= 1e-6
    for axis, expected in zip(directions, arm.directions(commands[100:]), strict=True):
        np.testing.assert_allclose(axis[100:], expected, atol=2e-6)


def test_targets_in_the_workspace_are_reached(
    robot: str, arm: Arm, device: str, workspace: Callable
) -> None:
    """All of them from home in 40 iterations, and almost all in eight."""
    _, targets = workspace(robot)
    start = arm.at_home(len(targets))
    command, distance = results(arm.solver(len(targets), device, iterations=40), start, targets)
    miss = np.linalg.norm(arm.grasp_point(command) - targets, axis=1)
    assert (miss <= 0.00001).all()
    np.testing.assert_allclose(distance, miss, atol=1e-6)
    _, distance = results(arm.solver(len(targets), device), start, targets)
    assert (distance <= TOLERANCE).mean() >= 0.99


class Compared(NamedTuple):
    """What mink makes of some targets, from home and drawn there.

    Attributes:
        targets: Where the grasp point goes [m], shape ``(MINK, 3)``.
        commands: Where mink ended, gripper open, shape ``(MINK, nu)``.
        reached: Whether within the tolerance.
    """

    targets: np.ndarray
    commands: np.ndarray
    reached: np.ndarray


@pytest.fixture(scope="module")
def by_mink(
    get_stage: GetStage, get_arm: Callable[[str], Arm], workspace: Callable
) -> Callable[[str], dict[str, Compared]]:
    """On and above the table, and wherever the arm reaches above the table's height; each target is
    solved once.
    """

    @cache
    def get(robot: str) -> dict[str, Compared]:
        stage = get_stage(robot)
        arm = get_arm(robot)
        top = stage.cfg.scene.table_center[2] + stage.cfg.scene.table_half[2]
        anywhere = arm.grasp_point(arm.anywhere(3000, 25))
        anywhere = anywhere[anywhere[:, 2] > top][:MINK]
        assert len(anywhere) == MINK
        mink = GraspIk(arm.robot, stage.cfg.model, tolerance=TOLERANCE)
        start = np.array([*arm.home[: len(arm.robot.arm_joints)], *arm.robot.gripper_open])
        made = {}
        for where, targets in ((TABLE, workspace(robot)[1][:MINK]), ("anywhere", anywhere)):
            solutions = [mink.solve(target, start) for target in targets]
            commands, distance = (np.array(part) for part in zip(*solutions, strict=True))
            made[where] = Compared(targets, commands, distance <= TOLERANCE)
        return made

    return get


def shipped(stage: Stage) -> dict[str, float]:
    """The gains with which ``controller=closed_loop`` runs."""
    c = stage.cfg.controller
    return {"posture_gain": c.posture_gain, "approach_gain": c.approach_gain}


@pytest.mark.full
@pytest.mark.parametrize("gains", ["shipped", "drawn home"])
def test_reaches_what_mink_reaches(
    robot: str, gains: str, get_stage: GetStage, arm: Arm, by_mink: Callable
) -> None:
    """From home, in 40 iterations: with the gains that the robot is shipped with, and drawn home as
    mink is, where most solutions are the same one.

    In front of the base nothing that mink reaches is missed. Behind it, where the way from home
    ends at the joints' limits, either one ends short at times where the other arrives; with the
    base turned as mink turned it, nothing is missed at all.
    """
    own = shipped(get_stage(robot)) if gains == "shipped" else {"posture_gain": 0.3}
    ik = arm.solver(MINK, iterations=40, **own)
    for mink in by_mink(robot).values():
        front = mink.targets[:, 0] > 0.0
        command, distance = results(ik, arm.at_home(MINK), mink.targets)
        reached = distance <= TOLERANCE
        missed = mink.reached & ~reached
        assert mink.reached.mean() > 0.8
        assert not (missed & front).any()
        assert missed.mean() <= 0.01
        to_limit = np.minimum(command - arm.low, arm.high - command)[:, arm.moved].min(1)
        assert (to_limit[missed] < 0.001).all()
        assert reached.sum() > mink.reached.sum()
        assert (distance[reached & front] <= 0.0001).mean() >= 0.998
        turned = arm.at_home(MINK)
        turned[:, 0] = mink.commands[:, 0]
        assert (results(ik, turned, mink.targets)[1][mink.reached] <= TOLERANCE).all()
        miss = np.linalg.norm(arm.grasp_point(command) - mink.targets, axis=1)
        np.testing.assert_allclose(miss, distance, atol=1e-6)
        if gains == "drawn home":
            both = mink.reached & reached
            apart = np.abs(command - mink.commands)[both].max(1)
            away, mink_away = (
                np.linalg.norm(c - arm.home, axis=1)[both] for c in (command, mink.commands)
            )
            assert np.median(apart) < 0.005
            assert (apart < 0.1).mean() > 0.9  # the others bend another way to the same point
            assert away.mean() <= mink_away.mean() + 0.001


GAINS = [(0.3, 0.0), (0.0, 0.3), (0.1, 0.3)]


@pytest.mark.parametrize(("posture_gain", "approach_gain"), GAINS)
def test_gains_do_not_spoil_the_position(
    robot: str,
    arm: Arm,
    device: str,
    workspace: Callable,
    posture_gain: float,
    approach_gain: float,
) -> None:
    """Neither from afar nor on the way: a target that moves 5 mm a step, from postures far from the
    one that is wanted.
    """
    start, targets = workspace(robot)
    gains = {"posture_gain": posture_gain, "approach_gain": approach_gain}
    ik = arm.solver(1000, device, iterations=40, **gains)
    _, distance = results(ik, arm.at_home(1000), targets)
    assert (distance <= 0.0001).all()
    free = arm.free(start, 0.3)
    assert free.sum() > 100
    ik = arm.solver(1000, device, iterations=8, **gains)
    command = start
    worst = np.zeros(1000)
    for k in range(6):
        towards_home = targets + 0.005 * k * np.array([-1.0, 0.0, 0.0])
        command, distance = results(ik, command, towards_home)
        worst = np.maximum(worst, distance)
    assert (worst[free] <= 0.0001).mean() >= 0.98


@pytest.mark.full
def test_a_posture_is_approached_as_far_as_the_target_allows(
    robot: str, arm: Arm, device: str, workspace: Callable
) -> None:
    """At the end nothing of the way to it is left that would not move the centre: checked with
    native MuJoCo's Jacobian.
    """
    start, targets = workspace(robot)
    posture = arm.home.copy()
    posture[arm.moved] += 0.3
    ik = arm.solver(1000, device, iterations=100, posture_gain=0.3)
    given, goal, wanted = tensors(device, start, targets, np.tile(posture, (1000, 1)))
    command = ik.solve(given, goal, wanted)[0].cpu().numpy().astype(float)
    plain, _ = results(arm.solver(1000, device, iterations=100), start, targets)
    left = (posture - command)[:, arm.moved]
    plain_left = np.linalg.norm((posture - plain)[:, arm.moved], axis=1)
    assert (np.linalg.norm(left, axis=1) <= plain_left + 0.01).mean() > 0.98
    # Near a stretched arm the damping lets the posture count along what would move the centre,
    # which settling then undoes.
    free = np.flatnonzero(arm.free(command))[:300]
    free = np.array([w for w in free if np.linalg.svd(arm.jacobian(command[w]))[1][-1] > 0.1])
    assert len(free) > 150
    open_ = [np.abs(arm.spare(command[w]) @ left[w]).max() for w in free]
    before = [np.abs(arm.spare(start[w]) @ (posture - start[w])[arm.moved]).max() for w in free]
    assert np.quantile(open_, 0.95) < 0.002
    assert np.median(before) > 0.2


@pytest.mark.full
def test_the_approach_axis_turns_down_as_far_as_the_target_allows(
    robot: str, arm: Arm, device: str, workspace: Callable
) -> None:
    """At the end no motion that leaves the centre turns it further down, by differences of native
    MuJoCo's kinematics.
    """
    start, targets = workspace(robot)
    command, _ = results(
        arm.solver(1000, device, iterations=200, approach_gain=0.3), start, targets
    )
    plain, _ = results(arm.solver(1000, device, iterations=40), start, targets)
    down, plain_down = (-arm.directions(c)[1][:, 2] for c in (command, plain))
    assert (down >= plain_down - 1e-3).mean() > 0.97
    assert down.mean() > plain_down.mean() + 0.2
    free = np.flatnonzero(arm.free(command))[:100]
    assert len(free) > 30
    slopes = []
    for w in free:
        steps = np.zeros((2 * len(arm.moved), len(arm.names)))
        steps[::2, arm.moved] = 1e-4 * np.eye(len(arm.moved))
        steps[1::2, arm.moved] = -1e-4 * np.eye(len(arm.moved))
        z = -arm.directions(command[w] + steps)[1][:, 2]
        slopes.append(np.abs(arm.spare(command[w]) @ ((z[::2] - z[1::2]) / 2e-4)).max())
    assert np.quantile(slopes, 0.9) < 0.01


@pytest.mark.full
def test_the_approach_axis_turns_where_it_is_wished(
    robot: str, arm: Arm, device: str, workspace: Callable
) -> None:
    """Each world to a direction of its own, which a posture nearby is known to have at the same
    target.
    """
    start, _ = workspace(robot)
    start = start[arm.free(start, 0.5)][:300]
    goal = start.copy()
    for world in range(len(start)):
        spare = arm.spare(start[world])
        way = spare[np.argmax(np.linalg.norm(spare, axis=1))]
        goal[world, arm.moved] += 0.3 * way / np.linalg.norm(way)
    target = arm.grasp_point(goal)
    wished = arm.directions(goal)[1]
    (direction,) = tensors(device, wished)
    ik = arm.solver(len(start), device, iterations=200, approach_gain=0.3)
    command, distance = (
        a.cpu().double().numpy()
        for a in ik.solve(*tensors(device, start, target), approach=direction)
    )
    before, after = (
        np.degrees(np.arccos(np.clip((arm.directions(c)[1] * wished).sum(1), -1, 1)))
        for c in (start, command)
    )
    assert len(start) > 50
    assert np.median(before) > 3.0
    assert (after < 1.0).mean() > 0.95
    assert (distance <= 0.0001).all()
    down = (
        ik.solve(*tensors(device, start, target))[0].cpu().double().numpy()
    )  # not where it was wished before
    assert np.mean(arm.directions(down)[1][:, 2]) < np.mean(wished[:, 2]) - 0.1


@pytest.mark.full
def test_a_start_at_its_target_still_goes_to_the_posture(
    robot: str, arm: Arm, device: str, workspace: Callable
) -> None:
    """Though no later iterate is nearer to the target than the first one."""
    start, _ = workspace(robot)
    start = start[arm.free(start, 0.2)]
    n = len(start)
    at = arm.grasp_point(start)
    command, distance = results(arm.solver(n, device, iterations=40, posture_gain=0.3), start, at)
    before, after = (np.linalg.norm((c - arm.home)[:, arm.moved], axis=1) for c in (start, command))
    assert (distance <= 0.0001).all()
    assert np.median(before - after) > 0.2
    assert (after <= before + 0.01).all()


def test_postures_of_each_world(arm: Arm, device: str) -> None:
    start = arm.anywhere(16, 30)
    target = arm.grasp_point(arm.anywhere(16, 31))
    ik = arm.solver(16, device, iterations=20, posture_gain=0.3)
    given, goal, home, other = tensors(device, start, target, arm.at_home(16), arm.anywhere(16, 32))
    by_default = ik.solve(given, goal)[0].clone()
    assert torch.equal(ik.solve(given, goal, home)[0], by_default)
    each = ik.solve(given, goal, other)[0].clone()
    assert not torch.allclose(each, by_default, atol=1e-3)
    first = ik.solve(given, goal, other[:1].repeat(16, 1))[0].clone()
    assert torch.equal(each[0], first[0])
    assert not torch.allclose(each[1:], first[1:], atol=1e-3)
    assert torch.equal(ik.solve(given, goal)[0], by_default)  # home again


@pytest.mark.parametrize("goal_name", ["posture", "approach"])
def test_a_goal_that_is_not_finite_stays_in_its_world(
    arm: Arm, device: str, goal_name: str
) -> None:
    start = arm.at_home(4)
    target = arm.grasp_point(arm.anywhere(4, 33))
    ik = arm.solver(4, device, **{f"{goal_name}_gain": 0.3})
    rows = arm.at_home(4) if goal_name == "posture" else np.tile([0.0, 0.0, -1.0], (4, 1))
    given, goal, values = tensors(device, start, target, rows)
    clean = ik.solve(given, goal, **{goal_name: values})[0].clone()
    values[2, arm.moved[0] if goal_name == "posture" else 1] = torch.nan
    command, distance = ik.solve(given, goal, **{goal_name: values})
    assert torch.isnan(distance).tolist() == [False, False, True, False]
    np.testing.assert_allclose(command[2].cpu().numpy(), start[2], atol=1e-6)
    assert torch.equal(command[[0, 1, 3]], clean[[0, 1, 3]])


@pytest.mark.full
def test_the_approach_axis_leads_from_the_wrist_to_the_grasp_point(robot: str) -> None:
    """It is the axis about which the last arm joint rolls, away from the wrist, and across the way
    the jaws close.
    """
    cfg = load_config([f"robot={robot}"])
    arm = Arm(robot_spec(cfg.robot, cfg.model).compile(), cfg.robot)
    data = mujoco.MjData(arm.model)
    for name, value in zip(
        arm.names, [*arm.home[: len(cfg.robot.arm_joints)], *cfg.robot.gripper_closed], strict=True
    ):
        data.joint(name).qpos[0] = value
    mujoco.mj_kinematics(arm.model, data)
    roll = data.joint(cfg.robot.arm_joints[-1])
    first, second = (data.site(name).xpos for name in cfg.robot.grasp_sites)
    approach = data.body(cfg.robot.approach_body).xmat.reshape(3, 3) @ cfg.robot.approach_axis
    assert abs(approach @ roll.xaxis) == pytest.approx(1.0, abs=1e-6)
    assert approach @ (0.5 * (first + second) - roll.xanchor) > 0.09
    assert abs(approach @ (second - first)) / np.linalg.norm(second - first) < 0.02


def test_small_steps_arrive(robot: str, arm: Arm, device: str, workspace: Callable) -> None:
    """Reachable targets some 5 mm away, made by moving the joints a little in a random
    direction.
    """
    start, here = workspace(robot)
    nudge = np.zeros_like(start)
    nudge[:, arm.moved] = np.random.default_rng(2).normal(size=(len(start), len(arm.moved)))
    slope = np.linalg.norm(arm.grasp_point(start + 1e-4 * nudge) - here, axis=1) / 1e-4
    goal = start + nudge * (0.005 / slope)[:, None]
    target = arm.grasp_point(goal)
    near = np.abs(np.linalg.norm(target - here, axis=1) - 0.005) < 0.0005
    usable = near & ((goal >= arm.low) & (goal <= arm.high)).all(1)
    assert usable.sum() > 800
    command, distance = results(arm.solver(len(start), device, iterations=8), start, target)
    moved = command[:, arm.moved]
    free = ((moved > arm.low[arm.moved] + 1e-3) & (moved < arm.high[arm.moved] - 1e-3)).all(1)
    assert (usable & free).sum() > 700
    assert (distance[usable & free] <= 0.0001).all()
    assert np.abs(command - start)[usable].max() < 0.5


@pytest.mark.full
def test_limits_hold_and_the_other_joints_stay(arm: Arm, device: str) -> None:
    """Even from commands beyond the limits, and towards targets that pull against them."""
    rng = np.random.default_rng(4)
    start = (
        rng.uniform(arm.low - 0.5, arm.high + 0.5, (500, len(arm.names)))
        .astype(np.float32)
        .astype(float)
    )
    command, distance = results(arm.solver(500, device), start, rng.uniform(-0.6, 0.6, (500, 3)))
    low = arm.low.copy()
    high = arm.high.copy()
    for i, name in enumerate(arm.names):
        low[i], high[i] = np.clip(arm.model.actuator(name).ctrlrange, low[i], high[i])
    moved = arm.moved
    assert ((command >= low) & (command <= high))[:, moved].all()
    assert ((command == low.astype(np.float32)) | (command == high.astype(np.float32)))[
        :, moved
    ].any()
    others = [i for i in range(len(arm.names)) if i not in moved]
    np.testing.assert_array_equal(command[:, others], start[:, others])
    assert np.isfinite(distance).all()


def test_small_steps_arrive_from_limits(robot: str, arm: Arm) -> None:
    """Joints that cannot follow leave the work to the others; solving for all and cutting the step
    would stall.
    """
    start = arm.at_limits(2000, 23)
    goal = start.copy()
    goal[:, arm.moved] += np.random.default_rng(24).normal(scale=0.02, size=(2000, len(arm.moved)))
    goal = np.clip(goal, arm.low, arm.high)
    target = arm.grasp_point(goal)
    near = np.linalg.norm(target - arm.grasp_point(start), axis=1) < 0.01
    assert near.sum() > 500
    _, distance = results(arm.solver(2000), start, target)
    assert (distance[near] <= 0.0001).mean() >= 0.99


@pytest.mark.parametrize("iterations", [1, 8, 40])
def test_never_farther_than_the_start(arm: Arm, device: str, iterations: int) -> None:
    """The cases are those where a single step can overshoot: near a limit, and far away."""
    rng = np.random.default_rng(6)
    start = arm.at_limits(2000, 5)
    at = arm.grasp_point(start)
    target = np.where(
        np.arange(2000)[:, None] < 1500,
        at + rng.normal(scale=0.003, size=(2000, 3)),
        rng.uniform(-0.8, 0.8, (2000, 3)),
    )
    command, distance = results(arm.solver(2000, device, iterations=iterations), start, target)
    before, after = (np.linalg.norm(a - target, axis=1) for a in (at, arm.grasp_point(command)))
    assert (after <= before + 1e-6).all()
    assert (after < before - 1e-4).mean() > 0.5
    np.testing.assert_allclose(distance, after, atol=1e-6)


def test_unreachable_target_shows_in_the_distance(arm: Arm, device: str) -> None:
    target = np.array([[1.5, 0.0, 0.2], [0.0, 0.0, 3.0], [1e6, -1e6, 0.0], [1e30, 0.0, 0.0]])
    command, distance = results(arm.solver(4, device, iterations=40), arm.at_home(4), target)
    assert np.isfinite(command).all()
    assert not np.isnan(distance).any()
    assert (distance > 0.5).all()
    assert distance[0] < 1.2


def test_a_start_at_its_target_stays(arm: Arm, device: str) -> None:
    ik = arm.solver(50, device)
    start = np.clip(arm.anywhere(50, 7), arm.low + 1e-3, arm.high - 1e-3)
    command, distance = results(ik, start, ik.forward(*tensors(device, start))[0].cpu().numpy())
    np.testing.assert_allclose(command, start, atol=1e-5)
    assert (distance <= 1e-6).all()


def test_not_finite_input_stays_in_its_world(arm: Arm, device: str) -> None:
    start = arm.at_home(8)
    target = arm.grasp_point(arm.anywhere(8, 8))
    ik = arm.solver(8, device)
    clean_command, clean_distance = results(ik, start, target)
    start[1, arm.moved[0]] = np.nan
    start[2, -1] = np.nan
    start[4, 1] = np.inf
    target[5, 0] = np.nan
    target[6, 2] = -np.inf
    bad = [1, 2, 4, 5, 6]
    good = [0, 3, 7]
    command, distance = results(ik, start, target)
    assert np.isnan(distance[bad]).all()
    np.testing.assert_array_equal(command[good], clean_command[good])
    np.testing.assert_array_equal(distance[good], clean_distance[good])
    assert np.isnan(command[1, arm.moved[0]])
    np.testing.assert_allclose(command[[5, 6]], start[[5, 6]], atol=1e-6)
    start = arm.at_home(8)
    target = arm.grasp_point(arm.anywhere(8, 8))
    np.testing.assert_array_equal(results(ik, start, target)[0], clean_command)


@pytest.mark.full
def test_world_k_of_n_is_world_k_of_one(robot: str, arm: Arm, workspace: Callable) -> None:
    start = arm.anywhere(64, 9)
    target = workspace(robot)[1][:64]
    command, distance = results(arm.solver(64), start, target)
    alone = arm.solver(1)
    for k in range(64):
        one, left = results(alone, start[k : k + 1], target[k : k + 1])
        np.testing.assert_array_equal(one[0], command[k])
        assert left[0] == distance[k]


def test_outputs_are_rewritten_in_place(arm: Arm, device: str) -> None:
    """Whatever the last call left, of outputs or of working memory, does not show in the next. An
    output can be an input.
    """
    start = arm.anywhere(20, 10)
    target = arm.grasp_point(arm.anywhere(20, 11))
    ik = arm.solver(20, device)
    given, goal = tensors(device, start, target)
    outputs = [ik.forward(given)[0], *ik.solve(given, goal)]
    before = [output.clone() for output in outputs]
    for output in outputs:
        output.fill_(torch.nan)
    again = [ik.forward(given)[0], *ik.solve(given, goal)]
    for output, new, expected in zip(outputs, again, before, strict=True):
        assert new.data_ptr() == output.data_ptr()
        assert torch.equal(new, expected)
    second, _ = results(ik, before[1].cpu().numpy(), target)
    ik.solve(given, goal)
    assert (ik.solve(outputs[1], goal)[0].cpu().numpy() == second).all()


def test_float32_and_float64_agree(arm: Arm) -> None:
    start = arm.anywhere(20, 14).astype(np.float32)
    target = arm.grasp_point(arm.anywhere(20, 15)).astype(np.float32)
    ik = arm.solver(20)
    single = results(ik, start, target)
    double = results(ik, start.astype(float), target.astype(float))
    for a, b in zip(single, double, strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_robot_alone_is_the_robot_in_its_scene(
    robot: str, get_stage: GetStage, arm: Arm
) -> None:
    alone = Arm(
        robot_spec(get_stage(robot).cfg.robot, get_stage(robot).cfg.model).compile(), arm.robot
    )
    start = arm.anywhere(20, 16)
    target = arm.grasp_point(arm.anywhere(20, 17))
    for a, b in zip(
        results(alone.solver(20), start, target),
        results(arm.solver(20), start, target),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("cuda", [pytest.param("cuda:0", marks=CUDA)])
@pytest.mark.parametrize("gain", [0.0, 0.1])
def test_a_cuda_graph_holds_it(arm: Arm, cuda: str, gain: float) -> None:
    """Replays follow their inputs, among torch's own operations, as eager calls do."""
    ik = arm.solver(256, cuda, posture_gain=gain, approach_gain=gain)
    posture = tensors(cuda, arm.at_home(256))[0] if gain else None
    command, goal = tensors(cuda, arm.at_home(256), arm.grasp_point(arm.anywhere(256, 20)))
    out = torch.zeros_like(ik.solve(command, goal)[0])
    stream = torch.cuda.Stream()
    graph = torch.cuda.CUDAGraph()

    def follow_goal() -> None:
        here = ik.forward(command)[0]
        new, _ = ik.solve(
            command, here + 0.5 * (goal - here) + 0.0 * sum(ik.forward(command)[1:]), posture
        )
        out.copy_(new)
        command.copy_(new)

    start = command.clone()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        follow_goal()
    torch.cuda.synchronize()
    gc.disable()
    try:
        with torch.cuda.graph(graph, stream=stream):
            scope = torch_stream_scope(wp.get_device(cuda))
            with scope, wp.ScopedCapture(stream=wp.get_stream(cuda), external=True):
                follow_goal()
    finally:
        gc.enable()
    for seed in (21, 22):
        goal.copy_(tensors(cuda, arm.grasp_point(arm.anywhere(256, seed)))[0])
        command.copy_(start)
        for _ in range(3):
            graph.replay()
        replayed = out.clone()
        command.copy_(start)
        for _ in range(3):
            follow_goal()
        torch.cuda.synchronize()
        assert torch.isfinite(replayed).all()
        assert torch.equal(out, replayed)
