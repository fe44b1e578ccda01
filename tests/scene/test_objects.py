"""Scenes of a stranger: any number of objects of any shape, and places drawn per episode."""

import itertools
import math
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from compositions import load_config, make_env, refusal
from environments import mask_of

from mjstack.config.schema import Config, ObjectCfg
from mjstack.drivers.closed_loop import make_expert
from mjstack.drivers.open_loop import OpenLoopPlanner
from mjstack.envs import Env
from mjstack.managers import episode_draw
from mjstack.math import lowest_point
from mjstack.mdp.geometry import above_table, place_xy, pose_w, source_xy
from mjstack.mdp.observation import object_to_place
from mjstack.mdp.starts.starts_file import write_starts
from mjstack.scene.phases import build_phases, nominal_xy, target_xy

TABLE = """
  table_center: [0.35, -0.04, 0.012]
  table_half: [0.16, 0.26, 0.012]
  random_xy: [0.02, 0.02]
"""
PUCK = """
  objects:
    puck: {shape: cylinder, size: [0.03, 0.012], mass: 0.1, xy: [0.33, -0.10]}
  places:
    goal: {xy: [0.33, 0.08], random_xy: [0.03, 0.02]}
"""
SHAPES = """
  objects:
    brick: {size: [0.03, 0.015, 0.02], mass: 0.1, xy: [0.30, -0.20]}
    can: {shape: cylinder, size: [0.02, 0.03], mass: 0.1, xy: [0.36, -0.10]}
    post: {size: [0.01, 0.01, 0.05], mass: 1.0, xy: [0.44, 0.0], fixed: true}
    ball: {shape: sphere, size: [0.02], mass: 0.05, xy: [0.32, 0.04]}
    pill: {shape: capsule, size: [0.015, 0.02], mass: 0.05, xy: [0.32, 0.15]}
  places:
    goal: {xy: [0.30, -0.04], random_xy: [0.01, 0.01]}
    corner: {xy: [0.28, -0.25]}
"""
# Pushes the first object: from beside it, opposite to the goal, to where the goal is.
PHASES = """
approach:
  {{anchor: {0}, offset: [-0.06, 0.01, 0.1], toward: goal, gripper: closed, seconds: 1.0,
    observe: true}}
push: {{anchor: goal, offset: [0.03, 0.0, 0.08], toward: {0}, gripper: closed, seconds: 1.0}}
done: {{gripper: closed, seconds: 0.4}}
"""
TASK = """
# @package _global_
defaults:
  - override /scene: mine
  - override /phases: mine
  - override /observation: mine
  - override /reward: mine
task:
  name: mine
  control_hz: 50.0
  episode_steps: 100
"""
OBSERVATION = """
policy:
  terms:
    to_goal: {{func: mjstack.mdp.observation.object_to_place, params: {{object: {0}, place: goal}}}}
"""
REWARD = """
near:
  func: mjstack.mdp.reward.reach
  params: {{object: {0}, scale: 0.1}}
  weight: 1.0
"""


@pytest.fixture
def folder(tmp_path: Path) -> Callable[[str], Path]:
    """A stranger's folder, with a scene of some objects and a task that pushes the first one."""

    def write(objects: str) -> Path:
        first = objects.split()[1].rstrip(":")
        for group, text in (
            ("scene", "name: mine\n" + "\n".join(x[2:] for x in (TABLE + objects).splitlines())),
            ("phases", "# @package controller.phases\n" + PHASES.format(first)),
            ("task", TASK.lstrip()),
            ("observation", OBSERVATION.format(first)),
            ("reward", REWARD.format(first)),
        ):
            (tmp_path / "conf" / group).mkdir(parents=True)
            (tmp_path / "conf" / group / "mine.yaml").write_text(text)
        return tmp_path / "conf"

    return write


def build(conf: Path, *overrides: str, nworld: int = 8) -> Env:
    env = make_env(["task=mine", "sim=native", *overrides], nworld=nworld, config_dir=conf)
    env.reset(seed=0)
    return env


