"""Gate *parity*: what it lets pass, and differences that are put into MJWarp's model."""

import copy
import math
import re
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
import torch
from compositions import load_config
from doc_blocks import ROOT, write_files
from environments import few

from mjstack.config.schema import Backend
from mjstack.episodes.rollout import State
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Stage
from mjstack.gates.parity import (
    _compare_ends,
    compare_options,
    compare_states,
    differences,
    end_state,
    turn_between,
)
from mjstack.math import quat_mul
from mjstack.report.record import GateResult, Status
from mjstack.scene import build_model
from mjstack.sim import Simulation, make_simulation
from mjstack.sim.mjwarp import MjwarpSimulation

SCENES = {"box": "stack", "cylinder": "lift", "box in the jaws": "peg"}
OBJECT = "(red|blue|can|peg)"


@pytest.fixture(scope="module", params=SCENES)
def played(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The reference episode of a cube, of the can of docs/own_tasks.md, or of a peg."""
    folder = tmp_path_factory.mktemp("docs")
    write_files((ROOT / "docs" / "own_tasks.md").read_text(encoding="utf-8"), folder)
    task = SCENES[request.param]
    home = ROOT / "examples" / "peg" if task == "peg" else folder / "lift"
    cfg = load_config([f"task={task}"], config_dir=home / "conf")
    run = Run(Stage(cfg))
    _ = run.nominal
    return run


def compared(
    run: Run, change: Callable[[mujoco.MjModel, list[int]], None]
) -> tuple[list[str], list[str]]:
    """Problems of a MJWarp world with a changed model: of the model itself, and of its steps."""
    model = copy.copy(run.stage.model)
    change(model, [model.body(name).id for name in run.stage.index.objects])
    mjwarp = make_simulation(model, run.cfg, 1, backend=Backend.mjwarp, device="cpu")
    with closing(mjwarp):
        return split(run, mjwarp)


def split(run: Run, mjwarp: Simulation) -> tuple[list[str], list[str]]:
    """Problems of MJWarp's model, and of its steps."""
    problems = compare_states(run, mjwarp, GateResult(name="parity", status=Status.passed))
    own = [text for text in problems if text.startswith("model: ")]
    return own, [text for text in problems if text not in own]


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
        (heavier, r"swung, 1 steps: qvel of "),
        (smoother, rf"in_motion, 1 steps: \w+ of {OBJECT} .*look first at {OBJECT}: its shape"),
        (undamped, r"in_motion, 1 steps: qvel of \w+ .*look first at \w+: its servo, damping"),
        (
            apart,
            r"1 steps: contact_count of the world .*look first at (red|blue|can|peg): its shape",
        ),
        (faster, r"in_motion, 1 steps: qvel of \w+ "),
    ],
)
def test_what_differs_is_caught_on_a_box_and_on_a_cylinder(
    change: Callable[[mujoco.MjModel, list[int]], None], caught: str | None, played: Run
) -> None:
    of_model, of_steps = compared(played, change)
    if caught is None:
        assert of_model == of_steps == []
    else:
        assert re.search(caught, "; ".join(of_steps)), of_steps
        assert bool(of_model) == (change is not faster)  # a time step is no array of the model


@pytest.mark.full
def test_contacts_that_float32_misses_by_chance_pass_and_lost_ones_do_not() -> None:
    """Of a puck that just touches the table, and of a table that touches no object."""
    run = Run(Stage(load_config(["task=push"], config_dir=ROOT / "examples/push/conf")))
    result = GateResult(name="parity", status=Status.passed)
    with closing(make_simulation(run.stage.model, run.cfg, 1, backend=Backend.mjwarp)) as mjwarp:
        assert compare_states(run, mjwarp, result) == []
    limits = [v for name, v in result.thresholds.items() if name.endswith("contact_count")]
    assert {0.0} < {*limits} <= {0.0, 1.0, 2.0, 3.0, 4.0}  # ranges, not multiples of them
    assert any("contact_count" in text for text in compared(run, apart)[1])


MESH = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast" cone="elliptic" tolerance="1e-10"/>
  <asset><mesh name="brick" vertex="-.03 -.02 -.01  .03 -.02 -.01  -.03 .02 -.01  .03 .02 -.01
    -.03 -.02 .01  .03 -.02 .01  -.03 .02 .01  .03 .02 .01"/></asset>
  <worldbody>
    <geom type="box" size=".2 .2 .02"/>
    <body pos="0 0 .0297" quat="1 .002 .003 0">
      <freejoint/><geom type="mesh" mesh="brick" mass=".1"/>
    </body>
  </worldbody>
