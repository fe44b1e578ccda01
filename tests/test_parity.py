"""Gate *parity*: what it lets pass, and differences that are put into MJWarp's model."""

import copy
import math
import re
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
import torch
from doc_blocks import ROOT, write_files

import mjstack
from mjstack.config.schema import Backend
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Stage
from mjstack.gates.parity import compare_states, turn_between
from mjstack.math import quat_mul
from mjstack.report.record import GateResult, Status
from mjstack.sim import make_simulation

SCENES = {"box": "stack", "cylinder": "lift"}


@pytest.fixture(scope="module", params=SCENES)
def played(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The reference episode of a cube, or of the can of docs/own_tasks.md."""
    folder = tmp_path_factory.mktemp("docs")
    write_files((ROOT / "docs" / "own_tasks.md").read_text(encoding="utf-8"), folder)
    task = SCENES[request.param]
    cfg = mjstack.load_config([f"task={task}"], config_dir=folder / "lift" / "conf")
    run = Run(Stage(cfg))
    _ = run.nominal
    return run


def compared(run: Run, change: Callable[[mujoco.MjModel, list[int]], None]) -> list[str]:
    """Problems of a MJWarp world with a changed model."""
    model = copy.copy(run.stage.model)
    change(model, [model.body(name).id for name in run.stage.index.objects])
    mjwarp = make_simulation(model, run.cfg, 1, backend=Backend.mjwarp, device="cpu")
    try:
        return compare_states(run, mjwarp, GateResult(name="parity", status=Status.passed))
    finally:
        mjwarp.close()


def heavier(model: mujoco.MjModel, objects: list[int]) -> None:
    model.body_mass[objects] *= 1.01
    model.body_inertia[objects] *= 1.01
    mujoco.mj_setConst(model, mujoco.MjData(model))


def smoother(model: mujoco.MjModel, objects: list[int]) -> None:
    model.geom_friction *= 0.95


def undamped(model: mujoco.MjModel, objects: list[int]) -> None:
    model.dof_damping *= 0.95


def apart(model: mujoco.MjModel, objects: list[int]) -> None:
    """The table collides with the arm alone."""
    arm = ~np.isin(model.geom_bodyid, objects)
    model.geom_contype[arm] = 3
    table = model.geom("table").id
    model.geom_contype[table] = model.geom_conaffinity[table] = 2


def faster(model: mujoco.MjModel, objects: list[int]) -> None:
    model.opt.timestep *= 1.01


@pytest.mark.full
@pytest.mark.parametrize(
    ("change", "caught"),
    [
        (lambda model, objects: None, None),
        (heavier, r"in_(grasp|contact), 1 steps: qvel of "),
        (
            smoother,
            r"in_motion, 1 steps: \w+ of (red|blue|can) .*look first at (red|blue|can): its shape",
        ),
        (undamped, r"in_motion, 1 steps: qvel of \w+ .*look first at \w+: its servo, damping"),
        (apart, r"1 steps: contact_count of the world .*look first at (red|blue|can): its shape"),
        (faster, r"in_motion, 1 steps: \w+ of (red|blue|can) "),
    ],
)
def test_what_differs_is_caught_on_a_box_and_on_a_cylinder(
    change: Callable[[mujoco.MjModel, list[int]], None], caught: str | None, played: Run
) -> None:
    problems = compared(played, change)
    if caught is None:
        assert problems == []
    else:
        assert re.search(caught, "; ".join(problems)), problems


@pytest.mark.parametrize(
    ("shape", "axis", "expected"),
    [
        ("box", [0, 0, 1], 0.3),
        ("cylinder", [0, 0, 1], 0.0),  # about its axis
        ("cylinder", [1, 0, 0], 0.3),
        ("capsule", [1, 0, 0], 0.0),
        ("capsule", [0, 0, 1], 0.3),
        ("sphere", [1, 0, 0], 0.0),
    ],
)
def test_a_turn_that_nothing_shows_is_none(shape: str, axis: list[float], expected: float) -> None:
    start = torch.tensor([0.5, 0.5, 0.5, 0.5], dtype=torch.float64)
    half = torch.tensor([math.cos(0.15), *(math.sin(0.15) * x for x in axis)], dtype=torch.float64)
    assert turn_between(shape, start, quat_mul(start, half)) == pytest.approx(expected, abs=1e-12)
