"""The success gate: rates, where episodes go wrong, what is left of them, and the same starts on
both backends.
"""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from check_cases import rules_of
from compositions import checked, load_config, put
from environments import at_double_speed, configure, one_second_episode

from mjstack.cli import run
from mjstack.config.schema import Config
from mjstack.episodes import context as gate_module
from mjstack.episodes.context import RunContext
from mjstack.episodes.failures import FailureMonitor, Sign
from mjstack.episodes.record import FAILING, PICTURE, REGIONS, EpisodeRecord
from mjstack.episodes.regions import Region, find_regions, radial_yaw_deg, regions_table
from mjstack.episodes.rollout import Episode, Hook, play_episode
from mjstack.errors import ConfigError
from mjstack.gates.success import run_success, success_config
from mjstack.jobs import check_job
from mjstack.jobs.gates import check_machine
from mjstack.math import wilson_interval
from mjstack.report.record import GateResult, Status
from mjstack.scene.phases import build_phases
from mjstack.sim import Simulation
from mjstack.tasks.check import make_check

RULES = rules_of("stack")

PHASES = list(configure().controller.phases)


@pytest.fixture(scope="module")
def passed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a native run of six SO-101 worlds in a small region."""
    folder = tmp_path_factory.mktemp("success") / "run"
    args = [
        "gates=[success]",
        "sim=native",
        "nworld=6",
        "gate.success.region=[0.03,0.03]",
        "gate.success.cell_episodes=2",
    ]
    assert run([*args, *at_double_speed(), f"hydra.run.dir={folder}"]) == 0
    return folder


@pytest.fixture(scope="module")
def warp(passed: Path) -> Path:
    """The folder of a run on Warp's CPU device from the first two of the native run's layouts."""
    folder = passed.parent / "warp"
    start = ["reset=starts_file", f"starts={passed}/starts_seed0.csv"]
    assert (
        run(
            [
                "gates=[success]",
                "sim=mjwarp",
                "sim.device=cpu",
                "nworld=2",
                *start,
                *at_double_speed(),
                f"hydra.run.dir={folder}",
            ]
        )
        == 0
    )
    return folder


def gate_of(folder: Path) -> dict:
    (gate,) = json.loads((folder / "report.json").read_text())["gates"]
    return gate


def record_of(folder: Path) -> EpisodeRecord:
    record = EpisodeRecord.read(folder, 0, "success")
    assert record is not None
    return record


def play(context: RunContext, folder: Path | None = None) -> GateResult:
    context.folder = folder
    (result,) = run_success(context)
    return result


def test_small_region_passes(passed: Path) -> None:
    gate = gate_of(passed)
    assert (gate["name"], gate["status"]) == ("success", "pass")
    metrics = gate["metrics"]
    assert (
        metrics["episodes"],
        metrics["succeeded"],
        metrics["distinct_starts"],
        metrics["unreachable"],
    ) == (6, 6, 6, 0)
    assert (metrics["success_rate_low95"], metrics["success_rate_high95"]) == wilson_interval(6, 6)
    assert gate["thresholds"]["success_rate_min"] == 0.99
    assert "objects within 0.03 x 0.03 m" in gate["notes"]["starts"]
    assert sorted(path.name for path in passed.iterdir()) == sorted(
        [
            ".hydra",
            "episode.html",
            "motion_success.npz",
            "starts_seed0.csv",
            "report.html",
            "report.json",
            "report.md",
            "run.log",
            "success.png",
            "success_regions.csv",
            "success_seed0.npz",
        ]
    )
    assert "no region of at least 2 episodes had a failure" in gate["details"]
    assert not [table for table in gate["tables"] if "region" in table["title"]]
    assert "![success.png](success.png)" in (passed / "report.md").read_text()
    scene = load_config().scene
    with np.load(passed / "success_seed0.npz") as held:
        off = np.abs(
            held["start_places"][..., :2] - [scene.objects["red"].xy, scene.objects["blue"].xy]
        )
        assert 0.015 < off.max() <= 0.03
        assert (held["sign"] == 0).all()
        assert (held["failed"] == 0).all()
        assert held["phase_names"].tolist() == PHASES


@pytest.mark.full
def test_rebot_passes(new_context: Callable[..., RunContext], tmp_path: Path) -> None:
    context = new_context("sim=native", "nworld=4", *at_double_speed("rebot"), robot="rebot")
    result = play(context, tmp_path)
    assert result.status is Status.passed
    assert (
        result.metrics["succeeded"],
        result.metrics["episodes"],
        result.metrics["distinct_starts"],
    ) == (4, 4, 4)
    assert not (tmp_path / FAILING).exists()
    assert context.page.pictures == [PICTURE]
    assert context.cfg.reset == load_config(["robot=rebot"]).reset  # other gates start as they did


def test_broken_controller_fails_by_rule_and_phase(tmp_path: Path) -> None:
    """A gripper that never closes: the grasp is empty, is tried again, and is empty again."""
    folder = tmp_path / "broken"
    args = [
        "gates=[success]",
        "sim=native",
        "nworld=2",
        "robot.gripper_closed=[0.7]",
        *at_double_speed(),
        f"hydra.run.dir={folder}",
    ]
    assert run(args) == 1
    gate = gate_of(folder)
    assert gate["status"] == "fail"
    assert (
        "0 of 2 episodes succeeded (0 %, 95 % interval 0 to 65.76 %), 99 % wanted" in gate["reason"]
    )
    assert "2 retried, 0 of them succeeded" in gate["reason"]
    assert f"job=replay run={folder} world=0" in gate["reason"]
    assert {
        name: gate["metrics"][f"failed.{name}"] for name in ("LIFT", "CARRY", "STACKED")
    } == dict.fromkeys(("LIFT", "CARRY", "STACKED"), 2)
    (table,) = [table for table in gate["tables"] if "first sign of failure" in table["header"]]
    assert table["rows"] == [["grasp_red: grasp empty, and not tried again", "2", "0, 1"]]
    rows = list(csv.DictReader((folder / FAILING).read_text().splitlines()))
    assert [(row["world"], row["sign"], row["phase"], row["retries"]) for row in rows] == [
        (str(world), "EMPTY", "grasp_red", "1") for world in range(2)
    ]
    assert all("LIFT" in row["rules"].split() for row in rows)
    assert any("no region of at least 20 episodes (gate" in line for line in gate["details"])


@pytest.fixture
def hasty() -> Callable[..., RunContext]:
    """Contexts of episodes that are over, and have failed, after a second."""

    def make(*overrides: str) -> RunContext:
        return RunContext(
            cfg=load_config(
                ["gates=[success]", "sim=native", "nworld=2", *one_second_episode(), *overrides]
            )
        )

    return make


@pytest.mark.full
def test_seeds_add_up_and_the_rate_decides(
    hasty: Callable[..., RunContext], tmp_path: Path
) -> None:
    """The threshold is on the rate itself; what fails is named all the same."""
    context = hasty("gates=[batch,success]", "gate.success.seeds=2", "gate.success.cell_episodes=2")
    lines: list[str] = []
    context.print_line = lines.append
    result = play(context, tmp_path)
    assert result.status is Status.failed
    failing = "4 of 4 episodes (0:0, 0:1, 1:0, 1:1) failed: "
    assert "0 of 4 episodes succeeded" in result.reason
    assert failing in result.reason
    assert result.reason.endswith(f"job=replay run={tmp_path} world=success:0:0")
    assert result.metrics["distinct_starts"] == 4
    assert [line.split(":")[0] for line in lines] == ["success, seed 0", "success, seed 1"]
    seeds = next(table for table in result.tables if table.title == "Seeds")
    assert [row[:3] for row in seeds.rows] == [["0", "2", "0"], ["1", "2", "0"]]
    (worst,) = [
        table
        for table in result.tables
        if table.title.startswith("Worst regions of at least 2 episodes")
    ]
    assert worst.title.endswith(f"({len(worst.rows)} of {len(worst.rows)} with a failure)")
    assert not any("had a failure" in line for line in result.details)
    (signs,) = [table for table in result.tables if "first sign" in table.header[0]]
    assert (
        sum(int(row[1]) for row in signs.rows) == 4
    )  # every failed episode is in one line, with a sign or without
    rows = list(csv.DictReader((tmp_path / "success_failing_worlds.csv").read_text().splitlines()))
    assert [(row["seed"], row["world"]) for row in rows] == [
        ("0", "0"),
        ("0", "1"),
        ("1", "0"),
        ("1", "1"),
    ]
    assert not (tmp_path / FAILING).exists()  # that is the batch gate's

    result = play(hasty("gate.success.rate=0"))
    assert result.status is Status.passed
    assert "2 of 2 episodes (0, 1) failed: " in result.reason


@pytest.mark.full
def test_both_backends_start_and_end_alike(passed: Path, warp: Path) -> None:
    native = record_of(passed)
    other = record_of(warp)
    assert (native.backend, other.backend) == ("native", "mjwarp")
    with (
        np.load(passed / "success_seed0.npz") as ours,
        np.load(warp / "success_seed0.npz") as theirs,
    ):
        assert theirs["start_qpos"].dtype == np.float32
        assert np.abs(ours["start_qpos"][:2] - theirs["start_qpos"]).max() < 1e-7
        assert np.array_equal(
            ours["start_places"][:2, :, :2].astype(np.float32), theirs["start_places"][..., :2]
        )
    assert np.array_equal(native.failed[:2], other.failed)
    assert np.abs(native.values["xy_err_m"][:2] - other.values["xy_err_m"]).max() < 0.003
    notes = gate_of(warp)["notes"]
    assert notes["starts"] == f"starts={passed}/starts_seed0.csv"
    assert "Warp" in notes["backend"]


@pytest.mark.full
def test_replay_plays_the_gates_world(passed: Path, tmp_path: Path) -> None:
    """Region and controller are the run's own: the world ends bit for bit where it did."""
    out = tmp_path / "out"
    assert run(["job=replay", f"run={passed}", "world=5", f"hydra.run.dir={out}"]) == 0
    gate = gate_of(out)
    assert gate["reason"].endswith("; as recorded, and it ends bit for bit where it did")
    assert len(gate["details"]) == len(RULES) + 1
    assert gate["details"][-1] == "first sign of failure: none; grasps tried again: 0"


