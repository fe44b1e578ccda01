"""The success gate: rates, where episodes go wrong, what is left of them, and the same starts on
both backends.
"""

import csv
import shutil
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from check_cases import rules_of
from compositions import load_config
from environments import (
    Capture,
    NewRun,
    Patch,
    Refused,
    at_double_speed,
    configure,
    gate_of,
    judge,
    on_cuda,
    one_second_episode,
    report_of,
)

from mjstack.cli import run
from mjstack.config.schema import Config
from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.failures import FailureMonitor, Sign
from mjstack.episodes.rollout import Hook, reset_worlds, rollout
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Stage
from mjstack.gates.episodes import Goal, find_doubts, gate_config
from mjstack.jobs.gates import check_machine
from mjstack.math import wilson_interval
from mjstack.report.record import GateResult, Status
from mjstack.scene.phases import build_phases
from mjstack.sim import Simulation
from mjstack.tasks.check import make_check

RULES = rules_of("stack")
FAILING = "success_failing.csv"

PHASES = list(configure().controller.phases)


def command(folder: Path, *overrides: str) -> int:
    """Exit code of a run of the gate at double speed."""
    return run(["gates=[success]", *at_double_speed(), *overrides, f"hydra.run.dir={folder}"])


@pytest.fixture(scope="module")
def passed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a native run of six SO-101 worlds in a small region."""
    folder = tmp_path_factory.mktemp("success") / "run"
    region = "gate.success.reset.cubes.params.xy=[0.03,0.03]"
    assert command(folder, "sim=native", "nworld=6", region) == 0
    return folder


def counts(metrics: dict[str, float], *names: str) -> list[float]:
    return [metrics[name] for name in names]


def rows_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


def play(run: Run, folder: Path | None = None) -> GateResult:
    run.folder = folder
    return judge(run, "success")


def test_small_region_passes(passed: Path) -> None:
    gate = gate_of(passed)
    assert (gate["name"], gate["status"]) == ("success", "pass")
    metrics = gate["metrics"]
    assert counts(metrics, "episodes", "succeeded", "distinct_starts") == [6] * 3
    assert metrics["unreachable"] == 0
    assert (metrics["success_rate_low95"], metrics["success_rate_high95"]) == wilson_interval(6, 6)
    assert gate["thresholds"]["success_rate_min"] == 0.99
    assert "objects within 0.03 x 0.03 m" in gate["notes"]["starts"]
    files = """.hydra episode.html report.html report.json report.md run.log
        success_seed0.npz success_starts_seed0.npz"""
    assert sorted(path.name for path in passed.iterdir()) == files.split()
    objects = load_config().scene.objects
    with np.load(passed / "success_seed0.npz") as record:
        off = np.abs(record["start_places"][..., :2] - [objects["red"].xy, objects["blue"].xy])
        assert 0.015 < off.max() <= 0.03
        assert not record["sign"].any()
        assert not record["failed"].any()
        assert record["phase_names"].tolist() == PHASES


def test_broken_controller_fails_by_rule_and_phase(tmp_path: Path) -> None:
    """A gripper that never closes: the grasp is empty, is tried again, and is empty again."""
    folder = tmp_path / "broken"
    never = ["robot.gripper_closed=[0.7]", "web.episode=false"]
    assert command(folder, "sim=native", "nworld=2", *never) == 1
    gate = gate_of(folder)
    assert gate["status"] == "fail"
    rate = "0 of 2 episodes succeeded (0 %, 95 % interval 0 to 65.76 %), 99 % wanted"
    assert rate in gate["reason"]
    assert "2 retried, 0 of them succeeded" in gate["reason"]
    assert f"mjstack job=replay run={folder} world=0" in gate["reason"].replace("'", "")
    broken = ("failed.LIFT", "failed.CARRY", "failed.STACKED")
    assert counts(gate["metrics"], *broken) == [2] * 3
    (table,) = [table for table in gate["tables"] if "first sign of failure" in table["header"]]
    assert table["rows"] == [["grasp_red: grasp empty at the last try", "2", "0, 1"]]
    for world, row in enumerate(rows_of(folder / FAILING)):
        expected = {"world": str(world), "sign": "EMPTY", "phase": "grasp_red", "retries": "1"}
        assert row.items() >= expected.items()
        assert "LIFT" in row["rules"].split()
    assert world == 1


@pytest.fixture
def hasty() -> NewRun:
    """Runs of episodes that are over, and have failed, after a second."""

    def make(*overrides: str) -> Run:
        short = ["gates=[success]", "sim=native", "nworld=2", *one_second_episode()]
        return Run(Stage(load_config([*short, *overrides])))

    return make


@pytest.mark.full
def test_seeds_add_up_and_the_rate_decides(hasty: NewRun, tmp_path: Path) -> None:
    """The threshold is on the rate itself; what fails is named all the same."""
    run = hasty("gates=[batch,success]", "gate.success.seeds=2")
    result = play(run, tmp_path)
    assert result.status is Status.failed
    assert "4 of 4 episodes (0:0, 0:1, 1:0, 1:1) failed: " in result.reason
    assert result.reason.endswith(f"job=replay run={tmp_path} world=success:0:0")
    assert result.metrics["distinct_starts"] == 4
    seeds = next(table for table in result.tables if table.title == "Seeds")
    assert [row[:3] for row in seeds.rows] == [["0", "2", "0"], ["1", "2", "0"]]
    (signs,) = [table for table in result.tables if "first sign" in table.header[0]]
    # Every failed episode is in one line, with a sign or without
    assert sum(int(row[1]) for row in signs.rows) == 4
    result = play(hasty("gate.success.rate=0"))
    assert result.status is Status.passed
    assert "2 of 2 episodes (0, 1) failed: " in result.reason


@pytest.mark.full
def test_replay_plays_the_gates_world(passed: Path, tmp_path: Path) -> None:
    """Region and controller are the run's own: the world ends bit for bit where it did."""
    out = tmp_path / "out"
    assert run(["job=replay", f"run={passed}", "world=5", f"hydra.run.dir={out}"]) == 0
    gate = gate_of(out)
    assert gate["reason"].endswith("; as recorded, and it ends bit for bit where it did")
    assert len(gate["details"]) == len(RULES) + 1
    assert gate["details"][-1] == "first sign of failure: none; grasps tried again: 0"


