"""The batched check on the device against the plain checker, world by world."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from check_cases import STOPPED_EARLY, Altered, Cases, limits, rules_of
from environments import StubViews
from stack_checker import BLUE, RED, Outcome, check_world

from mjstack.scene.index import Columns
from mjstack.tasks.check import CheckResult, make_check

RULES = rules_of("stack")
CASES = Cases(RULES)
HAIR = 2e-6  # [m], [m/s], [rad]: a good deal more than float32 rounds at these sizes
NUMBERS = {
    "xy_err": "xy_err_m",
    "dz": "dz_m",
    "rest_speed": "rest_speed_m_per_s",
    "peak_speed": "peak_speed_m_per_s",
    "rest_position": "rest_position_m",
    "rest_rotation": "rest_rotation_deg",
}


@dataclass
class World:
    """A recording to be altered."""

    pose: np.ndarray
    velocity: np.ndarray
    force: np.ndarray
    gripper: np.ndarray
    step_count: int
    rec: SimpleNamespace
    overflow: int = 0
    arm: float = 0.0

    @classmethod
    def of(cls, rec: SimpleNamespace, k: int = 0) -> World:
        arrays = (getattr(rec, n)[k].copy() for n in ("pose", "velocity", "force", "gripper"))
        return cls(*arrays, int(rec.step_count[k]), rec)

    def jaw(self, number: int) -> np.ndarray:
        """A view of a jaw's force on red, shape ``(steps, 3)``."""
        first = self.rec.jaw_force["red"][number]
        return self.force[:, first : first + 3]

    def steps(self, name: str) -> slice:
        phase = next(p for p in self.rec.phases if p.name == name)
        return slice(phase.start, phase.stop)

    @property
    def window(self) -> slice:
        return slice(-self.t.window, None)

    @property
    def t(self) -> Any:
        return limits(self.rec.cfg)


def feed(
    worlds: list[World],
    rec: SimpleNamespace,
    dtype: torch.dtype = torch.float64,
    *,
    phased: bool = True,
) -> CheckResult:
    """Plays recordings through the check, as of a driver with phases or without; the state also has
    one coordinate of an arm, and the gripper's.
    """

    def columns(qpos: int, qvel: int) -> tuple[Columns, Columns]:
        cpu = torch.device("cpu")
        return Columns(range(qpos, qpos + 7), cpu), Columns(range(qvel, qvel + 6), cpu)

    closed = torch.tensor(rec.cfg.robot.gripper_closed, dtype=dtype)
    index = SimpleNamespace(
        object_columns={"red": columns(1, 1), "blue": columns(8, 7)}.__getitem__,
        jaw_force=rec.jaw_force,
        support_force={},
        constant=lambda values, like: torch.tensor(values, dtype=like.dtype),
        fixed={},
        n_arm=1,
        on=lambda device, dtype: SimpleNamespace(
            gripper_qpos=Columns(range(15, 15 + worlds[0].gripper.shape[1]), device),
            gripper_closed=closed,
            gripper_travel=torch.tensor(rec.cfg.robot.gripper_open, dtype=dtype) - closed,
        ),
    )
    n = len(worlds)
    phase_at = torch.tensor([i for i, p in enumerate(rec.phases) for _ in range(p.start, p.stop)])
    arm = np.array([[w.arm] for w in worlds])
    pose = np.stack([w.pose.reshape(len(w.pose), 14) for w in worlds])
    velocity = np.stack([w.velocity.reshape(len(w.velocity), 12) for w in worlds])
    force = np.stack([w.force for w in worlds])
    gripper = np.stack([w.gripper for w in worlds])
    sim = StubViews(
        step_count=torch.tensor([w.step_count for w in worlds]),
        overflow=torch.tensor([w.overflow for w in worlds], dtype=torch.int32),
    )
    env = SimpleNamespace(sim=sim, cfg=rec.cfg, index=index, nworld=n, device=torch.device("cpu"))
    check = make_check(rec.cfg)
    sim.qpos = torch.zeros((n, 1), dtype=dtype)
    check.start(env, len(phase_at), rec.phases if phased else ())
    for step in range(pose.shape[1]):
        sim.qpos = torch.tensor(np.hstack([arm, pose[:, step], gripper[:, step]]), dtype=dtype)
        sim.qvel = torch.tensor(np.hstack([arm, velocity[:, step]]), dtype=dtype)
        sim.sensordata = torch.tensor(force[:, step], dtype=dtype)
        phase = phase_at[min(step, len(phase_at) - 1)].expand(n)
        check.update(phase if phased else None)
    return check.result()


