"""Objects from files: meshes and MJCF that move, and fixtures with joints."""

from functools import partial
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from compositions import load_config, make_env, refusal
from environments import few

from mjstack import verify
from mjstack.envs import Env
from mjstack.math import lowest_point
from mjstack.mdp.geometry import above_table, pose_w
from mjstack.mdp.observation import fixture_pos, fixture_vel
from mjstack.mdp.reset import FixtureJoints
from mjstack.mdp.starts.starts_file import write_starts
from mjstack.robots.guest import object_left_behind
from mjstack.scene import build_model
from mjstack.tasks.view import Step

NATIVE = ("sim=native", "reset=nominal")
BOX = [(-1, 3, 4, 2), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
MUG = """<mujoco>
  <compiler angle="radian" settotalmass="0.12"/>
  <option gravity="0 0 0" timestep="0.01"><flag contact="disable"/></option>
  <default><default class="pad"><geom friction="3 0.1 0.1"/></default></default>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <light pos="0 0 2"/>
    <body name="mug" pos="0.5 0.2 0.8">
      <freejoint/>
      <geom name="cup" class="pad" type="box" size="0.02 0.02 0.03" pos="0.6 0 0.5"/>
      <body name="handle">
        <geom class="pad" type="box" size="0.01 0.004 0.015" pos="0.63 0 0.5"/>
      </body>
    </body>
    <body name="tray"><geom type="box" size="1 1 0.01"/></body>
  </worldbody>
  <contact><exclude body1="mug" body2="handle"/></contact>
  <keyframe><key name="home" qpos="0 0 1 1 0 0 0"/></keyframe>
</mujoco>"""
DOOR = """<mujoco>
  <compiler angle="degree"/>
  <option timestep="0.01"/>
  <default><default class="pad"><joint damping="0.1"/></default></default>
  <worldbody>
    <body name="frame" pos="0 0 0.3">
      <geom type="box" size="0.01 0.01 0.15"/>
      <body name="door">
        <joint name="hinge" class="pad" axis="0 0 1" range="0 90"/>
        <geom type="box" size="0.004 0.04 0.1" pos="0 0.06 0" mass="0.2"/>
        <body name="latch" pos="-0.02 0.08 0">
          <joint axis="1 0 0" range="0 45"/>
          <geom type="capsule" fromto="0 0 0 0 -0.03 0" size="0.005" mass="0.02"/>
          <site name="grip" pos="0 -0.03 0"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>"""


def write_box(path: Path, half: tuple[float, float, float], middle: tuple[float, ...]) -> Path:
    """A box as a mesh, far off its origin."""
    corners = np.array(np.meshgrid(*[(-1, 1)] * 3, indexing="ij")).reshape(3, -1).T
    lines = ["v {:.9g} {:.9g} {:.9g}".format(*point) for point in corners * half + middle]
    for a, b, c, d in BOX:
        lines += [f"f {abs(a)} {b} {c}", f"f {abs(a)} {c} {d}"]
    path.write_text("\n".join(lines) + "\n")
    return path


def build(path: Path, *overrides: str, keys: str = "", nworld: int = 1) -> Env:
    """The task stack with another object."""
    file = f"+scene.objects.thing={{file: {path}, xy: [0.38, 0.13]{keys}}}"
    env = make_env([*NATIVE, file, *overrides], nworld=nworld)
    env.reset(seed=0)
    return env


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "thing.xml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("keys", "mass"), [("mass: 0.05", 0.05), ("density: 500", 500 * 8 * 0.02 * 0.03 * 0.01)]
)
def test_a_mesh_far_off_its_origin_moves(tmp_path: Path, keys: str, mass: float) -> None:
    """It stands by its lowest point, about its middle, and weighs as MuJoCo says of a box."""
    path = write_box(tmp_path / "brick.obj", (0.02, 0.03, 0.01), (0.4, -0.3, 0.5))
    env = build(path, keys=f", {keys}")
    model, body = env.sim.model, env.index.bodies["thing"]
    brick = env.cfg.scene.objects["thing"]
    assert brick.half == pytest.approx([0.02, 0.03, 0.01], rel=1e-6)
    assert brick.grip_width == pytest.approx(0.04, rel=1e-6)
    height = env.cfg.scene.table_top + 0.01
    assert pose_w(env, "thing")[0].tolist() == pytest.approx([0.38, 0.13, height, 1, 0, 0, 0])
    inertia = mass / 3.0 * np.array([0.03**2 + 0.01**2, 0.02**2 + 0.01**2, 0.02**2 + 0.03**2])
    assert model.body_mass[body] == pytest.approx(mass, rel=1e-5)
    assert sorted(model.body_inertia[body]) == pytest.approx(sorted(inertia), rel=1e-4)
    for _ in range(20):
        env.step(torch.zeros((1, env.action_manager.action_dim)))
    assert float(above_table(env, "thing")) == pytest.approx(0.0, abs=5e-4)
    first = env.index.objects["thing"][1]
    assert float(env.sim.qvel[0, first : first + 6].abs().max()) < 0.01
    env.close()


