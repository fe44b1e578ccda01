"""Policies that cheat at the stack task break a named rule when judged without phases; the plain
checker agrees. Every accepted episode of the expert passes.

Some cheats are driven, by joint targets of the expert that are changed a little. Others, which
would take long to drive, are written into a recorded episode.
"""

from collections.abc import Callable
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from check_cases import BLUE, RED, rules_of
from environments import REBOT_LATER, GetStage, MakeSim
from recordings import Recorder, World, feed

from mjstack.drivers.driver import Driver
from mjstack.episodes import recorder
from mjstack.episodes.rollout import play_episode

RULES = rules_of("stack")
NWORLD = 4


class Targets(Driver):
    """Gives joint targets, shape ``(steps, nworld, nu)``."""

    def __init__(self, targets: torch.Tensor) -> None:
        super().__init__(targets.shape[1], len(targets), targets.device)
        self._rest = iter(targets)

    def command(self) -> torch.Tensor:
        return next(self._rest)


@pytest.fixture(scope="module")
def drive(get_stage: GetStage, make_sim: MakeSim) -> Callable[..., list[set[str]]]:
    """Drives jittered native worlds without phases by the expert's joint targets, changed; the
    broken rules of each world, on which the plain checker agrees.
    """

    @cache
    def expert(robot: str) -> torch.Tensor:
        stage = get_stage(robot)
        commands = recorder.Recorder(recorder.Channels(recorder.read_commands))
        stage.play(make_sim("native", NWORLD, robot=robot), stage.cfg.reset, [commands])
        return commands.rows["ctrl"].clone()

    def play(
        robot: str, change: Callable[[torch.Tensor, dict[str, slice]], None]
    ) -> list[set[str]]:
        stage = get_stage(robot)
        targets = expert(robot).clone()
        change(targets, {p.name: slice(p.start, p.stop) for p in stage.planner.phases})
        env = stage.start(make_sim("native", NWORLD, robot=robot), stage.cfg.reset)
        recorder = Recorder()
        episode = play_episode(env, Targets(targets), [recorder])
        rec = recorder.recording(stage, episode)
        broken = [set(RULES.broken(int(bits))) for bits in episode.failed]
        for k in (0, NWORLD - 1):
            assert World.of(rec, k).outcome_without_phases.failed == broken[k]
        return broken

    return play


def stay_low(targets: torch.Tensor, spans: dict[str, slice]) -> None:
    """Let go, and leave the open gripper around the cube."""
    targets[spans["retreat"].start :] = targets[spans["release"].stop - 1]


@REBOT_LATER
def test_the_expert_passes_without_phases(robot: str, drive: Callable[..., list[set[str]]]) -> None:
    assert drive(robot, lambda targets, spans: None) == [set()] * NWORLD


@REBOT_LATER
def test_holding_is_no_stack(robot: str, drive: Callable[..., list[set[str]]]) -> None:
    """It never lets go; in the last two worlds it does so when the settled window has begun."""

    def hold(targets: torch.Tensor, spans: dict[str, slice]) -> None:
        let_go = targets[spans["release"], 2:].clone()
        targets[spans["release"].start :] = targets[spans["place_stack"].stop - 1]
        late = len(targets) - 50 - len(let_go) // 2
        targets[late : late + len(let_go), 2:] = let_go
        targets[late + len(let_go) :, 2:] = let_go[-1]

    broken = drive(robot, hold)
    assert broken[:2] == [{"RELEASED"}] * 2
    assert all("RELEASED" in rules for rules in broken)


@pytest.mark.full
def test_leaning_on_the_stack_is_no_release(drive: Callable[..., list[set[str]]]) -> None:
    """World 0 keeps the open gripper away from the cube. In the others it turns towards the cube,
    by more from world to world.
    """
    turns = torch.tensor([0.0, 0.02, 0.05, 0.08])

    def lean(targets: torch.Tensor, spans: dict[str, slice]) -> None:
        stay_low(targets, spans)
        ramp = torch.linspace(0.0, 1.0, 40)[:, None]
        targets[spans["retreat"].stop - 40 : spans["retreat"].stop, :, 0] += ramp * turns
        targets[spans["retreat"].stop :, :, 0] += turns

    broken = drive("so101", lean)
    assert broken[0] == set()
    assert {"RELEASED"} in broken