def reference(w: World, *, phased: bool = True) -> Outcome:
    return check_world(
        w.pose,
        w.velocity,
        w.rec.cfg,
        w.rec.phases if phased else [],
        jaw_force=np.stack([w.jaw(number) for number in (0, 1)], axis=1),
        gripper=w.gripper,
        step_count=w.step_count,
        overflow=bool(w.overflow & ~STOPPED_EARLY),
        finite_elsewhere=math.isfinite(w.arm),
    )


def assert_same(result: CheckResult, k: int, expected: Outcome) -> None:
    assert CASES.broken(result, k) == expected.failed
    for name, value in NUMBERS.items():
        wanted = getattr(expected, name)
        wanted = math.degrees(wanted) if value.endswith("_deg") else wanted
        tolerance = math.degrees(1e-6) if value.endswith("_deg") else 1e-6
        assert float(result.values[value][k]) == pytest.approx(
            wanted, abs=tolerance, rel=1e-4, nan_ok=True
        ), name


@pytest.mark.full
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_recorded_episodes(
    robot: str, recorded: Callable[[str], SimpleNamespace], dtype: torch.dtype
) -> None:
    rec = recorded(robot)
    worlds = [World.of(rec, k) for k in range(len(rec.pose))]
    result = feed(worlds, rec, dtype)
    for k, world in enumerate(worlds):
        expected = reference(world)
        assert expected.failed == set()
        assert_same(result, k, expected)
        assert_same(rec.result, k, expected)


# Alterations of a recording whose last steps have been made ideal.


@CASES.case("STACKED")
def red_teleported_after_release(w: World) -> None:
    w.pose[w.steps("retreat").start :, RED, 0] += 0.06


@CASES.case("STACKED")
def fallen_off_in_the_last_step_only(w: World) -> None:
    w.pose[-1, RED, :2] = w.pose[-1, BLUE, :2] + [0.0153, 0.0]
    w.pose[-2, RED, :2] = w.pose[-2, BLUE, :2] + [0.0147, 0.0]
    w.pose[w.window, RED, 0] = np.where(np.arange(50) == 49, w.pose[-1, RED, 0], w.pose[-2, RED, 0])


@CASES.case("STACKED")
def stacked_late_by_one_step(w: World) -> None:
    first = len(w.pose) - w.t.window
    w.pose[w.window, RED, 0] += 0.0149
    w.pose[first, RED, 0] += 0.0002


@CASES.case()
def not_stacked_just_before_the_window(w: World) -> None:
    w.pose[: len(w.pose) - 50][-1, RED, 0] += 0.05


@CASES.case("SUPPORTED", "STACKED")
def blue_sunk_into_the_table(w: World) -> None:
    w.pose[w.window, BLUE, 2] -= 0.012


def _edge(w: World, axis: int, side: float, by: float) -> None:
    scene = w.rec.cfg.scene
    reach = scene.table_half[axis] - scene.objects["red"].half_height + by
    w.pose[w.window, :, axis] = scene.table_center[axis] + side * reach


CASES.add("both_off_the_table_edge", {"SUPPORTED"}, lambda w: _edge(w, 1, 1.0, HAIR))
CASES.add("both_at_the_table_edge", set(), lambda w: _edge(w, 1, 1.0, -HAIR))
CASES.add("both_off_the_far_edge", {"SUPPORTED"}, lambda w: _edge(w, 0, -1.0, HAIR))


@CASES.case("SUPPORTED")
def blue_tilted_off_its_support(w: World) -> None:
    w.pose[w.window, BLUE, 3:] = [math.cos(0.2), math.sin(0.2), 0.0, 0.0]


@CASES.case("REST_POSITION")
def slow_drift(w: World) -> None:
    w.pose[w.window, :, 1] += np.linspace(0.0, 0.0052, 50)[:, None]


@CASES.case("REST_POSITION")
def drift_there_and_back(w: World) -> None:
    w.pose[w.window, :, 1] += (0.0026 * np.sin(np.linspace(0.0, 2.0 * np.pi, 50)))[:, None]


def _turn(w: World, cube: int, degrees: np.ndarray) -> None:
    half = 0.5 * np.radians(degrees)
    w.pose[w.window, cube, 3:] = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], 1)