def test_a_mug_is_one_body_without_its_surroundings(tmp_path: Path) -> None:
    path = written(tmp_path, MUG)
    env = build(path)
    model, body = env.sim.model, env.index.bodies["thing"]
    assert model.body_mass[body] == pytest.approx(0.12)  # as the file says, and red as the scene
    assert model.body_mass[env.index.bodies["red"]] == pytest.approx(0.08)
    assert model.opt.gravity.tolist() == [0.0, 0.0, -9.81]
    assert not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    geoms = env.index.geoms["thing"]
    assert [model.geom(geom).name for geom in geoms] == ["thing_cup", ""]
    assert np.all(model.geom_bodyid[geoms] == body)
    assert model.geom_friction[geoms, 0].tolist() == [3.0, 3.0]
    assert env.cfg.scene.objects["thing"].half == pytest.approx([0.03, 0.02, 0.03])
    lines = "\n".join(object_left_behind(str(path), model, fixed=False))
    for part in ("option gravity 0 0 0", "flags contact", "geom floor", "body tray", "light"):
        assert part in lines
    other = build(path, keys=", mass: 0.3, friction: [0.7, 0.01, 0.01], color: [1, 0, 0, 1]")
    assert other.sim.model.body_mass[body] == pytest.approx(0.3)
    assert other.sim.model.geom_friction[geoms, 0].tolist() == [0.7, 0.7]
    ratio = other.sim.model.body_inertia[body] / model.body_inertia[body]
    assert ratio == pytest.approx([2.5] * 3)
    env.close()
    other.close()


NAMED = {  # requests that would keep a body apart from the object's
    "gravcomp": ("", ""),
    "camera k": ("<camera name='k' mode='trackcom'/>", ""),
    "camera t": ("<camera name='t' mode='targetbody' target='b'/>", ""),
    "light l": ("<light name='l' mode='targetbody' target='b'/>", ""),
    "equality": ("", "<equality><weld body1='b'/></equality>"),
}


@pytest.mark.parametrize("left", NAMED)
def test_a_body_that_its_file_names_is_one_with_the_object(tmp_path: Path, left: str) -> None:
    content, end = NAMED[left]
    body = f"<body name='b' gravcomp='{int(left == 'gravcomp')}'><freejoint/>{content}"
    body += "<geom size='0.02' mass='0.05'/></body>"
    path = written(tmp_path, f"<mujoco><worldbody>{body}</worldbody>{end}</mujoco>")
    model = build_model(load_config([f"+scene.objects.w={{file: {path}, xy: [0.38, 0.13]}}"]))
    assert model.body("w").mass[0] == pytest.approx(0.05)
    assert model.body_gravcomp[model.body("w").id] == 0.0
    assert left in "\n".join(object_left_behind(str(path), model, fixed=False))


