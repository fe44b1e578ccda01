"""The scripted plan against kinematics of its own, on the whole scene."""

import threading
from collections.abc import Callable
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from environments import GetStage, Patch
from ik_arm import Arm

from mjstack.drivers import open_loop
from mjstack.drivers.open_loop import JointTrajectory
from mjstack.episodes.stage import Stage
from mjstack.errors import Unreachable
from mjstack.scene.phases import nominal_xy
from mjstack.sim.warp_setup import wp

# Anchor, approach heights, offset [m] and gripper of each phase, from the task's definition.
PHASES = {
    "above_red": ("red", 1, 0.0, "open"),
    "descend_red": ("red", 0, 0.0, "open"),
    "grasp_red": ("red", 0, 0.0, "closed"),
    "lift_red": ("red", 1, 0.05, "closed"),
    "above_blue": ("blue", 1, 0.07, "closed"),
    "place_stack": ("blue", 0, 0.044 + 0.004, "closed"),
    "release": ("blue", 0, 0.044 + 0.004, "open"),
    "retreat": ("blue", 1, 0.09, "open"),
    "done": ("blue", 1, 0.09, "open"),
}
APPROACH = {"so101": 0.09, "rebot": 0.12}
TOP = {"so101": 0.024, "rebot": 0.212}


def nominal(stage: Stage) -> np.ndarray:
    return nominal_xy(stage.cfg.scene)


def layouts(stage: Stage) -> np.ndarray:
    shifts = np.random.default_rng(3).uniform(-0.004, 0.004, (3, 2, 2))
    shifts[0] = 0.0
    return nominal(stage) + shifts


def target(stage: Stage, phase: str, xy: np.ndarray) -> np.ndarray:
    robot = stage.cfg.robot.name
    anchor, heights, offset, _ = PHASES[phase]
    place = xy[0] if anchor == "red" else xy[1]
    return np.array([*place, TOP[robot] + 0.022 + heights * APPROACH[robot] + offset])


def grasp_point(stage: Stage, command: np.ndarray) -> np.ndarray:
    """Forward kinematics on the scene's model."""
    return Arm(stage.model, stage.cfg.robot).grasp_point(command[None])[0]


@pytest.fixture(autouse=True)
def several_threads(monkeypatch: Patch) -> None:
    """As on a large machine with thousands of worlds."""
    monkeypatch.setattr(open_loop, "available_cores", lambda: 8)
    monkeypatch.setattr(open_loop, "_WORLDS", 4)


@pytest.fixture
def stage(robot: str, get_stage: GetStage) -> Stage:
    return get_stage(robot)


@pytest.fixture(scope="module")
def planned(get_stage: GetStage) -> Callable[[str], JointTrajectory]:
    return cache(lambda robot: get_stage(robot).planner.plan(layouts(get_stage(robot))))


@pytest.fixture
def trajectory(robot: str, planned: Callable[[str], JointTrajectory]) -> JointTrajectory:
    return planned(robot)


def test_phases_cover_the_episode(stage: Stage) -> None:
    phases = stage.planner.phases
    assert [p.name for p in phases] == list(PHASES)
    assert phases[0].start == 0
    assert all(a.stop == b.start for a, b in pairwise(phases))
    assert phases[-1].stop == 600
    assert [p.stop - p.start for p in phases] == [60, 70, 80, 70, 80, 70, 50, 50, 70]


def test_phase_ends_reach_their_targets(stage: Stage, trajectory: JointTrajectory) -> None:
    for phase in stage.planner.phases:
        commands = trajectory.command(phase.stop - 1).numpy()
        for command, xy in zip(commands, layouts(stage), strict=True):
            miss = np.linalg.norm(grasp_point(stage, command) - target(stage, phase.name, xy))
            assert miss <= 0.0005, phase.name


def test_every_step_stays_on_its_straight_path(stage: Stage, trajectory: JointTrajectory) -> None:
    """Between waypoints too, the commands follow the smoothstep line from one target to
    the next.
    """
    xy = layouts(stage)[1]
    before = target(stage, "above_red", xy)
    for phase in stage.planner.phases:
        after = target(stage, phase.name, xy)
        for step in range(phase.start, phase.stop, 3):
            u = (step + 1 - phase.start) / (phase.stop - phase.start)
            wanted = before + u * u * (3 - 2 * u) * (after - before)
            miss = np.linalg.norm(grasp_point(stage, trajectory.command(step)[1].numpy()) - wanted)
            assert miss <= 0.002, (phase.name, step)
        before = after


def test_reported_ik_error_is_within_tolerance(stage: Stage, trajectory: JointTrajectory) -> None:
    assert trajectory.ik_error.shape == (3,)
    assert (trajectory.ik_error <= stage.cfg.controller.ik_tolerance).all()
    assert (trajectory.ik_error > 0).all()


def test_commands_are_within_limits_and_do_not_jump(
    stage: Stage, trajectory: JointTrajectory
) -> None:
    """Locked joints stay where they are locked. Only the first phase starts at its target."""
    model = stage.model
    robot = stage.cfg.robot
    names = [*robot.arm_joints, *robot.gripper_joints]
    commands = np.stack(
        [trajectory.command(step).numpy() for step in range(len(trajectory.weights))]
    )
    assert commands.shape == (600, 3, len(names))
    assert np.abs(np.diff(commands, axis=0)).max() < 0.08
    for column, name in enumerate(names):
        low = commands[..., column].min()
        high = commands[..., column].max()
        ranges = [model.joint(name).range]
        if model.actuator(name).ctrllimited[0]:
            ranges.append(model.actuator(name).ctrlrange)
        for least, most in ranges:
            assert least - 1e-9 <= low <= high <= most + 1e-9, name
        assert low >= robot.locked.get(name, low) - 1e-6, name
        assert high <= robot.locked.get(name, high) + 1e-6, name
    assert robot.locked