@pytest.mark.full
def test_knocking_it_over_at_the_end_is_no_stack(drive: Callable[..., list[set[str]]]) -> None:
    """The open gripper swings into the stack in the last steps, a step later in each world."""

    def knock(targets: torch.Tensor, spans: dict[str, slice]) -> None:
        stay_low(targets, spans)
        for world in range(NWORLD):
            targets[len(targets) - 12 + 2 * world :, world, 0] += 0.6

    broken = drive("so101", knock)
    assert all("RELEASED" in rules for rules in broken)
    assert "STACKED" in broken[0]


# Written into a recorded episode


@pytest.fixture
def recording(recorded: Callable[[str], SimpleNamespace]) -> World:
    return World.of(recorded("so101"))


def judge(world: World) -> set[str]:
    """The broken rules, on which the plain checker agrees."""
    broken = set(RULES.broken(int(feed([world], phased=False).failed[0])))
    assert world.outcome_without_phases.failed == broken
    return broken


def fly(world: World, first: int, steps: int = 25) -> None:
    """From a step on red is in free flight, out of the jaws, onto blue, where it comes to rest."""
    land = world.poses[-1, RED].copy()
    at = np.linspace(0.0, 1.0, steps)[:, None]
    start = world.poses[first, RED, :3].copy()
    path = start + at * (land[:3] - start)
    path[:, 2:] += 4.0 * 0.08 * at * (1.0 - at)
    world.poses[first : first + steps, RED, :3] = path
    world.poses[first + steps :, RED] = land
    for jaw in (0, 1):
        world.jaw(RED, jaw)[first:] = 0.0


def test_a_throw_is_no_carry(recording: World) -> None:
    """Held up for long enough, then thrown onto blue."""
    fly(recording, recording.steps("above_blue")[0])
    assert judge(recording) == {"CARRY"}


def test_a_throw_from_the_table_is_no_lift(recording: World) -> None:
    """Flung up when it has been in the air for nine steps, which is one too few."""
    top = recording.stage.cfg.scene.table_top
    up = np.flatnonzero(recording.poses[:, RED, 2] - 0.022 - top > recording.t.airborne_height)
    fly(recording, int(up[0]) + recording.t.lift_steps - 1)
    assert judge(recording) == {"LIFT", "CARRY"}


@pytest.mark.parametrize("both", [False, True])
def test_a_cube_pushed_up_the_others_side_is_not_carried(recording: World, both: bool) -> None:
    """Along the table to blue, and up its side, with one jaw, or with either in turn."""
    flight = slice(recording.steps("lift_red")[0], recording.steps("place_stack")[-1] + 1)
    n = flight.stop - flight.start
    place = recording.poses[-1, RED].copy()
    side = recording.poses[-1, BLUE, :3] - np.array([0.0, 0.045, 0.0])
    above = [*side[:2], place[2]]
    corners = np.array([recording.poses[0, RED, :3], side, above, place[:3]])
    at = np.linspace(0.0, 3.0, n)
    path = [np.interp(at, range(4), corners[:, axis]) for axis in range(3)]
    recording.poses[flight, RED, :3] = np.stack(path, axis=1)
    recording.poses[flight, RED, 3:] = recording.poses[0, RED, 3:]
    recording.poses[flight.stop :, RED] = place
    steps = np.arange(flight.start, flight.stop)
    for jaw in (0, 1):
        recording.jaw(RED, jaw)[flight.stop :] = 0.0
        pushes = steps % 2 == jaw if both else jaw == 0
        recording.jaw(RED, jaw)[flight] = np.where(np.broadcast_to(pushes, n)[:, None], 1.0, 0.0)
    assert judge(recording) == {"LIFT", "CARRY"}


def test_a_grip_that_slips_every_ninth_step_is_no_lift(recording: World) -> None:
    for jaw in (0, 1):
        recording.jaw(RED, jaw)[::9] = 0.0
    assert judge(recording) == {"LIFT", "CARRY"}
    assert not feed([recording]).failed.any()  # with phases the jaws do not count


@pytest.mark.full
def test_a_lift_in_the_settled_window_comes_too_late(recording: World) -> None:
    """The same flight, shifted so that all of it but the last step before the window is in it."""
    first = np.flatnonzero((recording.jaw(RED, 0) != 0.0).any(1))[0]
    late = len(recording.poses) - recording.t.window - 9
    for values in (recording.poses, recording.sensordata):
        shifted = np.roll(values, late - first, axis=0)
        shifted[:late] = values[0]
        values[:] = shifted
    assert judge(recording) >= {"LIFT", "CARRY"}