def corners(name: str, cfg: Config, pose: np.ndarray) -> np.ndarray:
    """Points of an object's surface in x and y, seen from above."""
    thing = cfg.scene.objects[name]
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, pose[3:])
    if thing.shape == "box":
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        points = signs * thing.size
    else:
        angle = np.linspace(0.0, 2.0 * math.pi, 48, endpoint=False)
        ring = thing.size[0] * np.column_stack((np.cos(angle), np.sin(angle), 0.0 * angle))
        half = np.array([thing.size[1] if thing.shape == "capsule" else 0.0, 0.0, 0.0])
        points = np.concatenate((ring + half, ring - half))
    return pose[:2] + (points @ turn.reshape(3, 3).T)[:, :2]


def test_every_shape_stands_on_the_table(folder: Callable[[str], Path]) -> None:
    env = build(folder(SHAPES), "reset=nominal", nworld=1)
    model = env.sim.model
    assert list(env.index.bodies) == ["brick", "can", "post", "ball", "pill"]
    assert list(env.index.objects) == ["brick", "can", "ball", "pill"]
    assert [model.geom(name).type[0] for name in env.index.bodies] == [6, 5, 6, 2, 3]
    for name in env.index.bodies:
        assert float(above_table(env, name)[0]) == pytest.approx(0.0, abs=1e-6)
        assert pose_w(env, name)[0, :2].tolist() == env.cfg.scene.objects[name].xy
    for _ in range(5):
        env.step(torch.zeros((1, env.action_manager.action_dim)))
    contacts = mujoco.MjData(model)
    contacts.qpos[:] = env.sim.qpos[0].numpy()
    mujoco.mj_forward(model, contacts)
    table = model.geom("table").id
    pairs = contacts.contact.geom[: contacts.ncon].tolist()
    for name in env.index.objects:
        touching = {g for pair in pairs if model.geom(name).id in pair for g in pair}
        assert touching == {table, model.geom(name).id}
    env.close()


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        ("box", [0.03, 0.015, 0.02]),
        ("box", [0.022, 0.022, 0.022]),
        ("cylinder", [0.02, 0.03]),
        ("sphere", [0.02]),
        ("capsule", [0.015, 0.02]),
    ],
)
def test_lowest_point_of_any_shape(shape: str, size: list[float]) -> None:
    """Against MuJoCo's distance from a plane far below."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="plane", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    body = spec.worldbody.add_body()
    body.add_freejoint()
    kind = getattr(mujoco.mjtGeom, f"mjGEOM_{shape.upper()}")
    turn = [1.0, 0.0, float(shape == "capsule"), 0.0]
    body.add_geom(name="thing", type=kind, size=[*size, 0.0, 0.0][:3], mass=1.0, quat=turn)
    model = spec.compile()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(20):
        quat = rng.normal(size=4)
        quat /= np.linalg.norm(quat)
        data.qpos[:] = [0.0, 0.0, 0.5, *quat]
        mujoco.mj_forward(model, data)
        lowest = lowest_point(torch.tensor(data.qpos[:3]), torch.tensor(quat), shape, size)
        expected = mujoco.mj_geomDistance(model, data, 0, 1, 2.0, None)
        assert float(lowest) == pytest.approx(expected, abs=1e-6)


LYING = [math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0]
FIXTURES = f"""
  objects:
    roll: {{shape: cylinder, size: [0.015, 0.04], mass: 0.1, xy: [0.0, -0.1], quat: {LYING}}}
    left: {{size: [0.03, 0.004, 0.02], xy: [0.0, 0.118], yaw: 0.4, fixed: true}}
    right: {{size: [0.03, 0.004, 0.02], xy: [0.0, 0.120], fixed: true}}
    rack:
      fixed: true
      xy: [0.05, 0.0]
      yaw: 0.5
      parts:
        post: {{size: [0.005, 0.02, 0.03], pos: [-0.02, 0.0, 0.03]}}
        shelf: {{size: [0.03, 0.03, 0.004], pos: [0.0, 0.0, 0.064]}}
    ball: {{shape: sphere, size: [0.01], mass: 0.01, pos: [0.05, 0.0, 0.078]}}
  places:
    goal: {{xy: [0.0, -0.2]}}
  frame: table
