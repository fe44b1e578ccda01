"""The rearranged physics step is MJWarp's own."""

from __future__ import annotations

import mujoco
import pytest
import torch
import warp as wp
from environments import configure

from mjstack.config.schema import Backend
from mjstack.scene import SceneIndex, build_model
from mjstack.sim import make_simulation
from mjstack.sim.mjwarp import MjwarpSimulation
from mjstack.sim.sizes import resolve_env_sizes
from mjstack.sim.substep import ARRANGEMENTS, can_rearrange
from mjstack.sim.warp_setup import mjw

CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
DEVICES = ["cpu", pytest.param("cuda:0", marks=[pytest.mark.gpu, CUDA])]


def worlds(robot: str, device: str, *overrides: str) -> MjwarpSimulation:
    cfg = configure(*overrides, robot=robot)
    sizes = resolve_env_sizes(cfg)
    sim = make_simulation(
        build_model(cfg), cfg, 3, backend=Backend.mjwarp, device=device, sizes=sizes
    )
    assert isinstance(sim, MjwarpSimulation)
    return sim


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("robot", ["so101", "rebot"])
def test_a_rearranged_step_is_mjwarps_own(robot: str, device: str) -> None:
    """Random commands, cubes thrown about: on the CPU device bit for bit, sensors included."""
    ours = worlds(robot, device)
    plain = worlds(robot, device)
    ours.arrange(ARRANGEMENTS["arranged"])
    plain.arrange(ARRANGEMENTS["stock"])
    low, high = torch.from_numpy(ours.model.actuator_ctrlrange).float().unbind(1)
    generator = torch.Generator().manual_seed(0)
    most = 0
    touched = False
    cfg = configure(robot=robot)
    index = SceneIndex(ours.model, cfg.robot, cfg.scene)
    red = index.object_qpos[0]
    for step in range(40):
        command = low + (high - low) * torch.rand((3, len(low)), generator=generator)
        between = ours.site_xpos[:, index.grasp_sites].mean(1)
        if device != "cpu":  # where runs differ by rounding, each step starts from the same state
            plain.qpos[:] = ours.qpos
            plain.qvel[:] = ours.qvel
        for sim in (ours, plain):
            if step == 20:  # a cube between the jaws, for the contact sensors
                sim.qpos[:, red : red + 3] = between
            sim.ctrl[:] = command.to(device)
            sim.step(5, kinematics=step % 2 == 0)
            sim.synchronize()
        for name in (
            "qpos",
            "qvel",
            "site_xpos",
            "sensordata",
            "qfrc_actuator",
            "contact_count",
            "constraint_count",
        ):
            a = getattr(ours, name)
            b = getattr(plain, name)
            if device == "cpu":
                assert torch.equal(a, b), (step, name)
            elif name in ("qpos", "site_xpos"):
                torch.testing.assert_close(a, b, rtol=0.0, atol=2e-3)
        assert torch.equal(ours.step_count, plain.step_count)
        most = max(most, int(ours.contact_count.max()))
        touched |= bool((ours.sensordata != 0.0).any())
    assert most >= 8
    assert touched
    if device == "cpu":
        assert torch.equal(ours.peak_contacts, plain.peak_contacts)
        assert torch.equal(ours.peak_constraints, plain.peak_constraints)
        assert torch.equal(ours.peak_pool, plain.peak_pool)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("robot", ["so101", "rebot"])