SITE = """\
# The starts of one file
defaults:
  - /reset@reset: starts_file
  - _self_

func: mjstack.gates.episodes.judge_episodes
rate: 0.9
reset: {starts: {params: {path: layouts.npz}}}
"""


@pytest.mark.full
def test_a_gate_of_ones_own_is_a_file(
    passed: Path, tmp_path: Path, monkeypatch: Patch, capsys: Capture
) -> None:
    """It starts worlds from a file, and reports, keeps and replays them as *success* does."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "conf" / "gate" / "site.yaml"
    path.parent.mkdir(parents=True)
    path.write_text(SITE)
    shutil.copy(passed / "success_starts_seed0.npz", "layouts.npz")
    conf = ["--config-dir", "conf", "sim=native"]
    args = [*conf, *at_double_speed(), "nworld=3", "gates=[batch,site]", "gate.batch.rate=0"]
    assert run([*args, "hydra.run.dir=run"]) == 0
    _, site = report_of(Path("run"))["gates"]
    assert (site["name"], site["metrics"]["succeeded"]) == ("site", 3)
    assert site["thresholds"]["success_rate_min"] == 0.9
    with np.load("run/site_seed0.npz") as ours, np.load(passed / "success_seed0.npz") as theirs:
        assert np.allclose(ours["start_places"], theirs["start_places"][:3], atol=1e-6)
    with np.load("run/batch_seed0.npz") as held:  # which starts as ever
        assert "sign" not in held
    Path("layouts.npz").unlink()
    assert run([*conf[:2], "job=replay", "run=run", "world=site:2", "hydra.run.dir=again"]) == 0
    assert "bit for bit where it did" in gate_of(Path("again"))["reason"]
    assert run([*conf, "gates=[site]", "gate.site.rate=2"]) == 2
    assert "gate.site.rate=2.0: expected a number from 0 to 1" in capsys.readouterr().err
    assert run([*conf[:2], "--help", "gate.site.seeds"]) == 0
    assert "gate.site.seeds=1" in capsys.readouterr().out


FILE = "reset=starts_file starts={run}/success_starts_seed0.npz"
REGION = "gate.success.reset.cubes.params.xy"
BAD = [
    (f"{REGION}=[0.5,0.02]", "expected a region with a free position for every object"),
    (f"{REGION}=[0.1,0.1]", "expected a region that the arm reaches"),
    (f"{REGION}=[0.01]", "expected two numbers [m]"),
    ("gate.success.reset.cubes.params.gap=0.3", "gate.success.reset.cubes.params.xy"),
    (f"{FILE} gate.success.seeds=2", "start alike under every seed"),
    (f"{FILE} nworld=7", "at least 7 worlds, it has 6"),
]


@pytest.mark.full
@pytest.mark.parametrize(("args", "words"), BAD, ids=[args for args, _ in BAD])
def test_bad_input_is_one_line_and_writes_nothing(
    args: str, words: str, passed: Path, refused: Refused
) -> None:
    overrides = args.format(run=passed).split()
    line = refused("gates=[success]", "sim=native", "nworld=2", *overrides)
    assert line.startswith("mjstack: ")
    assert words in line


@pytest.mark.full
def test_region_is_the_gates_alone() -> None:
    """Without the gate, its region is not tried; with it, no other start changes."""
    check_machine(load_config(["sim=native", "gates=[batch]", f"{REGION}=[0.1,0.1]"]))
    cfg = load_config([f"{REGION}=[0.01,0.02]"])
    assert gate_config(cfg, "success").reset["cubes"].params["xy"] == [0.01, 0.02]
    assert gate_config(cfg, "success").controller.name == "closed_loop"
    assert cfg.controller.name == "open_loop"


def test_tracker_against_a_plain_recount(monkeypatch: Patch) -> None:
    """Made-up episodes of 300 worlds, in which anything may happen at any time; the recount goes
    world by world.
    """
    size = (90, 300)
    rng = np.random.default_rng(3)
    moves = rng.random(size) < 0.12
    phase = np.minimum(np.cumsum(moves, axis=0), len(PHASES) - 1)
    again = rng.random(size) < 0.3  # out of the grasp and back to the start
    for world in range(size[1]):
        for step in range(1, size[0]):
            grasped = PHASES[phase[step - 1, world]] == "grasp_red"
            if grasped and moves[step, world] and again[step, world]:
                phase[step:, world] -= phase[step, world]
                break
    in_hand = (rng.random((*size, 2, 2)) < 0.93).all(3)
    placed = rng.random((*size, 2)) < 0.8
    overflow = (rng.random(size) < 0.0005).cumsum(axis=0) > 0
    qpos = np.where(rng.random((*size, 1)) < 0.0005, np.inf, 1.0) * np.ones((1, 1, 3))

    watch = monitor(load_config(), monkeypatch, phase, in_hand, placed, qpos, overflow)
    signs = zip(watch.sign.tolist(), watch.phase.tolist(), watch.step.tolist(), strict=True)
    names = np.array(PHASES)[phase]
    lost = overflow | np.isinf(qpos[:, :, 0])
    worlds = zip(names.T, in_hand[..., 0].T, placed[..., 0].T, lost.T, strict=True)
    expected = [recount(name.tolist(), *rows) for name, *rows in worlds]
    assert list(signs) == expected
    # Else this would show less than it seems to
    assert {sign for sign, _, _ in expected} == {int(sign) for sign in Sign}


def monitor(
    cfg: Config,
    monkeypatch: Patch,
    phase: np.ndarray,
    in_hand: np.ndarray,
    placed: np.ndarray,
    qpos: np.ndarray,
    overflow: np.ndarray,
) -> FailureMonitor:
    """The monitor after episodes that the test made up: each step's phases of the worlds, objects
    in hand and objects placed, positions and overflow.
    """
    n = phase.shape[1]
    counts = torch.zeros(n, dtype=torch.int32)
    sim = SimpleNamespace(qpos=torch.zeros(n, 3), qvel=torch.zeros(n, 3), overflow=counts)
    driver = SimpleNamespace(phase=torch.zeros(n, dtype=torch.int64), phases=build_phases(cfg))
    state = SimpleNamespace(value=lambda condition: condition(state))
    check = SimpleNamespace(objects=make_check(cfg).objects)
    views = {"sim": sim, "index": None, "cfg": cfg, "check": check, "state": state}
    env = SimpleNamespace(nworld=n, device=torch.device("cpu"), **views)
    watch = FailureMonitor()
    watch.start(env, driver)
    for step in range(len(phase)):
        state.in_hand = torch.from_numpy(in_hand[step])
        check.placed = lambda _, step=step: torch.from_numpy(placed[step])
        for tensor, values in ((driver.phase, phase), (sim.qpos, qpos), (sim.overflow, overflow)):
            tensor.copy_(torch.from_numpy(values[step]))
        watch.update()
    return watch


def recount(
    phases: list[str], in_hand: np.ndarray, placed: np.ndarray, lost: np.ndarray
) -> tuple[int, int, int]:
    """The first sign of one world of the stack task, its phase, and the step."""
    gone = 0
    for step, name in enumerate(phases):
        before = phases[step - 1] if step else name
        onward = PHASES.index(name) > PHASES.index(before)
        carrying = name in ("lift_red", "above_blue", "place_stack")
        gone = gone + 1 if carrying and not in_hand[step] else 0
        if lost[step]:
            return Sign.PHYSICS, PHASES.index(name), step
        if before == "grasp_red" and onward and not in_hand[step - 1]:
            return Sign.EMPTY, PHASES.index(before), step
        if gone >= 3:
            return Sign.DROPPED, PHASES.index(name), step
        if before == "release" and onward and not placed[step - 1]:
            return Sign.MISSED, PHASES.index(before), step
        if name in ("retreat", "done") and placed[step - 1] and not placed[step]:
            return Sign.LEFT, PHASES.index(name), step
    return Sign.NONE, -1, -1


@pytest.mark.full
def test_signs_in_real_episodes(new_run: NewRun) -> None:
    """Worlds that somebody interferes with: each shows its own sign, in its phase, and one is
    undisturbed.
    """
    base = new_run("sim=native", "nworld=6")
    run = base.with_stage(base.stage.with_config(gate_config(base.cfg, "success")))
    red, _ = run.stage.index.object_qpos
    at = {name: run.stage.phase(name).start for name in PHASES}
    done = at["done"] + 5

    def interfere(step: int, sim: Simulation) -> None:
        if step == at["lift_red"] + 30:
            sim.qpos[1, red + 1] -= 0.1  # out of the hand
        if step == at["grasp_red"] + 60:
            sim.qpos[2, red + 1] -= 0.03  # out of the jaws: tried again, and found
        if step == at["release"] + 30:
            sim.qpos[3, red] += 0.018  # it still stands on blue, too far off
        if step == done:
            sim.qpos[4, red : red + 3] += torch.tensor([0.1, 0.0, -0.044])  # down on the table
        if step == at["above_blue"]:
            sim.qvel[5] = torch.nan

    watch = FailureMonitor()
    sim = run.stage.batch_simulation(6)
    episode = run.stage.play(sim, run.cfg.reset, [watch, Hook(interfere)])
    failed = episode.result.failed.tolist()
    assert episode.retries.tolist() == [0, 0, 1, 0, 0, 0]
    sim.close()
    signs = [Sign(sign).name for sign in watch.sign.tolist()]
    assert signs == ["NONE", "DROPPED", "NONE", "MISSED", "LEFT", "PHYSICS"]
    phases = [PHASES[number] if number >= 0 else "" for number in watch.phase.tolist()]
    assert phases == ["", "lift_red", "", "release", "done", "above_blue"]
    assert [bits == 0 for bits in failed] == [True, False, True, False, False, False]
    assert failed[5] & RULES["FINITE"]
    assert watch.step.tolist()[4] == done + 1


@pytest.mark.full
def test_each_cube_of_the_box_has_its_own_release(monkeypatch: Patch) -> None:
    """World by world: all well; red misses, blue does not; red is let go well and leaves under
    blue's approach; blue misses; blue leaves at the end.
    """
    cfg = load_config(["task=box"])
    names = list(cfg.controller.phases)
    at = {name: 2 * number for number, name in enumerate(names)}  # two steps a phase
    placed = np.zeros((2 * len(names), 5, 2), dtype=bool)
    placed[at["open_red"] + 1 :, :, 0] = True
    placed[at["open_blue"] + 1 :, :, 1] = True
    placed[:, 1, 0] = False
    placed[at["approach_blue"] + 1 :, 2, 0] = False
    placed[:, 3, 1] = False
    placed[at["done"] + 1 :, 4, 1] = False

    phase = np.repeat(np.arange(len(names)), 2)[:, None].repeat(5, axis=1)
    qpos = np.zeros((*phase.shape, 3))
    watch = monitor(cfg, monkeypatch, phase, placed | True, placed, qpos, 0 * phase)
    signs = [Sign(sign).name for sign in watch.sign.tolist()]
    assert signs == ["NONE", "MISSED", "LEFT", "MISSED", "LEFT"]
    phases = ["open_red", "approach_blue", "open_blue", "done"]
    assert [names[number] for number in watch.phase[1:].tolist()] == phases
    steps = [at["retreat_red"], at["approach_blue"] + 1, at["retreat_blue"], at["done"] + 1]
    assert watch.step[1:].tolist() == steps


@pytest.mark.full
@on_cuda
def test_steps_with_the_tracker_are_one_graph(robot: str, new_run: NewRun, tmp_path: Path) -> None:
    device = ("sim=mjwarp", "sim.device=cuda:0", "nworld=64")
    base = new_run(*device, "graph=require", robot=robot)
    run = base.with_stage(base.stage.with_config(gate_config(base.cfg, "success")))
    sim = run.stage.batch_simulation(64)
    watch = FailureMonitor()
    episode = run.stage.play(sim, run.cfg.reset, [watch])
    assert episode.timing.captured
    failed = episode.result.failed != 0
    assert int(failed.sum()) <= 3
    assert not bool(((watch.sign != 0) & ~failed).sum() > 3)
    assert int(watch._count) == episode.timing.steps
    sim.close()
    assert play(new_run(*device, robot=robot), tmp_path).metrics["succeeded"] >= 61


def test_evaluations_that_show_less_than_they_seem_to_are_flagged() -> None:
    """Repeated starts, a success that flickers, 10 episodes for a claim of 95 %; a good one not."""
    assert find_doubts(distinct=200, episodes=200, successes=199, lost=0, rate=0.95) == []
    (repeated,) = find_doubts(distinct=50, episodes=200, successes=200, lost=0, rate=0.95)
    assert repeated == "150 of 200 starts are there twice"
    (lost,) = find_doubts(distinct=300, episodes=300, successes=296, lost=4, rate=0.95)
    assert lost.startswith("reached the goal and lost it: 4 of 300 episodes")
    (few,) = find_doubts(distinct=10, episodes=10, successes=10, lost=0, rate=0.95)
    assert few.startswith("10 episodes show at least 72.25 %, not 95 %")


class Retreat(Driver):
    """Goes where another driver goes, and back to the start."""

    def __init__(self, driver: Driver, env: Env, after: int) -> None:
        super().__init__(env.nworld, driver.steps, env.device)
        self._driver = driver
        self._start = env.sim.ctrl.clone()
        self._left = after

    def command(self) -> torch.Tensor:
        self._left -= 1
        return self._driver.command() if self._left >= 0 else self._start


@pytest.mark.parametrize(("after", "lost"), [(120, 2), (1000, 0)])
def test_a_goal_that_is_reached_and_lost_is_counted(after: int, lost: int) -> None:
    cfg = configure("task=reach", "sim=native", "nworld=2", "controller=closed_loop")
    stage = Stage(cfg)
    with closing(stage.batch_simulation(2)) as sim:
        driven = replace(stage.driven(cfg.reset), task=cfg.task)
        env = reset_worlds(Env(sim, stage.index, driven), seed=0)
        goal = Goal(stage.ranks)
        rollout(env, Retreat(stage.driver(env), env, after), [goal])
        assert goal.lost == lost
