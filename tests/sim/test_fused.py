"""Contact rows and the solver as one kernel each end where MJWarp's own do."""

import math
from collections.abc import Callable, Iterator

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from environments import configure, fused_sim

from mjstack.sim.fused import constraints
from mjstack.sim.mujoco_warp import mjw

RESULTS = ("qacc", "qfrc_constraint", "efc.Ma", "efc.force")
CONTACTS = (
    *("dist", "pos", "frame", "includemargin", "friction", "solref", "solreffriction", "solimp"),
    *("dim", "geom", "efc_address", "worldid", "type"),
)
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


def heap(boxes: int, condim: int) -> str:
    """Boxes that fall onto the floor and each other."""
    places = [(0.06 * (k % 3), 0.3, 0.05 + 0.07 * k, 10 * k) for k in range(boxes)]
    return "".join(BOX.format(k, *place, condim) for k, place in enumerate(places))


def every_row(cone: str, condim: int, boxes: int) -> mujoco.MjModel:
    xml = ROWS.format(cone=cone, condim=condim, boxes=heap(boxes, condim))
    return mujoco.MjModel.from_xml_string(xml)


def model_of(bodies: str, rest: str = "", jacobian: str = "dense") -> mujoco.MjModel:
    """A model of some bodies and geoms, with elliptic cones."""
    option = f"<option cone='elliptic' jacobian='{jacobian}'/>"
    xml = f"<mujoco>{option}<worldbody>{bodies}</worldbody>{rest}</mujoco>"
    return mujoco.MjModel.from_xml_string(xml)


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
        results = {name: self._array(name).numpy().copy() for name in RESULTS}
        rows = np.arange(self.d.njmax)[None] < self.d.nefc.numpy()[:, None]
        results["efc.force"] = np.where(rows, results["efc.force"][:, : self.d.njmax], 0.0)
        results["state"] = np.where(rows, self.d.efc.state.numpy()[:, : self.d.njmax], 0)
        results["efc.Ma"] = results["efc.Ma"][:, : self.m.nv]
        results["niter"] = self.d.solver_niter.numpy().copy()
        results["bits"] = self.d.overflow.numpy().copy()
        return results

    def _array(self, name: str) -> wp.array:
        owner = self.d.efc if name.startswith("efc.") else self.d
        return getattr(owner, name.removeprefix("efc."))


