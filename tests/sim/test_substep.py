"""The rearranged physics step is MJWarp's own."""

import mujoco
import pytest
import torch
import warp as wp
from environments import configure, on_cuda

from mjstack.config.schema import Backend
from mjstack.scene import SceneIndex, build_model
from mjstack.sim import make_simulation
from mjstack.sim.fused.step import StepPlan, why_stock
from mjstack.sim.mjwarp import MjwarpSimulation
from mjstack.sim.mujoco_warp import mjw
from mjstack.sim.sizes import resolve_sizes


def worlds(robot: str, device: str, step: str) -> MjwarpSimulation:
    cfg = configure(robot=robot)
    sizes = resolve_sizes(cfg, driven=False)
    sim = make_simulation(
        build_model(cfg), cfg, 3, backend=Backend.mjwarp, device=device, sizes=sizes
    )
    assert isinstance(sim, MjwarpSimulation)
    assert sim.plan == StepPlan("fused", smooth=True)
    if step != "fused":
        sim.plan = StepPlan(step)
    return sim


@pytest.mark.parametrize("step", ["arranged", "fused"])
def test_a_step_ends_where_mjwarps_own_does(step: str, robot: str, device: str) -> None:
    """Random commands, cubes thrown about, one between the jaws, for the sensors. Arranged on the
    CPU device this is bit for bit so over many steps; else every step starts from the same state.
    """
    exact = step == "arranged" and device == "cpu"
    sim = worlds(robot, device, step)
    stock = worlds(robot, device, "stock")
    low, high = torch.from_numpy(sim.model.actuator_ctrlrange).float().to(device).unbind(1)
    generator = torch.Generator(device).manual_seed(0)
    cfg = configure(robot=robot)
    index = SceneIndex(sim.model, cfg.robot, cfg.scene)
    red = index.object_qpos[0]
    sensed = torch.zeros(sim.sensordata.shape[1], device=device)
    most = 0
    for number in range(40 if exact else 12):
        between = stock.site_xpos[:, index.grasp_sites].mean(1)
        if number == (20 if exact else 4):
            stock.qpos[:, red : red + 3] = between
            sim.qpos[:, red : red + 3] = between
        if not exact:
            sim.qpos[:] = stock.qpos
            sim.qvel[:] = stock.qvel
            wp.copy(sim._d.qacc_warmstart, stock._d.qacc_warmstart)
        command = low + (high - low) * torch.rand((3, len(low)), generator=generator, device=device)
        for world_batch in (sim, stock):
            world_batch.ctrl[:] = command
            world_batch.step(
                5 if exact else 1 + number % 3, kinematics=not exact or number % 2 == 0
            )
            world_batch.synchronize()
        for name in ("contact_count", "constraint_count", "step_count", "solver_limits"):
            assert torch.equal(getattr(sim, name), getattr(stock, name)), (number, name)
        scale = float(stock.sensordata.abs().max()) + 1.0
        sizes = {"qpos": 1e-5, "site_xpos": 1e-5, "qvel": 5e-3, "sensordata": 0.01 * scale}
        for name, size in {**sizes, "qfrc_actuator": 1.0}.items():
            a = getattr(sim, name)
            b = getattr(stock, name)
            if exact:
                assert torch.equal(a, b), (number, name)
            elif name in sizes:
                torch.testing.assert_close(a, b, rtol=0.0, atol=size)
        sensed += stock.sensordata.abs().sum(0)
        most = max(most, int(sim.contact_count.max()))
    assert bool((sensed > 0.0).any())
    assert most >= 8 or not exact
    for name in ("peak_contacts", "peak_constraints", "peak_pool", "overflow"):
        assert torch.equal(getattr(sim, name), getattr(stock, name)) or not exact, name


@pytest.mark.full
@on_cuda
def test_branches_count_and_sense_what_one_after_the_other_does(robot: str) -> None:
    """Cubes at rest, red between the jaws: a few decimation from one state, where rounding has no
    time to grow.
    """
    sim = worlds(robot, "cuda:0", "arranged")
    stock = worlds(robot, "cuda:0", "stock")
    cfg = configure(robot=robot)
    index = SceneIndex(sim.model, cfg.robot, cfg.scene)
    home = torch.tensor(cfg.robot.start, device="cuda:0")
    for world_batch in (sim, stock):
        world_batch.qpos[:, torch.as_tensor(index.robot_qpos, device="cuda:0")] = home
        world_batch.ctrl[:, torch.as_tensor(index.ctrl, device="cuda:0")] = home
        world_batch.step(50, kinematics=True)
    red = index.object_qpos[0]
    stock.qpos[:, red : red + 3] = stock.site_xpos[:, index.grasp_sites].mean(1)
    for n in (1, 1, 2, 3, 1, 2):
        sim.qpos[:] = stock.qpos
        sim.qvel[:] = stock.qvel
        sim.step(n, kinematics=True)
        stock.step(n, kinematics=True)
        for name in ("contact_count", "constraint_count"):
            assert torch.equal(getattr(sim, name), getattr(stock, name)), name
        scale = float(stock.sensordata.abs().max()) + 1.0
        sizes = {"qpos": 1e-4, "qvel": 2e-2, "site_xpos": 1e-4, "sensordata": 0.05 * scale}
        for name, size in sizes.items():
            torch.testing.assert_close(
                getattr(sim, name), getattr(stock, name), rtol=0.0, atol=size
            )
    for name in ("peak_contacts", "peak_constraints", "overflow"):
        assert torch.equal(getattr(sim, name), getattr(stock, name))


@pytest.mark.parametrize(
    "change",
    [
        lambda spec: setattr(spec.option, "integrator", mujoco.mjtIntegrator.mjINT_EULER),
        lambda spec: setattr(spec.option, "enableflags", mujoco.mjtEnableBit.mjENBL_ENERGY),
        lambda spec: spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_BODY, target="box"),
    ],
)
def test_what_it_leaves_out_is_stepped_by_mjwarp(change) -> None:
    spec = mujoco.MjSpec()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    body = spec.worldbody.add_body(name="box", pos=[0, 0, 1])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 0.1])
    plain = spec.copy().compile()
    change(spec)
    changed = spec.compile()
    with wp.ScopedDevice("cpu"):
        assert not why_stock(plain, mjw.put_model(plain))
        assert why_stock(changed, mjw.put_model(changed))