def test_heights_of_a_turned_mesh_are_those_of_its_points(tmp_path: Path) -> None:
    """Against all vertices: a box around the mesh would reach lower by 10 mm."""
    points = np.random.default_rng(0).normal(size=(60, 3))
    points *= 0.03 / np.linalg.norm(points, axis=1, keepdims=True)
    vertices = " ".join(f"{number:.9g}" for number in points.ravel())
    path = written(
        tmp_path,
        f"<mujoco><asset><mesh name='ball' vertex='{vertices}'/></asset><worldbody>"
        "<body><freejoint/><geom type='mesh' mesh='ball'/></body></worldbody></mujoco>",
    )
    key = f"+scene.objects.thing={{file: {path}, xy: [0.38, 0.13]}}"
    shape, size = load_config([key]).scene.objects["thing"].form
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    turn = np.empty(9)
    for quat in np.random.default_rng(1).normal(size=(20, 4)):
        quat /= np.linalg.norm(quat)
        mujoco.mju_quat2Mat(turn, quat)
        expected = ((points - center) @ turn[6:]).min()
        found = lowest_point(torch.zeros(3).double(), torch.tensor(quat), shape, size)
        assert float(found) == pytest.approx(expected, abs=1e-3)


PAIR = "<body name='{}'><freejoint/><geom size='0.02'/></body>"
LID = (
    "<body><freejoint/><geom size='.02'/><body><joint name='lid'/><geom size='.01'/></body></body>"
)
WRONG = {
    "two bodies": (PAIR.format("a") + PAIR.format("b"), "", "it has 2 free ones."),
    "a joint": (LID, "", "it has joint lid."),
    "no collision": ("<geom size='1' contype='0' conaffinity='0'/>", "", "a geom that collides"),
    "no mesh": ("<geom type='mesh' mesh='none'/>", "", "Correct the object's file"),
    "size": ("<geom size='0.02'/>", "size: [1, 1, 1]", "expected [], because it has parts"),
    "twice": ("<geom size='0.02'/>", "mass: 1, density: 1", "thing.density=1.0: expected null"),
    "fixed mass": ("<geom size='0.02'/>", "fixed: true, mass: 1", "masses of a fixture are its"),
    "free": ("<geom size='0.02'/>", "joints: {lid: {damping: 1}}", "it is no fixture from a file"),
    "mocap": ("<body name='b' mocap='true'><geom size='.1'/></body>", "", "rigid body; body b"),
    "adhesion": (
        "<body name='b'><freejoint/><geom size='.02'/></body></worldbody><actuator>"
        "<adhesion body='b' ctrlrange='0 1'/></actuator><worldbody>",
        "",
        "body b cannot be fused",
    ),
    "fixed mocap": (
        "<body name='b' mocap='true'><geom size='.02'/></body>",
        "fixed: true",
        "scene.objects.thing: mocap body 'thing_b' is not",
    ),
    "range": (LID, "fixed: true, joints: {lid: {range: [0.5, 0.1]}}", "lid.range=[0.5, 0.1]: expe"),
    "empty range": (LID, "fixed: true, joints: {lid: {range: [0, 0]}}", "lid.range=[0.0, 0.0]: ex"),
    "ball": (
        "<body><joint name='b' type='ball'/><geom size='.02'/></body>",
        "fixed: true, joints: {b: {range: [0.1, 0.5]}}",
        "scene.objects.thing: range[0] should be 0 in ball joint",
    ),
    "unknown": (LID, "fixed: true, joints: {lit: {damping: 1}}", "Did you mean 'lid'"),
}


