"""Contact rows and the solver as one kernel each end where MJWarp's own do."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from environments import configure

from mjstack.config.schema import Backend
from mjstack.errors import UnsupportedModel
from mjstack.scene import build_model
from mjstack.sim import fused, make_simulation
from mjstack.sim.mjwarp import MjwarpSimulation
from mjstack.sim.sizes import BatchSizes
from mjstack.sim.warp_setup import mjw

CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
DEVICES = ["cpu", pytest.param("cuda:0", marks=[pytest.mark.gpu, CUDA])]
RESULTS = ("qacc", "qfrc_constraint", "efc.Ma", "efc.force")
N = 4

# Every kind of row: equalities, friction loss of joints and tendons, limits of both, contacts of
# every dimension, and bodies enough for more than 32 degrees of freedom.
ROWS = """
<mujoco>
  <option timestep="0.002" cone="{cone}" integrator="implicitfast" jacobian="dense"/>
  <default><geom solref="0.01 1"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 .1" condim="{condim}" friction="0.7 0.02 0.003"/>
    <body pos="0 0 0.6">
      <joint name="a" axis="0 1 0" range="-20 20" limited="true" frictionloss="0.3"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0" mass="0.4"/>
      <body pos="0.3 0 0">
        <joint name="b" axis="0 1 0" frictionloss="0.1"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0.25 0 0" mass="0.3"/>
        <body pos="0.25 0 0">
          <joint name="c" type="ball" range="0 30" limited="true"/>
          <geom type="capsule" size="0.02" fromto="0 0 0 0.2 0 0" mass="0.2"/>
        </body>
      </body>
    </body>
    <body pos="-0.4 0 0.5"><joint name="d" type="slide" axis="0 0 1"/><geom size="0.05"/></body>
    {boxes}
  </worldbody>
  <tendon>
    <fixed name="t" limited="true" range="-0.2 0.1" frictionloss="0.2">
      <joint joint="a" coef="1"/><joint joint="b" coef="-0.5"/>
    </fixed>
  </tendon>
  <equality>
    <joint joint1="b" joint2="d" polycoef="0 0.5 0 0 0"/>
    <connect body1="box0" body2="box1" anchor="0 0 0.05"/>
  </equality>
</mujoco>
"""
BOX = """<body name="box{0}" pos="{1} {2} {3}" euler="{4} 20 0"><freejoint/>
<geom type="box" size=".05 .04 .03" mass="0.1" condim="{5}"/></body>"""


def every_row(cone: str, condim: int, boxes: int) -> mujoco.MjModel:
    """A model whose boxes fall onto the floor and each other."""
    bodies = [
        BOX.format(k, 0.06 * (k % 3), 0.3, 0.05 + 0.07 * k, 10 * k, condim) for k in range(boxes)
    ]
    return mujoco.MjModel.from_xml_string(
        ROWS.format(cone=cone, condim=condim, boxes="".join(bodies))
    )


class Worlds:
    """A model's worlds, without anything of mjstack but the solver."""

    def __init__(self, model: mujoco.MjModel, device: str, njmax: int) -> None:
        self.device = wp.get_device(device)
        with wp.ScopedDevice(self.device):
            self.m = mjw.put_model(model)
            self.m.opt.warn_overflow = 0
            self.d = mjw.make_data(model, nworld=N, njmax=njmax, nconmax=200)
        self.qvel = wp.to_torch(self.d.qvel)

    def step(self, steps: int) -> None:
        """Plain steps, and up to what the solver starts from."""
        with wp.ScopedDevice(self.device):
            for _ in range(steps):
                mjw.step(self.m, self.d)
            mjw.fwd_position(self.m, self.d)
            mjw.fwd_velocity(self.m, self.d)
            mjw.fwd_actuation(self.m, self.d)
            mjw.fwd_acceleration(self.m, self.d, factorize=True)

    def solve(self, solver: object) -> dict[str, np.ndarray]:
        """The solver's results; rows that do not exist are zero."""
        with wp.ScopedDevice(self.device):
            self.d.overflow.zero_()
            for name in RESULTS:
                self._array(name).fill_(math.nan)
            solver(self.m, self.d)
            wp.synchronize_device(self.device)
        found = {name: self._array(name).numpy().copy() for name in RESULTS}
        rows = np.arange(self.d.njmax)[None] < self.d.nefc.numpy()[:, None]
        found["efc.force"] = np.where(rows, found["efc.force"][:, : self.d.njmax], 0.0)
        found["state"] = np.where(rows, self.d.efc.state.numpy()[:, : self.d.njmax], 0)
        found["efc.Ma"] = found["efc.Ma"][:, : self.m.nv]
        found["niter"] = self.d.solver_niter.numpy().copy()
        found["bits"] = self.d.overflow.numpy().copy()
        return found

    def _array(self, name: str) -> wp.array:
        owner = self.d.efc if name.startswith("efc.") else self.d
        return getattr(owner, name.removeprefix("efc."))


