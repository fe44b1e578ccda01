"""A check of one's own, made of parts; and thresholds."""

from dataclasses import dataclass, replace

import mujoco
import numpy as np
import pytest
import torch
from compositions import checked, load_config, refusal
from environments import NOMINAL, configure, few

from mjstack.config.fields import spec
from mjstack.config.schema import Backend, Config, TermCfg
from mjstack.config.schema.scene import PlaceCfg
from mjstack.episodes.failures import FailureMonitor
from mjstack.episodes.stage import Stage
from mjstack.errors import MjstackError, UnknownName
from mjstack.jobs.gates import check_machine
from mjstack.scene import SceneIndex, build_model
from mjstack.sim import make_simulation
from mjstack.tasks.check import EpisodeCheck, Rule, make_check
from mjstack.tasks.parts import (
    AtRest,
    InWindow,
    Streak,
    at_place,
    flat,
    in_hand,
    in_zone,
    on_table,
    released,
    upright,
)
from mjstack.tasks.placed import Placed
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


def test_conditions_see_what_the_check_does_not_judge() -> None:
    """Such as a fixture under the object. An object that is to be judged is one of the check's."""
    cfg = load_config(["sim=native"])
    model = build_model(cfg)
    sim = make_simulation(model, cfg, 2, backend=Backend.native, device="cpu")
    env = Stage(cfg).start(sim, NOMINAL)
    step = Step(env, ["red"])
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
    thresholds = {figure.key: figure.high for figure in check.thresholds()}
    assert thresholds == {"grasp_steps": 3, "distance_m": 0.01, "window_steps": 10}
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
    assert check.placed(env.state)[:, 0].tolist() == [True, False, True]
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


def turned_step(*overrides: str, nworld: int = 64) -> tuple[Step, np.ndarray]:
    """Red turned at random in every world, some by little; and how high each of its axes points,
    by MuJoCo.
    """
    stage = Stage(configure("sim=native", *overrides))
    env = stage.start(stage.simulation(nworld, "native", "cpu"), NOMINAL)
    rng = np.random.default_rng(3)
    quats = rng.normal(size=(nworld, 4))
    quats[::2, 1:] *= 0.05
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    at, _ = env.index.objects["red"]
    env.sim.qpos[:, at + 3 : at + 7] = torch.tensor(quats).to(env.sim.qpos)
    matrices = np.empty((nworld, 9))
    for matrix, quat in zip(matrices, quats, strict=True):
        mujoco.mju_quat2Mat(matrix, quat)
    return Step(env, ["red"]), matrices.reshape(-1, 3, 3)[:, 2]


@pytest.mark.parametrize(("number", "axis"), list(enumerate("xyz")))
def test_upright_is_an_angle_from_the_vertical(number: int, axis: str) -> None:
    step, up = turned_step()
    angles = np.degrees(np.arccos(up[:, number]))
    np.testing.assert_allclose(step.tilt("red", axis, either_end=False), angles, atol=0.01)
    folded = np.minimum(angles, 180.0 - angles)
    np.testing.assert_allclose(step.tilt("red", axis), folded, atol=0.01)
    for ends, expected in ((True, folded), (False, angles)):
        holds = upright("red", tilt_deg=40.0, axis=axis, either_end=ends)(step)
        assert holds.tolist() == (expected <= 40.0).tolist()
        assert 0 < holds.sum() < len(holds)


@pytest.mark.parametrize("shape", ["box", "cylinder"])
def test_flat_is_a_face_that_is_level(shape: str) -> None:
    """Any face of a box, the ends of a cylinder."""
    size = {"box": [0.03, 0.02, 0.02], "cylinder": [0.02, 0.02]}[shape]
    step, up = turned_step(f"scene.objects.red.shape={shape}", f"scene.objects.red.size={size}")
    level = np.abs(up).max(axis=1) if shape == "box" else np.abs(up[:, 2])
    expected = np.degrees(np.arccos(level)) <= 15.0
    holds = flat("red", tilt_deg=15.0)(step)
    assert holds.tolist() == expected.tolist()
    assert 0 < holds.sum() < len(holds)