@pytest.mark.parametrize("case", few(WRONG, 2))
def test_a_file_that_is_no_object_is_refused(tmp_path: Path, case: str) -> None:
    body, keys, message = WRONG[case]
    path = written(tmp_path, f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    refusal(lambda: build(path, keys=f", {keys}" * bool(keys)), message)


def test_a_mesh_needs_a_mass(tmp_path: Path) -> None:
    path = write_box(tmp_path / "brick.STL.obj", (0.02, 0.03, 0.01), (0.0, 0.0, 0.0))
    refusal(lambda: build(path), "thing.mass=null: expected a number [kg], or a density: it moves")


def test_joints_of_a_fixture(tmp_path: Path) -> None:
    """A door whose latch is two bodies below it: state, keys, starts, and where it stands."""
    path = written(tmp_path, DOOR)
    door = "fixed: true, yaw: 0.3, joints: {hinge: {damping: 2.5, range: [0.0, 1.0]}}"
    env = build(path, keys=f", {door}")
    model = env.sim.model
    assert list(env.index.joints) == ["thing_hinge", "thing_joint1"]
    hinge = model.joint("thing_hinge")
    assert hinge.range.tolist() == pytest.approx([0.0, 1.0])
    assert hinge.damping.tolist() == [2.5]
    assert model.joint("thing_joint1").range.tolist() == pytest.approx([0.0, np.pi / 4])
    # The file's origin is 0.15 m below the frame's lowest point.
    assert float(above_table(env, "thing")) == pytest.approx(0.0, abs=1e-6)
    height = env.cfg.scene.table_top - 0.15
    assert pose_w(env, "thing")[0, :3].tolist() == pytest.approx([0.38, 0.13, height])
    assert len(env.index.geoms["thing"]) == 3
    qpos, dof = env.index.joints["thing_hinge"]
    env.sim.qpos[:, qpos] = 0.4
    env.sim.qvel[:, dof] = -0.2
    assert fixture_pos(env, joint="thing_hinge").tolist() == [0.4]
    assert fixture_vel(env, joint="thing_hinge").tolist() == [-0.2]
    assert Step(env, ["red"]).joint("thing_hinge").tolist() == [[pytest.approx(0.4)]]
    refusal(lambda: fixture_pos(env, joint="hinge"), "Did you mean 'thing_hinge'")
    env.close()


def test_starts_of_a_fixture_are_drawn_and_come_back_from_a_file(tmp_path: Path) -> None:
    path = written(tmp_path, DOOR)
    ends = "{thing_hinge: [0.2, 0.6], thing_joint1: [0.1, 0.1]}"
    term = f"{{func: mjstack.mdp.reset.FixtureJoints, params: {{joints: {ends}}}}}"
    env = build(path, f"+reset.door={term}", keys=", fixed: true", nworld=8)
    hinge = fixture_pos(env, joint="thing_hinge").clone()
    assert 0.2 <= float(hinge.min()) < float(hinge.max()) <= 0.6
    assert torch.equal(fixture_pos(env, joint="thing_joint1"), torch.full_like(hinge, 0.1))
    write_starts(env, tmp_path / "starts.npz")
    file = f"starts={tmp_path}/starts.npz"
    again = build(path, "reset=starts_file", file, keys=", fixed: true", nworld=8)
    assert torch.equal(again.sim.qpos, env.sim.qpos)
    for wrong in ([0.6, 0.2], [0.0, 1.6], [0.1], 3, ["a", "b"], "ab", {"a": 1, "b": 2}):
        message = "expected two numbers in 0 to 1.5708"
        refusal(partial(FixtureJoints, env, joints={"thing_hinge": wrong}), message)
    message = "joint of a fixture '0' does not exist"  # it would be the first joint of the model
    refusal(partial(FixtureJoints, env, joints={"0": [0.2, 0.6]}), message)
    for wrong in ({}, None, [1], 3):
        refusal(partial(FixtureJoints, env, joints=wrong), "expected a mapping")
    env.close()
    again.close()


@pytest.mark.parametrize(("ends", "start"), [([0.5, 0.9], 0.5), ([-0.9, -0.5], -0.5)])
def test_a_fixture_starts_at_the_end_nearest_to_zero(
    tmp_path: Path, ends: list[float], start: float
) -> None:
    keys = f", fixed: true, joints: {{hinge: {{range: {ends}}}}}"
    env = build(written(tmp_path, DOOR), keys=keys)
    assert fixture_pos(env, joint="thing_hinge").tolist() == [start]
    env.close()


def test_a_fixture_with_pos_may_be_beside_the_table(tmp_path: Path) -> None:
    path = written(tmp_path, DOOR)
    file = f"+scene.objects.thing={{file: {path}, fixed: true, pos: [-0.6, 0.5, -0.1]}}"
    env = make_env([*NATIVE, file], nworld=1)
    assert pose_w(env, "thing")[0, :3].tolist() == [-0.6, 0.5, -0.1]
    env.close()
    refusal(lambda: load_config([file.replace("pos: [-0.6, 0.5, -0.1]", "xy: [-0.6, 0.5]")]), "on")


@pytest.mark.full
def test_the_expert_stacks_a_mesh(tmp_path: Path) -> None:
    path = write_box(tmp_path / "cube.obj", (0.022, 0.022, 0.022), (0.4, -0.3, 0.5))
    cube = [f"scene.objects.red.file={path}", "scene.objects.red.size=[]"]
    assert verify([*cube, "sim=native", "gates=[baseline]"]).status == "pass"
