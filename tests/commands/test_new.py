"""``mjstack new``: a task and a robot of one's own, from templates."""

import math
import os
import runpy
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import mujoco
import numpy as np
import pytest
import torch
from doc_blocks import ROOT
from environments import Capture, Patch, Refused, few
from omegaconf import OmegaConf

import mjstack
from mjstack.cli import run
from mjstack.config.schema import Config
from mjstack.episodes.rollout import Hook
from mjstack.episodes.stage import Stage
from mjstack.errors import MjstackError
from mjstack.jobs.new_robot import show_guesses
from mjstack.mdp.geometry import jaw_forces
from mjstack.report import picture
from mjstack.robots.hand import find_hands
from mjstack.robots.new import write_new
from mjstack.robots.tips import Fingers
from mjstack.scene.build import build_model

GATES = "gates=[baseline,parity,capacity,batch]"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: Patch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_task_passes_as_it_is_written(here: Path, capsys: Capture) -> None:
    assert run(["new", "task", "fresh_task"]) == 0
    files = ["conf/task/fresh_task.yaml", "fresh_task.py", "test_fresh_task.py"]
    assert capsys.readouterr().out.split() == [f"fresh_task/{file}" for file in files]
    overrides = ["task=fresh_task", "sim=native", "nworld=2", "gates=[baseline,batch]"]
    result = mjstack.verify(overrides, config_dir=here / "fresh_task" / "conf")
    assert result.status == "pass", result.messages


@pytest.mark.full
@pytest.mark.parametrize("arm", ["so101", "rebot"])
def test_it_passes_the_gates_with_both_robots(arm: str, here: Path) -> None:
    assert run(["new", "task", f"fresh_{arm}"]) == 0
    folder = here / f"fresh_{arm}"
    overrides = [f"task=fresh_{arm}", f"robot={arm}", "nworld=4", "gate.capacity.cpu_nworld=2"]
    result = mjstack.verify([*overrides, GATES], config_dir=folder / "conf")
    assert result.status == "pass", result.messages
    if arm == "rebot":
        runpy.run_path(str(folder / f"test_fresh_{arm}.py"))["test_the_gates_pass"]()


@pytest.mark.parametrize(
    ("name", "file", "config"),
    [
        ("scara", "examples/scara/scara.xml", ["robot=scara"]),
        pytest.param("so101", "mjstack/robots/so101.xml", [], marks=pytest.mark.full),
    ],
)
def test_a_robot_is_read_from_its_file(
    name: str, file: str, config: list[str], here: Path, capsys: Capture
) -> None:
    """What the project's own YAML says of it, and gate *baseline* passes as it is written."""
    assert run(["new", "robot", f"read_{name}", str(ROOT / file)]) == 0
    printed = capsys.readouterr().out
    assert "pass baseline" in printed
    assert "branches" in printed or "one jaw" in printed
    folder = here / f"read_{name}"
    assert (folder / "home.png").stat().st_size > 10_000 or "offscreen" in printed
    robot = mjstack.load_config([f"robot=read_{name}"], config_dir=folder / "conf").robot
    own = mjstack.load_config(config, config_dir=ROOT / "examples/scara/conf").robot
    for key in ("arm_joints", "gripper_joints", "jaw_bodies", "roll_joint", "approach_axis"):
        assert getattr(robot, key) == getattr(own, key), key
    assert Path(str(robot.file)).samefile(ROOT / file)
    assert [joint for joint in robot.arm_joints if joint in robot.locked] == [*own.locked]
    # The nominal plan closes the jaws on two faces of the first cube
    stage = Stage(mjstack.load_config([f"robot=read_{name}"], config_dir=folder / "conf"))
    data = mujoco.MjData(stage.model)
    grasp = [phase.grasped >= 0 for phase in stage.planner.phases].index(True)
    data.qpos[stage.index.robot_qpos] = stage.planner.nominal[grasp]
    mujoco.mj_kinematics(stage.model, data)
    x, y, _ = np.subtract(*data.site_xpos[stage.index.grasp_sites])
    assert abs(math.remainder(math.atan2(y, x), 0.5 * math.pi)) < 0.15