def test_a_fused_step_ends_where_mjwarps_own_does(robot: str, device: str) -> None:
    """Steps from equal states, sensors included: a cube between the jaws, then random commands."""
    ours = worlds(robot, device)
    plain = worlds(robot, device)
    assert ours.arrangement == ARRANGEMENTS["fused"]
    plain.arrange(ARRANGEMENTS["stock"])
    low, high = torch.from_numpy(ours.model.actuator_ctrlrange).float().to(device).unbind(1)
    generator = torch.Generator(device).manual_seed(0)
    cfg = configure(robot=robot)
    index = SceneIndex(ours.model, cfg.robot, cfg.scene)
    red = index.object_qpos[0]
    sensed = torch.zeros(ours.sensordata.shape[1], device=device)
    for step in range(12):
        if step == 4:
            plain.qpos[:, red : red + 3] = plain.site_xpos[:, index.grasp_sites].mean(1)
        command = low + (high - low) * torch.rand((3, len(low)), generator=generator, device=device)
        ours.qpos[:] = plain.qpos
        ours.qvel[:] = plain.qvel
        wp.copy(ours._d.qacc_warmstart, plain._d.qacc_warmstart)
        for sim in (ours, plain):
            sim.ctrl[:] = command
            sim.step(1 + step % 3, kinematics=True)
            sim.synchronize()
        for name in ("contact_count", "constraint_count", "step_count", "solver_limits"):
            assert torch.equal(getattr(ours, name), getattr(plain, name)), (step, name)
        for name, size in (("qpos", 1e-5), ("site_xpos", 1e-5), ("qvel", 5e-3)):
            torch.testing.assert_close(
                getattr(ours, name), getattr(plain, name), rtol=0.0, atol=size
            )
        scale = float(plain.sensordata.abs().max()) + 1.0
        torch.testing.assert_close(ours.sensordata, plain.sensordata, rtol=0.0, atol=0.01 * scale)
        sensed += plain.sensordata.abs().sum(0)
    assert bool((sensed > 0.0).any())


@pytest.mark.full
@pytest.mark.gpu
@CUDA
@pytest.mark.parametrize("robot", ["so101", "rebot"])
def test_branches_count_and_sense_what_one_after_the_other_does(robot: str) -> None:
    """Cubes at rest, red between the jaws: a few decimation from one state, where rounding has no
    time to grow.
    """
    ours = worlds(robot, "cuda:0")
    plain = worlds(robot, "cuda:0")
    ours.arrange(ARRANGEMENTS["arranged"])
    plain.arrange(ARRANGEMENTS["stock"])
    cfg = configure(robot=robot)
    index = SceneIndex(ours.model, cfg.robot, cfg.scene)
    home = torch.tensor(configure(robot=robot).robot.start, device="cuda:0")
    for sim in (ours, plain):
        sim.qpos[:, torch.as_tensor(index.robot_qpos, device="cuda:0")] = home
        sim.ctrl[:, torch.as_tensor(index.ctrl, device="cuda:0")] = home
        sim.step(50, kinematics=True)
    between = plain.site_xpos[:, index.grasp_sites].mean(1)
    red = index.object_qpos[0]
    plain.qpos[:, red : red + 3] = between
    for n in (1, 1, 2, 3, 1, 2):
        ours.qpos[:] = plain.qpos
        ours.qvel[:] = plain.qvel
        for sim in (ours, plain):
            sim.step(n, kinematics=True)
        for name in ("contact_count", "constraint_count"):
            assert torch.equal(getattr(ours, name), getattr(plain, name)), name
        for name, size in (("qpos", 1e-4), ("qvel", 2e-2), ("site_xpos", 1e-4)):
            torch.testing.assert_close(
                getattr(ours, name), getattr(plain, name), rtol=0.0, atol=size
            )
        scale = float(plain.sensordata.abs().max()) + 1.0
        torch.testing.assert_close(ours.sensordata, plain.sensordata, rtol=0.0, atol=0.05 * scale)
    assert torch.equal(ours.peak_contacts, plain.peak_contacts)
    assert torch.equal(ours.peak_constraints, plain.peak_constraints)
    assert torch.equal(ours.overflow, plain.overflow)


@pytest.mark.parametrize(
    "change",
    [
        lambda spec: setattr(spec.option, "integrator", mujoco.mjtIntegrator.mjINT_EULER),
        lambda spec: (
            spec.worldbody.add_body(name="b").add_site(name="s")
            and spec.add_sensor(
                name="a",
                type=mujoco.mjtSensor.mjSENS_ACCELEROMETER,
                objtype=mujoco.mjtObj.mjOBJ_SITE,
                objname="s",
            )
        ),
        lambda spec: spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_BODY, target="box"),
        lambda spec: (
            spec.worldbody.add_camera(name="c")
            and spec.add_sensor(
                type=mujoco.mjtSensor.mjSENS_FRAMEPOS,
                objtype=mujoco.mjtObj.mjOBJ_CAMERA,
                objname="c",
            )
        ),
        lambda spec: spec.add_equality(
            type=mujoco.mjtEq.mjEQ_CONNECT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1="box",
            name2="world",
        ),
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
        assert can_rearrange(plain, mjw.put_model(plain))
        assert not can_rearrange(changed, mjw.put_model(changed))