@CASES.case("REST_ROTATION")
def slow_turn_of_blue(w: World) -> None:
    _turn(w, BLUE, np.linspace(0.0, 3.1, 50))


@CASES.case("REST_ROTATION")
def turn_between_the_middle_and_the_ends(w: World) -> None:
    _turn(w, RED, 1.6 * np.sin(np.linspace(0.0, 2.0 * np.pi, 50)))


@CASES.case()
def quaternion_of_either_sign(w: World) -> None:
    w.pose[::2, :, 3:] *= -1.0


@CASES.case("REST_SPEED")
def jitter_in_place(w: World) -> None:
    w.velocity[w.window, RED, 0] = 0.06 * (-1.0) ** np.arange(50)


@CASES.case("REST_SPEED")
def spin_in_place(w: World) -> None:
    w.velocity[w.window, BLUE, 5] = 0.0502 / (math.sqrt(3.0) * 0.022)


@CASES.case()
def one_fast_step(w: World) -> None:
    w.velocity[-20, RED, 0] = 0.3


@CASES.case("LIFT", "CARRY")
def never_lifted(w: World) -> None:
    w.pose[w.steps("lift_red").start : w.steps("above_blue").stop, RED, 2] = w.pose[0, RED, 2]


@CASES.case("LIFT", "CARRY")
def airborne_runs_of_nine_steps(w: World) -> None:
    w.pose[w.steps("lift_red").start : w.steps("above_blue").stop : 10, RED, 2] = w.pose[0, RED, 2]


@CASES.case("CARRY")
def dragged_in_above_blue(w: World) -> None:
    w.pose[w.steps("above_blue"), RED, 2] = w.pose[0, RED, 2]


@CASES.case("CARRY")
def carried_in_hops_of_nine_steps(w: World) -> None:
    flight = w.steps("above_blue")
    w.pose[flight.start : flight.stop : 10, RED, 2] = w.pose[0, RED, 2]


@CASES.case("CARRY")
def moved_between_two_flights_only(w: World) -> None:
    part = w.steps("above_blue")
    middle = (part.start + part.stop) // 2
    w.pose[part.start : middle, RED, :2] = w.pose[0, RED, :2]
    w.pose[middle, RED, 2] = w.pose[0, RED, 2]
    w.pose[middle : part.stop, RED, :2] = w.pose[-1, RED, :2]


@CASES.case("FINITE")
def not_a_number_in_one_step(w: World) -> None:
    w.velocity[100, RED, 3] = math.nan


@CASES.case("FINITE", "LIFT", "CARRY", "STACKED", "REST_SPEED", "REST_POSITION", "REST_ROTATION")
def red_not_a_number_from_the_grasp(w: World) -> None:
    w.pose[w.steps("grasp_red").start :, RED] = math.nan
    w.velocity[w.steps("grasp_red").start :, RED] = math.nan


@CASES.case("FINITE", "REST_SPEED")
def infinite_velocity_at_the_end(w: World) -> None:
    w.velocity[-1, BLUE, 0] = math.inf


@CASES.case("FINITE")
def arm_not_a_number(w: World) -> None:
    w.arm = math.nan


@CASES.case("RELEASED")
def touched_by_a_jaw_in_the_windows_first_step(w: World) -> None:
    w.jaw(1)[-w.t.window] = [0.0, 2e-5, 0.0]


@CASES.case()
def touched_by_a_jaw_just_before_the_window(w: World) -> None:
    w.jaw(1)[-w.t.window - 1] = 1.0


@CASES.case()
def touched_by_less_than_the_threshold(w: World) -> None:
    w.jaw(0)[w.window, 2] = 9e-6


@CASES.case("RELEASED")
def held_to_the_end(w: World) -> None:
    w.gripper[w.steps("release").start :] = w.gripper[w.steps("place_stack").stop - 1]
    for jaw in (0, 1):
        w.jaw(jaw)[w.steps("release").start :] = w.jaw(jaw)[w.steps("place_stack").stop - 1]


def hair(name: str, *broken: str) -> Callable[[Callable[[World, float], None]], None]:
    """Registers both sides of a threshold, from which the decorated function goes away."""

    def register(alter: Callable[[World, float], None]) -> None:
        CASES.add(f"{name}_inside", set(), lambda w: alter(w, -HAIR))
        CASES.add(f"{name}_outside", {*broken}, lambda w: alter(w, HAIR))

    return register


