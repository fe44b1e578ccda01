"""One contract for every backend."""

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from threading import Barrier

import mujoco
import numpy as np
import pytest
import torch
from compositions import load_config, refusal
from environments import (
    POSES,
    STATE,
    GetStage,
    MakeSim,
    Patch,
    assert_same_run,
    on_backend,
    start_moving,
)

from mjstack.config.schema import Backend
from mjstack.errors import MjstackError
from mjstack.scene import build_model
from mjstack.sim import BatchSizes, Simulation, SolverLimit, compiling, make_simulation
from mjstack.sim.fused.step import StepPlan
from mjstack.sim.mujoco_warp import mjw, wp

N = 3
VIEWS = (*STATE, *POSES, "qfrc_actuator", "sensordata")
COUNTS = ("contact_count", "constraint_count", "peak_contacts", "peak_constraints", "overflow")


# An arm with an activation and sensors, and a ball: what the robots' scenes lack.
SENSING = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="arm" pos="0 0 0.5">
      <joint name="elbow" type="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02"/>
      <site name="tip" pos="0.2 0 0"/>
    </body>
    <body name="ball" pos="0.5 0 0.5"><freejoint/><geom size="0.03"/></body>
  </worldbody>
  <actuator><position joint="elbow" kp="20" timeconst="0.02"/></actuator>
  <sensor>
    <jointpos joint="elbow"/><jointvel joint="elbow"/><framepos objtype="site" objname="tip"/>
  </sensor>