</mujoco>
"""


def test_one_contact_of_a_mesh_is_the_same_on_both_backends() -> None:
    """Where one backend finds several, and the other one, their steps differ."""
    model = mujoco.MjModel.from_xml_string(MESH)
    cfg = load_config([])
    state = State(model.qpos0[None], np.full((1, 6), 0.1), np.zeros((1, 0)))
    sims = [
        make_simulation(model, cfg, 1, backend=kind, device="cpu")
        for kind in (Backend.native, Backend.mjwarp)
    ]
    apart = []
    for off in ((False, True), (True, True), (False, False)):
        for sim, flag in zip(sims, off, strict=True):
            sim.switch(int(mujoco.mjtDisableBit.mjDSBL_MULTICCD), off=flag)
        apart.append(differences(*(end_state(sim, state, 1) for sim in sims)))
    counts = [float(gaps["contact_count"].max()) for gaps in apart]
    speeds = [float(gaps["qvel"].max()) for gaps in apart]
    assert counts[0] > 0.0
    assert counts[1:] == [0.0, 0.0]
    assert speeds[0] > 0.01
    assert max(speeds[1:]) < 1e-3


class Uploaded(NamedTuple):
    """A robot's reference episode, and its MJWarp world."""

    run: Run
    mjwarp: MjwarpSimulation

    @contextmanager
    def scaled(self, name: str, factor: float, *column: int) -> Iterator[None]:
        """An array that MJWarp holds, with some numbers of all its rows or of one changed."""
        array = getattr(self.mjwarp._m, name)
        kept = array.numpy().copy()
        changed = kept.copy().reshape(getattr(self.run.stage.model, name).shape)
        changed[..., *column] *= factor
        array.assign(changed.reshape(kept.shape))
        try:
            yield
        finally:
            array.assign(kept)


@pytest.fixture(scope="module", params=["so101", "rebot"])
def uploaded(request: pytest.FixtureRequest) -> Iterator[Uploaded]:
    run = Run(Stage(load_config([f"robot={request.param}"])))
    with closing(make_simulation(run.stage.model, run.cfg, 1, backend=Backend.mjwarp)) as mjwarp:
        assert isinstance(mjwarp, MjwarpSimulation)
        yield Uploaded(run, mjwarp)


def test_two_healthy_arms_pass_within_the_limits_that_were_constants(uploaded: Uploaded) -> None:
    """The limits of states that were compared with constants are at most those."""
    step1 = {"qpos": 1e-6, "qvel": 1e-4, "xpos": 1e-6, "xquat": 1e-6, "site_xpos": 1e-6}
    step1 |= {"qfrc_actuator": 1e-3, "contact_count": 0.0}
    step50 = {"qpos": 1e-3, "qvel": 5e-2, "xpos": 5e-5, "xquat": 1e-3, "site_xpos": 5e-5}
    step50 |= {"qfrc_actuator": 2e-2, "contact_count": 0.0}
    result = GateResult(name="parity", status=Status.passed)
    assert compare_states(uploaded.run, uploaded.mjwarp, result) == []
    for name, limit in result.thresholds.items():
        state, steps, field = name.split(".")
        if state != "twisted":
            assert limit <= {"step1": step1, "step50": step50}[steps][field], name


@pytest.mark.full
def test_the_gain_of_every_servo_shows(uploaded: Uploaded) -> None:
    """Also that of a hand whose servo is at its target or at its limit in every episode's state."""
    model = uploaded.run.stage.model
    for number in range(model.nu):
        joint = model.actuator(number).name
        with (
            uploaded.scaled("actuator_gainprm", 1.01, number, 0),
            uploaded.scaled("actuator_biasprm", 1.01, number, 1),
        ):
            of_model, of_steps = split(uploaded.run, uploaded.mjwarp)
        assert f"_biasprm of actuator {joint} is " in of_model[0]
        assert any(f"in_motion, 1 steps: qfrc_actuator of {joint} " in text for text in of_steps)
        assert of_steps[-1] == f"look first at {joint}: its servo, damping and range"


@pytest.mark.full
@pytest.mark.parametrize("direction", ["slide", "torsion", "roll"])
def test_every_direction_of_friction_shows(direction: str, uploaded: Uploaded) -> None:
    """reBot's pads do not resist rolling: there the model alone differs."""
    model = uploaded.run.stage.model
    column = ["slide", "torsion", "roll"].index(direction)
    with uploaded.scaled("geom_friction", 0.94, column):
        of_model, of_steps = split(uploaded.run, uploaded.mjwarp)
    assert "geom_friction of geom " in of_model[0]
    rolls = (model.geom_condim == 6).any()
    assert bool(of_steps) == (direction != "roll" or rolls)
    if of_steps:
        assert any("twisted, 1 steps: qvel of red " in text for text in of_steps)
        assert of_steps[-1] == "look first at red: its shape, mass, friction and contacts"