"""


@pytest.mark.parametrize("robot", ["so101", "rebot"])
def test_things_lie_lean_touch_and_stand_on_each_other(
    folder: Callable[[str], Path], robot: str
) -> None:
    """One set of positions for both robots: each counts from the middle of its table."""
    conf = folder(FIXTURES)
    path = conf / "scene" / "mine.yaml"
    text = path.read_text()
    for key, value in (("center", "[0.35, -0.04, 0.012]"), ("half", "[0.16, 0.26, 0.012]")):
        text = text.replace(value, f"${{robot.placements.stack.table_{key}}}")
    path.write_text(text)
    env = build(conf, f"robot={robot}", "reset=randomized", nworld=16)
    scene = env.cfg.scene
    middle = [*scene.table_center[:2], scene.table_top]
    model = env.sim.model
    assert scene.objects["rack"].xy == [middle[0] + 0.05, middle[1]]
    post = model.geom("rack_post")
    turn = [math.cos(0.5), math.sin(0.5)]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    expected = np.add(middle, [0.05 - 0.02 * turn[0], -0.02 * turn[1], 0.03])
    np.testing.assert_allclose(data.geom_xpos[post.id], expected, atol=1e-12)
    np.testing.assert_allclose(pose_w(env, "left")[0, 3:], [math.cos(0.2), 0, 0, math.sin(0.2)])
    for name, height in (("roll", 0.015), ("ball", 0.078)):
        pose = pose_w(env, name).double().numpy()
        np.testing.assert_allclose(pose[:, 2], middle[2] + height, atol=1e-9)
        assert np.ptp(pose[:, 0]) > 0.005
    axis = np.stack([mujoco_axis(quat) for quat in pose_w(env, "roll")[:, 3:].numpy()])
    np.testing.assert_allclose(axis[:, 2], 0.0, atol=1e-6)
    assert np.ptp(np.arctan2(axis[:, 1], axis[:, 0])) > 1.0
    assert float(above_table(env, "roll").abs().max()) < 1e-6
    for _ in range(10):
        env.step(torch.zeros((16, env.action_manager.action_dim)))
    assert float(above_table(env, "ball").min()) > 0.06
    env.close()


def mujoco_axis(quat: np.ndarray) -> np.ndarray:
    """The z axis of a body."""
    axis = np.empty(3)
    mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, 1.0]), quat.astype(float))
    return axis


def test_a_fixture_from_a_file_and_an_object_from_the_command_line(tmp_path: Path) -> None:
    (tmp_path / "rack.xml").write_text(
        "<mujoco><worldbody><body name='rack'><geom name='slab' type='box' size='.02 .03 .01'"
        " pos='0 0 .01'/><body pos='0 0 .05'><geom type='sphere' size='.01'/></body></body>"
        "</worldbody></mujoco>"
    )
    rack = f"+scene.objects.rack={{fixed: true, xy: [0.4, -0.04], file: {tmp_path}/rack.xml}}"
    can = ["shape=cylinder", "size=[0.02,0.03]", "mass=0.1", "xy=[0.27,-0.04]"]
    options = [rack, *(f"+scene.objects.can.{part}" for part in can)]
    env = make_env([*options, "sim=native", "reset=randomized"], nworld=8)
    env.reset(seed=0)
    assert list(env.cfg.scene.objects) == ["red", "blue", "rack", "can"]
    assert list(env.index.objects) == ["red", "blue", "can"]
    assert env.sim.model.geom("rack_slab").type[0] == mujoco.mjtGeom.mjGEOM_BOX
    env.close()
    bad = ["scene.objects.can.shapes=box", "scene.objects.can=5"]
    refusal(lambda: load_config([f"+{bad[0]}"]), "Did you mean 'scene.objects.can.shape'?")
    refusal(lambda: load_config([f"+{bad[1]}"]), "scene.objects.can=5: expected keys and values")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["scene.objects.red.xy=[0.33,0.02]"], "position clear of blue, into which it reaches 4.0"),
        (["task=box", "scene.objects.blue.xy=[0.35,0.0]"], "blue.xy=[0.35, 0.0]: expected a"),
        (
            ["+scene.objects.a={xy: [0.3, 0], size: [0.01, 0.01, 0.01], mass: 1, parts: {p: {}}}"],
            "scene.objects.a.fixed=false: expected true, because it has parts",
        ),
    ],
)
def test_what_moves_starts_clear_of_the_rest(overrides: list[str], message: str) -> None:
    refusal(lambda: make_env([*overrides, "sim=native"], nworld=1), message)


def test_corners_may_pass_where_circles_meet() -> None:
    """Diagonal neighbours: closer than their circles, not touching."""
    make_env(["scene.objects.red.xy=[0.33,0.01]", "sim=native", "reset=nominal"], nworld=1).close()


@pytest.mark.full
@pytest.mark.parametrize("objects", [PUCK, SHAPES], ids=["one", "many"])
def test_random_starts_keep_apart_and_come_back_from_a_file(
    folder: Callable[[str], Path], objects: str, tmp_path: Path
) -> None:
    conf = folder(objects)
    env = build(conf, "reset=randomized", nworld=32)
    names = list(env.cfg.scene.objects)
    poses = {name: pose_w(env, name).double().numpy() for name in names}
    for world in range(32):
        points = {name: corners(name, env.cfg, poses[name][world]) for name in names}
        for a, b in itertools.combinations(names, 2):
            gaps = np.linalg.norm(points[a][:, None] - points[b], axis=2)
            assert gaps.min() > 0.005, (a, b)
    assert float(env.sim.qpos[:, env.index.object_qpos[0]].std()) > 0.005
    write_starts(env, tmp_path / "starts.npz")
    with np.load(tmp_path / "starts.npz") as file:
        assert {f"{names[0]}_quat", "goal_xy"} <= set(file)
        assert not {"post_xy", "corner_xy"} & set(file)
    again = build(conf, "reset=starts_file", f"starts={tmp_path}/starts.npz", "seed=9", nworld=32)
    assert torch.equal(again.sim.qpos, env.sim.qpos)
    assert torch.equal(place_xy(again, "goal"), place_xy(env, "goal"))
    for name, field in env.sim.fields.items():
        torch.testing.assert_close(again.sim.fields[name], field, rtol=0.0, atol=1e-12)
    env.close()
    again.close()


def test_a_place_is_drawn_once_an_episode(folder: Callable[[str], Path]) -> None:
    conf = folder(PUCK)
    env = build(conf)
    goal = place_xy(env, "goal").clone()
    assert float((goal - torch.tensor([0.33, 0.08])).abs().max()) <= 0.03
    assert len(set(goal[:, 0].tolist())) == env.nworld
    puck = pose_w(env, "puck")[:, :3]
    away = torch.cat((goal - puck[:, :2], torch.zeros_like(goal[:, :1])), dim=1)
    for _ in range(3):
        observed = env.step(torch.zeros((env.nworld, env.action_manager.action_dim)))[0]["policy"]
        assert torch.equal(place_xy(env, "goal"), goal)
    torch.testing.assert_close(observed, away.float(), rtol=0.0, atol=2e-3)
    to_goal = object_to_place(env, object="puck", place="goal").float()
    torch.testing.assert_close(to_goal, observed, rtol=0.0, atol=1e-6)
    draw = episode_draw(env, "goal", 2)
    torch.testing.assert_close(draw * torch.tensor([0.03, 0.02]) + torch.tensor([0.33, 0.08]), goal)

    # Another episode has another goal, in the worlds that reset alone.
    mask = mask_of(env, 2)
    env.reset(mask=mask)
    assert torch.equal((place_xy(env, "goal") != goal).any(1), mask)
    fewer = build(conf, nworld=3)
    assert torch.equal(place_xy(fewer, "goal"), goal[:3])
    env.close()
    fewer.close()


def test_both_drivers_aim_toward_the_goal(folder: Callable[[str], Path]) -> None:
    env = build(folder(PUCK), "action=joint_absolute", nworld=2)
    sources = source_xy(env).double().numpy()
    puck, goal = sources.swapaxes(0, 1)
    along = (goal - puck) / np.linalg.norm(goal - puck, axis=1, keepdims=True)
    left = np.column_stack((-along[:, 1], along[:, 0]))
    expected = {"approach": puck - 0.06 * along + 0.01 * left, "push": goal - 0.03 * along}
    targets = {phase.name: phase.target for phase in build_phases(env.cfg)}
    for name, xy in expected.items():
        np.testing.assert_allclose(target_xy(targets[name], sources), xy, atol=1e-9)
    assert targets["done"] is None
    planner = OpenLoopPlanner(env.cfg)
    trajectory = planner.plan(sources)
    driver = make_expert(env)
    for step in range(driver.phases[1].stop):
        command = driver.command()
        for number, xy in enumerate(expected.values()):
            if step == driver.phases[number].stop - 1:
                closed = driver._ik.forward(command)[0].double().numpy()
                planned = [planner.ik.grasp_point(q.numpy()) for q in trajectory.command(step)]
                for points in (closed, np.stack(planned)):
                    np.testing.assert_allclose(points[:, :2], xy, atol=6e-4)
        env.step(command)
    env.close()


def test_what_is_stacked_is_higher_from_then_on() -> None:
    """After red was put on blue, red's centre is a cube higher."""
    cfg = load_config([])
    retreat = list(cfg.controller.phases).index("retreat")
    before = build_phases(cfg)[retreat].target
    cfg.controller.phases["retreat"].anchor = "red"
    after = build_phases(cfg)[retreat].target
    assert before is not None
    assert after is not None
    assert after.z - before.z == pytest.approx(0.044)
    # And the plan takes it to be where it was let go.
    end = OpenLoopPlanner(cfg)._targets(nominal_xy(cfg.scene)[None])[0, retreat + 1]
    np.testing.assert_allclose(end[:2], cfg.scene.objects["blue"].xy, atol=1e-12)