def agree(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray], size: float) -> None:
    """Both are one solution, to the tolerance at which the solver stops."""
    for name in RESULTS:
        scale = np.abs(theirs[name]).max(axis=1, keepdims=True) + 1e-6
        np.testing.assert_allclose(
            ours[name] / scale, theirs[name] / scale, atol=size, err_msg=name
        )
    np.testing.assert_array_equal(ours["bits"], theirs["bits"])
    assert np.abs(ours["niter"] - theirs["niter"]).max() <= 3


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("cone", "condim", "boxes"),
    [
        ("elliptic", 1, 2),
        ("elliptic", 3, 2),
        ("elliptic", 4, 5),
        ("elliptic", 6, 8),
        ("pyramidal", 3, 3),
        ("pyramidal", 6, 5),
    ],
)
def test_every_kind_of_row(cone: str, condim: int, boxes: int, device: str) -> None:
    model = every_row(cone, condim, boxes)
    worlds = Worlds(model, device, njmax=768)
    assert fused.why_not(worlds.m, worlds.d) == ""
    generator = torch.Generator().manual_seed(0)
    kinds: set[int] = set()
    seen: set[int] = set()
    for _ in range(12):
        worlds.qvel += 0.5 * torch.randn(worlds.qvel.shape, generator=generator).to(device)
        worlds.step(12)
        ours = worlds.solve(fused.solve)
        agree(ours, worlds.solve(mjw.solve), 5e-3)
        seen |= set(ours["state"].ravel().tolist())
        for world in range(N):
            kinds |= set(worlds.d.efc.type.numpy()[world, : int(worlds.d.nefc.numpy()[world])])
    contact = {1: 5}.get(condim, {"elliptic": 7, "pyramidal": 6}[cone])
    assert kinds == {0, 1, 2, 3, 4, contact}
    assert seen >= {0, 1, 2, 3} | ({4} if contact == 7 else set())


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("njmax", [300, 16])
@pytest.mark.parametrize("condim", [1, 3, 6])
def test_contact_rows(condim: int, njmax: int, device: str) -> None:
    """All that MJWarp writes of a row, also where the buffer ends within a contact. On CUDA the
    order of contacts is another in every run, so there rows are compared by contact.
    """
    worlds = Worlds(every_row("elliptic", condim, 4), device, njmax=njmax)
    worlds.m.opt.impratio_invsqrt.fill_(0.2)
    generator = torch.Generator().manual_seed(0)
    names = ("J", "D", "aref", "vel", "pos", "margin", "frictionloss", "type")
    most = 0
    for _ in range(4):
        worlds.qvel += torch.randn(worlds.qvel.shape, generator=generator).to(device)
        worlds.step(40)
        found = []
        for make in (mjw.make_constraint, fused.make_constraint):
            for name in names:
                getattr(worlds.d.efc, name).fill_(-7)
            with wp.ScopedDevice(worlds.device):
                make(worlds.m, worlds.d)
                wp.synchronize_device(worlds.device)
            address = worlds.d.contact.efc_address.numpy()[: int(worlds.d.nacon.numpy()[0]), 0]
            world = worlds.d.contact.worldid.numpy()
            rows = [
                (world[c], r + k) for c, r in enumerate(address) if r >= 0 for k in range(condim)
            ]
            rows = [(w, r) for w, r in rows if r < njmax]
            pick = tuple(np.array(rows).T)
            values = {name: getattr(worlds.d.efc, name).numpy()[pick] for name in names}
            found.append((worlds.d.nefc.numpy().copy(), len(rows), values))
        np.testing.assert_array_equal(found[0][0], found[1][0])
        most = max(most, int(found[0][0].max()))
        if njmax == 16 and device != "cpu":
            continue  # contacts that are left out differ
        assert found[0][1] == found[1][1]
        for name in names:
            a, b = (one[2][name].reshape(found[0][1], -1)[:, : worlds.m.nv] for one in found)
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * np.abs(a).max(), err_msg=name)
    assert most > 16


