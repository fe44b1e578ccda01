"""The batched check on the device against the plain checker, world by world."""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from check_cases import BLUE, RED, Altered, Cases, rules_of
from compositions import load_config
from recordings import World, feed

from mjstack.tasks.check import make_check

RULES = rules_of("stack")
CASES = Cases(RULES, rel=1e-4)
HAIR = 2e-6  # [m], [m/s], [rad]: a good deal more than float32 rounds at these sizes


@pytest.mark.full
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_recorded_episodes(
    robot: str, recorded: Callable[[str], SimpleNamespace], dtype: torch.dtype
) -> None:
    rec = recorded(robot)
    worlds = [World.of(rec, k) for k in range(len(rec.qpos))]
    result = feed(worlds, dtype)
    for k, world in enumerate(worlds):
        expected = world.outcome
        assert expected.failed == set()
        CASES.assert_same(result, k, expected)
        CASES.assert_same(rec.result, k, expected)


# Alterations of a recording whose last steps have been made ideal.


THERE_AND_BACK = np.sin(np.linspace(0.0, 2.0 * np.pi, 50))[:, None]
TILTED = [math.cos(0.2), math.sin(0.2), 0.0, 0.0]
SPIN = 0.0502 / (math.sqrt(3.0) * 0.022)
VALUES: dict[str, tuple[str, str, Any, Any]] = {
    "not_stacked_just_before_the_window": ("", "poses", np.s_[-51, RED, 0], lambda x: x + 0.05),
    "blue_sunk_into_the_table": (
        *("SUPPORTED STACKED", "poses", np.s_[-50:, BLUE, 2], lambda z: z - 0.012),
    ),
    "blue_tilted_off_its_support": ("SUPPORTED", "poses", np.s_[-50:, BLUE, 3:], TILTED),
    "slow_drift": (
        *("REST_POSITION", "poses", np.s_[-50:, :, 1]),
        lambda y: y + np.linspace(0.0, 0.0052, 50)[:, None],
    ),
    "drift_there_and_back": (
        *("REST_POSITION", "poses", np.s_[-50:, :, 1], lambda y: y + 0.0026 * THERE_AND_BACK),
    ),
    "quaternion_of_either_sign": ("", "poses", np.s_[::2, :, 3:], np.negative),
    "jitter_in_place": (
        *("REST_SPEED", "velocities", np.s_[-50:, RED, 0], 0.06 * (-1.0) ** np.arange(50)),
    ),
    "spin_in_place": ("REST_SPEED", "velocities", np.s_[-50:, BLUE, 5], SPIN),
    "one_fast_step": ("", "velocities", np.s_[-20, RED, 0], 0.3),
    "not_a_number_in_one_step": ("FINITE", "velocities", np.s_[100, RED, 3], math.nan),
    "infinite_velocity_at_the_end": (
        *("FINITE REST_SPEED", "velocities", np.s_[-1, BLUE, 0], math.inf),
    ),
    "arm_not_a_number": ("FINITE", "qpos", np.s_[7, 0], math.nan),
}


CASES.add_values(VALUES)


@CASES.case("STACKED")
def red_teleported_after_release(w: World) -> None:
    w.poses[w.steps("retreat")[0] :, RED, 0] += 0.06


@CASES.case("STACKED")
def fallen_off_in_the_last_step_only(w: World) -> None:
    w.poses[-1, RED, :2] = w.poses[-1, BLUE, :2] + [0.0153, 0.0]
    w.poses[-2, RED, :2] = w.poses[-2, BLUE, :2] + [0.0147, 0.0]
    w.poses[w.window, RED, 0] = np.where(
        np.arange(50) == 49, w.poses[-1, RED, 0], w.poses[-2, RED, 0]
    )


@CASES.case("STACKED")
def stacked_late_by_one_step(w: World) -> None:
    first = len(w.poses) - w.t.window
    w.poses[w.window, RED, 0] += 0.0149
    w.poses[first, RED, 0] += 0.0002


def _edge(w: World, axis: int, side: float, by: float) -> None:
    scene = w.stage.cfg.scene
    reach = scene.table_half[axis] - scene.objects["red"].half_height + by
    w.poses[w.window, :, axis] = scene.table_center[axis] + side * reach


CASES.add("both_off_the_table_edge", {"SUPPORTED"}, lambda w: _edge(w, 1, 1.0, HAIR))
CASES.add("both_at_the_table_edge", set(), lambda w: _edge(w, 1, 1.0, -HAIR))
CASES.add("both_off_the_far_edge", {"SUPPORTED"}, lambda w: _edge(w, 0, -1.0, HAIR))


