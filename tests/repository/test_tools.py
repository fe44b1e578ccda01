"""The developers' tools: each does its work once, on a small scale."""

import json
import runpy
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import bench_physics
import bench_solver
import mujoco
import numpy as np
import pytest
import soak
import verdicts
from compositions import load_config
from environments import Capture, Patch, on_cuda, one_second_episode
from policies import hold_above_red
from solver_states import FUSED, RANDOM, SCRIPTED, STOCK, Pipeline, Sample, record_states

import mjstack
from mjstack.config.schema import Backend
from mjstack.episodes.stage import Stage
from mjstack.sim.mjwarp import MjwarpSimulation
from mjstack.sim.native import NativeSimulation

TOOLS = Path(mjstack.__file__).parents[1] / "tools"
NWORLD = 4
Recorded = tuple[Stage, Pipeline, list[Sample]]

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def recorded() -> Iterator[Recorded]:
    overrides = ("sim.device=cpu", f"nworld={NWORLD}", *one_second_episode())
    stage = Stage(load_config(overrides))
    sim = stage.simulation(NWORLD, Backend.mjwarp, "cpu")
    assert isinstance(sim, MjwarpSimulation)
    yield stage, Pipeline(sim), record_states(stage, sim, 10 * NWORLD)
    sim.close()


def test_states_are_of_both_kinds_of_episodes(recorded: Recorded) -> None:
    _, _, samples = recorded
    assert [sample.kind for sample in samples] == [SCRIPTED] * 5 + [RANDOM] * 5
    ctrl = np.stack([s.state["ctrl"].numpy() for s in samples if s.kind == RANDOM])
    assert len(np.unique(ctrl[..., 0])) == ctrl[..., 0].size  # a new target in each step and world


def test_the_cost_is_mujocos(recorded: Recorded) -> None:
    stage, pipeline, samples = recorded
    model = stage.model
    data = mujoco.MjData(model)
    for sample in samples[::3]:
        assert not pipeline.prepare(sample).any()
        for scale in (1.0, -0.5, 30.0):
            qacc = pipeline.array("qacc_smooth") * scale
            costs = pipeline.cost(qacc).numpy()
            for world in range(NWORLD):
                for name, values in sample.state.items():
                    getattr(data, name)[:] = values[world].numpy()
                mujoco.mj_forward(model, data)
                acceleration = qacc[world].double().numpy()
                residual = np.zeros(data.nefc)
                mujoco.mj_mulJacVec(model, data, residual, acceleration)
                cost = np.zeros(1)
                mujoco.mj_constraintUpdate(model, data, residual - data.efc_aref, cost, 0)
                change = acceleration - data.qacc_smooth
                product = np.zeros(model.nv)
                mujoco.mj_mulM(model, data, product, change)
                expected = cost[0] + 0.5 * change @ product
                assert costs[world] == pytest.approx(expected, rel=2e-3, abs=1e-3)


def test_a_wrong_solver_is_seen(recorded: Recorded, monkeypatch: Patch) -> None:
    stage, pipeline, samples = recorded
    native = NativeSimulation(stage.model, NWORLD)

    def wrong(m: object, d: object) -> None:
        pipeline._solvers[STOCK](m, d)
        forces = pipeline.array("qfrc_constraint")
        forces[1] *= 1.01
        pipeline.array("qacc")[2].fill_(np.nan)
        pipeline.array("overflow")[3] |= 1 << 9

    monkeypatch.setitem(pipeline._solvers, FUSED, wrong)
    part = bench_solver.compare(pipeline, native, samples[-1])
    native.close()
    assert not part["other rows"].any()
    assert max(part[f"qacc, {STOCK}"]) < 1e-3  # native MuJoCo's
    assert (part["difference"] <= bench_solver.AGREEMENT).tolist() == [True, False, False, True]
    assert part[f"qacc, {FUSED}"][2] == part["cost"][2] == np.inf
    assert part["cost"][[0, 1, 3]].tolist() == [0.0] * 3
    assert part[f"qfrc_constraint, {FUSED}"][1] > part[f"qfrc_constraint, {STOCK}"][1]
    assert part[f"ITERATIONS, {FUSED}"].tolist() == [False, False, False, True]
    assert not part[f"ITERATIONS, {STOCK}"].any()


