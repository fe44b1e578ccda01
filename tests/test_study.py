"""The solver study: what it measures, that a broken variant stops no other, and that its settings
reach the physics.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from compositions import load_config, put
from environments import at_double_speed

from mjstack.bench.timing import describe_lost, lost_worlds
from mjstack.cli import run
from mjstack.config.check import validate
from mjstack.config.schema import Backend, Config, StudyJobCfg
from mjstack.episodes.context import RunContext
from mjstack.errors import ConfigError, MjstackError
from mjstack.gates.parity import compare_options
from mjstack.jobs import CheckedJob, check_job, study
from mjstack.report.record import Report, Status
from mjstack.scene import build_model
from mjstack.sim import LOST_PHYSICS, Simulation, SolverLimit, make_simulation

QUICK = ("job=study", "sim=native", "nworld=2", "job.repetitions=2", "job.steps=1")


def configure(*overrides: str, keep: tuple[str, ...]) -> Config:
    """A study of some of its variants."""
    task = "box" if "task=box" in overrides else "stack"
    cfg = load_config([*QUICK, *at_double_speed(task=task), *overrides])
    assert isinstance(cfg.job, StudyJobCfg)
    cfg.job.variants = {name: cfg.job.variants[name] for name in keep}
    return cfg


def run_study(cfg: Config, folder: Path) -> Report:
    """Run the job without its check, which builds what `configure` has not changed."""
    job = CheckedJob(context=RunContext(cfg), title="study", work=study.run_study)
    return job.run(folder)


def table(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "study.csv").open() as file:
        return {row["variant"]: row for row in csv.DictReader(file)}


def report(folder: Path) -> dict:
    return json.loads((folder / "report.json").read_text())


def test_native_study(tmp_path: Path) -> None:
    cfg = configure(keep=("base", "iterations_5", "iterations_100", "condim_3", "cone_pyramidal"))
    outcome = run_study(cfg, tmp_path)
    assert outcome.exit_code == 0
    rows = table(tmp_path)
    assert list(rows) == ["base", "iterations_5", "iterations_100", "condim_3", "cone_pyramidal"]
    assert rows["base"]["succeeded"] == rows["condim_3"]["succeeded"] == "2"
    # With five iterations the grip is lost. A study says so, and passes: it measured.
    assert int(rows["iterations_5"]["succeeded"]) < 2
    assert "not stacked" in rows["iterations_5"]["broken_rules"]
    assert rows["iterations_5"]["status"] == "pass"
    assert (rows["iterations_100"]["status"], rows["iterations_100"]["reason"]) == (
        "skip",
        "the same as base",
    )
    assert rows["condim_3"]["changes"] == "gripper_condim=3"
    # A contact of the gripper has 6 rows as modelled, 3 with condim 3, and 10 with a pyramidal
    # cone.
    peak = {name: int(row["peak_rows"]) for name, row in rows.items() if row["peak_rows"]}
    assert peak["condim_3"] < peak["base"] < peak["cone_pyramidal"]
    for name in ("base", "iterations_5", "condim_3", "cone_pyramidal"):
        row = rows[name]
        low, middle, high = (float(row[key]) for key in ("ratio_min", "ratio", "ratio_max"))
        assert 0.0 < low <= middle <= high
        assert float(row["ms_min"]) <= float(row["ms_per_batched_step"]) <= float(row["ms_max"])
        assert "iteration_limit_worlds" not in row
    found = report(tmp_path)
    assert found["status"] == "pass"
    assert {gate["name"]: gate["status"] for gate in found["gates"]}["iterations_100"] == "skip"
    text = (tmp_path / "study.md").read_text()
    assert "| iterations_5 | iterations=5 |" in text
    assert "| 2 | 0 |" in text
    assert "does not tell which worlds stopped" in text
    assert (tmp_path / "study.png").stat().st_size > 10_000
    assert "![study.png](study.png)" in text


@pytest.mark.full
def test_a_broken_variant_stops_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make = study._simulation

    def fragile(context: RunContext) -> Simulation:
        if context.cfg.solver.iterations == 20:
            raise RuntimeError("it is bad\nat length")
        if context.cfg.solver.iterations == 10:
            raise MjstackError("this one cannot be.")
        return make(context)

    monkeypatch.setattr(study, "_simulation", fragile)
    cfg = configure(keep=("iterations_20", "iterations_10", "base"))
    outcome = run_study(cfg, tmp_path)
    assert outcome.exit_code == 1
    rows = table(tmp_path)
    assert [row["status"] for row in rows.values()] == ["fail", "fail", "pass"]
    reason = rows["iterations_20"]["reason"]
    assert reason.startswith("RuntimeError: it is bad (test_study.py:")
    assert reason.endswith("; run.log has the traceback)")
    assert rows["iterations_10"]["reason"] == "this one cannot be."
    assert rows["iterations_20"]["ratio"] == ""
    assert report(tmp_path)["status"] == "fail"


@pytest.mark.full
def test_without_a_base_there_is_a_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(_: RunContext) -> Simulation:
        raise RuntimeError("no room")

    monkeypatch.setattr(study, "_simulation", broken)
    assert run_study(configure(keep=("base",)), tmp_path).exit_code == 1
    assert report(tmp_path)["status"] == "fail"
    assert "mjstack: RuntimeError: no room (test_study.py:" in capsys.readouterr().err


@pytest.mark.full
def test_a_base_that_breaks_is_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    closed = []
    sim = SimpleNamespace(close=lambda: closed.append(True))
    monkeypatch.setattr(study, "_simulation", lambda context: sim)
    assert run_study(configure(keep=("base",)), tmp_path).exit_code == 1
    assert closed == [True]


@pytest.mark.full
def test_ctrl_c_keeps_what_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measure = study._measure
    calls = []

    def interrupted(*args: object) -> None:
        calls.append(args)
        if len(calls) == 2:
            raise KeyboardInterrupt
        measure(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(study, "_measure", interrupted)
    cfg = configure(keep=("base", "condim_3", "condim_4"))
    outcome = run_study(cfg, tmp_path)
    assert outcome.exit_code == 130
    assert list(table(tmp_path)) == ["base"]
    found = report(tmp_path)
    assert found["status"] == "interrupted"
    assert [gate["name"] for gate in found["gates"]] == ["base"]


@pytest.mark.full
def test_mjwarp_tells_who_stopped_at_a_limit(tmp_path: Path) -> None:
    cfg = configure("sim=mjwarp", "sim.device=cpu", "nworld=1", keep=("base", "ls_iterations_5"))
    assert run_study(cfg, tmp_path).status is Status.passed
    rows = table(tmp_path)
    assert rows["base"]["iteration_limit_worlds"] == rows["base"]["line_search_limit_worlds"] == "0"
    assert rows["ls_iterations_5"]["line_search_limit_worlds"] == "1"
    assert rows["ls_iterations_5"]["iteration_limit_worlds"] == "0"


def test_limits_are_no_lost_physics() -> None:
    assert LOST_PHYSICS & int(SolverLimit.ITERATIONS | SolverLimit.LS_ITERATIONS) == 0


@pytest.mark.full
def test_no_time_for_worlds_that_diverged(
    make_sim: Callable[..., Simulation], backend: str
) -> None:
    sim = make_sim(backend, 2)
    sim.step(10)
    assert describe_lost(lost_worlds(sim, 10)) == ""
    assert lost_worlds(sim, 20).tolist() == [True, True]
    sim.qvel[1, 0] = torch.nan
    assert describe_lost(lost_worlds(sim, 10)).startswith("1 worlds overflowed, diverged")


@pytest.mark.full
def test_a_variant_without_its_steps_has_no_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    play = study.HeldPhysics._play

    def lazy(self: study.HeldPhysics, steps: int) -> None:
        play(self, steps - 1)

    monkeypatch.setattr(study.HeldPhysics, "_play", lazy)
    assert run_study(configure(keep=("base",)), tmp_path).exit_code == 1
    assert table(tmp_path)["base"]["reason"].startswith("no time: 2 worlds overflowed, diverged")


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
    asked, held, uploaded, equal = compare_options(cfg, native, mjwarp)["cone"]
    assert asked == held == uploaded == f"mjCONE_{cone.upper()}"
    assert equal


BAD = [
    (["solver.cone=round"], "elliptic, pyramidal"),
    (["solver.gripper_condim=2"], "1, 3, 4, 6"),
    (["job=studies"], "Did you mean 'study'?"),
    (["job=stud_schema"], "Did you mean 'study'? Available: collect, export,"),
    (["job.repetitions=3"], "job.repetitions"),
    (["job=study", "+job.variants.mine=3"], "job.variants.mine=3: expected a mapping"),
    (["job=study", "+job.variants.mine={iteration: 3}"], "Did you mean 'iterations'?"),
    (["job=study", "+job.variants.mine={iterations: 0}"], "job.variants.mine.iterations=0"),
    (["job=study", "+job.variants.mine={iterations: few}"], "job.variants.mine.iterations=few"),
    (["job=study", "+job.variants.mine={cone: round}"], "one of elliptic, pyramidal"),
    (
        ["job=study", "job.variants.condim_3.gripper_condim=5"],
        "job.variants.condim_3.gripper_condim=5",
    ),
    (["job=study", "job.variants=null"], "job.variants"),
    (["job=study", "task=reach", "task.check=null"], "task=reach"),
]


@pytest.mark.full
@pytest.mark.parametrize(("overrides", "says"), BAD, ids=[" ".join(o) for o, _ in BAD])
def test_bad_input_is_one_line_and_nothing_is_written(
    overrides: list[str],
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run([*overrides, "nworld=2", "sim=native"]) == 2
    message = capsys.readouterr().err.strip()
    assert says in message
    assert "\n" not in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("value", ["job.repetitions=0", "job.max_seconds=0"])
def test_range_of_a_number(value: str) -> None:
    with pytest.raises(ConfigError, match=f"{value}: expected"):
        validate(put(load_config(["job=study"]), value))


@pytest.mark.full
def test_an_own_variant_takes_the_rest_from_the_configured_solver() -> None:
    cfg = load_config(
        ["job=study", "solver=asset", "+job.variants.mine={iterations: 7, cone: pyramidal}"]
    )
    assert isinstance(cfg.job, StudyJobCfg)
    mine = cfg.job.variants["mine"]
    assert (mine.iterations, mine.cone, mine.impratio) == (7, "pyramidal", None)
    check_job(cfg)


@pytest.mark.full
def test_the_box_is_studied_too(tmp_path: Path) -> None:
    cfg = configure("task=box", keep=("base",))
    assert run_study(cfg, tmp_path).exit_code == 0
    (row,) = table(tmp_path).values()
    assert row["status"] == "pass"
    assert row["succeeded"] == "2"
    assert 0.0 < float(row["slot_err_red_max_m"]) < 0.02
    assert "xy_err_max_m" not in row