def _turn(w: World, cube: int, degrees: np.ndarray) -> None:
    half = 0.5 * np.radians(degrees)
    w.poses[w.window, cube, 3:] = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], 1)


@CASES.case("REST_ROTATION")
def slow_turn_of_blue(w: World) -> None:
    _turn(w, BLUE, np.linspace(0.0, 3.1, 50))


@CASES.case("REST_ROTATION")
def turn_between_the_middle_and_the_ends(w: World) -> None:
    _turn(w, RED, 1.6 * np.sin(np.linspace(0.0, 2.0 * np.pi, 50)))


# Red down on the table: the rules that break, in which phases, and how often in them.
GROUNDED = {
    "never_lifted": ("LIFT CARRY", "lift_red above_blue", 1),
    "airborne_runs_of_nine_steps": ("LIFT CARRY", "lift_red above_blue", 10),
    "dragged_in_above_blue": ("CARRY", "above_blue", 1),
    "carried_in_hops_of_nine_steps": ("CARRY", "above_blue", 10),
}


def _ground(w: World, names: str, every: int) -> None:
    w.poses[w.steps(*names.split())[::every], RED, 2] = w.poses[0, RED, 2]


for name, (rules, *args) in GROUNDED.items():
    CASES.add(name, {*rules.split()}, lambda w, args=args: _ground(w, *args))


@CASES.case("CARRY")
def moved_between_two_flights_only(w: World) -> None:
    part = w.steps("above_blue")
    middle = len(part) // 2
    w.poses[part[:middle], RED, :2] = w.poses[0, RED, :2]
    w.poses[part[middle], RED, 2] = w.poses[0, RED, 2]
    w.poses[part[middle:], RED, :2] = w.poses[-1, RED, :2]


@CASES.case("FINITE", "LIFT", "CARRY", "STACKED", "REST_SPEED", "REST_POSITION", "REST_ROTATION")
def red_not_a_number_from_the_grasp(w: World) -> None:
    w.poses[w.steps("grasp_red")[0] :, RED] = math.nan
    w.velocities[w.steps("grasp_red")[0] :, RED] = math.nan


@CASES.case("RELEASED")
def touched_by_a_jaw_in_the_windows_first_step(w: World) -> None:
    w.jaw(RED, 1)[-w.t.window] = [0.0, 2e-5, 0.0]


@CASES.case()
def touched_by_a_jaw_just_before_the_window(w: World) -> None:
    w.jaw(RED, 1)[-w.t.window - 1] = 1.0


@CASES.case()
def touched_by_less_than_the_threshold(w: World) -> None:
    w.jaw(RED, 0)[w.window, 2] = 9e-6


@CASES.case("RELEASED")
def held_to_the_end(w: World) -> None:
    w.gripper[w.steps("release")[0] :] = w.gripper[w.steps("place_stack")[-1]]
    for jaw in (0, 1):
        w.jaw(RED, jaw)[w.steps("release")[0] :] = w.jaw(RED, jaw)[w.steps("place_stack")[-1]]


def hair(name: str, *broken: str) -> Callable[[Callable[[World, float], None]], None]:
    """Registers both sides of a threshold, from which the decorated function goes away."""

    def register(alter: Callable[[World, float], None]) -> None:
        CASES.add(f"{name}_inside", set(), lambda w: alter(w, -HAIR))
        CASES.add(f"{name}_outside", {*broken}, lambda w: alter(w, HAIR))

    return register


@hair("xy_err", "STACKED")
def _xy(w: World, by: float) -> None:
    w.poses[w.window, RED, 0] = w.poses[w.window, BLUE, 0] + w.t.xy_err + by


@hair("dz_min", "STACKED")
def _dz_min(w: World, by: float) -> None:
    w.poses[w.window, RED, 2] = w.poses[w.window, BLUE, 2] + w.t.dz_min - by


@hair("dz_max", "STACKED")
def _dz_max(w: World, by: float) -> None:
    w.poses[w.window, RED, 2] = w.poses[w.window, BLUE, 2] + w.t.dz_max + by


@hair("gap_above", "SUPPORTED")
def _gap_above(w: World, by: float) -> None:
    w.poses[w.window, :, 2] += w.t.support_gap + by


@hair("gap_below", "SUPPORTED")
def _gap_below(w: World, by: float) -> None:
    w.poses[w.window, :, 2] -= w.t.support_gap + by


@hair("rest_speed", "REST_SPEED")
def _speed(w: World, by: float) -> None:
    w.velocities[w.window, RED, 1] = w.t.rest_speed + by


