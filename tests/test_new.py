"""``mjstack new``: a task and a robot of one's own, from templates."""

import os
import runpy
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import pytest
import torch
from doc_blocks import ROOT
from environments import Capture, Patch, Refused

import mjstack
from mjstack.cli import run

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


def test_a_robot_is_read_from_its_file(here: Path) -> None:
    """What the example's own YAML says, as far as the XML tells."""
    assert run(["new", "robot", "fresh_scara", str(ROOT / "examples/scara/scara.xml")]) == 0
    folder = here / "fresh_scara" / "conf"
    robot = mjstack.load_config(["robot=fresh_scara"], config_dir=folder).robot
    example = mjstack.load_config(["robot=scara"], config_dir=ROOT / "examples/scara/conf").robot
    for key in ("file", "arm_joints", "gripper_joints", "jaw_bodies", "grasp_sites"):
        assert getattr(robot, key) == getattr(example, key), key
    assert robot.gripper_open == [0.05, 0.05]
    assert robot.home == [0.0, 0.1, 0.0, 0.0, 0.0, 0.0]  # within the elbow's range
    assert run(["new", "robot", "fresh_arm", str(ROOT / "mjstack/robots/so101.xml")]) == 0
    arm = mjstack.load_config(["robot=fresh_arm"], config_dir=here / "fresh_arm" / "conf").robot
    builtin = mjstack.load_config().robot
    for key in ("arm_joints", "gripper_joints", "jaw_bodies", "grasp_sites"):
        assert getattr(arm, key) == getattr(builtin, key), key


NAMES = [
    "01", "Revolute: 2", "Slider, 3", "回転#4", "a\\b", "a\\", "it's", '"x"', "*x", "null", "1",
    "1e5", "~", "&x", "{a: 1}", "x] # y", "x\ny: 1", "- x", "$HOME", "@NAME@", "🤖", " x ", "<<",
    "true", "\x85",
]  # fmt: skip


def arm(names: Sequence[str]) -> str:
    """An MJCF file with a body, a joint and a site for each name, one on the other."""
    bodies = [
        f"<body name={quoteattr(f'{name} body')}><joint name={quoteattr(name)}/>"
        f"<geom size='0.1'/><site name={quoteattr(f'{name} site')}/>"
        for name in names
    ]
    text = f"<mujoco><worldbody>{''.join(bodies)}{'</body>' * len(bodies)}</worldbody></mujoco>"
    return text.replace("\n", "&#10;")


def test_names_come_back_as_they_are(here: Path) -> None:
    """Whatever they would mean in YAML; of the file, bodies and sites too."""
    folder = here / "it's a: #1\nname: x"
    folder.mkdir()
    file = folder / "arm.xml"
    file.write_text(arm([*NAMES, "left finger", "right finger"]))
    assert run(["new", "robot", "odd", str(file)]) == 0
    robot = mjstack.load_config(["robot=odd"], config_dir=here / "odd" / "conf").robot
    assert robot.name == "odd"
    assert robot.arm_joints == NAMES
    assert robot.gripper_joints == ["left finger", "right finger"]
    assert robot.jaw_bodies == ["left finger body", "right finger body"]
    assert robot.grasp_sites == ["left finger site", "right finger site"]
    assert robot.file == str(file)


REFUSED = {
    "interpolation": (arm(["x${oc.env:HOME}", "jaw"]), "'x${oc.env:HOME}' in it means something"),
    "missing value": (arm(["???", "jaw"]), "'???' in it means something else"),
    "no joints": ("<mujoco><worldbody/></mujoco>", "it has 0 hinges and slides, fewer than"),
    "free": (
        "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>",
        "it has 0 hinges and slides",
    ),
    "no name": (arm(["", "jaw"]).replace('joint name=""', "joint"), "the name '' in it"),
    "text": ("<mujoco", "expected an MJCF file: XML parse error"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_robot_that_no_profile_can_name_is_refused(
    name: str, here: Path, refused: Refused
) -> None:
    content, message = REFUSED[name]
    (here / "arm.xml").write_text(content)
    line = refused("new", "robot", "odd", "arm.xml")
    assert line.startswith("mjstack: arm.xml: expected an MJCF file: ")
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
        ("new robot arm nope.xml", "nope.xml: expected an MJCF file: "),
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