NAMES = [
    "01", "Revolute: 2", "Slider, 3", "回転#4", "a\\b", "a\\", "it's", '"x"', "*x", "null", "1",
    "1e5", "~", "&x", "{a: 1}", "x] # y", "x\ny: 1", "- x", "$HOME", "@NAME@", "🤖", " x ", "<<",
    "true", "\x85",
]  # fmt: skip


PLAIN = ["x", "y", "z", "roll", "left", "right", "bridge", "hand", "left jaw", "right jaw"]


SERVO = "<position joint='{0}' kp='500' kv='50'/>"


def gantry(
    names: Sequence[str] = PLAIN,
    *,
    actuators: str = SERVO,
    roll: str = "range='-3 3'",
    right: str = SERVO,
    more: str = "",
    base: str = "",
    world: str = "",
    root: str = "",
    ball: str = "",
    link: str = "",
) -> str:
    """An MJCF file of three slides, a roll and two fingers; ``names`` are those of its joints and
    of some of its bodies.
    """
    x, y, z, turn, left, rightmost, bridge, hand, one, two = (
        escape(n, {'"': "&quot;", "\n": "&#10;", "\r": "&#13;"}) for n in names
    )
    servos = "".join(actuators.format(name) for name in (x, y, z, turn, left))
    return f"""<mujoco><compiler angle="radian"/>
    <default><geom mass="0.1"/><joint damping="1" armature="0.01"/></default>
    <worldbody>{world}<body pos="0 0 0.5" {base}>{root}
      <body name="{bridge}">
        <joint name="{x}" type="slide" axis="1 0 0" range="-0.4 0.4"/>
        <joint name="{y}" type="slide" axis="0 1 0" range="-0.4 0.4"/><geom size="0.02"/>
        <body><joint name="{z}" type="slide" axis="0 0 1" range="-0.45 0"/><geom size="0.02"/>{link}
          <body name="{hand}"><joint name="{turn}" axis="0 0 1" {roll}/>
            <geom type="box" size="0.02 0.06 0.01" pos="0 0 -0.03"/>
            <body name="{one}"><joint name="{left}" type="slide" axis="0 1 0" range="0 0.04"/>
              <geom type="box" size="0.01 0.005 0.03" pos="0 0.005 -0.07" friction="1.5"/>
              {ball}</body>
            <body name="{two}"><joint name="{rightmost}" type="slide" axis="0 -1 0" range="0 0.04"/>
              <geom type="box" size="0.01 0.005 0.03" pos="0 -0.005 -0.07" friction="1.5"/></body>
          </body></body></body></body></worldbody>
    <actuator>{servos}{right.format(rightmost)}</actuator>{more}</mujoco>"""