def test_gripper_ramps(stage: Stage, trajectory: JointTrajectory) -> None:
    cfg = stage.cfg.robot
    grips = {"open": np.array(cfg.gripper_open), "closed": np.array(cfg.gripper_closed)}
    before = np.array(cfg.home[len(cfg.arm_joints) :])
    for phase in stage.planner.phases:
        after = grips[PHASES[phase.name][3]]
        for step in range(phase.start, phase.stop):
            u = (step + 1 - phase.start) / (phase.stop - phase.start)
            wanted = before + u * u * (3 - 2 * u) * (after - before)
            got = trajectory.command(step)[:, len(cfg.arm_joints) :].numpy()
            np.testing.assert_allclose(got, np.tile(wanted, (3, 1)), atol=1e-6)
        before = after


def test_unreachable_target_names_world_phase_and_distance(stage: Stage) -> None:
    xy = np.stack([nominal(stage)] * 2)
    xy[1, 0] = [1.5, 0.0]
    with pytest.raises(Unreachable, match="world 1, phase above_red") as caught:
        stage.planner.plan(xy)
    assert caught.value.world == 1
    assert caught.value.phase == "above_red"
    assert 0.3 < caught.value.distance < 1.5
    assert "Move red closer, or change controller.phases.above_red." in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_first_unreachable_world_is_named(stage: Stage) -> None:
    """Not the one that fails first in the episode; by its number, where there are some."""
    xy = np.stack([nominal(stage)] * 6)
    xy[3, 1] = xy[[4, 5], 0] = [1.5, 0.0]
    for names, expected in ((None, 3), ([0, 2, 4, 6, 8, 10], 6)):
        with pytest.raises(Unreachable) as caught:
            stage.planner.plan(xy, names=names)
        assert (caught.value.world, caught.value.phase) == (expected, "above_blue")


def test_a_world_that_is_nowhere_is_unreachable(stage: Stage) -> None:
    xy = np.stack([nominal(stage)] * 2)
    xy[1, 0, 0] = np.nan
    with pytest.raises(Unreachable, match="world 1, phase above_red"):
        stage.planner.plan(xy)


def test_plan_does_not_depend_on_the_other_worlds(stage: Stage) -> None:
    """To the last bit, wherever a world stands in the batch, the nominal one included."""
    xy = nominal(stage) + np.random.default_rng(7).uniform(-0.02, 0.02, (40, 2, 2))
    xy[[3, 17]] = nominal(stage)
    xy[20, 0] = nominal(stage)[0]  # its first phases are the nominal ones
    xy[23] = xy[8]
    planner = stage.planner
    among = planner.plan(xy)
    order = np.random.default_rng(8).permutation(40)
    assert among.knots[order].numpy().tobytes() == planner.plan(xy[order]).knots.numpy().tobytes()
    for world in (0, 3, 8, 20, 23, 39):
        alone = planner.plan(xy[[world]])
        assert alone.knots.numpy().tobytes() == among.knots[[world]].numpy().tobytes()
        assert alone.ik_error[0] == among.ik_error[world]
        for step in range(0, 600, 37):
            assert (alone.command(step)[0] == among.command(step)[world]).all()
    assert planner.plan(xy) is among  # the last two batches are planned once
    planner.plan(xy[:2])
    assert planner.plan(xy) is not among
    assert len(np.unique(among.knots.numpy().round(4), axis=0)) == 38


def test_planning_threads_leave_the_cuda_device_alone(stage: Stage, monkeypatch: Patch) -> None:
    """Warp keeps one CUDA context for all scopes of its CPU device: a thread's scope would put the
    thread's in place of the caller's. So threads enter none, here as if the GPUs were counted.
    """
    entered = []

    class Counted(wp.ScopedDevice):
        def __enter__(self) -> wp.Device:
            entered.append(threading.current_thread())
            return super().__enter__()

    monkeypatch.setattr(wp, "ScopedDevice", Counted)
    stage.planner.plan(nominal(stage) + np.random.default_rng(9).uniform(-0.02, 0.02, (40, 2, 2)))
    assert threading.main_thread() in entered
    assert {*entered} == {threading.main_thread()}


def test_plans_are_those_that_mink_makes(stage: Stage) -> None:
    """mink, from the nominal plan too, comes to the same joints, on one branch of solutions."""
    xy = nominal(stage) + np.random.default_rng(9).uniform(-0.02, 0.02, (4, 2, 2))
    planner = stage.planner
    (seed,) = planner.plan(nominal(stage)[None]).knots.numpy()
    arm = Arm(stage.model, stage.cfg.robot)
    n_arm = len(stage.cfg.robot.arm_joints)
    for knots in planner.plan(xy).knots.numpy():
        points = arm.grasp_point(knots)
        solved = [
            planner.ik.solve(point, np.array([*start[:n_arm], *knot[n_arm:]]))
            for point, knot, start in zip(points, knots, seed, strict=True)
        ]
        commands, distances = (np.array(part) for part in zip(*solved, strict=True))
        assert distances.max() <= planner.ik.tolerance
        assert np.abs(knots - commands).max() <= 0.04
        assert np.abs(knots - commands).mean() <= 0.002