SMALL = ["sim=mjwarp", "sim.device=cpu", "nworld=2", "--repetitions", "2"]
CAMERA = ["cameras=top", "scene.cameras.top.size=[32,32]"]


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        ("bench_cameras", [*SMALL, *CAMERA, "--draws", "1"], "top 32 x 32"),
        ("bench_ik", [*SMALL, "--nworld", "8", "--iterations", "40"], "1.0000"),
        ("bench_policy", [*SMALL[:3], "--steps", "5", "--repetitions", "2"], "policy adds"),
        ("bench_physics", [*SMALL, "batch.njmax=200", "--steps", "2"], "bare mujoco_warp.step"),
        (
            "profile_pixels",
            [
                "experiment=pixels",
                "task=reach",
                *SMALL[:3],
                *CAMERA,
                "job.episodes=4",
                "--batches=2",
            ],
            "aten::convolution_backward",
        ),
        ("bench_solver", [*SMALL[:3], "batch.njmax=200", "--states", "40"], "100.000 %"),
        (
            "bench_errors",
            [*SMALL[:3], "batch.njmax=200", "--states", "40", "--converge"],
            "0 void, 0 with another number of rows; fused step",
        ),
    ],
)
def test_a_benchmark_prints_its_table(
    name: str,
    options: list[str],
    expected: str,
    monkeypatch: Patch,
    capsys: Capture,
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("COLUMNS", "400")
    if name == "bench_policy":
        options = [
            *options,
            "controller=policy",
            f"policy={hold_above_red(tmp_path)}",
            "task=reach",
        ]
    short = (
        one_second_episode() if name in ("bench_physics", "bench_solver", "bench_errors") else ()
    )
    monkeypatch.setattr(sys, "argv", [name, *options, *short])
    runpy.run_path(str(TOOLS / f"{name}.py"), run_name="__main__")
    assert expected in capsys.readouterr().out


@pytest.mark.long
def test_an_arm_has_a_row_with_its_ratios_and_what_failed(tmp_path: Path) -> None:
    command = [sys.executable, str(TOOLS / "bench_arms.py"), "so101", *SMALL[:3], "batch.njmax=200"]
    options = ["--gates", "batch", "--warm", "--steps", "2", "--repetitions", "1"]
    done = subprocess.run(
        [*command, *one_second_episode(), *options, "--collision", "primitives"],
        check=True,
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    header, _, row = done.stdout.splitlines()
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert len(cells) == header.count("|") - 1 == 10
    assert cells[:3] == ["so101", "1 joints", "no meshes"]
    assert float(cells[4].split()[0]) > 1.0
    assert float(cells[5].split()[0]) > 1.0
    assert cells[-1].startswith("batch: ")


def test_random_actions_for_a_while() -> None:
    figures = soak.soak(["sim=native", "nworld=8", "task.episode_steps=40"], 120)
    assert not figures["problems"]
    assert figures["episodes"] >= 24


def test_equal_runs_have_equal_verdicts(tmp_path: Path) -> None:
    """What makes equal runs bit for bit alike has its own tests: this one reads a run twice."""
    command = [sys.executable, str(TOOLS / "verdicts.py")]
    files = [tmp_path / f"{name}.json" for name in ("before", "after")]
    for file in files:  # the second call finds the run in the folder
        options = ["--only=so101_reach", f"--folder={tmp_path}/runs", f"--out={file}"]
        subprocess.run([*command, "--python", sys.executable, *options], check=True)
    subprocess.run([*command, "--compare", *files], check=True)
    before, after = (json.loads(file.read_text()) for file in files)
    records = after["runs"]["so101_reach"]
    assert {"batch_seed0.npz", "success_seed0.npz"} == set(records)
    records["batch_seed0.npz"]["arrays"]["qpos"] = "other"
    (line,) = verdicts.compare(before, after)
    assert line.startswith("so101_reach/batch_seed0.npz: qpos differs")


@on_cuda
def test_the_fused_step_is_twice_as_fast_as_a_bare_one() -> None:
    stage = Stage(load_config(["sim=mjwarp", "nworld=2048"]))
    for random in (False, True):
        times = bench_physics.measure_plans(stage, 5, 3, random)
        ratios = [a / b for a, b in zip(times[bench_physics.BARE], times["fused"], strict=True)]
        assert np.median(ratios) > 2.0  # other tests beside it slow a repetition down
