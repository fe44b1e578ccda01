"""The comparison of the two solvers: its cost, its reference, and what it reports."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
from compositions import load_config
from environments import one_second_episode

from mjstack.bench import cli, solver
from mjstack.bench.pipeline import FUSED, SOLVERS, STOCK, Pipeline
from mjstack.bench.states import RANDOM, Sample, name_kinds, record_states
from mjstack.config.schema import Backend
from mjstack.episodes.context import RunContext
from mjstack.scene.phases import build_phases
from mjstack.sim.mjwarp import MjwarpSimulation
from mjstack.sim.native import NativeSimulation

NWORLD = 4
Recorded = tuple[RunContext, Pipeline, list[Sample]]


@pytest.fixture(scope="module")
def recorded() -> Iterator[Recorded]:
    overrides = ("sim.device=cpu", f"nworld={NWORLD}", *one_second_episode())
    context = RunContext(cfg=load_config(overrides))
    sim = context.simulation(NWORLD, Backend.mjwarp, "cpu")
    assert isinstance(sim, MjwarpSimulation)
    yield context, Pipeline(sim), record_states(context, sim, 10 * NWORLD)
    sim.close()


def test_states_are_of_both_kinds_of_episodes(recorded: Recorded) -> None:
    _, _, samples = recorded
    assert len(samples) == 10
    kinds = [sample.kind[0] for sample in samples]
    assert kinds[0] == "before contact"
    assert kinds.count(RANDOM) == 5
    ctrl = np.stack([s.state["ctrl"].numpy() for s in samples if s.kind[0] == RANDOM])
    assert len(np.unique(ctrl[..., 0])) == ctrl[..., 0].size  # a new target in each step and world
    warm = np.stack([s.state["qacc_warmstart"].numpy() for s in samples])
    assert np.isfinite(warm).all()
    assert warm.any(axis=(1, 2)).all()


@pytest.mark.parametrize("task", ["stack", "box"])
def test_phases_have_kinds_in_their_order(task: str) -> None:
    names = name_kinds(build_phases(load_config((f"task={task}",))))
    assert list(dict.fromkeys(names)) == ["before contact", "grasp", "carried", "put down"]


def test_the_cost_is_mujocos(recorded: Recorded) -> None:
    context, pipeline, samples = recorded
    model = context.model
    data = mujoco.MjData(model)
    contacts = 0
    for sample in samples[::3]:
        assert not pipeline.prepare(sample).any()
        for scale in (1.0, -0.5, 30.0):
            qacc = pipeline.array("qacc_smooth") * scale
            found = pipeline.cost(qacc).numpy()
            for world in range(NWORLD):
                for name, values in sample.state.items():
                    getattr(data, name)[:] = values[world].numpy()
                mujoco.mj_forward(model, data)
                acceleration = qacc[world].double().numpy()
                residual = np.zeros(data.nefc)
                mujoco.mj_mulJacVec(model, data, residual, acceleration)
                cost = np.zeros(1)
                mujoco.mj_constraintUpdate(model, data, residual - data.efc_aref, cost, 0)
                away = acceleration - data.qacc_smooth
                product = np.zeros(model.nv)
                mujoco.mj_mulM(model, data, product, away)
                expected = cost[0] + 0.5 * away @ product
                contacts += data.ncon
                assert found[world] == pytest.approx(expected, rel=2e-3, abs=1e-3)
    assert contacts > 0


def test_native_mujoco_solves_what_mjwarp_does(recorded: Recorded) -> None:
    context, pipeline, samples = recorded
    native = NativeSimulation(context.model, NWORLD)
    for sample in samples[::3]:
        pipeline.prepare(sample)
        found = pipeline.solve(STOCK)["qacc"].numpy()
        residuals = pipeline.residuals(pipeline.array("qacc_smooth")).numpy()
        expected = solver.solve_natively(native, sample, residuals.shape[1])
        assert (expected["nefc"][:, 0] == pipeline.array("nefc").numpy()).all()
        scale = abs(expected["qacc_smooth"]).max()
        assert abs(found - expected["qacc"]).max() < 1e-3 * scale
        rows = np.arange(residuals.shape[1]) < expected["nefc"]
        residuals = np.where(rows, residuals, np.inf)
        assert not solver._differ(residuals, expected["residuals"]).any()
    native.close()


def test_a_wrong_solver_is_seen(recorded: Recorded, monkeypatch: pytest.MonkeyPatch) -> None:
    context, pipeline, samples = recorded
    native = NativeSimulation(context.model, NWORLD)

    def wrong(m: object, d: object) -> None:
        pipeline._solvers[STOCK](m, d)
        forces = pipeline.array("qfrc_constraint")
        forces[1] *= 1.01
        pipeline.array("qacc")[2].fill_(np.nan)
        pipeline.array("overflow")[3] |= 1 << 9

    monkeypatch.setitem(pipeline._solvers, FUSED, wrong)
    part = solver._compare(pipeline, native, samples[-1])
    native.close()
    assert (part["difference"] <= solver.AGREEMENT).tolist() == [True, False, False, True]
    assert part[f"qacc, {FUSED}"][2] == part["cost"][2] == np.inf
    assert part["cost"][[0, 1, 3]].tolist() == [0.0] * 3
    assert part[f"qfrc_constraint, {FUSED}"][1] > part[f"qfrc_constraint, {STOCK}"][1]
    assert part[f"ITERATIONS, {FUSED}"].tolist() == [False, False, False, True]
    assert not part[f"ITERATIONS, {STOCK}"].any()


def test_other_rows_are_found_in_any_order() -> None:
    expected = np.array([[1.0, -5.0, np.inf]] * 4)
    found = np.array(
        [[-5.004, 1.0, np.inf], [-5.0, 1.02, np.inf], [1.0, np.inf, np.inf], [1.0, -5.0, 0.0]]
    )
    assert solver._differ(found, expected).tolist() == [False, True, True, True]


def test_the_report_has_figures_and_a_list() -> None:
    count = 4
    numbers: solver.Numbers = {
        "sample": np.arange(count),
        "world": np.array([5, 6, 7, 8]),
        "kind": np.array(["grasp", "grasp", RANDOM, RANDOM]),
        "void": np.array([False, True, False, False]),
        "other rows": np.array([False, False, False, True]),
        "difference": np.array([1e-5, np.inf, 2e-3, 1e-3]),
        solver.TOLERANCES: np.array([0.0, 9.0, -0.9, 3.0]),
        "efc.force": np.zeros(count),
        "efc.state": np.array([True, True, False, True]),
        "cost": np.array([-1.0, 5.0, 1e-7, 2e-6]),
    }
    for name, stock in (("iterations", 2), ("ITERATIONS", False), ("LS_ITERATIONS", True)):
        numbers |= {f"{name}, {s}": np.full(count, stock) for s in SOLVERS}
    numbers[f"LS_ITERATIONS, {FUSED}"] = np.array([True, False, False, True])
    for name in solver.VECTORS:
        numbers[f"{name}, difference"] = numbers["difference"]
        numbers[f"{name}, {STOCK}"] = np.array([1.0, 9.0, 2.0, 9.0])
        numbers[f"{name}, {FUSED}"] = np.array([1.0, 9.0, 3.0, 9.0])
    figures, listed = solver.report(numbers)
    assert figures.header == ["", "grasp", RANDOM, "all"]
    rows = {row[0].partition(" (")[0]: row[1:] for row in figures.rows}
    assert rows["states"] == ["2", "2", "4"]
    assert rows["void: not finite, or a buffer too small"] == ["1", "0", "1"]
    assert rows["not compared with native: other rows there"] == ["0", "1", "1"]
    assert rows["qacc, ratio of the errors"] == ["1 / 1 / 1", "1.5 / 1.5 / 1.5", "1.5 / 1.5 / 1.5"]
    assert rows["qacc agrees within 0.001"] == ["100.000 %", "50.000 %", "66.667 %"]
    assert rows["do not agree / costs within the tolerance"] == ["0 / 0", "1 / 1", "1 / 1"]
    assert rows["efc.state of a row differs"] == ["1", "1", "2"]
    assert rows["cost, worst change"] == ["-1", "+2e-06", "+2e-06"]
    assert rows[f"limit LS_ITERATIONS: {STOCK} / {FUSED} / differ"] == [
        "1 / 1 / 0",
        "2 / 1 / 1",
        "3 / 2 / 1",
    ]
    assert [row[:4] for row in listed.rows] == [["2", "7", RANDOM, "0.002"]]


@pytest.mark.full
def test_the_benchmark_compares_the_solvers(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "400")
    small = ["sim.device=cpu", "nworld=4", "batch.njmax=200", *one_second_episode()]
    cli.main("solver", [*small, "--states", "80"])
    out = " ".join(capsys.readouterr().out.split())
    assert "qacc agrees within 0.001" in out
    assert "100.000 %" in out