@hair("rest_position", "REST_POSITION")
def _position(w: World, by: float) -> None:
    w.poses[-30, :, 1] += w.t.rest_position + by


@hair("rest_rotation", "REST_ROTATION")
def _rotation(w: World, by: float) -> None:
    half = 0.5 * (math.radians(w.t.rest_rotation_deg) + by)
    w.poses[-30, RED, 3:] = [math.cos(half), 0.0, 0.0, math.sin(half)]


@hair("airborne_height", "LIFT", "CARRY")
def _height(w: World, by: float) -> None:
    top = w.stage.cfg.scene.table_center[2] + w.stage.cfg.scene.table_half[2]
    flight = w.steps("lift_red", "above_blue")
    w.poses[flight, RED, 3:] = [1.0, 0.0, 0.0, 0.0]
    w.poses[flight, RED, 2] = top + 0.022 + w.t.airborne_height - by


@hair("carry_distance", "CARRY")
def _carry_distance(w: World, by: float) -> None:
    w.poses[w.steps("above_blue"), RED, :2] = w.poses[0, RED, :2]
    w.poses[w.steps("above_blue")[-1], RED, 0] += w.t.carry_distance - by


@hair("open_fraction", "RELEASED")
def _opening(w: World, by: float) -> None:
    closed, opened = (w.stage.cfg.robot.gripper_closed[0], w.stage.cfg.robot.gripper_open[0])
    w.gripper[-7] = closed + w.t.open_fraction * (opened - closed) - by


@pytest.fixture(scope="module")
def altered(recorded: Callable[[str], SimpleNamespace]) -> Altered:
    rec = recorded("so101")

    def fresh() -> World:
        world = World.of(rec)
        _make_ideal(world)
        return world

    return CASES.play(fresh, feed)


def _make_ideal(w: World) -> None:
    """The last steps at rest, one cube exactly on the other."""
    top = w.stage.cfg.scene.table_center[2] + w.stage.cfg.scene.table_half[2]
    xy = w.poses[-1, BLUE, :2].copy()
    w.poses[w.window, :, 3:] = [1.0, 0.0, 0.0, 0.0]
    w.poses[w.window, RED, :3] = [*xy, top + 0.066]
    w.poses[w.window, BLUE, :3] = [*xy, top + 0.022]
    w.velocities[w.window] = 0.0


@pytest.mark.parametrize("name", CASES.alter)
def test_altered_recording(name: str, altered: Altered) -> None:
    result, k, world = altered[name]
    assert CASES.broken(result, k) == CASES.breaks[name]
    CASES.assert_same(result, k, world.outcome)


@pytest.mark.parametrize(
    ("name", "rule", "words"),
    [
        ("xy_err", "STACKED", " (xy_err 0 of 50)"),
        ("dz_min", "STACKED", " (dz 0 of 50)"),
        ("dz_max", "STACKED", " (dz 0 of 50)"),
        ("gap_above", "SUPPORTED", " (gap 0 of 50)"),
        ("open_fraction", "RELEASED", " (open_fraction 6 of 50)"),
        ("carry_distance", "CARRY", " (carry_m 0.05 of 0.05)"),
        ("rest_speed", "REST_SPEED", ""),  # its only one
    ],
)
def test_the_threshold_that_broke_is_named(
    name: str, rule: str, words: str, altered: Altered
) -> None:
    result, k, _ = altered[f"{name}_outside"]
    check = make_check(load_config([]))
    values = {value: found.numpy() for value, found in result.values.items()}
    one = {value: found[k : k + 1] for value, found in values.items()}
    why, beyond = check.why(result.failed[k : k + 1].numpy(), one)
    assert why == {rule: words}
    assert len(beyond) == 1
    every, all_beyond = check.why(result.failed.numpy(), values)
    assert set(every) == set(RULES)
    assert beyond[0] in all_beyond
    assert every["STACKED"].startswith(" (xy_err in ")


@pytest.mark.full
def test_episode_cut_short_fails_whatever_came_before(
    recorded: Callable[[str], SimpleNamespace],
) -> None:
    world = World.of(recorded("so101"))
    for name in ("phase", "qpos", "qvel", "sensordata"):
        setattr(world, name, getattr(world, name)[:-1])
    assert {"STEPS", "STACKED", "SUPPORTED"} <= CASES.broken(feed([world]))


def test_every_rule_has_words_and_a_case() -> None:
    assert set(RULES) == set().union(*CASES.breaks.values())
    assert all(RULES.texts.values())
    assert RULES.describe(RULES["LIFT"] | RULES["STACKED"]).count(",") == 1