def random_states(
    worlds: Worlds, count: int, steps: int, speed: float = 0.5, seed: int = 0
) -> Iterator[None]:
    """Bring worlds that are thrown about into one state after the other."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(count):
        thrown = torch.randn(worlds.qvel.shape, generator=generator)
        worlds.qvel += speed * thrown.to(worlds.qvel.device)
        worlds.step(steps)
        yield


def solved_alike(worlds: Worlds) -> dict[str, np.ndarray]:
    """The fused results; both are one solution, to the tolerance at which the solver stops."""
    fused = worlds.solve(constraints.solve)
    stock = worlds.solve(mjw.solve)
    for name in RESULTS:
        scale = np.abs(stock[name]).max(axis=1, keepdims=True) + 1e-6
        values = (fused[name] / scale, stock[name] / scale)
        np.testing.assert_allclose(*values, atol=5e-3, err_msg=name)
    np.testing.assert_array_equal(fused["bits"], stock["bits"])
    assert np.abs(fused["niter"] - stock["niter"]).max() <= 3
    return fused


@pytest.mark.parametrize(
    ("cone", "condim", "boxes"),
    [
        ("elliptic", 1, 2),
        pytest.param("elliptic", 3, 2, marks=pytest.mark.full),
        pytest.param("elliptic", 6, 8, marks=pytest.mark.full),
        pytest.param("pyramidal", 3, 3, marks=pytest.mark.full),
        pytest.param("pyramidal", 6, 5, marks=pytest.mark.full),
    ],
)
def test_every_kind_of_row(cone: str, condim: int, boxes: int, device: str) -> None:
    model = every_row(cone, condim, boxes)
    worlds = Worlds(model, device, njmax=768)
    assert constraints.why_not(worlds.m, worlds.d) == ""
    kinds: set[int] = set()
    states: set[int] = set()
    for _ in random_states(worlds, 12, 12):
        states |= set(solved_alike(worlds)["state"].ravel().tolist())
        for world in range(N):
            kinds |= set(worlds.d.efc.type.numpy()[world, : int(worlds.d.nefc.numpy()[world])])
    contact = {1: 5}.get(condim, {"elliptic": 7, "pyramidal": 6}[cone])
    assert kinds == {0, 1, 2, 3, 4, contact}
    assert states >= {0, 1, 2, 3} | ({4} if contact == 7 else set())


@pytest.mark.parametrize(
    ("condim", "njmax"),
    [
        (3, 300),
        *(
            pytest.param(*sizes, marks=pytest.mark.full)
            for sizes in ((1, 300), (1, 16), (3, 16), (6, 300), (6, 16))
        ),
    ],
)
def test_contact_rows(condim: int, njmax: int, device: str) -> None:
    """All that MJWarp writes of a row, also where the buffer ends within a contact. On CUDA the
    order of contacts is another in every run, so there rows are compared by contact.
    """
    worlds = Worlds(every_row("elliptic", condim, 4), device, njmax=njmax)
    worlds.m.opt.impratio_invsqrt.fill_(0.2)
    names = ("J", "D", "aref", "vel", "pos", "margin", "frictionloss", "type")
    most = 0
    for _ in random_states(worlds, 4, 40, speed=1.0):
        written = []
        for stages in (
            (mjw.make_constraint,),
            (constraints.noncontact_rows, constraints.contact_rows),
        ):
            for name in names:
                getattr(worlds.d.efc, name).fill_(-7)
            with wp.ScopedDevice(worlds.device):
                for stage in stages:
                    stage(worlds.m, worlds.d)
                wp.synchronize_device(worlds.device)
            address = worlds.d.contact.efc_address.numpy()[: int(worlds.d.nacon.numpy()[0]), 0]
            world = worlds.d.contact.worldid.numpy()
            first = [(world[c], row) for c, row in enumerate(address) if row >= 0]
            rows = [(w, row + k) for w, row in first for k in range(condim) if row + k < njmax]
            pick = tuple(np.array(rows).T)
            values = {name: getattr(worlds.d.efc, name).numpy()[pick] for name in names}
            written.append((worlds.d.nefc.numpy().copy(), len(rows), values))
        np.testing.assert_array_equal(written[0][0], written[1][0])
        most = max(most, int(written[0][0].max()))
        if njmax == 16 and device != "cpu":
            continue  # contacts that are left out differ
        assert written[0][1] == written[1][1]
        for name in names:
            a, b = (of[2][name].reshape(written[0][1], -1)[:, : worlds.m.nv] for of in written)
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * np.abs(a).max(), err_msg=name)
    assert most > 16


def test_worlds_without_rows_and_with_too_many(device: str) -> None:
    """No row at all: the smooth acceleration. More rows than there is room for: that world is
    marked as lost by MJWarp, and the others are solved.
    """
    box = "<body pos='{} 0 .049'><freejoint/><geom type='box' size='.05 .05 .05'/></body>"
    floor = "<geom type='plane' size='2 2 .1'/>"
    model = model_of(floor + box.format(0) + box.format(1), jacobian="auto")
    worlds = Worlds(model, device, njmax=20)
    qpos = wp.to_torch(worlds.d.qpos)
    qpos[0, 2::7] = 1.0
    qpos[1, 2] = 1.0
    worlds.step(0)
    np.testing.assert_array_equal(worlds.d.nefc.numpy(), [0, 12, 24, 24])
    fused = worlds.solve(constraints.solve)
    stock = worlds.solve(mjw.solve)
    for name in RESULTS:
        np.testing.assert_allclose(fused[name][:2], stock[name][:2], atol=1e-3, err_msg=name)
    np.testing.assert_allclose(fused["qacc"][0], worlds.d.qacc_smooth.numpy()[0], rtol=1e-6)
    assert np.isfinite(fused["qacc"]).all()


def test_a_world_that_is_not_finite_is_alone(device: str) -> None:
    worlds = Worlds(every_row("elliptic", 3, 2), device, njmax=128)
    worlds.step(150)
    before = worlds.solve(constraints.solve)
    tangent = int(np.flatnonzero(worlds.d.efc.type.numpy()[1] == 7)[1])  # the first contact's
    spoilt = (
        (worlds.d.qfrc_smooth, slice(None), math.nan),
        (worlds.d.efc.J, slice(None), math.inf),
        (worlds.d.efc.aref, tangent, math.nan),
    )
    for array, where, value in spoilt:
        view = wp.to_torch(array)
        before_it = view.clone()
        view[1, where] = value
        after = worlds.solve(constraints.solve)
        view.copy_(before_it)
        assert not np.isfinite(after["qacc"][1]).all()
        for name in RESULTS:
            np.testing.assert_array_equal(after[name][[0, 2, 3]], before[name][[0, 2, 3]])


@pytest.mark.full
@pytest.mark.parametrize(("boxes", "slides"), [(0, 1), (5, 1), (5, 2), (5, 3), (8, 0), (9, 6)])
def test_sizes(boxes: int, slides: int, device: str) -> None:
    """On CUDA a row of the Hessian is a thread's up to 31 degrees of freedom; columns of J are
    padded to 4, and above 32 to 16. The CPU device solves some of these sizes in other tests too.
    """
    if device == "cpu" and (boxes, slides) in ((5, 1), (5, 3), (8, 0)):
        pytest.skip("their kernels take half a minute to compile each")
    arm = "<body pos='{} 1 .15'><joint type='slide' axis='0 0 1'/><geom size='.1'/></body>"
    arms = "".join(map(arm.format, range(slides)))
    model = model_of(f"<geom type='plane' size='9 9 .1'/>{heap(boxes, 3)}{arms}")
    worlds = Worlds(model, device, njmax=256)
    assert constraints.why_not(worlds.m, worlds.d) == ""
    rows = 0
    for _ in random_states(worlds, 4, 30):
        solved_alike(worlds)
        rows = max(rows, int(worlds.d.nefc.numpy().max()))
    assert rows > boxes


def test_sizes_that_do_not_fit() -> None:
    """A row of J at 48 degrees of freedom has 64 columns."""
    limit = 48 * 1024 - 256
    assert constraints.shared_bytes(48, 64, 1152) > limit > constraints.shared_bytes(18, 20, 1152)
    bodies = "".join(BOX.format(k, 0.1 * k, 0, 0.5, 0, 3) for k in range(8))
    worlds = Worlds(model_of(bodies), "cpu", njmax=1152)
    assert "1152 rows need 51,376 bytes of shared memory" in constraints.why_not(worlds.m, worlds.d)


def test_more_equalities_than_room(device: str) -> None:
    """MJWarp counts them all: such a world is lost, and nothing is read beyond the buffer."""
    body = "<body pos='{0} 0 1'><joint name='j{0}' axis='0 1 0'/><geom size='.1'/></body>"
    pairs = "".join(map("<joint joint1='j{}'/>".format, range(40)))
    bodies = "".join(map(body.format, range(40)))
    worlds = Worlds(model_of(bodies, f"<equality>{pairs}</equality>"), device, njmax=16)
    worlds.step(1)
    assert worlds.d.ne.numpy().tolist() == [40] * N
    fused = worlds.solve(constraints.solve)
    assert np.isfinite(fused["qacc"]).all()


def test_limits_are_reported_as_mjwarp_does(device: str) -> None:
    """Of one iteration: later ones end at the rounding of their sums, on either side."""
    model = every_row("elliptic", 3, 2)
    model.opt.iterations = 1
    model.opt.ls_iterations = 2
    worlds = Worlds(model, device, njmax=128)
    bits = []
    for _ in random_states(worlds, 10, 8, speed=1.0, seed=1):
        fused = worlds.solve(constraints.solve)
        np.testing.assert_array_equal(fused["bits"], worlds.solve(mjw.solve)["bits"])
        bits += fused["bits"].tolist()
    limits = int(mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS)
    assert set(bits) >= {int(mjw.OverflowType.ITERATIONS), limits}


def test_contacts_are_mjwarps_own(robot: str, device: str) -> None:
    """The same kernels, launched here: on the CPU device bit for bit, in the same order."""
    sim = fused_sim(configure(robot=robot), 2, device)
    sim.ctrl[:] = torch.from_numpy(sim.model.actuator_ctrlrange[:, 1]).to(sim.ctrl)
    sim.step(60)
    results = []
    for collide in (mjw.collision, constraints.collision):
        for name in CONTACTS:
            getattr(sim._d.contact, name).fill_(0)
        with wp.ScopedDevice(sim._device):
            collide(sim._m, sim._d)
            wp.synchronize_device(sim._device)
        count = int(sim._d.nacon.numpy()[0])
        arrays = {name: getattr(sim._d.contact, name).numpy()[:count] for name in CONTACTS}
        order = np.arange(count)
        if device != "cpu":
            order = np.lexsort(np.column_stack([arrays["pos"], arrays["worldid"]]).T)
        results.append({name: values[order] for name, values in arrays.items()})
    assert len(results[0]["dist"]) >= 8
    for name, values in results[0].items():
        np.testing.assert_array_equal(results[1][name], values, err_msg=name)


def no_slip(model: mujoco.MjModel) -> None:
    model.opt.noslip_iterations = 2


def slower(model: mujoco.MjModel) -> None:
    model.opt.density = 1.2
    model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL


REASONS = "MJWarp's contact rows, because cones are pyramidal; "
REASONS += "MJWarp's smooth dynamics, because there is a fluid"


@pytest.mark.parametrize(
    ("step", "edit", "name"),
    [
        ("auto", None, "fused step"),
        ("stock", None, "stock step"),
        ("auto", no_slip, "arranged step (noslip is on)"),
        ("auto", slower, f"fused step ({REASONS})"),
    ],
)
def test_the_step_is_chosen_and_named(
    step: str,
    edit: Callable[[mujoco.MjModel], None] | None,
    name: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    sim = fused_sim(configure(f"sim.step={step}"), 2, edit=edit)
    assert sim.description.endswith(f", {name}")
    sim.step(3)
    assert bool(sim.qpos.isfinite().all())
    assert (f"sim.step: {name}" in caplog.text) == ("(" in name)