MIMIC = "<equality><joint joint1='right' joint2='left' polycoef='0 1 0 0 0'/></equality>"
TENDON = (
    "<tendon><fixed name='t'><joint joint='left' coef='0.5'/><joint joint='right' coef='0.5'/>"
    "</fixed></tendon><actuator><general tendon='t' gainprm='4' biasprm='0 -1000 -30' biastype="
    "'affine' ctrlrange='0 10'/></actuator>"
)
KINDS: dict[str, tuple[dict[str, str], dict[str, object]]] = {
    "two servos": ({}, {"gripper_joints": ["left", "right"], "gripper_open": [0.04, 0.04]}),
    "a finger that follows": (
        {"right": "", "more": MIMIC},
        {"gripper_joints": ["left"], "jaw_bodies": ["left jaw", "right jaw"]},
    ),
    "no range": ({"roll": ""}, {"ranges": {"roll": [-6.283, 6.283]}, "roll_joint": "roll"}),
    "a whole scene": (
        {
            "world": "<geom type='plane' size='1 1 1'/><geom name='table' type='box' size='1 1 .1'"
            " pos='0 0 -.1'/><body name='cube'><freejoint/><geom name='cube' size='.02'/></body>"
        },
        {"root": "unnamed_2"},
    ),
    "a base that floats": ({"root": "<freejoint/><geom size='.05'/>"}, {"root": "bridge"}),
    "a base that drives": (
        {"root": "<joint name='d' type='slide' axis='1 0 0'/><geom size='.05'/>"},
        {"root": "bridge", "arm_joints": ["x", "y", "z", "roll"]},
    ),
    "a torso with another arm": (
        {
            "root": "<joint name='torso' axis='0 0 1' range='-1 1'/><geom size='.05'/><body>"
            "<joint name='other' axis='0 1 0' range='-1 1'/><geom size='.05'/></body>",
            "right": SERVO + SERVO.format("torso") + SERVO.format("other"),
        },
        {"root": "bridge"},
    ),
    "a link beside the arm": (
        {"link": "<body pos='0 .1 0'><joint name='link' axis='0 1 0'/><geom size='.02'/></body>"},
        {"root": None},
    ),
}


def guess(text: str, arm: str = "") -> dict[str, Any]:
    """The YAML as it is written: its reader refuses a key that is there twice."""
    Path("arm.xml").write_text(text)
    paths, _ = write_new(["robot", f"guess_{len(list(Path().iterdir()))}", "arm.xml"], arm)
    written: dict[str, Any] = OmegaConf.to_container(OmegaConf.load(paths[0]))  # type: ignore
    return written


@pytest.mark.parametrize("kind", few(KINDS, 3))
def test_files_of_many_kinds_are_read(kind: str, here: Path) -> None:
    options, expected = KINDS[kind]
    robot = guess(gantry(**options))
    assert {key: robot.get(key) for key in expected} == expected
    assert robot["approach_axis"] == [0.0, 0.0, -1.0]
    assert robot["arm_joints"] == ["x", "y", "z", "roll"]
    assert "servos" not in robot
    point = np.mean([robot["grasp_pos"][site] for site in robot["grasp_sites"]], axis=0)
    assert point == pytest.approx([0.0, 0.0, -0.084], abs=2e-4)  # 16 mm above the tips' ends
    center = robot["placements"]["stack"]["table_center"]
    assert center[2] == 0.012


def urdf() -> str:
    """The gantry as a URDF."""
    axes = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1", "roll": "0 0 1"}
    axes |= {"left": "0 1 0", "right": "0 -1 0"}
    parents = ["base", "x", "y", "z", "roll", "roll"]
    low = {"x": -0.4, "y": -0.4, "z": -0.45, "roll": -3.0}
    high = {"x": 0.4, "y": 0.4, "roll": 3.0, "left": 0.04, "right": 0.04}
    box = {"roll": ("0 0 -.03", ".04 .12 .02"), "left": ("0 .005 -.07", ".02 .01 .06")}
    box["right"] = ("0 -.005 -.07", ".02 .01 .06")
    text = "<link name='base'/>"
    for (name, axis), parent in zip(axes.items(), parents, strict=True):
        at, size = box.get(name, ("0 0 0", ".02 .02 .02"))
        text += f"""<link name='{name}_link'>
          <inertial><mass value='.1'/><inertia ixx='1e-4' iyy='1e-4' izz='1e-4' ixy='0' ixz='0'
            iyz='0'/></inertial>
          <collision><origin xyz='{at}'/><geometry><box size='{size}'/></geometry></collision>
        </link><joint name='{name}' type='{"revolute" if name == "roll" else "prismatic"}'>
          <parent link='{parent if parent == "base" else parent + "_link"}'/>
          <child link='{name}_link'/><axis xyz='{axis}'/>
          <origin xyz='0 0 {0.5 * (name == "x")}'/>
          <limit lower='{low.get(name, 0.0)}' upper='{high.get(name, 0.0)}' effort='50'
            velocity='1'/></joint>"""
    return f"<robot name='gantry'>{text}</robot>"


