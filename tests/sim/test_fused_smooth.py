"""Smooth dynamics in three kernels end where MJWarp's own stages do."""

import math
from functools import partial

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from arms import model_of
from environments import Patch, configure, few, fused_sim

from mjstack.sim.fused import smooth
from mjstack.sim.mujoco_warp import mjw

N = 3
POSES = (
    *("xpos", "xquat", "xmat", "xipos", "ximat", "xanchor", "xaxis", "geom_xpos", "geom_xmat"),
    *("site_xpos", "site_xmat", "subtree_com", "cinert", "cdof", "ten_length", "ten_J"),
)
FORCES = (
    *("M", "cvel", "cdof_dot", "ten_velocity"),
    *("act_dot", "actuator_length", "actuator_velocity"),
    *("actuator_force", "qfrc_bias", "qfrc_passive", "qfrc_actuator", "qfrc_smooth", "qacc_smooth"),
)
STATE = ("qpos", "qvel", "act", "qacc_warmstart", "time", "overflow")
FIELDS = (
    *("body_pos", "body_quat", "body_ipos", "body_mass", "body_subtreemass", "body_inertia"),
    *("body_gravcomp", "jnt_stiffness", "dof_armature", "dof_damping", "geom_pos", "site_pos"),
    *("actuator_gainprm", "actuator_biasprm", "actuator_gear", "actuator_forcerange"),
)

# Joints of all kinds, several of a body, a free body with an arm, bodies that are fixed to others
# or moved by hand, springs, damping and forces of all kinds, actuators with and without dynamics.
PARTS = """
<mujoco>
  <option timestep="0.002" cone="elliptic" integrator="implicitfast" jacobian="dense"/>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 .1"/>
    <body name="hand" mocap="true" pos=".3 .2 .8" euler="10 20 30">
      <geom size=".02" contype="0" conaffinity="0"/>
      <body pos=".1 0 0"><geom size=".01" contype="0" conaffinity="0"/><site name="tip"/></body>
    </body>
    <body pos="0 0 0.6" euler="0 10 0">
      <joint name="a" axis="0 1 .2" pos=".01 0 .02" damping=".3" armature=".02" stiffness="2"
             springref="20"/>
      <joint name="b" axis="1 0 0" actuatorfrcrange="-.2 .15" actuatorgravcomp="true"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0" mass="0.4"/>
      <body pos="0.3 0 0" gravcomp="0.7">
        <geom type="box" size=".02 .03 .04" pos=".02 .01 0" euler="10 20 30"/>
        <body pos=".02 0 .05" euler="0 0 40">
          <joint name="c" type="slide" axis="1 0 1" pos="0 .1 0" damping="2" stiffness="5"/>
          <geom type="capsule" size="0.02" fromto="0 0 0 0.25 0 0" mass="0.3"/>
        </body>
        <body pos="0 .05 0">
          <joint name="d" axis="0 0 1" armature=".02"/><geom size=".03"/><site/>
        </body>
      </body>
    </body>
    <body name="drone" pos="-.5 .3 .6">
      <joint type="free" stiffness=".6" damping=".05"/>
      <geom type="box" size=".05 .04 .03" pos=".01 0 .02"/>
      <body pos=".06 0 0" gravcomp="1">
        <joint name="e" axis="0 0 1" armature=".01"/><geom size=".02"/>
      </body>
    </body>
    <body pos="-.2 .4 .5">
      <joint name="ball" type="ball" pos="0 .02 0" stiffness=".3" damping=".02" armature=".01"/>
      <geom type="capsule" size=".02" fromto="0 0 0 .1 .1 0"/>
      <body pos=".1 .1 0">
        <joint type="ball" damping=".01"/><geom size=".02" pos=".05 0 0" mass=".1"/>
      </body>
    </body>
    <body name="tool" pos=".5 -.3 .6" euler="30 20 10">
      <freejoint/><geom type="capsule" size=".02" fromto="0 0 0 .2 .1 0"/>
      <body pos="0 0 .1"><geom size=".03"/></body>
    </body>
    {boxes}
  </worldbody>
  <actuator>
    <position joint="a" kp="20" kv="1" ctrlrange="-1 1" forcerange="-3 2"/>
    <motor joint="b" gear=".5"/>
    <intvelocity joint="c" kp="30" actrange="-.1 .1"/>
    <general joint="d" dyntype="filter" dynprm=".05" gaintype="affine" gainprm="1 .2 -.3"
             biastype="affine" biasprm=".1 -.5 -.02" actearly="true" gear="1.5" armature=".01"
             damping=".02 .01 .005"/>
    <general joint="e" dyntype="filterexact" dynprm=".03" gainprm=".01"/>
    <general joint="e" gaintype="affine" gainprm=".01 0 -.02"/>
  </actuator>
</mujoco>
"""
BOX = """<body pos="{0} 1 .5"><freejoint/><geom type="box" size=".03 .02 .04"/></body>"""


