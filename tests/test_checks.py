"""A check of one's own, made of parts; and thresholds."""

from dataclasses import dataclass, replace

import pytest
import torch
from compositions import checked, load_config, refusal
from environments import NOMINAL

from mjstack.config.fields import spec
from mjstack.config.schema import Backend
from mjstack.config.schema.scene import PlaceCfg
from mjstack.episodes.stage import Stage
from mjstack.errors import UnknownName
from mjstack.scene import SceneIndex, build_model
from mjstack.sim import make_simulation
from mjstack.tasks.check import EpisodeCheck, Rule, make_check
from mjstack.tasks.parts import AtRest, InWindow, Streak, at_place, in_hand, on_table
from mjstack.tasks.view import Step, TaskView


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


def test_conditions_see_what_the_check_does_not_judge() -> None:
    """Such as a fixture under the object. An object that is to be judged is one of the check's."""
    cfg = load_config(["sim=native"])
    model = build_model(cfg)
    sim = make_simulation(model, cfg, 2, backend=Backend.native, device="cpu")
    env = Stage(cfg).start(sim, NOMINAL)
    step = TaskView(env, ["red"]).step()
    blue = cfg.scene.objects["blue"]
    expected = torch.tensor([*blue.xy, cfg.scene.table_top + blue.half_height])
    torch.testing.assert_close(step.center("blue"), expected.expand(2, 3), rtol=0, atol=1e-6)
    with pytest.raises(UnknownName, match=r"object of the check.*blue.*red"):
        on_table("blue", gap=0.001)(step)
    with pytest.raises(UnknownName, match=r"object 'bleu'"):
        step.center("bleu")


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
    address, _ = index.objects["blue"]
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
        ("task.check=null", ["task.check=null", "task stack", "trained, not verified"]),
    ],
)
def test_a_bad_value_is_one_line(override: str, parts: list[str]) -> None:
    refusal(lambda: checked(override), *parts)