def test_what_has_no_face_is_never_flat() -> None:
    step, _ = turned_step("scene.objects.red.shape=sphere", "scene.objects.red.size=[0.02]")
    with pytest.raises(UnknownName, match=r"axis of sphere red 'face'"):
        flat("red", tilt_deg=5.0)(step)
    with pytest.raises(UnknownName, match=r"axis of sphere red 'w'.*x, y, z"):
        upright("red", tilt_deg=5.0, axis="w")(step)


def test_a_zone_has_both_ends_in_the_frame_of_its_fixture() -> None:
    """A wall that is turned by 30 degrees; red goes along its x axis, then along its y axis."""
    wall = "{size: [0.05, 0.01, 0.02], fixed: true, xy: [0.4, 0.1], yaw: 0.5235987755982988}"
    step, _ = turned_step(f"+scene.objects.wall={wall}", nworld=8)
    env = step.env
    along = np.array([-0.08, 0.019, 0.021, 0.03, 0.039, 0.041, 0.03, 0.03])
    aside = np.array([0.0, 0.0, 0.0, 0.001, 0.0, 0.0, 0.003, -0.003])
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    xy = np.stack((0.4 + c * along - s * aside, 0.1 + s * along + c * aside), axis=1)
    at, _ = env.index.objects["red"]
    env.sim.qpos[:, at : at + 2] = torch.tensor(xy).to(env.sim.qpos)
    zone = in_zone("red", "wall", low=(0.02, -0.002), high=(0.04, 0.002))
    expected = [False, False, True, True, True, False, False, False]
    assert zone(Step(env, ["red"])).tolist() == expected
    # Of both conditions, each threshold by its name
    both = zone & released("red", open_fraction=0.0)
    assert both.names == ("along_x", "along_y", "untouched", "open_fraction")
    assert both(Step(env, ["red"])).tolist() == expected


class Drawer(EpisodeCheck):
    """The arm is raised: about no object."""

    @dataclass(kw_only=True, slots=True)
    class Thresholds:
        window: int = spec(unit="steps", ge=1)
        least: float = spec(unit="rad")
        wrong: str = ""

    def build(self) -> list[Rule]:
        self.objects = []
        rests = [AtRest(self.t.window, 0.1, 0.1, 1.0)] * (self.t.wrong == "rests")
        return [InWindow("OPEN", "not open", self.up, self.t.window), *rests]

    def up(self, step: Step) -> torch.Tensor:
        return step.env.sim.qpos[:, 0] >= self.t.least

    def placed(self, step: Step) -> torch.Tensor:
        return self.up(step) if self.t.wrong == "shape" else self.up(step)[:, None]


def drawer(least: float, wrong: str = "") -> Config:
    """A task about no object, with the expert of task reach."""
    cfg = configure("task=reach", "sim=native", "nworld=2")
    check = {"func": f"{__name__}.Drawer", "window": 5, "least": least, "wrong": wrong}
    success = TermCfg(func="mjstack.tasks.placed.Placed", params={"open_fraction": 0.0})
    return replace(cfg, task=replace(cfg.task, check=check, success=success))


@pytest.mark.parametrize(("least", "broken"), few([(-9.0, []), (9.0, ["OPEN"])], 2))
def test_a_check_may_be_about_no_object(least: float, broken: list[str]) -> None:
    """Played and watched as gate *success* does; success is that of `placed`."""
    stage = check_machine(drawer(least))
    monitor = FailureMonitor()
    episode = stage.play(stage.batch_simulation(2), stage.cfg.reset, [monitor])
    assert [stage.check.rules.broken(int(bits)) for bits in episode.failed] == [broken] * 2
    assert monitor.sign.tolist() == [0, 0]
    env = stage.start(stage.batch_simulation(2), stage.cfg.reset)
    assert Placed(env, open_fraction=0.0)(env).tolist() == [not broken] * 2


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ("shape", r"task.check.func: placed: a torch.bool tensor of shape \(2,\)"),
        ("rests", "self.objects names none"),
    ],
)
def test_a_check_that_cannot_judge_is_one_line_before_a_run(wrong: str, text: str) -> None:
    with pytest.raises(MjstackError, match=text):
        check_machine(drawer(0.0, wrong))


def test_supports_need_their_sensors() -> None:
    """Without, nothing would count as resting on anything."""
    cfg = configure("task=box", "sim=native", "scene.support_sensors=false")
    with pytest.raises(MjstackError, match=r"scene.support_sensors=false: expected true"):
        check_machine(cfg)