@pytest.mark.full
@pytest.mark.parametrize(
    ("world", "says"),
    [
        ("batch:1", "a gate that run had, success"),
        ("1:1", "a seed from 0 to 0"),
        ("6", "a world from 0 to 5"),
    ],
)
def test_replay_refuses_worlds_that_were_not(world: str, says: str, passed: Path) -> None:
    cfg = put(load_config(["job=replay"]), f"run={passed}")
    cfg.world = world
    with pytest.raises(ConfigError, match=says):
        check_job(cfg)


BAD = [
    (
        ["gate.success.region=[0.5,0.02]"],
        "gate.success.region=[0.5, 0.02]: expected a region with a free position for every object",
    ),
    (
        ["gate.success.region=[0.1,0.1]"],
        "gate.success.region=[0.1, 0.1]: expected a region that the arm reaches",
    ),
    (["gate.success.region=[0.01]"], "2 numbers"),
    (
        ["gate.success.region=[0.01,0.01]", "~gate.success.reset.cubes"],
        "null, because no reset term of the success gate has a region",
    ),
    (["gate.success.reset.cubes.params.gap=0.3"], "gate.success.reset.cubes.params.xy"),
    (
        ["reset=starts_file", "starts={run}/starts_seed0.csv", "gate.success.seeds=2"],
        "start alike under every seed",
    ),
    (
        ["reset=starts_file", "starts={run}/starts_seed0.csv", "gate.success.region=[0.01,0.01]"],
        "null, because no reset term of the success gate has a region",
    ),
    (
        ["reset=starts_file", "starts={run}/starts_seed0.csv", "nworld=7"],
        "at least 7 worlds, it has 6",
    ),
]


