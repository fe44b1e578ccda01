"""The solver gate: what it measures, and that its settings reach the physics."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from compositions import load_config, put
from environments import MakeSim, Patch, Refused, at_double_speed

from mjstack.bench.timing import describe_lost, lost_worlds
from mjstack.config.schema import Backend, Config
from mjstack.gates import solver
from mjstack.gates.parity import compare_options
from mjstack.jobs import check_job
from mjstack.report.record import GateResult, Status
from mjstack.scene import build_model
from mjstack.sim import LOST_PHYSICS, Simulation, SolverLimit, make_simulation


def measure(folder: Path, changes: str, *overrides: str) -> GateResult:
    """The result of the gate for a variant."""
    task = "box" if "task=box" in overrides else "stack"
    quick = ["gate.solver.repetitions=2", "gate.solver.steps=1", "nworld=2", "sim=native"]
    quick += [*at_double_speed(task=task), "web.episode=false"]
    args = ["experiment=solver", f"gate.solver.changes={{{changes}}}", *quick, *overrides]
    folder.mkdir(exist_ok=True)
    (result,) = check_job(load_config(args)).run(folder).gates
    return result


@pytest.mark.parametrize("changes", ["", pytest.param("iterations:5", marks=pytest.mark.full)])
def test_a_variant_beside_the_configured_solver(changes: str, tmp_path: Path) -> None:
    """With five iterations the grip is lost. The gate reports it, and passes: it measured."""
    result = measure(tmp_path, changes)
    metrics = result.metrics
    assert result.status is Status.passed
    assert result.notes["variant"] == ("iterations_5" if changes else "base")
    assert result.notes["changes"] == ("iterations=5" if changes else "nothing")
    assert (metrics["succeeded"] < 2) == bool(changes)
    assert ("not stacked" in result.notes["broken_rules"]) == bool(changes)
    assert 0.0 < metrics["ratio_min"] <= metrics["ratio"] <= metrics["ratio_max"]
    assert metrics["ms_min"] <= metrics["ms_per_batched_step"] <= metrics["ms_max"]
    assert metrics["base_ms"] > 0.0
    assert "iteration_limit_worlds" not in metrics


@pytest.mark.full
def test_a_simulation_that_breaks_is_a_failure_and_the_other_is_closed(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    simulations: list[Simulation] = []
    closed = []
    make = solver._simulation

    def fragile(context: object) -> Simulation:
        if simulations:
            raise RuntimeError("no room")
        simulations.append(make(context))  # type: ignore[arg-type]
        close = simulations[0].close
        monkeypatch.setattr(simulations[0], "close", lambda: closed.append(close()))
        return simulations[0]

    monkeypatch.setattr(solver, "_simulation", fragile)
    result = measure(tmp_path, "")
    assert result.status is Status.failed
    assert result.reason.startswith("RuntimeError: no room (test_solver_gate.py:")
    assert closed


@pytest.mark.full
def test_mjwarp_tells_who_stopped_at_a_limit(tmp_path: Path) -> None:
    mjwarp = ["sim=mjwarp", "sim.device=cpu", "nworld=1"]
    for number, (changes, count) in enumerate([("", 0), ("ls_iterations:5", 1)]):
        metrics = measure(tmp_path / str(number), changes, *mjwarp).metrics
        assert metrics["line_search_limit_worlds"] == count
        assert metrics["iteration_limit_worlds"] == 0


def test_limits_are_no_lost_physics() -> None:
    assert LOST_PHYSICS & int(SolverLimit.ITERATIONS | SolverLimit.LS_ITERATIONS) == 0


@pytest.mark.full
def test_no_time_for_worlds_that_diverged(make_sim: MakeSim, backend: str) -> None:
    sim = make_sim(backend, 2)
    sim.step(10)
    assert describe_lost(lost_worlds(sim, 10)) == ""
    assert lost_worlds(sim, 20).tolist() == [True, True]
    sim.qvel[1, 0] = torch.nan
    assert describe_lost(lost_worlds(sim, 10)).startswith("1 worlds overflowed, diverged")


@pytest.mark.full
def test_a_variant_without_its_steps_has_no_time(tmp_path: Path, monkeypatch: Patch) -> None:
    play = solver.HeldPhysics._play
    monkeypatch.setattr(solver.HeldPhysics, "_play", lambda self, steps: play(self, steps - 1))
    result = measure(tmp_path, "")
    assert result.status is Status.failed
    assert result.reason.startswith("no time: 2 worlds overflowed, diverged")


@pytest.mark.full
def test_the_box_is_measured_too(tmp_path: Path) -> None:
    metrics = measure(tmp_path, "", "task=box").metrics
    assert metrics["succeeded"] == 2
    assert 0.0 < metrics["slot_err_red_max_m"] < 0.02
    assert "xy_err_max_m" not in metrics


# The two settings that came with it


def gripper_geoms(model: mujoco.MjModel, cfg: Config) -> np.ndarray:
    bodies = [model.body(name).id for name in cfg.robot.jaw_bodies]
    return np.isin(model.geom_bodyid, bodies)


@pytest.mark.full
@pytest.mark.parametrize("condim", [3, 6])
def test_gripper_condim_reaches_the_gripper_alone(robot: str, condim: int) -> None:
    plain_cfg = load_config([f"robot={robot}"])
    plain = build_model(plain_cfg)
    model = build_model(put(load_config([f"robot={robot}"]), f"solver.gripper_condim={condim}"))
    gripper = gripper_geoms(model, plain_cfg)
    assert gripper.sum() >= 2
    assert (model.geom_condim[gripper] == condim).all()
    assert np.array_equal(model.geom_condim[~gripper], plain.geom_condim[~gripper])
    assert set(plain.geom_condim[gripper]) <= {3, 4, 6}


@pytest.mark.full
@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_cone_reaches_both_backends(cone: str) -> None:
    cfg = load_config([f"solver.cone={cone}"])
    model = build_model(cfg)
    native, mjwarp = (
        make_simulation(model, cfg, 1, backend=kind, device="cpu")
        for kind in (Backend.native, Backend.mjwarp)
    )
    configured, compiled, uploaded, equal = compare_options(cfg, native, mjwarp)["cone"]
    assert configured == compiled == uploaded == f"mjCONE_{cone.upper()}"
    assert equal


CHANGES = "gate.solver.changes="
BAD = [
    (["solver.cone=round"], "elliptic, pyramidal"),
    (["solver.gripper_condim=2"], "1, 3, 4, 6"),
    (["experiment=solver", f"{CHANGES}3"], "gate.solver.changes"),
    (["experiment=solver", f"{CHANGES}{{iteration:3}}"], "Did you mean 'iterations'?"),
    (["experiment=solver", f"{CHANGES}{{iterations:0}}"], "gate.solver.changes.iterations=0"),
    (["experiment=solver", f"{CHANGES}{{cone:round}}"], "one of elliptic, pyramidal"),
    (["experiment=solver", "gate.solver.repetitions=0"], "gate.solver.repetitions=0: expected"),
    (["-m", "experiment=solver", f"{CHANGES}{{}},{{cone:round}}"], "one of elliptic, pyramidal"),
]


@pytest.mark.full
@pytest.mark.parametrize(("overrides", "says"), BAD, ids=[" ".join(o) for o, _ in BAD])
def test_bad_input_is_one_line_and_nothing_is_written(
    overrides: list[str], says: str, refused: Refused
) -> None:
    assert says in refused(*overrides, "nworld=2", "sim=native")
