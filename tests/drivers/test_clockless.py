"""The expert without a clock: accepted without phases, and a function of the state alone."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from compositions import load_config
from doc_blocks import ROOT, write_files
from environments import GetStage

import mjstack
from mjstack import load_config as load_from
from mjstack.cli import run
from mjstack.config.schema import Config
from mjstack.drivers.clockless import ClocklessDriver
from mjstack.drivers.moves import Move, find_moves
from mjstack.envs import Env
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError
from mjstack.scene.phases import build_phases
from mjstack.train.clone_network import input_noise
from mjstack.train.trainer import with_observation

EXPERT = ["controller=closed_loop", "controller.clock=false"]


def started(get_stage: GetStage, robot: str, *overrides: str, nworld: int) -> tuple[Stage, Env]:
    """Worlds that have started, and their stage."""
    stage = get_stage(robot, *EXPERT, "sim=native", "reset=jitter", *overrides)
    return stage, stage.start(stage.batch_simulation(nworld), stage.cfg.reset)


@pytest.mark.parametrize(
    ("robot", "task", "steps"),
    [
        ("so101", "stack", 200),
        pytest.param("rebot", "stack", 260, marks=pytest.mark.full),
        pytest.param("so101", "box", 320, marks=pytest.mark.full),
        pytest.param("rebot", "box", 400, marks=pytest.mark.full),
    ],
)
def test_episodes_are_accepted(get_stage: GetStage, robot: str, task: str, steps: int) -> None:
    """The episode is as long as the expert needs, and the window of rest."""
    accept(get_stage(robot, f"task={task}", *EXPERT, "sim=native", "reset=randomized"), steps)


@pytest.mark.parametrize(
    ("robot", "task", "steps"),
    [
        ("so101", "peg", 240),
        pytest.param("rebot", "peg", 300, marks=pytest.mark.full),
        ("so101", "slot", 260),
        pytest.param("rebot", "slot", 420, marks=pytest.mark.full),
        ("so101", "push", 180),
        pytest.param("rebot", "push", 260, marks=pytest.mark.full),
        ("so101", "lift", 170),
        pytest.param("rebot", "lift", 170, marks=pytest.mark.full),
        pytest.param("so101", "tower", 520, marks=pytest.mark.full),
    ],
)
def test_tasks_of_ones_own_are_accepted(
    robot: str, task: str, steps: int, folder: Callable[[str], Path]
) -> None:
    choices = [f"robot={robot}", f"task={task}", *EXPERT, "sim=native", "reset=randomized"]
    accept(Stage(load_from(choices, config_dir=folder(task))), steps)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The configuration folder of an example, or of a task of the guide."""
    guide = tmp_path_factory.mktemp("guide")
    write_files((ROOT / "docs" / "own_tasks.md").read_text(encoding="utf-8"), guide)

    def find(task: str) -> Path:
        example = ROOT / "examples" / task / "conf"
        return example if example.is_dir() else guide / task / "conf"

    return find


def accept(whole: Stage, steps: int) -> None:
    """Play an episode of that many steps in a few worlds, all of which succeed."""
    cfg = replace(whole.cfg, task=replace(whole.cfg.task, episode_steps=steps))
    stage = whole.with_config(cfg)
    episode = stage.play(stage.batch_simulation(4), cfg.reset)
    assert not episode.failed.any(), stage.check.rules.failing(episode.failed)


def test_a_command_is_a_function_of_the_state(get_stage: GetStage) -> None:
    """A driver that has never been asked gives the same command, in whatever step it is asked."""
    stage, env = started(get_stage, "so101", nworld=2)
    driver = stage.driver(env)
    other = stage.start(stage.batch_simulation(2), stage.cfg.reset, seed=7)
    fresh = stage.driver(other)
    assert isinstance(driver, ClocklessDriver)
    seen = set()
    for step in range(84):
        command = driver.command()
        if step % 4 == 0:
            for name in ("qpos", "qvel", "sensordata", "xpos", "xquat"):
                getattr(other.sim, name).copy_(getattr(env.sim, name))
            torch.testing.assert_close(fresh.command(), command, rtol=0.0, atol=0.0)
            seen |= set(driver.due.tolist())
        env.step(command)
    assert len(seen) >= 4  # over red, close, over blue and more
    env.close()
    other.close()


def test_moves_are_found_in_the_phases(folder: Callable[[str], Path]) -> None:
    _, box = find(load_config(["task=box"]))
    names = list(load_config(["task=box"]).controller.phases)
    assert (box.name, box.way, names[box.close]) == ("blue", "grasp", "close_blue")
    assert [names[k] for k in box.reach] == ["approach_blue", "descend_blue"]
    assert [names[k] for k in box.carry] == ["carry_blue", "hold_blue"]
    assert [names[k] for k in box.lifts] == ["lift_blue", "carry_blue", "hold_blue"]
    assert (names[box.open], names[box.retreat]) == ("open_blue", "retreat_blue")
    (reach,) = find(load_config(["task=reach"]))
    assert (reach.way, reach.reach, reach.close, reach.carry) == ("approach", [0, 1], 1, [1])


def test_of_phases_to_the_same_target_the_last_is_a_way(folder: Callable[[str], Path]) -> None:
    cfg = load_from(["task=slot"], config_dir=folder("slot"))
    (slot,) = find(cfg)
    names = list(cfg.controller.phases)
    assert [names[k] for k in slot.carry] == ["carry", "ready", "slide"]