def parts(boxes: int = 0, flags: int = 0) -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_string(
        PARTS.format(boxes="".join(BOX.format(0.2 * k) for k in range(boxes)))
    )
    model.opt.disableflags |= flags
    return model


def read(d: mjw.Data, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    return {name: getattr(d, name).numpy().copy() for name in names}


def agree(fused_values: dict[str, np.ndarray], stock_values: dict[str, np.ndarray]) -> None:
    """Within the rounding of float32: of a world's largest value."""
    for name, expected in stock_values.items():
        values = expected.reshape(N, -1).astype(float)
        scale = np.abs(values).max(1, keepdims=True, initial=1e-6)
        difference = (fused_values[name].reshape(N, -1) - values) / scale
        np.testing.assert_allclose(difference, 0.0, atol=1e-5, err_msg=name)


def compare(m: mjw.Model, d: mjw.Data) -> None:
    """All stages from one state: each has what MJWarp's stages before it have written."""
    moving = m.body_weldid.numpy()[m.geom_bodyid.numpy()] != 0
    stages = (
        (POSES, smooth.positions, (mjw.kinematics, mjw.com_pos, mjw.tendon)),
        (FORCES, smooth.forces, (inertia, mjw.transmission, mjw.fwd_velocity, *FORWARD)),
        (STATE, smooth.advance, (mjw.collision, mjw.make_constraint, mjw.solve, mjw.implicit)),
    )
    for names, fused, stock in stages:
        for stage in stock[:-1]:
            stage(m, d)
        before = read(d, names)
        stock[-1](m, d)
        stock_values = read(d, names)
        for name in names:
            if names is STATE and name != "qacc_warmstart":
                getattr(d, name).assign(before[name])
            elif name.startswith("geom"):
                spoilt = stock_values[name].copy()
                spoilt[:, moving] = math.nan
                getattr(d, name).assign(spoilt)
            else:
                getattr(d, name).fill_(math.nan)
        fused(m, d)
        agree(read(d, names), stock_values)
        for name in names:
            getattr(d, name).assign(stock_values[name])


def inertia(m: mjw.Model, d: mjw.Data) -> None:
    mjw.crb(m, d)
    mjw._src.smooth.tendon_armature(m, d)


FORWARD = (mjw.fwd_actuation, partial(mjw.fwd_acceleration, factorize=True))


@pytest.mark.parametrize("args", [("robot=so101",), ("robot=rebot",), ("robot=so101", "task=box")])
def test_robots(args: tuple[str, ...], device: str) -> None:
    """Random commands and thrown objects, every world with masses, gains and places of its own."""
    sim = fused_sim(configure(*args), N, device, fields=FIELDS)
    assert smooth.why_not(sim._m) == ""
    generator = torch.Generator().manual_seed(0)

    def rand(like: torch.Tensor) -> torch.Tensor:
        return torch.rand(like.shape, generator=generator).to(device)

    for name, values in sim.fields.items():
        values *= 1.0 + 0.2 * rand(values)
        if name in ("body_gravcomp", "jnt_stiffness"):
            values[1] += 0.5
    low, high = torch.from_numpy(sim.model.actuator_ctrlrange).float().to(device).unbind(1)
    pushes = wp.to_torch(sim._d.xfrc_applied)
    for step in range(12):
        sim.ctrl[:] = low + (high - low) * rand(sim.ctrl)
        sim.qvel += 0.2 * (rand(sim.qvel) - 0.5)
        pushes[2] = 0.02 * step % 2 * rand(pushes[2])
        sim.step(5)
        sim.synchronize()
        assert bool(sim.qpos.isfinite().all())
        with wp.ScopedDevice(sim._device):
            compare(sim._m, sim._d)


@pytest.mark.parametrize(
    ("boxes", "off"),
    [
        (0, ""),
        pytest.param(4, "", marks=pytest.mark.full),  # more than 32 degrees of freedom
        (1, "GRAVITY CLAMPCTRL"),
        *(
            pytest.param(0, off, marks=pytest.mark.full)
            for off in ("ACTUATION", "SPRING", "DAMPER", "SPRING DAMPER", "SPRING DAMPER ACTUATION")
        ),
    ],
)
def test_parts(boxes: int, off: str, device: str) -> None:
    flags = [getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}") for name in off.split()]
    throw_and_compare(parts(boxes, sum(map(int, flags))), device)


@pytest.mark.parametrize("off", few(["", "ACTUATION", "DAMPER", "SPRING"], 2))
def test_tendons(off: str, device: str) -> None:
    """With limits, springs, dampers, armature, and several servos at one."""
    model = model_of("pulled")
    if off:
        model.opt.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{off}")
    throw_and_compare(model, device)


def throw_and_compare(model: mujoco.MjModel, device: str) -> None:
    generator = torch.Generator().manual_seed(0)
    with wp.ScopedDevice(device):
        m = mjw.put_model(model)
        m.opt.warn_overflow = 0
        d = mjw.make_data(model, nworld=N, njmax=200, nconmax=100)
        assert smooth.why_not(m) == ""
        for k in range(8):
            for array, size in (
                *((d.ctrl, 1.0), (d.qvel, 0.3), (d.qfrc_applied, 0.01), (d.mocap_pos, 0.1)),
                *((d.mocap_quat, 0.1), (d.xfrc_applied, 0.01 * (k % 2))),
            ):
                view = wp.to_torch(array)
                view += size * torch.randn(view.shape, generator=generator).to(device)
            wp.synchronize_device(device)  # torch's stream, too
            for _ in range(5):
                mjw.step(m, d)
            assert np.isfinite(d.qvel.numpy()).all()
            compare(m, d)


def test_overflow_is_reported() -> None:
    model = parts(4)
    with wp.ScopedDevice("cpu"):
        m = mjw.put_model(model)
        m.opt.warn_overflow = 0
        d = mjw.make_data(model, nworld=N, njmax=8, nconmax=1)
        mjw.forward(m, d)
        for counter, limit in ((d.nacon, d.naconmax), (d.ncollision, d.naconmax)):
            counter.fill_(limit + 1)
        d.nefc.assign([8, 9, 3])
        smooth.advance(m, d)
    bits = mjw.OverflowType
    lost = int(bits.BROADPHASE | bits.NARROWPHASE)
    assert d.overflow.numpy().tolist() == [lost, lost | int(bits.NEFC), lost]


def test_nan_stays_in_its_world(device: str) -> None:
    model = parts(1)
    with wp.ScopedDevice(device):
        m = mjw.put_model(model)
        d = mjw.make_data(model, nworld=N, njmax=200, nconmax=100)
        results = []
        for spoilt in (False, True):
            mjw.reset_data(m, d)
            wp.synchronize_device(device)
            if spoilt:
                wp.to_torch(d.qvel)[1, 3] = math.nan
                wp.to_torch(d.qpos)[1, 8] = math.nan
            wp.synchronize_device(device)
            smooth.positions(m, d)
            smooth.forces(m, d)
            d.efc.Ma.zero_()
            smooth.advance(m, d)
            results.append(read(d, (*POSES, *FORCES, *STATE)))
    assert np.isnan(results[1]["qvel"][1]).any()
    for name, values in results[0].items():
        np.testing.assert_array_equal(results[1][name][[0, 2]], values[[0, 2]], err_msg=name)


def change(spec: mujoco.MjSpec, name: str, **values: object) -> None:
    for key, value in values.items():
        setattr(next(a for a in spec.actuators if a.target == name), key, value)


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        (
            lambda spec: setattr(spec.joint("d"), "type", mujoco.mjtJoint.mjJNT_BALL),
            "actuators drive other things than hinges, slides and tendons",
        ),
        (
            lambda spec: change(spec, "b", trntype=mujoco.mjtTrn.mjTRN_SITE, target="tip"),
            "actuators drive other things than hinges, slides and tendons",
        ),
        (
            lambda spec: change(spec, "b", gaintype=mujoco.mjtGain.mjGAIN_USER),
            "actuators have dynamics, gains or biases of special kinds",
        ),
        (lambda spec: setattr(spec.option, "density", 1.2), "there is a fluid"),
    ],
)
def test_models_that_mjwarp_does(edit, reason: str) -> None:
    spec = mujoco.MjSpec.from_string(PARTS.format(boxes=""))
    edit(spec)
    with wp.ScopedDevice("cpu"):
        m = mjw.put_model(spec.compile())
    assert smooth.why_not(m) == reason


def test_callbacks_and_many_bodies_are_left_to_mjwarp() -> None:
    with wp.ScopedDevice("cpu"):
        m = mjw.put_model(parts())
        m.callback.passive = lambda m, d: None
        assert smooth.why_not(m) == "there are callbacks"
        plates = "".join("<body><geom size='.01'/></body>" for _ in range(250))
        crowded = mujoco.MjModel.from_xml_string(PARTS.format(boxes=plates))
        assert "bytes of shared memory" in smooth.why_not(mjw.put_model(crowded))


def test_a_later_step_reads_nothing_back(monkeypatch: Patch) -> None:
    """And it makes no kernel. A graph could not be captured."""
    sim = fused_sim(configure("graph=off"), 2)
    sim.step(1)
    read = []
    monkeypatch.setattr(wp.array, "numpy", read.append)
    monkeypatch.setattr(wp, "func_native", None)
    sim.step(1)
    assert not read
