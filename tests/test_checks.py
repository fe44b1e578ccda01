"""A check of one's own, made of parts; thresholds; and judging without phases."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from check_cases import rules_of
from compositions import checked, load_config, refusal
from test_stack_check import World as StackWorld
from test_stack_check import feed as feed_stack

from mjstack.config.fields import spec
from mjstack.config.schema import Backend
from mjstack.config.schema.scene import PlaceCfg
from mjstack.episodes.rollout import NOMINAL
from mjstack.episodes.stage import Stage
from mjstack.scene import SceneIndex, build_model
from mjstack.sim import make_simulation
from mjstack.tasks.check import EpisodeCheck, Rule, make_check
from mjstack.tasks.parts import AtRest, InWindow, Streak, at_place, in_hand
from mjstack.tasks.view import Step


class PutCheck(EpisodeCheck):
    """An object has been in the hand, and rests at a place."""

    @dataclass(kw_only=True, slots=True)
    class Thresholds:
        object: str = spec()
        place: str = spec()
        grasp_steps: int = spec(unit="steps", ge=1)
        distance: float = spec(unit="m", gt=0.0)
        window: int = spec(unit="steps", ge=2)

    def build(self) -> list[Rule]:
        t = self.t
        self.objects = [t.object]
        self.there = at_place(t.object, t.place, distance=t.distance)
        return [
            Streak(
                *("GRASP", "{object} not grasped", self.objects, in_hand(t.object)),
                t.grasp_steps,
                phases=[["grasp_red"]],
            ),
            InWindow("AT_PLACE", f"{t.object} not at {t.place}", self.there, t.window),
            AtRest(t.window, speed=0.05, position=0.005, rotation_deg=3.0),
        ]

    def placed(self, step: Step) -> torch.Tensor:
        return self.there(step)[:, None]


def test_a_check_of_ones_own_judges_native_worlds() -> None:
    """World 0: blue stands at the place. 1: beside it. 2: at it, but both jaws have pressed on it
    before.
    """
    cfg = load_config(["sim=native"])
    own = {"object": "blue", "place": "goal", "grasp_steps": 3, "distance": 0.01, "window": 10}
    task = replace(cfg.task, check={"func": f"{__name__}.PutCheck", **own})
    scene = replace(cfg.scene, places={"goal": PlaceCfg(xy=[0.33, 0.15])})
    cfg = replace(cfg, task=task, scene=scene)
    model = build_model(cfg)
    index = SceneIndex(model, cfg.robot, cfg.scene)
    sim = make_simulation(model, cfg, 3, backend=Backend.native, device="cpu")
    env = Stage(cfg).start(sim, NOMINAL)
    address, _ = index.object_address("blue")
    sim.qpos[:, address : address + 2] = torch.tensor([[0.33, 0.15], [0.33, 0.18], [0.33, 0.15]])
    check = make_check(cfg)
    assert list(check.rules)[3:] == [
        *("GRASP", "AT_PLACE", "REST_SPEED", "REST_POSITION", "REST_ROTATION")
    ]
    assert check.thresholds() == {"grasp_steps": 3, "distance_m": 0.01, "window_steps": 10}
    check.start(env, 20)
    for step in range(20):
        sim.step(cfg.timing.decimation)
        for jaw in index.jaw_force["blue"]:
            sim.sensordata[:, jaw] = 0.0
            sim.sensordata[2, jaw] = 1.0 if step < 5 else 0.0
        check.update()
    result = check.result()
    broken = [check.rules.broken(int(bits)) for bits in result.failed]
    assert broken == [["GRASP"], ["GRASP", "AT_PLACE"], []]
    assert result.values["grasp_steps"].tolist() == [0.0, 0.0, 5.0]
    assert check.placed(check.view(env).step())[:, 0].tolist() == [True, False, True]
    told = check.report(result)
    assert told["GRASP"] == ("grasp_steps 0", "at least 3")
    assert told["AT_PLACE"] == ("at_place_steps 20", "at least 10")
    sim.close()


class Halfway(EpisodeCheck):
    def build(self) -> list[Rule]:
        return []


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("+task.check.xy_er=1", ["task.check: key", "xy_er", "Did you mean 'xy_err'?"]),
        ("task.check.xy_err=wide", ["task.check.xy_err=wide", "a number above 0 [m]"]),
        ("task.check.lift_steps=2.5", ["task.check.lift_steps=2.5", "int"]),
        ("task.check.rest_speed=0", ["task.check.rest_speed=0", "above 0 [m/s]"]),
        ("task.check.open_fraction=1.5", ["task.check.open_fraction=1.5", "at most 1"]),
        ("task.check.window=601", ["task.check.window=601", "600 steps"]),
        ("task.check.object=green", ["task.check: object", "green", "red"]),
        ("task.check.func=mjstack.tasks.stack.StackChek", ["task.check: func=", "StackCheck"]),
        ("task.check.func=mjstack.tasks.stack.StackSuccess", ["a subclass of", "EpisodeCheck"]),
        (f"task.check.func={__name__}.Halfway", ["Halfway: method 'placed' is missing."]),
        ("task.check=null", ["task.check=null", "trained, not verified"]),
    ],
)
def test_a_bad_value_is_one_line(override: str, parts: list[str]) -> None:
    refusal(lambda: checked(override), *parts)


@pytest.mark.full
@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        (["task=reach", "task.check=null"], ["task.check=null", "task reach"]),
        (["task=box", "task.check.places=[red_slot]"], ["task.check.places", "each object"]),
        (["task=box", "task.check.places=[red_slot,lid]"], ["task.check.places", "lid"]),
    ],
)
def test_bad_thresholds_are_one_line(overrides: list[str], parts: list[str]) -> None:
    refusal(lambda: make_check(load_config(overrides)), *parts)


# Without phases


def stack_worlds(rec: SimpleNamespace) -> list[StackWorld]:
    return [StackWorld.of(rec, k) for k in range(len(rec.pose))]


@pytest.mark.full
def test_expert_episodes_of_the_stack_pass_without_phases(
    robot: str, recorded: Callable[[str], SimpleNamespace]
) -> None:
    rec = recorded(robot)
    assert feed_stack(stack_worlds(rec), rec, phased=False).failed.tolist() == [0] * 4


@pytest.mark.full
def test_a_throw_and_a_push_lift_and_carry_nothing(
    recorded: Callable[[str], SimpleNamespace],
) -> None:
    """World 0: one jaw alone presses. 1: both press, but let go every ninth step. 2: the cube only
    slides. 3: the jaws hold it in the air where it is and put it down, then it is thrown.
    """
    rec = recorded("so101")
    worlds = stack_worlds(rec)
    red = rec.jaw_force["red"]
    worlds[0].force[:, red[0] : red[0] + 3] = 0.0
    for jaw in red:
        worlds[1].force[::9, jaw : jaw + 3] = 0.0
    flight = slice(worlds[2].steps("lift_red").start, worlds[2].steps("release").stop)
    worlds[2].pose[flight, 0, 2] = worlds[2].pose[0, 0, 2]
    for jaw in red:
        worlds[3].force[worlds[3].steps("above_blue").start :, jaw : jaw + 3] = 0.0
    result = feed_stack(worlds, rec, phased=False)
    rules = rules_of("stack")
    broken = [rules.broken(int(bits)) for bits in result.failed]
    assert broken == [*[["LIFT", "CARRY"]] * 3, ["CARRY"]]
    # With phases the jaws do not count.
    assert feed_stack(worlds, rec).failed.tolist()[:2] == [0, 0]


@pytest.mark.full
def test_a_lift_in_the_settled_window_comes_too_late(
    recorded: Callable[[str], SimpleNamespace],
) -> None:
    """The same flight, shifted so that all of it but the last step before the window is in it."""
    rec = recorded("so101")
    world = stack_worlds(rec)[0]
    first = np.flatnonzero((world.force[:, rec.jaw_force["red"][0] :][:, :3] != 0.0).any(1))[0]
    late = len(world.pose) - world.t.window - 9
    for name in ("pose", "force"):
        values = getattr(world, name)
        shifted = np.roll(values, late - first, axis=0)
        shifted[:late] = values[0]
        setattr(world, name, shifted)
    broken = rules_of("stack").broken(int(feed_stack([world], rec, phased=False).failed[0]))
    assert {"LIFT", "CARRY"} <= set(broken)