</mujoco>
"""


@pytest.fixture(scope="module")
def sensing() -> Callable[[str], Simulation]:
    """Simulations of that model by backend, reset."""
    made: dict[str, Simulation] = {}

    def get(backend: str) -> Simulation:
        if backend not in made:
            model = mujoco.MjModel.from_xml_string(SENSING)
            made[backend] = make_simulation(model, load_config([]), N, **on_backend(backend))
        made[backend].reset()
        return made[backend]

    return get


def test_shapes_types_and_device(backend: str, make_sim: MakeSim, get_stage: GetStage) -> None:
    sim = make_sim(backend, N)
    m = get_stage("so101").model
    poses = [(m.nbody, 3), (m.nbody, 4), (m.nsite, 3), (m.ngeom, 3)]
    shapes = [(m.nq,), (m.nv,), (m.na,), (m.nu,), *poses, (m.nv,), (m.nsensordata,)]
    for name, shape in zip(VIEWS, shapes, strict=True):
        view = getattr(sim, name)
        assert tuple(view.shape) == (N, *shape), name
        assert view.dtype is (torch.float64 if backend == "native" else torch.float32), name
        assert view.device == sim.device, name
    for name in COUNTS:
        assert getattr(sim, name).shape == (N,), name
        assert getattr(sim, name).dtype is torch.int32, name
    assert sim.step_count.dtype is torch.int64
    assert sim.nworld == N
    assert sim.backend == backend.partition("-")[0]


def test_views_keep_their_address(backend: str, make_sim: MakeSim) -> None:
    sim = make_sim(backend, N)

    def addresses() -> dict[str, int]:
        return {name: getattr(sim, name).data_ptr() for name in (*VIEWS, *COUNTS, "step_count")}

    before = addresses()
    sim.step(10)
    sim.step(10, kinematics=True)
    sim.forward()
    sim.kinematics()
    sim.reset(torch.tensor([True, False, True], device=sim.device))
    sim.reset()
    sim.step(3)
    sim.qpos += 0.0
    assert addresses() == before


@pytest.mark.parametrize("name", [*VIEWS, *COUNTS, "step_count", "fields"])
def test_views_cannot_be_rebound(backend: str, make_sim: MakeSim, name: str) -> None:
    sim = make_sim(backend, N)
    view = getattr(sim, name)
    with pytest.raises(MjstackError) as caught:
        setattr(sim, name, torch.zeros(N))
    setattr(sim, name, view)
    assert getattr(sim, name) is view
    written = "sim.fields[name]" if name == "fields" else f"sim.{name}"
    why = f"{written} is a view of the simulation's memory and cannot be rebound"
    assert str(caught.value) == f"{why}: write {written}[:] = ... instead."


@pytest.mark.parametrize(
    ("mask", "found"),
    [
        (torch.zeros(N), r"a torch.float32 tensor of shape \(3,\) on "),
        (torch.zeros(N + 1, dtype=torch.bool), r"a torch.bool tensor of shape \(4,\) on "),
        (torch.zeros(N, 1, dtype=torch.bool), r"a torch.bool tensor of shape \(3, 1\) on "),
        (torch.zeros(N, dtype=torch.bool, device="meta"), r"a torch.bool .* \(3,\) on meta"),
        ([True] * N, "a list"),
    ],
)
def test_a_wrong_mask_is_refused(backend: str, make_sim: MakeSim, mask: object, found: str) -> None:
    sim = make_sim(backend, N)
    sim.step(1)
    if isinstance(mask, torch.Tensor) and mask.device.type == "cpu":
        mask = mask.to(sim.device)
    for call in (sim.reset, sim.kinematics):
        words = rf"^mask: found {found}.*, expected a torch.bool tensor of shape \(3,\) on "
        assert re.search(words, refusal(partial(call, mask)))
    assert sim.step_count.tolist() == [1] * N


def test_step_counts(backend: str, make_sim: MakeSim) -> None:
    sim = make_sim(backend, N)
    assert sim.step_count.tolist() == [0] * N
    sim.step(10)
    sim.step(3)
    sim.forward()
    assert sim.step_count.tolist() == [13] * N
    sim.reset(torch.tensor([False, True, False], device=sim.device))
    assert sim.step_count.tolist() == [13, 0, 13]
    sim.step(10)
    assert sim.step_count.tolist() == [23, 10, 23]


def test_masked_reset(backend: str, make_sim: MakeSim, get_stage: GetStage) -> None:
    sim = make_sim(backend, N)
    stage = get_stage("so101")
    fresh = {name: getattr(sim, name).clone() for name in ("qpos", "qvel", "ctrl")}
    start_moving(sim, stage)
    sim.step(10)
    sim.overflow.fill_(1)
    before = {name: getattr(sim, name).clone() for name in (*fresh, *COUNTS)}
    assert (before["peak_contacts"] > 0).all()
    assert (before["peak_constraints"] > 0).all()
    mask = torch.tensor([False, True, False], device=sim.device)
    sim.reset(mask)
    for name, value in fresh.items():
        assert torch.equal(getattr(sim, name)[mask], value[mask]), name
        assert torch.equal(getattr(sim, name)[~mask], before[name][~mask]), name
        assert not torch.equal(value[mask], before[name][mask]), name
    for name in ("peak_contacts", "peak_constraints", "overflow"):
        assert getattr(sim, name)[mask].tolist() == [0], name
        assert torch.equal(getattr(sim, name)[~mask], before[name][~mask]), name


def test_reset_world_goes_on_as_a_fresh_one(backend: str, make_sim: MakeSim) -> None:
    """Warm starts and whatever else a step leaves behind are reset too."""
    sim = make_sim(backend, N)
    sim.step(10)
    expected = sim.qpos.clone()
    sim.ctrl.fill_(0.3)
    sim.step(20)
    sim.reset(torch.tensor([False, True, False], device=sim.device))
    sim.step(10)
    assert_same_run(sim.qpos[1], expected[1], backend)
    assert not torch.equal(sim.qpos[0], expected[0])


def test_forward_writes_every_derived_number(
    backend: str, make_sim: MakeSim, get_stage: GetStage
) -> None:
    sim = make_sim(backend, N)
    m = get_stage("so101").model
    start_moving(sim, get_stage("so101"))
    sim.forward()
    derived = (*POSES, "qfrc_actuator")
    expected = {name: getattr(sim, name).clone() for name in derived}
    state = [sim.qpos.clone(), sim.qvel.clone()]
    for name in derived:
        getattr(sim, name).fill_(float("nan"))
    # What never moves MJWarp places once, with the data: the world body and the geoms of bodies
    # without a joint above them.
    static = torch.from_numpy(m.body_weldid[m.geom_bodyid] == 0).to(sim.device)
    sim.xpos[:, 0] = expected["xpos"][:, 0]
    sim.xquat[:, 0] = expected["xquat"][:, 0]
    sim.geom_xpos[:, static] = expected["geom_xpos"][:, static]
    sim.forward()
    for name in derived:
        assert torch.equal(getattr(sim, name), expected[name]), name
    assert torch.equal(sim.qpos, state[0])
    assert torch.equal(sim.qvel, state[1])


@pytest.mark.full
def test_activations_and_sensors(backend: str, sensing: Callable[[str], Simulation]) -> None:
    sim = sensing(backend)
    m = sim.model
    assert (sim.act.shape, sim.sensordata.shape) == ((N, 1), (N, 5))
    sim.ctrl[:, 0] = torch.tensor([0.2, 0.4, 0.6], device=sim.device)
    sim.step(20)
    expected = []
    for k in range(N):
        data = mujoco.MjData(m)
        data.ctrl[0] = float(sim.ctrl[k, 0])
        mujoco.mj_step(m, data, 20)
        assert float(sim.act[k, 0]) == pytest.approx(data.act[0], rel=1e-4)
        np.testing.assert_allclose(sim.sensordata[k].double().cpu(), data.sensordata, atol=1e-4)
        mujoco.mj_forward(m, data)
        expected.append(data.sensordata.copy())
    sim.sensordata.fill_(float("nan"))
    sim.forward()
    np.testing.assert_allclose(sim.sensordata.double().cpu(), expected, atol=1e-4)
    # Masked worlds become zero, even where they were NaN; the others stay.
    before = {name: getattr(sim, name).clone() for name in ("act", "sensordata")}
    mask = torch.tensor([False, True, False], device=sim.device)
    for name in before:
        getattr(sim, name)[1] = float("nan")
    sim.reset(mask)
    for name, value in before.items():
        assert not getattr(sim, name)[1].any(), name
        assert torch.equal(getattr(sim, name)[~mask], value[~mask]), name
        assert value[~mask].any(), name


def test_kinematics_belongs_to_the_last_state(
    backend: str, make_sim: MakeSim, get_stage: GetStage
) -> None:
    sim = make_sim(backend, N)
    start_moving(sim, get_stage("so101"))
    sim.step(10)
    stale = {name: getattr(sim, name).clone() for name in POSES}
    sim.kinematics()
    posed = {name: getattr(sim, name).clone() for name in POSES}
    sim.forward()  # by MJWarp's own kernels, whose roundings differ on CUDA
    for name in POSES:
        torch.testing.assert_close(getattr(sim, name), posed[name], rtol=0.0, atol=1e-6)
        assert (stale[name] - posed[name]).abs().max() > 1e-5, name
    sim.step(10, kinematics=True)
    posed = {name: getattr(sim, name).clone() for name in POSES}
    sim.forward()
    for name in POSES:
        torch.testing.assert_close(getattr(sim, name), posed[name], rtol=0.0, atol=1e-6)
    assert sim.step_count.tolist() == [20] * N


def test_kinematics_changes_no_physics(
    backend: str, make_sim: MakeSim, get_stage: GetStage
) -> None:
    if backend == "mjwarp-cuda":
        pytest.skip("CUDA repeats no run bit for bit")
    finals = []
    for kinematics in (False, True):
        sim = make_sim(backend, N)
        start_moving(sim, get_stage("so101"))
        for _ in range(5):
            sim.step(4, kinematics=kinematics)
            sim.step(1, kinematics=kinematics)
            if kinematics:
                sim.kinematics()
        names = (*STATE, "qfrc_actuator", *COUNTS, "step_count")
        finals.append([getattr(sim, name).clone() for name in names])
    for a, b in zip(*finals, strict=True):
        assert torch.equal(a, b)


@pytest.mark.full
def test_native_kinematics_visits_masked_worlds_only(
    make_sim: MakeSim, get_stage: GetStage
) -> None:
    sim = make_sim("native", N)
    start_moving(sim, get_stage("so101"))
    sim.forward()
    before = {name: getattr(sim, name).clone() for name in POSES}
    sim.qpos[:, 0] += 0.1
    sim.qvel[2, 0] = float("nan")
    sim.kinematics(torch.tensor([True, False, True]))
    for name in POSES:
        assert not torch.equal(getattr(sim, name)[0], before[name][0]), name
        assert torch.equal(getattr(sim, name)[1], before[name][1]), name
        assert torch.isnan(getattr(sim, name)[2]).all(), name


def test_forward_agrees_with_mujoco(backend: str, make_sim: MakeSim, get_stage: GetStage) -> None:
    sim = make_sim(backend, N)
    stage = get_stage("so101")
    start_moving(sim, stage)
    sim.step(10)
    sim.forward()
    data = mujoco.MjData(stage.model)
    for k in range(N):
        for name in ("qpos", "qvel", "ctrl"):
            setattr(data, name, getattr(sim, name)[k].double().cpu().numpy())
        mujoco.mj_forward(stage.model, data)
        for name, tolerance in (*((name, 1e-5) for name in POSES), ("qfrc_actuator", 5e-3)):
            got = getattr(sim, name)[k].double().cpu()
            np.testing.assert_allclose(got, getattr(data, name), atol=tolerance, err_msg=name)
        assert int(sim.contact_count[k]) == data.ncon


def test_options_as_uploaded(backend: str, make_sim: MakeSim) -> None:
    options = make_sim(backend, N).option_values()
    names = {"integrator": "mjINT_IMPLICITFAST", "cone": "mjCONE_ELLIPTIC", "box_box": "primitive"}
    numbers = {"impratio": 100.0, "tolerance": 1e-6, "iterations": 100, "ls_iterations": 50}
    assert options["timestep"] == pytest.approx(0.002, rel=1e-6)
    assert {name: options[name] for name in names} == names
    assert {name: options[name] for name in numbers} == pytest.approx(numbers, rel=1e-5, abs=0.0)


@pytest.mark.full
def test_worlds_whose_solver_stops_at_its_limit_are_told() -> None:
    told = []
    for overrides in ([], ["solver.iterations=1", "solver.ls_iterations=1"]):
        cfg = load_config(overrides)
        sim = make_simulation(build_model(cfg), cfg, 2, backend=Backend.mjwarp, device="cpu")
        sim.step(10)
        assert sim.solver_limits is not None
        told.append((sim.solver_limits & int(SolverLimit.ITERATIONS)).tolist())
        assert sim.overflow.tolist() == [0, 0]
    assert told == [[0, 0], 2 * [int(SolverLimit.ITERATIONS)]]


def test_captured_and_uncaptured_steps_agree(make_sim: MakeSim, get_stage: GetStage) -> None:
    finals = []
    for overrides in ((), ("graph=off",)):
        sim = make_sim("mjwarp", N, *overrides)
        start_moving(sim, get_stage("so101"))
        sim.step(5)
        sim.step(5)
        finals.append([getattr(sim, name).clone() for name in (*VIEWS, *COUNTS, "step_count")])
    for a, b in zip(*finals, strict=True):
        assert torch.equal(a, b)


def test_native_does_not_reset_a_diverged_world(make_sim: MakeSim, get_stage: GetStage) -> None:
    """MuJoCo would put it back to qpos0, which looks like a world that never moved."""
    sim = make_sim("native", N)
    start_moving(sim, get_stage("so101"))
    sim.qvel[1, 0] = 1e12  # beyond what MuJoCo calls a good velocity
    sim.step(10)
    assert not sim.qvel[1].abs().max() < 1e6
    sim.qvel[1, 0] = float("nan")
    sim.step(10)
    assert not torch.isfinite(sim.qvel[1]).all()
    for name in (*POSES, "qfrc_actuator"):
        assert torch.isnan(getattr(sim, name)[1]).all(), name
    assert torch.isfinite(sim.qpos[[0, 2]]).all()
    assert not mujoco.mjtDisableBit.mjDSBL_AUTORESET & get_stage("so101").model.opt.disableflags


# 435 pairs of balls, all of which MuJoCo calls contacts, in memory for some 170.
CROWD = """
<mujoco>
  <size memory="150K"/>
  <default><geom size="0.02" condim="1" gap="10"/></default>
  <worldbody>
    <replicate count="30" offset="0 0 0.1"><body><freejoint/><geom/></body></replicate>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize("most", [4096, 4])