def test_an_object_that_nothing_lets_go_of_is_kept(folder: Callable[[str], Path]) -> None:
    cfg = load_from(["task=lift"], config_dir=folder("lift"))
    (move,) = find(cfg)
    names = list(cfg.controller.phases)
    assert (move.name, move.way, names[move.close]) == ("can", "grasp", "grasp")
    assert {names[k] for k in (*move.carry, move.open, move.retreat)} == {"lift"}


def test_closed_jaws_that_leave_an_object_for_its_goal_push_it(
    folder: Callable[[str], Path],
) -> None:
    cfg = load_from(["task=push"], config_dir=folder("push"))
    (move,) = find(cfg)
    names = list(cfg.controller.phases)
    assert (move.name, move.way) == ("puck", "push")
    numbers = [*move.reach, move.close, *move.carry, move.open, move.retreat]
    assert [names[k] for k in numbers] == [
        "above", "descend", "descend", "push", "release", "retreat",
    ]  # fmt: skip
    first, *others = build_phases(cfg)
    held = replace(first, spec=replace(first.spec, gripper="open"))
    # Without the gripper opening, what leads away comes after the push.
    up = [replace(phase, spec=replace(phase.spec, gripper="closed")) for phase in others[2:]]
    (move,) = find_moves(cfg, [held, others[0], others[1], up[1]])
    assert (move.carry, move.open, move.retreat) == ([2], 3, 3)


def test_a_push_goes_on_from_wherever_the_arm_is(folder: Callable[[str], Path]) -> None:
    """Pulled up in the middle of a push."""
    choices = ["task=push", *EXPERT, "sim=native", "reset=jitter"]
    stage = Stage(load_from(choices, config_dir=folder("push")))
    env = stage.start(stage.batch_simulation(1), stage.cfg.reset)
    driver = stage.driver(env)
    for step in range(160):
        command = driver.command().clone()
        if 45 <= step < 55:
            command[:, 1] -= 0.02
        env.step(command)
    puck = env.state
    assert stage.check.placed(puck).all()
    assert puck.untouched.all()
    env.close()


def find(cfg: Config) -> list[Move]:
    return find_moves(cfg, build_phases(cfg))


def test_an_object_that_is_moved_twice_is_refused() -> None:
    """Of two moves a state shows only where the object is."""
    for task in ("stack", "box"):
        cfg = load_config([f"task={task}"])
        phases = build_phases(cfg)
        with pytest.raises(ConfigError, match="twice, which no state tells apart"):
            find_moves(cfg, [*phases[:-1], *phases])


def test_late_commands_are_refused_before_anything_runs(tmp_path: Path) -> None:
    late = ["timing.command_delay=6", "sim=native", "nworld=2", f"hydra.run.dir={tmp_path}/out"]
    for overrides in ([*EXPERT, "gates=[success]"], ["job=train", f"job.folder={tmp_path}/out"]):
        assert run([*overrides, *late]) == 2
    assert not (tmp_path / "out").exists()
    message = r"timing.command_delay=6: expected at most 5, both .* trainer=clone"
    with pytest.raises(ConfigError, match=message):
        find(load_config([*EXPERT, *late[:1]]))


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        (["grasp_red.grasps=null", "place_stack.level=center", "release.level=center",
          "grasp_red.retry=null", "lift_red.gripper=open"],
         "neither grasp an object, nor push one with closed jaws, nor keep"),
        (["above_blue.anchor=red", "place_stack.anchor=red", "place_stack.level=center"],
         "let go of red where it is, which no state tells from before"),
    ],
)  # fmt: skip
def test_what_no_state_tells_is_refused(changes: list[str], why: str) -> None:
    cfg = load_config([f"controller.phases.{change}" for change in changes])
    with pytest.raises(ConfigError, match=f"because the phases of task stack {why}"):
        find(cfg)


def test_failed_episodes_are_counted_by_the_phase_in_which_they_ended() -> None:
    """The grasp point stays over the object, lower than this check wants."""
    tight = ["task.check.height=0.3", "gate.success.rate=0.0", "gates=[success]"]
    result = mjstack.verify([*EXPERT, "task=reach", "sim=native", "nworld=3", *tight])
    (table,) = (t for t in result.gates["success"].tables if "phases" in t.title.lower())
    assert table.header == ["rule", "down"]
    assert table.rows == [["REACHED", "3"]]


def test_the_name_that_went_says_what_to_write(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["controller=state_based"]) == 2
    assert "Write controller=closed_loop controller.clock=false" in capsys.readouterr().err


def test_noise_is_less_where_the_check_asks_for_less(folder: Callable[[str], Path]) -> None:
    """Of the peg's 1.5 mm, three tenths of what the stack has."""
    widest = {}
    for task in ("stack", "peg"):
        choices = [f"task={task}", "job=train", "sim=native"]
        stage = Stage(load_from(choices, config_dir=folder(task) if task == "peg" else None))
        cfg = with_observation(stage.cfg)
        widest[task] = input_noise(cfg, stage.model, {"joint_pos": 6}, torch.zeros(6))
    torch.testing.assert_close(widest["peg"], 0.3 * widest["stack"])
