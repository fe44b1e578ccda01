"""``mjstack new``: a task and a robot of one's own, from templates."""

import runpy
from pathlib import Path

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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("new", "new : expected task, driver or action NAME, or robot NAME FILE.xml"),
        ("new task", "new task: expected task, driver or action NAME"),
        ("new robot arm", "new robot arm: expected task, driver or action NAME, or robot"),
        ("new task Lift", "new task Lift: expected small letters, digits and _"),
        ("new task stack", "and no folder, task or Python module of that name. Choose another"),
        ("new task json", "Python module of that name"),
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