@pytest.mark.parametrize("device", DEVICES)
def test_worlds_without_rows_and_with_too_many(device: str) -> None:
    """No row at all: the smooth acceleration. More rows than there is room for: that world is
    marked as lost by MJWarp, and the others are solved.
    """
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><option cone='elliptic'/><worldbody><geom type='plane' size='2 2 .1'/>"
        "<body pos='0 0 .049'><freejoint/><geom type='box' size='.05 .05 .05'/></body>"
        "<body pos='1 0 .049'><freejoint/><geom type='box' size='.05 .05 .05'/></body>"
        "</worldbody></mujoco>"
    )
    worlds = Worlds(model, device, njmax=20)
    qpos = wp.to_torch(worlds.d.qpos)
    qpos[0, 2::7] = 1.0
    qpos[1, 2] = 1.0
    worlds.step(0)
    np.testing.assert_array_equal(worlds.d.nefc.numpy(), [0, 12, 24, 24])
    ours = worlds.solve(fused.solve)
    theirs = worlds.solve(mjw.solve)
    for name in RESULTS:
        np.testing.assert_allclose(ours[name][:2], theirs[name][:2], atol=1e-3, err_msg=name)
    np.testing.assert_allclose(ours["qacc"][0], worlds.d.qacc_smooth.numpy()[0], rtol=1e-6)
    assert np.isfinite(ours["qacc"]).all()


@pytest.mark.parametrize("device", DEVICES)
def test_a_world_that_is_not_finite_is_alone(device: str) -> None:
    worlds = Worlds(every_row("elliptic", 3, 2), device, njmax=128)
    worlds.step(150)
    before = worlds.solve(fused.solve)
    tangent = int(np.flatnonzero(worlds.d.efc.type.numpy()[1] == 7)[1])  # the first contact's
    spoilt = (
        (worlds.d.qfrc_smooth, slice(None), math.nan),
        (worlds.d.efc.J, slice(None), math.inf),
        (worlds.d.efc.aref, tangent, math.nan),
    )
    for array, where, value in spoilt:
        view = wp.to_torch(array)
        kept = view.clone()
        view[1, where] = value
        after = worlds.solve(fused.solve)
        view.copy_(kept)
        assert not np.isfinite(after["qacc"][1]).all()
        for name in RESULTS:
            np.testing.assert_array_equal(after[name][[0, 2, 3]], before[name][[0, 2, 3]])


@pytest.mark.full
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("boxes", "slides"), [(0, 1), (5, 1), (5, 2), (5, 3), (8, 0), (9, 6)])
def test_sizes(boxes: int, slides: int, device: str) -> None:
    """On CUDA a row of the Hessian is a thread's up to 31 degrees of freedom; columns of J are
    padded to 4, and above 32 to 16.
    """
    bodies = [BOX.format(k, 0.06 * (k % 3), 0.3, 0.05 + 0.07 * k, 10 * k, 3) for k in range(boxes)]
    arms = [
        f"<body pos='{k} 1 .15'><joint type='slide' axis='0 0 1'/><geom size='.1'/></body>"
        for k in range(slides)
    ]
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><option cone='elliptic' jacobian='dense'/><worldbody>"
        f"<geom type='plane' size='9 9 .1'/>{''.join(bodies + arms)}</worldbody></mujoco>"
    )
    worlds = Worlds(model, device, njmax=256)
    assert fused.why_not(worlds.m, worlds.d) == ""
    generator = torch.Generator().manual_seed(0)
    rows = 0
    for _ in range(4):
        worlds.qvel += 0.5 * torch.randn(worlds.qvel.shape, generator=generator).to(device)
        worlds.step(30)
        agree(worlds.solve(fused.solve), worlds.solve(mjw.solve), 5e-3)
        rows = max(rows, int(worlds.d.nefc.numpy().max()))
    assert rows > boxes