def test_a_urdf_is_read_as_an_mjcf_file(here: Path) -> None:
    robot = guess(urdf())
    assert robot["arm_joints"] == ["x", "y", "z", "roll"]
    assert robot["gripper_joints"] == ["left", "right"]
    assert robot["servos"].keys() == {"x", "y", "z", "roll", "left", "right"}
    point = np.mean([robot["grasp_pos"][site] for site in robot["grasp_sites"]], axis=0)
    assert point == pytest.approx([0.0, 0.0, -0.084], abs=2e-4)


def test_servos_are_made_where_the_file_has_motors_or_none(here: Path) -> None:
    motors = gantry(actuators="<motor joint='{0}' ctrlrange='-9 9' gear='2'/>", right="")
    robot = guess(motors.replace("</actuator>", "</actuator>" + MIMIC))
    assert list(robot["servos"]) == ["x", "y", "z", "roll", "left"]
    assert {servo["effort"] for servo in robot["servos"].values()} == {18.0}
    ball = "<body pos='0 0 -0.06'><joint name='b' type='ball'/><inertial mass='0.01' pos='0 0 0'"
    ball += " diaginertia='1e-6 1e-6 1e-6'/></body>"  # not a joint of the gripper
    bare = guess(gantry(actuators="", right="", ball=ball))
    assert list(bare["servos"]) == ["x", "y", "z", "roll", "left", "right"]
    assert bare["servos"]["z"]["effort"] > 3.0 * 0.4 * 9.81  # what hangs on it


TENDON_ONLY = gantry(right="", more=TENDON).replace(SERVO.format("left"), "")
MOTOR = "<motor joint='{0}' ctrlrange='-90 90'/>"
WEAK = {"joint='left' kp='500'": "joint='left' kp='20'", "right' kp='500'": "right' kp='20'"}
GEARED = "<position joint='x' kp='125' kv='12' gear='2' ctrlrange='{}'/>"
FINGER = SERVO.replace("/>", " forcerange='-0.5 0.5'/>")


def altered(text: str, pairs: dict[str, str]) -> str:
    for old, new in pairs.items():
        assert old in text
        text = text.replace(old, new)
    return text


@pytest.mark.parametrize(
    ("text", "joints", "efforts"),
    few([
        (altered(gantry(), {SERVO.format("x"): MOTOR.format("x"), **WEAK}), "x left right", {90.0}),
        (altered(gantry(), {f: FINGER.format(n) for n in ("left", "right")
         if (f := SERVO.format(n))}), "left right", {40.0}),
        (TENDON_ONLY, "", set()),
        (TENDON_ONLY.replace("gainprm='4' biasprm='0 -1000 -30' biastype='affine'", "gainprm='4'"),
         "left right", {20.0}),
        (TENDON_ONLY.replace("gainprm", "dyntype='filter' dynprm='0.05' gainprm"), "left right",
         set()),
    ], 2),
    ids=["motor and weak fingers", "force", "tendon", "tendon motor", "tendon filter"],
)  # fmt: skip
def test_servos_are_made_where_others_do_not_do(
    text: str, joints: str, efforts: set[float], here: Path
) -> None:
    robot = guess(text)
    servos = robot.get("servos", {})
    assert list(servos) == joints.split()
    assert efforts <= {servo.get("effort") for servo in servos.values()}
    assert build_model(read("guess_1")).nu == 6


def read(name: str) -> Config:
    return mjstack.load_config([f"robot={name}"], config_dir=Path(name) / "conf")


@pytest.mark.full
def test_home_is_within_the_range_of_a_geared_servo(here: Path) -> None:
    for ends, low, high in (("0.2 0.6", 0.1, 0.3), ("-0.6 -0.2", -0.3, -0.1)):
        robot = guess(gantry().replace(SERVO.format("x"), GEARED.format(ends)))
        assert low <= robot["home"][0] <= high