def test_native_worlds_that_mujoco_warns_of_take_every_step(most: int, monkeypatch: Patch) -> None:
    """Many steps in one call of MuJoCo's, and in calls of few worlds each, are as many single ones,
    also for worlds that overflow or diverge.
    """
    from mjstack.sim import native

    monkeypatch.setattr(native, "_STEPS", most)
    monkeypatch.setattr(native, "available_cores", lambda: 2)
    finals = []
    for calls in (1, 20):
        sim = native.NativeSimulation(mujoco.MjModel.from_xml_string(CROWD), 5)
        sim.qpos[2, ::7] += 1e3 * torch.arange(30)
        sim.qvel[1, 0] = 1e12
        for _ in range(3):
            for _ in range(calls):
                sim.step(20 // calls, kinematics=calls == 1)
        sim.kinematics()
        finals.append([getattr(sim, name) for name in (*VIEWS, *COUNTS, "step_count")])
        assert sim.overflow.tolist() == [8, 8, 0, 8, 8]
        assert sim.step_count.tolist()[2:] == [60, 60, 60]
    for one, other in zip(*finals, strict=True):
        assert torch.equal(one.nan_to_num(7.0), other.nan_to_num(7.0))


def test_native_threads_do_not_matter(get_stage: GetStage, monkeypatch: Patch) -> None:
    from mjstack.sim import native

    finals = []
    for nthread in (1, 3):
        monkeypatch.setattr(native, "available_cores", lambda nthread=nthread: nthread)
        sim = native.NativeSimulation(get_stage("so101").model, 5)
        assert sim.nthread == nthread
        start_moving(sim, get_stage("so101"))
        sim.step(20)
        finals.append(sim.qpos.clone())
        sim.close()
    assert torch.equal(*finals)


def sleeping(spec: mujoco.MjSpec) -> None:
    spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)