@pytest.mark.full
def test_what_no_state_shows_is_found_in_the_model(uploaded: Uploaded) -> None:
    for name in ("actuator_forcerange", "jnt_range", "geom_solimp", "dof_invweight0"):
        with uploaded.scaled(name, 1.001):
            of_model, _ = split(uploaded.run, uploaded.mjwarp)
        assert re.fullmatch(rf"model: {name} of \w+ \w+ is \S+, natively \S+", of_model[0])
        assert len(of_model) == 1
    assert split(uploaded.run, uploaded.mjwarp) == ([], [])


@pytest.mark.full
@pytest.mark.parametrize("played", ["box in the jaws"], indirect=True)
def test_the_reference_is_the_solution_where_native_mujoco_stops_short(played: Run) -> None:
    """A native step at the model's tolerance may lie beyond the limits of the converged one."""
    model = copy.copy(played.stage.model)
    state = played.nominal.states[played.parity_steps["in_contact"]]
    ends = []
    for tolerance in (model.opt.tolerance, 1e-9, 1e-12):
        model.opt.tolerance = tolerance
        with closing(make_simulation(model, played.cfg, 1, backend=Backend.native)) as sim:
            ends.append(end_state(sim, state, 1))
    limit = 5e-5  # of the gate
    stopped, converged = (float(differences(end, ends[-1])["qvel"].max()) for end in ends[:2])
    assert stopped > 100.0 * limit
    assert converged < 1e-3 * limit


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


LINKAGE = """
name: droid
title: FR3 with a Robotiq 2F-85, of package tabletask
arm_joints: [joint1, joint2, joint3, joint4, joint5, joint6, joint7]
gripper_joints: [right_driver_joint, left_driver_joint]
jaw_bodies: [right_pad, left_pad]
home: [0.0, -0.11101, 0.0, -2.27058, 0.0, 2.15905, 0.0, 0.05, 0.05]
gripper_open: [0.05, 0.05]
gripper_closed: [0.6, 0.6]
approach_body: base
approach_axis: [0.0, 0.0, 1.0]
grasp_sites: [palm_a, palm_b]
grasp_parts: {palm_a: [base], palm_b: [base]}
grasp_pos: {palm_a: [0.0, 0.022, 0.145], palm_b: [0.0, -0.022, 0.145]}
roll_joint: joint7
yaw_alignment: 1.0
approach_gain: 0.5
finger_room: 0.02
locked: {joint3: 0.0, joint5: 0.0, joint7: 0.0}
placements:
  stack:
    table_center: [0.5, 0.0, 0.012]
    table_half: [0.18, 0.3, 0.012]
    objects: {red: [0.5, -0.1], blue: [0.5, 0.1]}
    random_xy: [0.03, 0.03]
"""


@pytest.mark.full
def test_a_stranger_s_linkage_passes_and_its_faults_show(tmp_path: Path) -> None:
    """Its light links are off by more than the 1e-4 rad/s that was the limit of every robot."""
    package = find_spec("tabletask")
    if package is None or package.origin is None:
        pytest.skip("package tabletask, which has the robot's file, is not installed")
    file = Path(package.origin).parent / "mujoco/robots/assets/droid/model.xml"
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot/droid.yaml").write_text(f"{LINKAGE}file: {file}\n", encoding="utf-8")
    run = Run(Stage(load_config(["robot=droid"], config_dir=tmp_path)))
    with closing(make_simulation(run.stage.model, run.cfg, 1, backend=Backend.mjwarp)) as mjwarp:
        assert isinstance(mjwarp, MjwarpSimulation)
        arm = Uploaded(run, mjwarp)
        result = GateResult(name="parity", status=Status.passed)
        assert compare_states(run, mjwarp, result) == []
        off = [value for name, value in result.metrics.items() if name.endswith("step1.qvel")]
        assert max(off) > 1e-4
        for joint in (0, 7):  # the last are the fingers'
            with arm.scaled("actuator_gainprm", 1.01, joint, 0):
                of_steps = split(run, mjwarp)[1]
            assert of_steps[-1].startswith(f"look first at {run.cfg.robot.joints[joint]}: ")
        with arm.scaled("geom_friction", 0.94, 0):
            assert split(run, mjwarp)[1]