@pytest.mark.full
def test_the_reason_tells_the_force_of_the_jaws(here: Path) -> None:
    """Less than 20 N, where the file's own servos have no more; it is enough for a cube."""
    for limit in (8.0, 200.0):
        fingers = {SERVO.format(n): SERVO.format(n).replace("/>", f" forcerange='-{limit} {limit}'"
                   "/>").replace("500", "5000") for n in ("left", "right")}  # fmt: skip
        robot = guess(altered(gantry(), fingers))
        text = next(Path().glob(f"guess_*/conf/robot/{robot['name']}.yaml")).read_text()
        assert f"to press with {min(limit, 20.0):.0f} N\n" in text
        assert "servos" not in robot
    # As much as they do, though a cube gives way
    cfg = mjstack.load_config(
        [f"robot={robot['name']}", "sim=native"], config_dir=f"{robot['name']}/conf"
    )
    stage = Stage(cfg)
    forces: list[Any] = []
    look = Hook(lambda _, sim: forces.append(jaw_forces(stage.index, sim, "red")[0].tolist()))
    stage.play(stage.batch_simulation(1), cfg.reset, [look])
    assert forces[stage.phase("grasp_red").stop - 1] == pytest.approx([20.0, 20.0], rel=0.2)


@pytest.mark.parametrize("lean", [0.0, 0.3])
def test_jaws_touch_the_cube_where_they_lean(lean: float) -> None:
    """Of fingers that are nearer to each other at their roots, a cube's upper edges count."""
    text = gantry()
    for sign in ("", "-"):
        jaw = f'pos="0 {sign}0.005 -0.07"'
        assert jaw in text
        text = text.replace(jaw, f'{jaw} euler="{sign}{lean} 0 0"')
    spec = mujoco.MjSpec.from_string(text)
    hand = find_hands(spec.compile())[0]
    grip = Fingers(spec, hand, np.array([[0.0, 0.04], [0.0, 0.04]])).measure(0.044)
    spec.body("hand").add_geom(
        name="cube", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.022] * 3, pos=grip.point
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[list(hand.gripper)]] = grip.touching
    mujoco.mj_kinematics(model, data)
    for jaw in grip.jaws:
        side = (model, data, model.geom("cube").id, int(model.body_geomadr[jaw]))
        assert mujoco.mj_geomDistance(*side, 1.0, None) == pytest.approx(0.0, abs=2e-4)


def test_the_picture_has_followers_in_their_places(here: Path, monkeypatch: Patch) -> None:
    guess(gantry(right="", more=MIMIC))
    drawn: list[Any] = []
    monkeypatch.setattr(picture, "save_scene", lambda _, *scene: drawn.append(scene))
    show_guesses([], read("guess_1"), Path("home.png"))
    model, qpos = drawn[0]
    left, right = (qpos[model.joint(name).qposadr[0]] for name in ("left", "right"))
    assert right == pytest.approx(left, abs=1e-6)
    assert left == pytest.approx(0.04)


def test_a_weak_gripper_gets_stiffer_servos(here: Path) -> None:
    robot = guess(gantry(right="<position joint='{0}' kp='20' kv='2'/>").replace("500", "20", 1))
    assert "servos" not in robot  # the arm's are the file's own
    weak = gantry().replace("joint='left' kp='500'", "joint='left' kp='20'")
    robot = guess(weak.replace("joint='right' kp='500'", "joint='right' kp='20'"))
    first, second = robot["servos"].values()
    assert first == second
    assert first["stiffness"] * 0.022**2 * 2 / 0.044 == pytest.approx(20.0, rel=0.02)  # N