def by_pgs(spec: mujoco.MjSpec) -> None:
    spec.option.solver = mujoco.mjtSolver.mjSOL_PGS


@pytest.mark.full
@pytest.mark.parametrize(
    ("edit", "backend", "message"),
    [
        (sleeping, Backend.native, "MuJoCo cannot step many worlds of this model: sleep and IPC "),
        (by_pgs, Backend.mjwarp, "MJWarp does not support this model: .* or run sim=native"),
    ],
)
def test_an_unsupported_model_is_refused_in_one_line(
    edit: Callable[[mujoco.MjSpec], None], backend: Backend, message: str
) -> None:
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_geom(size=[0.1, 0, 0])
    body.add_joint()
    edit(spec)
    make = partial(make_simulation, spec.compile(), load_config([]), 1, backend=backend)
    assert re.search(rf"{message}.*\.$", refusal(partial(make, device="cpu")))


def test_twice_the_same_run(backend: str, make_sim: MakeSim, get_stage: GetStage) -> None:
    finals = []
    for _ in range(2):
        sim = make_sim(backend, N)
        start_moving(sim, get_stage("so101"))
        for _ in range(4):
            sim.step(10)
        finals.append([getattr(sim, name).clone() for name in VIEWS])
    for a, b in zip(*finals, strict=True):
        assert_same_run(a, b, backend)
    assert not torch.equal(finals[0][0][0], finals[0][0][1])