JOINTS = """
<mujoco>
  <worldbody>
    <body><joint name="arm"/><geom size="0.1"/></body>
    <body><joint name="drawer" type="slide"/><geom size="0.1"/></body>
    <body><joint name="lid"/><geom size="0.1"/></body>
    <body><joint name="knob" type="ball"/><geom size="0.1"/></body>
    <body><freejoint name="loose"/><geom size="0.1"/></body>
    <body><freejoint name="can"/><geom size="0.1"/></body>
    <body><joint type="slide"/><geom size="0.1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize(
    ("dof", "by", "problems", "farthest"),
    few(
        [
            ("arm", 1.0, [], ["drawer ends 0.00 mm", "can ends 0.00 mm and 0.00 deg"]),
            ("drawer", 2e-5, [], ["drawer ends 0.02 mm", "can ends 0.00 mm and 0.00 deg"]),
            ("drawer", -0.003, ["drawer ends 3.00 mm"], None),
            ("drawer", math.nan, ["drawer ends nan mm"], None),
            ("lid", 0.02, [], ["lid ends 1.15 deg", "can ends 0.00 mm and 0.00 deg"]),
            ("lid", 2 * math.pi, ["lid ends 360.00 deg"], None),
            ("knob", 0.04, ["knob ends 2.29 deg"], None),
            ("loose", 0.003, ["loose ends 3.00 mm and 0.00 deg"], None),
            ("can", 0.001, [], ["drawer ends 0.00 mm", "can ends 1.00 mm and 0.00 deg"]),
            ("can", 0.003, ["can ends 3.00 mm and 0.00 deg"], None),
            (6, 0.004, ["joint 6 ends 4.00 mm"], None),
        ],
        2,
    ),
)
def test_ends_of_all_joints_but_the_robots_are_compared(
    dof: str | int, by: float, problems: list[str], farthest: list[str] | None
) -> None:
    """Also of a fixture, by the limits of objects: position of slides, rotation of hinges."""
    model = mujoco.MjModel.from_xml_string(JOINTS)
    cfg = load_config(["task=reach"])
    cfg.robot.arm_joints, cfg.robot.gripper_joints = ["arm"], []
    cfg.scene.objects["can"] = next(iter(cfg.scene.objects.values()))
    change = np.zeros(model.nv)
    change[int(model.joint(dof).dofadr[0])] = by
    ends = [model.qpos0.copy() for _ in range(2)]
    mujoco.mj_integratePos(model, ends[0], change, 1.0)
    nominal = SimpleNamespace(world=SimpleNamespace(qpos=ends[1][None]))
    stage = SimpleNamespace(model=model, play=lambda sim, reset, worlds: None)
    run = SimpleNamespace(cfg=cfg, stage=stage, nominal=nominal)
    result = GateResult(name="parity", status=Status.passed)
    found, lines = _compare_ends(run, ends[0], result, rounded=True)  # type: ignore[arg-type]
    assert found == [f"{text} from native's" for text in problems]
    assert farthest is None or lines == [f"{text} from native's" for text in farthest]
    assert not any("arm" in name for name in result.metrics)
    assert {"final.drawer.position_m", "final.lid.rotation_deg"} <= result.metrics.keys()


def test_an_end_that_native_mujoco_reaches_by_rounding_passes() -> None:
    model = mujoco.MjModel.from_xml_string(JOINTS)
    cfg = load_config(["task=reach"])
    drawer = int(model.joint("drawer").qposadr[0])
    end, near = model.qpos0.copy(), model.qpos0.copy()
    end[drawer], near[drawer] = 0.005, 0.004

    def play(sim: Simulation, reset: object, worlds: list[int]) -> None:
        assert worlds == [0] * sim.nworld  # all from the start of world 0
        sim.qpos[3] = torch.from_numpy(near)

    nominal = SimpleNamespace(world=SimpleNamespace(qpos=model.qpos0[None]))
    stage = SimpleNamespace(model=model, play=play)
    run = SimpleNamespace(cfg=cfg, stage=stage, nominal=nominal)
    for rounded, problems in ((True, []), (False, ["drawer ends 5.00 mm from native's"])):
        result = GateResult(name="parity", status=Status.passed)
        found, _ = _compare_ends(run, end, result, rounded=rounded)  # type: ignore[arg-type]
        assert found == problems
        text = "drawer ends 0.5 of the limit from one of 8 native worlds that round"
        assert result.details == [text] * rounded


@pytest.mark.full
@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_the_cone_reaches_both_backends(cone: str) -> None:
    cfg = load_config([f"solver.cone={cone}"])
    model = build_model(cfg)
    native, mjwarp = (
        make_simulation(model, cfg, 1, backend=kind, device="cpu")
        for kind in (Backend.native, Backend.mjwarp)
    )
    compiled, uploaded, equal = compare_options(native, mjwarp)["cone"]
    assert compiled == uploaded == f"mjCONE_{cone.upper()}"
    assert equal