def test_one_of_two_arms_is_chosen(here: Path) -> None:
    one, two = (
        gantry([f"{side} {name}" for name in PLAIN]).replace('pos="0 0 0.5"', f'pos="0 {y} 0.5"')
        for side, y in (("a", 0.6), ("b", -0.6))
    )
    body, servos = (two.split(f"<{t}>")[1].split(f"</{t}>")[0] for t in ("worldbody", "actuator"))
    both = one.replace("</worldbody>", body + "</worldbody>")
    both = both.replace("</actuator>", servos + "</actuator>")
    robot = guess(both)
    assert (robot["arm_joints"][0], robot["base"]["pos"][1]) == ("a x", -0.6)
    robot = guess(both, "B X")
    assert (robot["arm_joints"][0], robot["base"]["pos"][1]) == ("b x", 0.6)
    with pytest.raises(MjstackError, match="--arm c x: expected a part of a name of a hand or b"):
        guess(both, "c x")
    level = both.replace('pos="0 -0.6 0.5"', 'pos="0 -0.6 0.5" quat="1 1 0 0"')
    with pytest.raises(MjstackError, match="the hand of b hand cannot point down"):
        guess(level, "b x")


@pytest.mark.full
def test_a_high_arm_gets_a_table_in_its_reach(here: Path) -> None:
    """On a pedestal the table is higher; below the floor the base is."""
    for height, base, table in ((1.2, None, 0.7), (0.0, 0.5, 0.012)):
        robot = guess(gantry().replace('pos="0 0 0.5"', f'pos="0 0 {height}"'))
        raised = robot.get("base", {"pos": [0, 0, 0]})["pos"][2]
        assert raised == pytest.approx(base or 0.0, abs=0.2)
        found = robot["placements"]["stack"]["table_center"][2]
        assert found == pytest.approx(table, abs=0.2)


def test_names_come_back_as_they_are(here: Path) -> None:
    """Whatever they would mean in YAML; of the file, bodies and sites too."""
    folder = here / "it's a: #1\nname: x"
    folder.mkdir()
    file = folder / "arm.xml"
    files = [[*NAMES[k : k + 10], *PLAIN][:10] for k in range(0, len(NAMES), 10)]
    files.append([f"{k}{b}gravcomp: false{b}#" for k, b in enumerate(2 * "\n\r\x85\u2028\u2029")])
    for number, names in enumerate(files):
        file.write_text(gantry(names))
        name = f"odd_{number}"
        write_new(["robot", name, str(file)])
        robot = mjstack.load_config([f"robot={name}"], config_dir=here / name / "conf").robot
        assert robot.name == name
        assert robot.gravcomp == "auto"
        assert robot.joints == names[:6]
        assert robot.approach_body == names[7]
        assert sorted(robot.jaw_bodies) == sorted(names[8:])
        assert robot.file == str(file)


def test_a_joint_without_a_name_has_its_number(here: Path) -> None:
    """As the scene names it, with a servo, which the file cannot name it for."""
    robot = guess(gantry().replace('name="z"', ""))
    assert robot["arm_joints"] == ["x", "y", "unnamed_2", "roll"]
    assert [*robot["servos"]] == ["unnamed_2"]


