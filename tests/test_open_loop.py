"""The scripted plan against kinematics of its own, on the whole scene."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import mujoco
import numpy as np
import pytest

from mjstack.drivers.open_loop import JointTrajectory
from mjstack.episodes.context import RunContext
from mjstack.errors import Unreachable
from mjstack.scene.phases import nominal_xy

Stage = Callable[[str], RunContext]

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


def nominal(context: RunContext) -> np.ndarray:
    return nominal_xy(context.cfg.scene)


def layouts(context: RunContext) -> np.ndarray:
    shifts = np.random.default_rng(3).uniform(-0.004, 0.004, (3, 2, 2))
    shifts[0] = 0.0
    return nominal(context) + shifts


def target(robot: str, phase: str, xy: np.ndarray) -> np.ndarray:
    anchor, heights, offset, _ = PHASES[phase]
    place = xy[0] if anchor == "red" else xy[1]
    return np.array([*place, TOP[robot] + 0.022 + heights * APPROACH[robot] + offset])


def grasp_point(context: RunContext, command: np.ndarray) -> np.ndarray:
    """Forward kinematics on the scene's model: the midpoint of the two grasp_point sites."""
    data = mujoco.MjData(context.model)
    joints = [*context.cfg.robot.arm_joints, *context.cfg.robot.gripper_joints]
    for name, value in zip(joints, command, strict=True):
        data.joint(name).qpos[0] = value
    mujoco.mj_kinematics(context.model, data)
    return np.mean([data.site(name).xpos for name in context.cfg.robot.grasp_sites], axis=0)


@pytest.fixture(scope="module")
def tapes(stage: Stage) -> Callable[[str], JointTrajectory]:
    made: dict[str, JointTrajectory] = {}

    def get(robot: str) -> JointTrajectory:
        if robot not in made:
            made[robot] = stage(robot).planner.plan(layouts(stage(robot)))
        return made[robot]

    return get


def test_phases_cover_the_episode(robot: str, stage: Stage) -> None:
    phases = stage(robot).planner.phases
    assert [p.name for p in phases] == list(PHASES)
    assert phases[0].start == 0
    assert all(a.stop == b.start for a, b in pairwise(phases))
    assert phases[-1].stop == 600
    assert [p.stop - p.start for p in phases] == [60, 70, 80, 70, 80, 70, 50, 50, 70]


def test_phase_ends_reach_their_targets(
    robot: str, stage: Stage, tapes: Callable[[str], JointTrajectory]
) -> None:
    context = stage(robot)
    tape = tapes(robot)
    for phase in context.planner.phases:
        commands = tape.command(phase.stop - 1).numpy()
        for command, xy in zip(commands, layouts(context), strict=True):
            miss = np.linalg.norm(grasp_point(context, command) - target(robot, phase.name, xy))
            assert miss <= 0.0005, phase.name


def test_every_step_stays_on_its_straight_path(
    robot: str, stage: Stage, tapes: Callable[[str], JointTrajectory]
) -> None:
    """Between waypoints too, the commands follow the smoothstep line from one target to
    the next.
    """
    context = stage(robot)
    tape = tapes(robot)
    xy = layouts(context)[1]
    before = target(robot, "above_red", xy)
    for phase in context.planner.phases:
        after = target(robot, phase.name, xy)
        for step in range(phase.start, phase.stop, 3):
            u = (step + 1 - phase.start) / (phase.stop - phase.start)
            wanted = before + u * u * (3 - 2 * u) * (after - before)
            miss = np.linalg.norm(grasp_point(context, tape.command(step)[1].numpy()) - wanted)
            assert miss <= 0.002, (phase.name, step)
        before = after


def test_reported_waypoint_error_is_within_tolerance(
    robot: str, stage: Stage, tapes: Callable[[str], JointTrajectory]
) -> None:
    assert tapes(robot).waypoint_error.shape == (3,)
    assert (tapes(robot).waypoint_error <= stage(robot).cfg.controller.ik_tolerance).all()
    assert (tapes(robot).waypoint_error > 0).all()


def test_commands_are_within_limits(
    robot: str, stage: Stage, tapes: Callable[[str], JointTrajectory]
) -> None:
    context = stage(robot)
    tape = tapes(robot)
    model = context.model
    robot_cfg = context.cfg.robot
    names = [*robot_cfg.arm_joints, *robot_cfg.gripper_joints]
    commands = np.stack([tape.command(step).numpy() for step in range(tape.steps)])
    assert commands.shape == (600, 3, len(names))
    for column, name in enumerate(names):
        low = commands[..., column].min()
        high = commands[..., column].max()
        ranges = [model.joint(name).range]
        if model.actuator(name).ctrllimited[0]:
            ranges.append(model.actuator(name).ctrlrange)
        for least, most in ranges:
            assert least - 1e-9 <= low <= high <= most + 1e-9, name


def test_arm_moves_without_jumps(robot: str, tapes: Callable[[str], JointTrajectory]) -> None:
    """After the first phase, which starts at its target, no joint command jumps between steps."""
    commands = np.stack([tapes(robot).command(step).numpy() for step in range(600)])
    assert np.abs(np.diff(commands, axis=0)).max() < 0.08


def test_locked_joints_stay(
    robot: str, stage: Stage, tapes: Callable[[str], JointTrajectory]
) -> None:
    robot_cfg = stage(robot).cfg.robot
    tape = tapes(robot)
    assert robot_cfg.locked
    for name, value in robot_cfg.locked.items():
        column = robot_cfg.arm_joints.index(name)
        for step in range(600):
            np.testing.assert_allclose(tape.command(step)[:, column], value, atol=1e-6)


def test_gripper_ramps(robot: str, stage: Stage, tapes: Callable[[str], JointTrajectory]) -> None:
    context = stage(robot)
    tape = tapes(robot)
    cfg = context.cfg.robot
    grips = {"open": np.array(cfg.gripper_open), "closed": np.array(cfg.gripper_closed)}
    before = np.array(cfg.home[len(cfg.arm_joints) :])
    for phase in context.planner.phases:
        after = grips[PHASES[phase.name][3]]
        for step in range(phase.start, phase.stop):
            u = (step + 1 - phase.start) / (phase.stop - phase.start)
            wanted = before + u * u * (3 - 2 * u) * (after - before)
            got = tape.command(step)[:, len(cfg.arm_joints) :].numpy()
            np.testing.assert_allclose(got, np.tile(wanted, (3, 1)), atol=1e-6)
        before = after


def test_unreachable_target_names_world_phase_and_distance(robot: str, stage: Stage) -> None:
    context = stage(robot)
    xy = np.stack([nominal(context)] * 2)
    xy[1, 0] = [1.5, 0.0]
    with pytest.raises(Unreachable, match="world 1, phase above_red") as caught:
        context.planner.plan(xy)
    assert caught.value.world == 1
    assert caught.value.phase == "above_red"
    assert 0.3 < caught.value.distance < 1.5
    assert "Move red closer, or change controller.phases.above_red." in str(caught.value)
    assert "\n" not in str(caught.value)


def test_plan_does_not_depend_on_the_other_worlds(robot: str, stage: Stage) -> None:
    context = stage(robot)
    a, b, _ = layouts(context)
    alone = context.planner.plan(b[None])
    among = context.planner.plan(np.stack([a, b, b]))
    for step in range(0, 600, 7):
        assert (among.command(step)[1] == alone.command(step)[0]).all()
        assert (among.command(step)[2] == alone.command(step)[0]).all()
    assert not (among.command(300)[0] == alone.command(300)[0]).all()
