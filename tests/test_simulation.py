"""One contract for every backend."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import pytest
import torch
from comparison import assert_same_run

from mjstack.config import load_config
from mjstack.config.schema import Backend
from mjstack.errors import UnsupportedModel
from mjstack.gates.episode import start_worlds
from mjstack.gates.gate import GateContext
from mjstack.math import quat_angle
from mjstack.scene import build_scene, table_top
from mjstack.sim import Simulation, make_simulation

N = 3
VIEWS = ("qpos", "qvel", "ctrl", "xpos", "xquat", "site_xpos", "qfrc_actuator")
COUNTS = ("contact_count", "constraint_count", "peak_contacts", "peak_constraints", "overflow")
Make = Callable[..., Simulation]
Stage = Callable[[str], GateContext]


def start(sim: Simulation, context: GateContext) -> None:
    """Home, jittered cubes, and a command that moves every joint."""
    start_worlds(sim, context.index, context.cfg, context.cfg.reset, context.planner)
    sim.ctrl[:, torch.from_numpy(context.index.ctrl)] += 0.05


def test_shapes_types_and_device(backend: str, make_sim: Make, stage: Stage) -> None:
    sim, m = make_sim(backend, N), stage("so101").model
    shapes = {
        "qpos": (N, m.nq),
        "qvel": (N, m.nv),
        "ctrl": (N, m.nu),
        "xpos": (N, m.nbody, 3),
        "xquat": (N, m.nbody, 4),
        "site_xpos": (N, m.nsite, 3),
        "qfrc_actuator": (N, m.nv),
    }
    for name, shape in shapes.items():
        view = getattr(sim, name)
        assert tuple(view.shape) == shape, name
        assert view.dtype is (torch.float64 if backend == "native" else torch.float32), name
        assert view.device == sim.device, name
    for name in COUNTS:
        assert getattr(sim, name).shape == (N,), name
        assert getattr(sim, name).dtype is torch.int32, name
    assert sim.step_count.dtype is torch.int64
    assert sim.nworld == N
    assert sim.backend == backend.partition("-")[0]


def test_views_keep_their_address(backend: str, make_sim: Make) -> None:
    sim = make_sim(backend, N)

    def addresses() -> dict[str, int]:
        return {name: getattr(sim, name).data_ptr() for name in (*VIEWS, *COUNTS, "step_count")}

    before = addresses()
    sim.step(10)
    sim.forward()
    sim.reset(torch.tensor([True, False, True], device=sim.device))
    sim.reset()
    sim.step(3)
    assert addresses() == before


def test_step_counts(backend: str, make_sim: Make) -> None:
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


def test_masked_reset(backend: str, make_sim: Make, stage: Stage) -> None:
    sim, context = make_sim(backend, N), stage("so101")
    fresh = {name: getattr(sim, name).clone() for name in ("qpos", "qvel", "ctrl")}
    start(sim, context)
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


def test_reset_world_goes_on_as_a_fresh_one(backend: str, make_sim: Make) -> None:
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


def test_twice_the_same_run(backend: str, make_sim: Make, stage: Stage) -> None:
    finals = []
    for _ in range(2):
        sim = make_sim(backend, N)
        start(sim, stage("so101"))
        for _ in range(4):
            sim.step(10)
        finals.append([getattr(sim, name).clone() for name in VIEWS])
    for a, b in zip(*finals, strict=True):
        assert_same_run(a, b, backend)
    assert not torch.equal(finals[0][0][0], finals[0][0][1])


def test_world_k_of_n_is_world_k_of_one(backend: str, make_sim: Make, stage: Stage) -> None:
    many, one, context = make_sim(backend, N), make_sim(backend, 1), stage("so101")
    start(many, context)
    initial = [many.qpos.clone(), many.qvel.clone(), many.ctrl.clone()]
    for _ in range(3):
        many.step(10)
    for k in range(N):
        one.reset()
        for view, value in zip((one.qpos, one.qvel, one.ctrl), initial, strict=True):
            view[0] = value[k]
        one.forward()
        for _ in range(3):
            one.step(10)
        assert_same_run(one.qpos[0], many.qpos[k], backend)
        assert_same_run(one.qvel[0], many.qvel[k], backend)


def test_forward_writes_every_derived_number(backend: str, make_sim: Make, stage: Stage) -> None:
    sim = make_sim(backend, N)
    start(sim, stage("so101"))
    sim.forward()
    derived = ("xpos", "xquat", "site_xpos", "qfrc_actuator")
    expected = {name: getattr(sim, name).clone() for name in derived}
    state = [sim.qpos.clone(), sim.qvel.clone()]
    for name in derived:
        getattr(sim, name).fill_(float("nan"))
    # The world body never moves: MJWarp writes its pose once, with the data, and not again.
    sim.xpos[:, 0], sim.xquat[:, 0] = expected["xpos"][:, 0], expected["xquat"][:, 0]
    sim.forward()
    for name in derived:
        assert torch.equal(getattr(sim, name), expected[name]), name
    assert torch.equal(sim.qpos, state[0])
    assert torch.equal(sim.qvel, state[1])


def test_forward_agrees_with_mujoco(backend: str, make_sim: Make, stage: Stage) -> None:
    sim, context = make_sim(backend, N), stage("so101")
    start(sim, context)
    sim.step(10)
    sim.forward()
    data = mujoco.MjData(context.model)
    for k in range(N):
        data.qpos, data.qvel, data.ctrl = (v[k].double().cpu().numpy() for v in (sim.qpos, sim.qvel, sim.ctrl))
        mujoco.mj_forward(context.model, data)
        for name, tolerance in (("xpos", 1e-5), ("xquat", 1e-5), ("site_xpos", 1e-5), ("qfrc_actuator", 5e-3)):
            np.testing.assert_allclose(getattr(sim, name)[k].double().cpu(), getattr(data, name), atol=tolerance, err_msg=name)
        assert int(sim.contact_count[k]) == data.ncon


def test_options_as_uploaded(backend: str, make_sim: Make) -> None:
    options = make_sim(backend, N).option_values()
    assert options["timestep"] == pytest.approx(0.002, rel=1e-6)
    assert options["iterations"] == 100
    assert options["ls_iterations"] == 50
    assert options["impratio"] == pytest.approx(100.0, rel=1e-5)
    assert options["tolerance"] == pytest.approx(1e-6, rel=1e-5)
    assert options["integrator"] == "mjINT_IMPLICITFAST"
    assert options["cone"] == "mjCONE_ELLIPTIC"
    assert options["box_box"] == "primitive"


def test_captured_and_uncaptured_steps_agree(make_sim: Make, stage: Stage) -> None:
    finals = []
    for overrides in ((), ("graph=off",)):
        sim = make_sim("mjwarp", N, *overrides)
        start(sim, stage("so101"))
        sim.step(5)
        sim.step(5)
        finals.append([getattr(sim, name).clone() for name in (*VIEWS, *COUNTS, "step_count")])
    for a, b in zip(*finals, strict=True):
        assert torch.equal(a, b)


def test_native_does_not_reset_a_diverged_world(make_sim: Make, stage: Stage) -> None:
    """MuJoCo would put it back to qpos0, which looks like a world that never moved."""
    sim = make_sim("native", N)
    start(sim, stage("so101"))
    sim.qvel[1, 0] = 1e12  # beyond what MuJoCo calls a good velocity
    sim.step(10)
    assert not sim.qvel[1].abs().max() < 1e6
    sim.qvel[1, 0] = float("nan")
    sim.step(10)
    assert not torch.isfinite(sim.qvel[1]).all()
    assert torch.isnan(sim.xpos[1]).all()
    assert torch.isfinite(sim.qpos[[0, 2]]).all()
    assert not mujoco.mjtDisableBit.mjDSBL_AUTORESET & stage("so101").model.opt.disableflags


def test_native_threads_do_not_matter(make_sim: Make, stage: Stage) -> None:
    from mjstack.sim.native import NativeSimulation

    finals = []
    for nthread in (1, 3):
        sim = NativeSimulation(stage("so101").model, 5, nthread=nthread)
        start(sim, stage("so101"))
        sim.step(20)
        finals.append(sim.qpos.clone())
        sim.close()
    assert torch.equal(*finals)


def test_unsupported_model_says_so_in_one_line() -> None:
    spec = mujoco.MjSpec()
    spec.worldbody.add_body(name="b").add_geom(size=[0.1, 0, 0])
    spec.bodies[1].add_joint()
    spec.option.solver = mujoco.mjtSolver.mjSOL_PGS
    with pytest.raises(UnsupportedModel) as caught:
        make_simulation(spec.compile(), load_config([]), 1, backend=Backend.mjwarp, device="cpu")
    message = str(caught.value)
    assert "\n" not in message
    assert "MJWarp does not support this model: " in message
    assert "sim=native" in message
    assert caught.value.exit_code == 1


def test_random_stacks_come_to_rest_on_mjwarp() -> None:
    """A few stacks on the CPU device. Only the hundreds of tests/test_resting_stacks.py tell the two box colliders apart."""
    cfg, n = load_config([]), 16
    model = build_scene(mujoco.MjSpec(), cfg.scene, cfg.timing, cfg.solver)
    sim = make_simulation(model, cfg, n, backend=Backend.mjwarp, device="cpu")
    rng = np.random.default_rng(7)
    top, pose = table_top(cfg.scene), np.zeros((n, 2, 7))
    for cube, height in ((0, 0.0665), (1, 0.0222)):
        yaw = rng.uniform(-np.pi, np.pi, n)
        pose[:, cube, :2] = cfg.scene.table_center[:2] + rng.uniform(-0.006, 0.006, (n, 2))
        pose[:, cube, 2] = top + height
        pose[:, cube, 3], pose[:, cube, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
    sim.qpos.copy_(torch.from_numpy(pose.reshape(n, 14)))
    sim.forward()
    quats, speeds = [], []
    for frame in range(110):
        sim.step(10)
        if frame >= 60:
            quats.append(sim.qpos.view(n, 2, 7)[..., 3:].clone())
            v = sim.qvel.view(n, 2, 6)
            speeds.append(v[..., :3].norm(dim=-1) + 3**0.5 * 0.022 * v[..., 3:].norm(dim=-1))
    assert torch.stack(speeds).max() < 0.05
    spread = max(float(quat_angle(a, b).max()) for i, a in enumerate(quats) for b in quats[i + 1 :])
    assert np.degrees(spread) < 0.5
    last = sim.qpos.view(n, 2, 7)
    dz = last[:, 0, 2] - last[:, 1, 2]
    assert ((dz > 0.043) & (dz < 0.045)).all()