@pytest.mark.full
@pytest.mark.parametrize(("args", "says"), BAD, ids=[" ".join(args) for args, _ in BAD])
def test_bad_input_is_one_line_and_writes_nothing(
    args: list[str],
    says: str,
    passed: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert (
        run(
            ["gates=[success]", "sim=native", "nworld=2", *(arg.format(run=passed) for arg in args)]
        )
        == 2
    )
    err = capsys.readouterr().err.strip()
    assert err.startswith("mjstack: ")
    assert len(err.splitlines()) == 1
    assert says in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ("rate=1.01", "rate=1.01: expected a number from 0 to 1"),
        ("rate=nan", "rate=nan"),
        ("seeds=0", "seeds=0: expected an integer of at least 1"),
        ("cell=0", "cell"),
        ("yaw_cell_deg=91", "yaw_cell_deg"),
        ("region=[-0.01,0.1]", "region"),
    ],
)
def test_range_of_a_number(value: str, says: str) -> None:
    with pytest.raises(ConfigError, match=rf"gate\.success\.{says}"):
        checked(f"gate.success.{value}")


@pytest.mark.full
def test_region_is_the_gates_alone() -> None:
    """Without the gate, its region is not tried; with it, no other start changes."""
    check_machine(load_config(["sim=native", "gates=[batch]", "gate.success.region=[0.1,0.1]"]))
    cfg = load_config(["gate.success.region=[0.01,0.02]"])
    assert success_config(cfg).reset["cubes"].params["xy"] == [0.01, 0.02]
    assert cfg.gate.success.reset["cubes"].params["xy"] == [0.05, 0.05]
    assert (success_config(cfg).controller.name, cfg.controller.name) == (
        "closed_loop",
        "open_loop",
    )