ROLL_ALONE = gantry().split('<body name="left jaw">')[0] + 4 * "</body>" + "</worldbody></mujoco>"
REFUSED = {
    "interpolation": (gantry(["x${oc.env:HOME}", *PLAIN[1:]]), "'x${oc.env:HOME}' in it means"),
    "missing value": (gantry(["???", *PLAIN[1:]]), "'???' in it means something else"),
    "no joints": ("<mujoco><worldbody/></mujoco>", "expected an arm of two joints or more"),
    "free": (
        "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>",
        "no body has fingers, or one jaw, at the end of joints",
    ),
    "no gripper": (ROLL_ALONE, "its fingers do not close on each other"),
    "sideways": (
        gantry().replace('pos="0 0 0.5"', 'pos="0 0 0.5" quat="1 1 0 0"'),
        "the hand of hand cannot point down over a table within the arm's reach",
    ),
    "thick fingers": (gantry().replace("0 0.04", "0 0.01"), "its fingers open by 20 mm only"),
    "balls": (
        gantry(actuators="", right="")
        .replace('type="slide" axis="0 1 0" range="0 0.04"', 'type="ball"')
        .replace('type="slide" axis="0 -1 0" range="0 0.04"', 'type="ball"'),
        "expected an arm of two joints or more with a gripper; no body has fingers",
    ),
    "a loose finger": (
        gantry(
            ball="<body name='tip' pos='0 0 -.1'><joint type='ball'/><geom size='.005'/></body>"
        ),
        "body tip of its hand hangs on a ball joint, which no servo moves",
    ),
    "a finger that is held": (
        gantry(more="<equality><joint joint1='left' polycoef='.02 0 0 0 0'/></equality>"),
        "joint left is held at one place by an equality, expected one that moves",
    ),
    "along z": (
        gantry()
        .replace('axis="0 1 0" range="0 0.04"', 'axis="0 0 1" range="0 0.04"')
        .replace('axis="0 -1 0" range="0 0.04"', 'axis="0 0 1" range="0 0.04"'),
        "its fingers do not close on each other",
    ),
    "text": ("<mujoco", "arm.xml cannot be read: XML parse error"),
}


@pytest.mark.parametrize("name", few(REFUSED, 2))
def test_a_file_that_no_profile_fits_is_refused(name: str, here: Path, refused: Refused) -> None:
    content, message = REFUSED[name]
    (here / "arm.xml").write_text(content)
    line = refused("new", "robot", "odd", "arm.xml")
    assert message in line
    assert not (here / "odd").exists()


def test_a_robot_from_a_pipe_is_refused(here: Path, refused: Refused) -> None:
    os.mkfifo(here / "arm.xml")
    assert "it is no regular file" in refused("new", "robot", "odd", "arm.xml")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("new", "new : expected task, driver or action NAME, or robot NAME FILE.xml"),
        ("new task", "new task: expected task, driver or action NAME"),
        ("new robot arm", "new robot arm: expected task, driver or action NAME, or robot"),
        ("new task Lift", "new task Lift: expected small letters, digits and _"),
        ("new task stack", "and no folder, task or Python module of that name. Choose another"),
        ("new task json", "Python module of that name"),
        ("new task antigravity.x", "expected small letters, digits and _"),
        ("new task __main__", "expected small letters, digits and _"),
        (f"new task {'x' * 300}", "expected small letters, digits and _"),
        ("new robot arm nope.xml", "nope.xml: expected an MJCF file or a URDF: "),
    ],
)
def test_a_name_that_is_taken_is_refused(
    words: str, message: str, here: Path, refused: Refused
) -> None:
    assert message in refused(*words.split())


def test_a_driver_and_an_action_play_as_they_are_written(here: Path) -> None:
    assert run(["new", "driver", "fresh_driver"]) == 0
    overrides = ["task=reach", "sim=native", "nworld=2", "task.check.distance=10.0"]
    played = [*overrides, "controller=fresh_driver", "gates=[batch]"]
    result = mjstack.verify(played, config_dir=Path("fresh_driver/conf"))
    assert result.status == "pass", result.messages
    assert run(["new", "action", "fresh_action"]) == 0
    env = mjstack.make_env([*overrides, "action=fresh_action"], config_dir="fresh_action/conf")
    env.reset(seed=0)
    before = env.sim.ctrl.clone()
    env.step(torch.ones(2, env.action_manager.action_dim))
    change = (env.sim.ctrl - before)[:, : env.index.n_arm]
    torch.testing.assert_close(change, torch.full_like(change, 0.05))
    env.close()
    for args in (["driver"], ["driver", "a", "b"], ["gate", "x"], ["action", "ee_delta"]):
        assert run(["new", *args]) == 2