def test_sizes_that_do_not_fit() -> None:
    """A row of J at 48 degrees of freedom has 64 columns."""
    assert fused.shared_bytes(48, 64, 1152) > 48 * 1024 - 256 > fused.shared_bytes(18, 20, 1152)
    bodies = "".join(BOX.format(k, 0.1 * k, 0, 0.5, 0, 3) for k in range(8))
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><option cone='elliptic' jacobian='dense'/><worldbody>"
        f"{bodies}</worldbody></mujoco>"
    )
    worlds = Worlds(model, "cpu", njmax=1152)
    assert "1152 rows need 51,332 bytes of shared memory" in fused.why_not(worlds.m, worlds.d)


@pytest.mark.parametrize("device", DEVICES)
def test_more_equalities_than_room(device: str) -> None:
    """MJWarp counts them all: such a world is lost, and nothing is read beyond the buffer."""
    pairs = "".join(f"<joint joint1='j{k}'/>" for k in range(40))
    bodies = "".join(
        f"<body pos='{k} 0 1'><joint name='j{k}' axis='0 1 0'/><geom size='.1'/></body>"
        for k in range(40)
    )
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><option cone='elliptic' jacobian='dense'/><worldbody>"
        f"{bodies}</worldbody><equality>{pairs}</equality></mujoco>"
    )
    worlds = Worlds(model, device, njmax=16)
    worlds.step(1)
    assert worlds.d.ne.numpy().tolist() == [40] * N
    ours = worlds.solve(fused.solve)
    assert np.isfinite(ours["qacc"]).all()


@pytest.mark.parametrize("device", DEVICES)
def test_limits_are_reported_as_mjwarp_does(device: str) -> None:
    """Of one iteration: later ones end at the rounding of their sums, on either side."""
    model = every_row("elliptic", 3, 2)
    model.opt.iterations = 1
    model.opt.ls_iterations = 2
    worlds = Worlds(model, device, njmax=128)
    generator = torch.Generator().manual_seed(1)
    bits = []
    for _ in range(10):
        worlds.qvel += torch.randn(worlds.qvel.shape, generator=generator).to(device)
        worlds.step(8)
        ours = worlds.solve(fused.solve)
        np.testing.assert_array_equal(ours["bits"], worlds.solve(mjw.solve)["bits"])
        bits += ours["bits"].tolist()
    both = int(mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS)
    assert set(bits) >= {int(mjw.OverflowType.ITERATIONS), both}


def simulate(step: str, noslip: int = 0) -> MjwarpSimulation:
    cfg = configure(f"sim.step={step}")
    model = build_model(cfg)
    model.opt.noslip_iterations = noslip
    sizes = BatchSizes(nconmax=100, njmax=300)
    sim = make_simulation(model, cfg, 2, backend=Backend.mjwarp, device="cpu", sizes=sizes)
    assert isinstance(sim, MjwarpSimulation)
    return sim


def test_the_step_is_chosen_and_named() -> None:
    for step in ("auto", "fused", "arranged", "stock"):
        sim = simulate(step)
        expected = "fused" if step == "auto" else step
        assert sim.description.endswith(f", {expected} step")
        assert sim.arrangement.fused is (expected == "fused")
        assert sim.arrangement.own_stages is (expected != "stock")
        sim.step(3)
        assert bool(sim.qpos.isfinite().all())


def test_a_step_that_does_not_apply(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    other = simulate("auto", noslip=2)
    assert other.description.endswith("arranged step (noslip is on)")
    assert "sim.step: arranged step (noslip is on)" in caplog.text
    with pytest.raises(UnsupportedModel, match=r"sim\.step=fused does not apply: noslip is on"):
        simulate("fused", noslip=2)