@hair("xy_err", "STACKED")
def _xy(w: World, by: float) -> None:
    w.pose[w.window, RED, 0] = w.pose[w.window, BLUE, 0] + w.t.xy_err + by


@hair("dz_min", "STACKED")
def _dz_min(w: World, by: float) -> None:
    w.pose[w.window, RED, 2] = w.pose[w.window, BLUE, 2] + w.t.dz_min - by


@hair("dz_max", "STACKED")
def _dz_max(w: World, by: float) -> None:
    w.pose[w.window, RED, 2] = w.pose[w.window, BLUE, 2] + w.t.dz_max + by


@hair("gap_above", "SUPPORTED")
def _gap_above(w: World, by: float) -> None:
    w.pose[w.window, :, 2] += w.t.support_gap + by


@hair("gap_below", "SUPPORTED")
def _gap_below(w: World, by: float) -> None:
    w.pose[w.window, :, 2] -= w.t.support_gap + by


@hair("rest_speed", "REST_SPEED")
def _speed(w: World, by: float) -> None:
    w.velocity[w.window, RED, 1] = w.t.rest_speed + by


@hair("rest_position", "REST_POSITION")
def _position(w: World, by: float) -> None:
    w.pose[-30, :, 1] += w.t.rest_position + by


@hair("rest_rotation", "REST_ROTATION")
def _rotation(w: World, by: float) -> None:
    half = 0.5 * (math.radians(w.t.rest_rotation_deg) + by)
    w.pose[-30, RED, 3:] = [math.cos(half), 0.0, 0.0, math.sin(half)]


@hair("airborne_height", "LIFT", "CARRY")
def _height(w: World, by: float) -> None:
    top = w.rec.cfg.scene.table_center[2] + w.rec.cfg.scene.table_half[2]
    flight = slice(w.steps("lift_red").start, w.steps("above_blue").stop)
    w.pose[flight, RED, 3:] = [1.0, 0.0, 0.0, 0.0]
    w.pose[flight, RED, 2] = top + 0.022 + w.t.airborne_height - by


@hair("carry_distance", "CARRY")
def _carry_distance(w: World, by: float) -> None:
    w.pose[w.steps("above_blue"), RED, :2] = w.pose[0, RED, :2]
    w.pose[w.steps("above_blue").stop - 1, RED, 0] += w.t.carry_distance - by


@hair("open_fraction", "RELEASED")
def _opening(w: World, by: float) -> None:
    closed, opened = (w.rec.cfg.robot.gripper_closed[0], w.rec.cfg.robot.gripper_open[0])
    w.gripper[-7] = closed + w.t.open_fraction * (opened - closed) - by


@pytest.fixture(scope="module")
def altered(recorded: Callable[[str], SimpleNamespace]) -> Altered:
    rec = recorded("so101")

    def fresh() -> World:
        world = World.of(rec)
        _make_ideal(world)
        return world

    return CASES.play(fresh, lambda worlds: feed(worlds, rec))


def _make_ideal(w: World) -> None:
    """The last steps at rest, one cube exactly on the other."""
    top = w.rec.cfg.scene.table_center[2] + w.rec.cfg.scene.table_half[2]
    xy = w.pose[-1, BLUE, :2].copy()
    w.pose[w.window, :, 3:] = [1.0, 0.0, 0.0, 0.0]
    w.pose[w.window, RED, :3] = [*xy, top + 0.066]
    w.pose[w.window, BLUE, :3] = [*xy, top + 0.022]
    w.velocity[w.window] = 0.0


@pytest.mark.parametrize("name", CASES.alter)
def test_altered_recording(name: str, altered: Altered) -> None:
    result, k, world = altered[name]
    assert CASES.broken(result, k) == CASES.breaks[name]
    assert_same(result, k, reference(world))


@pytest.mark.full
def test_episode_cut_short_fails_whatever_came_before(
    recorded: Callable[[str], SimpleNamespace],
) -> None:
    rec = recorded("so101")
    world = World.of(rec)
    for name in ("pose", "velocity", "force", "gripper"):
        setattr(world, name, getattr(world, name)[:-1])
    assert {"STEPS", "STACKED", "SUPPORTED"} <= CASES.broken(feed([world], rec))


def test_every_rule_has_words_and_a_case() -> None:
    assert set(RULES) == set().union(*CASES.breaks.values())
    assert all(RULES.texts.values())
    assert RULES.describe(RULES["LIFT"] | RULES["STACKED"]).count(",") == 1