@pytest.mark.full
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("shape: cylinder", "shape: cone"), "scene.objects.puck.shape=cone"),
        (("[0.03, 0.012]", "[0.03, 0.012, 0.1]"), "scene.objects.puck.size"),
        (("mass: 0.1", "mass: 0.0"), "scene.objects.puck.mass=0"),
        (("xy: [0.33, -0.10]", "xy: [0.9, -0.10]"), "on the table"),
        (("goal:", "puck:"), "names that no object has"),
        (("random_xy: [0.03, 0.02]", "random_xy: [0.03, 0.5]"), "scene.places.goal.xy"),
    ],
)
def test_a_scene_that_cannot_be(
    folder: Callable[[str], Path], change: tuple[str, str], message: str
) -> None:
    conf = folder(PUCK.replace(*change))
    refusal(lambda: load_config(["task=mine"], config_dir=conf), message)


@pytest.mark.parametrize(
    ("shape", "size", "quat", "radius", "faces"),
    [
        ("box", [0.01, 0.02, 0.02], None, 0.03, True),
        ("cylinder", [0.03, 0.04], None, 0.05, False),
        ("cylinder", [0.03, 0.04], [1.0, 1.0, 0.0, 0.0], 0.05, True),
        ("capsule", [0.03, 0.04], None, 0.07, True),
        ("sphere", [0.03], None, 0.03, False),
    ],
)
def test_what_holds_a_shape_and_what_jaws_turn_to(
    shape: str, size: list[float], quat: list[float] | None, radius: float, faces: bool
) -> None:
    thing = ObjectCfg(shape=shape, size=size, quat=quat)
    assert thing.radius == pytest.approx(radius, rel=1e-12)
    assert thing.has_faces == faces