class Stop(Exception):
    """Something that nobody foresaw."""


@pytest.mark.full
def test_what_stops_the_second_seed_keeps_the_first(
    hasty: Callable[..., RunContext], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def stops(*args: Any, **kwargs: Any) -> Episode:
        if (tmp_path / "success_seed0.npz").exists():
            raise Stop("the second seed")
        return play_episode(*args, **kwargs)

    monkeypatch.setattr(gate_module, "play_episode", stops)
    result = play(hasty("gate.success.seeds=3", "gate.success.rate=0"), tmp_path)
    assert result.status is Status.failed
    assert "0 of 2 episodes succeeded" in result.reason
    assert "seeds 1 to 2 not played: the second seed" in result.reason
    left = {REGIONS, PICTURE, FAILING, "success_seed0.npz", "starts_seed0.csv", "starts_seed1.csv"}
    left |= {"motion_success.npz"}
    assert {path.name for path in tmp_path.iterdir()} <= left
    assert {FAILING, "success_seed0.npz", "starts_seed0.csv"} <= {
        path.name for path in tmp_path.iterdir()
    }


@pytest.mark.full
def test_full_disk_takes_no_verdict_back(
    hasty: Callable[..., RunContext], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    result = play(hasty("gate.success.rate=0"), tmp_path)
    assert result.status is Status.passed
    told = [line for line in result.details if "No space left on device" in line]
    for name in ("starts_seed0.csv", "no record of its episodes", REGIONS, PICTURE):
        assert any(name in line for line in told)
    assert list(tmp_path.iterdir()) == []


def test_tracker_against_a_plain_recount(monkeypatch: pytest.MonkeyPatch) -> None:
    """Made-up episodes of 300 worlds, in which anything may happen at any time; the recount goes
    world by world.
    """
    cfg = load_config()
    n = 300
    total = 90
    rng = np.random.default_rng(3)
    moves = rng.random((total, n)) < 0.12
    phase = np.minimum(np.cumsum(moves, axis=0), len(PHASES) - 1)
    again = rng.random((total, n)) < 0.3  # out of the grasp and back to the start
    for world in range(n):
        for step in range(1, total):
            if (
                PHASES[phase[step - 1, world]] == "grasp_red"
                and moves[step, world]
                and again[step, world]
            ):
                phase[step:, world] -= phase[step, world]
                break
    forces = (rng.random((total, n, 2, 2)) < 0.93) * 3.0
    placed = rng.random((total, n, 2)) < 0.8
    overflow = (rng.random((total, n)) < 0.0005).cumsum(axis=0) > 0
    qpos = np.where(rng.random((total, n, 1)) < 0.0005, np.inf, 1.0) * np.ones((1, 1, 3))

    watch = FailureMonitor()
    now = SimpleNamespace(step=0)
    device = torch.device("cpu")
    sim = SimpleNamespace(
        qpos=torch.zeros(n, 3), qvel=torch.zeros(n, 3), overflow=torch.zeros(n, dtype=torch.int32)
    )
    env = SimpleNamespace(nworld=n, device=device, sim=sim, index=None, cfg=cfg)
    controller = SimpleNamespace(phase=torch.zeros(n, dtype=torch.int64), phases=build_phases(cfg))
    pretend(
        cfg,
        monkeypatch,
        in_hand=lambda: torch.from_numpy(forces[now.step] > 0.0).all(2),
        placed=lambda: torch.from_numpy(placed[now.step]),
    )
    watch.start(env, controller)
    for step in range(total):
        now.step = step
        controller.phase.copy_(torch.from_numpy(phase[step]))
        sim.qpos.copy_(torch.from_numpy(qpos[step]))
        sim.overflow.copy_(torch.from_numpy(overflow[step]))
        watch.update()

    found = [
        tuple(row) for row in torch.stack((watch.sign, watch.phase, watch.step), dim=1).tolist()
    ]
    names = [[PHASES[number] for number in phase[:, world]] for world in range(n)]
    held = (forces[:, :, 0] > 0).all(2)
    lost = overflow | np.isinf(qpos[:, :, 0])
    wanted = [
        recount(names[world], held[:, world], placed[:, world, 0], lost[:, world])
        for world in range(n)
    ]
    assert found == wanted
    assert {sign for sign, _, _ in wanted} == {
        int(sign) for sign in Sign
    }  # else this would show less than it seems to


def pretend(
    cfg: Config,
    monkeypatch: pytest.MonkeyPatch,
    *,
    in_hand: Callable[[], torch.Tensor],
    placed: Callable[[], torch.Tensor],
) -> None:
    """Give the monitor a check that says what the test made up."""
    view = SimpleNamespace(step=lambda: SimpleNamespace(in_hand=in_hand()))
    check = SimpleNamespace(
        objects=make_check(cfg).objects, view=lambda _: view, placed=lambda _: placed()
    )
    monkeypatch.setattr("mjstack.episodes.failures.make_check", lambda _: check)


def recount(
    phases: list[str], held: np.ndarray, placed: np.ndarray, lost: np.ndarray
) -> tuple[int, int, int]:
    """The first sign of one world of the stack task, its phase, and the step."""
    gone = 0
    for step, name in enumerate(phases):
        before = phases[step - 1] if step else name
        onward = PHASES.index(name) > PHASES.index(before)
        gone = (
            gone + 1 if name in ("lift_red", "above_blue", "place_stack") and not held[step] else 0
        )
        if lost[step]:
            return Sign.PHYSICS, PHASES.index(name), step
        if before == "grasp_red" and onward and not held[step - 1]:
            return Sign.EMPTY, PHASES.index(before), step
        if gone >= 3:
            return Sign.DROPPED, PHASES.index(name), step
        if before == "release" and onward and not placed[step - 1]:
            return Sign.MISSED, PHASES.index(before), step
        if name in ("retreat", "done") and placed[step - 1] and not placed[step]:
            return Sign.LEFT, PHASES.index(name), step
    return Sign.NONE, -1, -1


@pytest.mark.full
def test_signs_in_real_episodes(new_context: Callable[..., RunContext]) -> None:
    """Worlds that somebody interferes with: each shows its own sign, in its phase, and one is
    undisturbed.
    """
    base = new_context("sim=native", "nworld=6")
    context = base.with_config(success_config(base.cfg))
    red, _ = context.index.object_qpos
    at = {name: context.phase(name).start for name in PHASES}

    def interfere(step: int, sim: Simulation) -> None:
        if step == at["lift_red"] + 30:
            sim.qpos[1, red + 1] -= 0.1  # out of the hand
        if step == at["grasp_red"] + 60:
            sim.qpos[2, red + 1] -= 0.03  # out of the jaws: tried again, and found
        if step == at["release"] + 30:
            sim.qpos[3, red] += 0.018  # it still stands on blue, too far off
        if step == at["done"] + 5:
            sim.qpos[4, red : red + 3] += torch.tensor([0.1, 0.0, -0.044])  # down on the table
        if step == at["above_blue"]:
            sim.qvel[5] = torch.nan

    watch = FailureMonitor()
    sim = context.batch_simulation(6)
    episode = context.play(sim, context.cfg.reset, [watch, Hook(interfere)])
    failed = episode.result.failed.tolist()
    retries = episode.retries.tolist()
    sim.close()
    signs = [Sign(sign).name for sign in watch.sign.tolist()]
    phases = [PHASES[number] if number >= 0 else "" for number in watch.phase.tolist()]
    assert list(zip(signs, phases, strict=True)) == [
        ("NONE", ""),
        ("DROPPED", "lift_red"),
        ("NONE", ""),
        ("MISSED", "release"),
        ("LEFT", "done"),
        ("PHYSICS", "above_blue"),
    ]
    assert [bits == 0 for bits in failed] == [True, False, True, False, False, False]
    assert failed[5] & RULES["FINITE"]
    assert retries == [0, 0, 1, 0, 0, 0]
    assert watch.step.tolist()[4] == at["done"] + 6


@pytest.mark.full
def test_each_cube_of_the_box_has_its_own_release(monkeypatch: pytest.MonkeyPatch) -> None:
    """World by world: all well; red misses, blue does not; red is let go well and leaves under
    blue's approach; blue misses; blue leaves at the end."""
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

    watch = FailureMonitor()
    now = SimpleNamespace(step=0)
    sim = SimpleNamespace(
        qpos=torch.zeros(5, 3), qvel=torch.zeros(5, 3), overflow=torch.zeros(5, dtype=torch.int32)
    )
    env = SimpleNamespace(nworld=5, device=torch.device("cpu"), sim=sim, index=None, cfg=cfg)
    controller = SimpleNamespace(phase=torch.zeros(5, dtype=torch.int64), phases=build_phases(cfg))
    pretend(
        cfg,
        monkeypatch,
        in_hand=lambda: torch.ones(5, 2, dtype=torch.bool),
        placed=lambda: torch.from_numpy(placed[now.step]),
    )
    watch.start(env, controller)
    for step in range(len(placed)):
        now.step = step
        controller.phase.fill_(step // 2)
        watch.update()
    signs = [Sign(sign) for sign in watch.sign.tolist()]
    assert signs == [Sign.NONE, Sign.MISSED, Sign.LEFT, Sign.MISSED, Sign.LEFT]
    assert [names[number] for number in watch.phase[1:].tolist()] == [
        "open_red",
        "approach_blue",
        "open_blue",
        "done",
    ]
    assert watch.step[1:].tolist() == [
        at["retreat_red"],
        at["approach_blue"] + 1,
        at["retreat_blue"],
        at["done"] + 1,
    ]


def test_radial_yaw() -> None:
    """A cube that faces the base is at 0 wherever it stands, and a quarter turn changes nothing."""
    angle = np.linspace(-3.0, 3.0, 13)
    places = np.stack((0.3 * np.cos(angle), 0.3 * np.sin(angle), angle), axis=1)
    for quarter in (-2, -1, 0, 1):
        found = radial_yaw_deg(places + np.array([0.0, 0.0, quarter * np.pi / 2]))
        assert np.minimum(found, 90.0 - found).max() < 1e-9
        assert ((found >= 0.0) & (found < 90.0)).all()
    assert radial_yaw_deg(np.array([0.0, 0.3, np.radians(90.0 + 37.0)])) == pytest.approx(37.0)
    assert radial_yaw_deg(np.array([0.3, 0.0, -1e-18])) == 0.0


def test_worst_regions_of_made_up_episodes() -> None:
    """Red fails in one corner, blue at some angles; a cell with too few episodes has no rate."""
    rng = np.random.default_rng(1)
    n = 4000
    places = np.empty((n, 2, 3))
    places[:, 0, :2] = rng.uniform([0.30, -0.14], [0.36, -0.10], (n, 2))
    places[:, 1, :2] = rng.uniform([0.30, 0.06], [0.36, 0.10], (n, 2))
    places[..., 2] = rng.uniform(-np.pi, np.pi, (n, 2))
    places[:5, 0, :2] = 0.41, -0.05
    corner = (places[:, 0, 0] >= 0.34) & (places[:, 0, 0] < 0.36) & (places[:, 0, 1] < -0.12)
    turned = (radial_yaw_deg(places[:, 1]) >= 30.0) & (radial_yaw_deg(places[:, 1]) < 45.0)
    succeeded = ~(corner & (rng.random(n) < 0.9)) & ~(turned & (rng.random(n) < 0.5))
    found = find_regions(
        places, succeeded, cell=0.02, yaw_cell_deg=15.0, episodes=20, objects=("red", "blue")
    )
    assert [region.rate for region in found] == sorted(region.rate for region in found)
    assert all(region.episodes >= 20 for region in found)
    assert not any(region.object == "red" and region.x_min_m == 0.4 for region in found)
    assert (found[0].object, found[0].x_min_m, found[0].y_min_m) == ("red", 0.34, -0.14)
    assert found[0].where.startswith("red: x 0.340 to 0.360 m, y -0.140 to -0.120 m")
    alone = [region for region in found if region.object == "blue" and region.x_min_m is None]
    assert (alone[0].yaw_min_deg, alone[0].yaw_max_deg) == (30.0, 45.0)
    assert alone[0].where == "blue: turned 30 to 45 deg"
    assert len(alone) == 6
    assert sum(region.episodes for region in alone) == n
    assert sum(region.succeeded for region in alone) == succeeded.sum()
    placed = [region for region in found if region.object == "red" and region.yaw_min_deg is None]
    assert len(placed) == 6
    whole = next(region for region in placed if (region.x_min_m, region.y_min_m) == (0.34, -0.14))
    assert (whole.episodes, whole.succeeded) == (int(corner.sum()), int((corner & succeeded).sum()))
    assert (whole.rate_low95, whole.rate_high95) == wilson_interval(whole.succeeded, whole.episodes)
    assert len(set(found)) == len(found)
    assert isinstance(found[0], Region)
    well = replace(
        found[0], object="blue", succeeded=found[0].episodes
    )  # has no place among the worst
    (table,) = regions_table(load_config(["gate.success.worst_regions=2"]), [*found[:1], well])
    assert table.title == "Worst regions of at least 20 episodes (1 of 1 with a failure)"
    assert [row[0] for row in table.rows] == [found[0].where]


@pytest.mark.full
@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
@pytest.mark.parametrize("robot", ["so101", "rebot"])
def test_steps_with_the_tracker_are_one_graph(
    robot: str, new_context: Callable[..., RunContext], tmp_path: Path
) -> None:
    base = new_context("sim=mjwarp", "sim.device=cuda:0", "nworld=64", "graph=require", robot=robot)
    context = base.with_config(success_config(base.cfg))
    sim = context.batch_simulation(64)
    watch = FailureMonitor()
    episode = context.play(sim, context.cfg.reset, [watch])
    assert episode.timing.captured
    failed = episode.result.failed != 0
    assert int(failed.sum()) <= 3
    assert not bool(((watch.sign != 0) & ~failed).sum() > 3)
    assert int(watch._now) == episode.timing.steps
    sim.close()
    result = play(
        new_context("sim=mjwarp", "sim.device=cuda:0", "nworld=64", robot=robot), tmp_path
    )
    assert result.metrics["succeeded"] >= 61