def test_one_thread_at_a_time_declares_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compilers alone run side by side: Warp's decorators hand out the newest function of a name,
    so of two threads one would get a kernel that calls the other's function.
    """
    declaring, most = [], {"declaring": 0, "compiling": 0}
    both = Barrier(2, timeout=20.0)
    source = wp._src.build

    def compiler() -> None:
        both.wait()
        most["compiling"] += 1

    def stage(m: object, d: object) -> None:
        for _ in range(2):
            declaring.append(stage)
            time.sleep(0.01)
            most["declaring"] = max(most["declaring"], len(declaring))
            declaring.pop()
            source.build_cpu()

    monkeypatch.setattr(source, "build_cpu", compiler)
    monkeypatch.setattr(compiling, "available_cores", lambda: 2)
    monkeypatch.setattr(compiling, "_done", set())
    monkeypatch.setattr(compiling, "_stages", lambda m, plan: [stage, stage])
    monkeypatch.setattr(compiling.constraints, "collision", lambda m, d: None)
    model = mujoco.MjModel.from_xml_string(SENSING)
    device = wp.get_device("cpu")
    with wp.ScopedDevice(device):
        m = mjw.put_model(model)
        compiling.compile_step(model, m, BatchSizes(nconmax=8, njmax=8), device, StepPlan("fused"))
    assert most == {"declaring": 1, "compiling": 4}
    assert source.build_cpu is compiler


@pytest.mark.full
def test_kernels_are_compiled_ahead(tmp_path: Path) -> None:
    """With an empty cache, all that a step, its forward and resets launch is loaded before."""
    script = """
import logging
from mjstack.config.load import load_config
from mjstack.scene import build_model
from mjstack.sim import make_simulation, mjwarp
from mjstack.sim.mujoco_warp import wp

logging.basicConfig(level=logging.INFO)
ahead = mjwarp.compile_step

def compile_step(*args):
    ahead(*args)
    wp.config.log_level = wp.LOG_INFO
    print("AHEAD", flush=True)

mjwarp.compile_step = compile_step
cfg = load_config(["sim=mjwarp", "sim.device=cpu"])
model = build_model(cfg)
sim = make_simulation(model, cfg, 2)
sim.step(2, kinematics=True)
sim.forward()
"""
    (tmp_path / "script.py").write_text(script)
    env = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "cache")}
    command = [sys.executable, str(tmp_path / "script.py")]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=300, check=True)
    assert "compiling MJWarp's kernels" in done.stderr
    ours = done.stdout.partition("AHEAD")[2]
    loaded = re.findall(r"Module (\S+) .*\((?:compiled|cached)\)", ours)
    assert loaded == ["mjstack.sim.usage"], ours  # the rest of a simulation's step
