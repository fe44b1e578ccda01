"""Model fields that differ from world to world."""

import copy
from functools import partial

import mujoco
import numpy as np
import pytest
import torch
from compositions import load_config
from environments import CUDA, GetStage, MakeSim, on_backend, start_moving

from mjstack.episodes.stage import Stage
from mjstack.errors import MjstackError, UnknownName
from mjstack.sim import Simulation, make_simulation
from mjstack.sim.model_fields import FIELD_NAMES

N = 3
FIELDS = (
    *("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0"),
    *("dof_damping", "geom_friction", "actuator_gainprm", "actuator_biasprm"),
)


def simulate(
    model: mujoco.MjModel, backend: str, nworld: int, fields: tuple[str, ...]
) -> Simulation:
    return make_simulation(model, load_config([]), nworld, fields=fields, **on_backend(backend))


@pytest.fixture(scope="module")
def make_fields(get_stage: GetStage) -> MakeSim:
    """Simulations of the SO-101 scene with fields, reset and with the model's values, shared by the
    tests of this file.
    """
    made: dict[tuple, Simulation] = {}

    def make(backend: str, nworld: int = N, fields: tuple[str, ...] = FIELDS) -> Simulation:
        key = (backend, nworld, fields)
        model = get_stage("so101").model
        if key not in made:
            made[key] = simulate(model, *key)
        for name, field in made[key].fields.items():
            field[:] = torch.from_numpy(getattr(model, name)).to(field)
        made[key].reset()
        return made[key]

    return make


def cube(stage: Stage) -> tuple[int, int, int]:
    """First cube: its body, and where its position and velocity begin."""
    q = int(stage.index.object_qpos[0])
    v = int(stage.index.object_qvel[0])
    return int(stage.model.dof_bodyid[v]), q, v


def scale_cube(sim: Simulation, stage: Stage, world: int, s: float) -> None:
    """Makes the cube of one world s times as heavy, with all that MuJoCo derives from it."""
    body, _, v = cube(stage)
    for name in ("body_mass", "body_inertia", "body_subtreemass"):
        sim.fields[name][world, body] *= s
    sim.fields["body_invweight0"][world, body] /= s
    sim.fields["dof_invweight0"][world, v : v + 6] /= s


def randomise(sim: Simulation, stage: Stage) -> None:
    """Other mass, friction and gains in every world, the same for every backend."""
    for k in range(sim.nworld):
        rng = np.random.default_rng(k)
        scale_cube(sim, stage, k, rng.uniform(0.5, 2.0))
        sim.fields["geom_friction"][k, :, 0] *= rng.uniform(0.6, 1.4)
        gain = rng.uniform(0.8, 1.2)
        sim.fields["actuator_gainprm"][k, :, 0] *= gain
        sim.fields["actuator_biasprm"][k, :, 1] *= gain


@pytest.mark.full
def test_every_field_has_mujocos_shape_and_values(
    backend: str, make_fields: MakeSim, get_stage: GetStage
) -> None:
    sim = make_fields(backend, N, FIELD_NAMES)
    m = get_stage("so101").model
    assert tuple(sim.fields) == FIELD_NAMES
    for name, field in sim.fields.items():
        value = getattr(m, name)
        assert tuple(field.shape) == (N, *value.shape), name
        assert field.dtype is (torch.float64 if backend == "native" else torch.float32), name
        assert field.device == sim.device, name
        for k in range(N):
            np.testing.assert_allclose(field[k].cpu().numpy(), value, rtol=1e-6, err_msg=name)


@pytest.mark.full
def test_the_models_values_change_nothing(
    backend: str, make_fields: MakeSim, make_sim: MakeSim, get_stage: GetStage
) -> None:
    # On CUDA sums have no fixed order: in a few steps their rounding has no time to grow.
    steps = 5 if backend == "mjwarp-cuda" else 20
    finals = []
    for sim in (make_sim(backend, N), make_fields(backend, N, FIELD_NAMES)):
        start_moving(sim, get_stage("so101"))
        sim.step(steps)
        finals.append([sim.qpos.clone(), sim.qvel.clone(), sim.geom_xpos.clone()])
    for a, b in zip(*finals, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)


@pytest.mark.full
def test_the_names_are_those_that_mjwarp_batches(make_fields: MakeSim) -> None:
    make_fields("mjwarp")  # sets Warp up
    from dataclasses import fields as dataclass_fields

    import mujoco_warp

    floats = {
        spec.name
        for spec in dataclass_fields(mujoco_warp.Model)
        if getattr(spec.type, "shape", ())
        and spec.type.shape[0] == "*"
        and not any(w in str(spec.type.dtype) for w in ("int", "bool", "vec2i"))
    }
    assert floats - set(FIELD_NAMES) == {"actuator_delay", "sensor_delay", "sensor_interval"}
    assert set(FIELD_NAMES) <= floats


@pytest.mark.full
def test_fields_keep_their_address(backend: str, make_fields: MakeSim) -> None:
    sim = make_fields(backend)
    before = {name: field.data_ptr() for name, field in sim.fields.items()}
    sim.step(5)
    sim.forward()
    sim.reset()
    sim.fields["body_mass"] *= 2.0  # Python sets the item to the very same tensor
    assert {name: field.data_ptr() for name, field in sim.fields.items()} == before
    words = r"^sim\.fields\['body_mass'\] is a view .* write sim\.fields\['body_mass'\]\[:\] = "
    with pytest.raises(MjstackError, match=words):
        sim.fields["body_mass"] = torch.zeros(N)
    words = r"geom_size.* is not a per-world field of this simulation"
    with pytest.raises(MjstackError, match=words):
        sim.fields["geom_size"]


@pytest.mark.full
@pytest.mark.parametrize("kind", ["native", "mjwarp"])
@pytest.mark.parametrize(
    ("name", "nearest"), [("geom_frictoin", "geom_friction"), ("dof_M0", None)]
)
def test_a_field_that_is_unknown_or_cannot_differ_is_refused(
    kind: str, get_stage: GetStage, name: str, nearest: str | None
) -> None:
    words = f"^per-world model field '{name}' does not exist. "
    words += rf"Did you mean '{nearest}'\? " if nearest else ""
    with pytest.raises(UnknownName, match=words) as caught:
        simulate(get_stage("so101").model, kind, 1, ("body_mass", name))
    assert caught.value.exit_code == 2


def test_a_heavy_cube_is_slowed_less(
    backend: str, make_fields: MakeSim, get_stage: GetStage
) -> None:
    """Damping c stops mass m as exp(-c t / m): the implicit integrator divides the speed by 1 + c
    dt / m in every step.
    """
    stage = get_stage("so101")
    body, q, v = cube(stage)
    sim = make_fields(backend)
    sim.step(10)  # a graph that is captured before anything is written sees it all the same
    sim.reset()
    sim.fields["dof_damping"][:, v : v + 3] = 0.8
    sim.fields["dof_damping"][:, v + 3 : v + 6] = 1e-4
    scale_cube(sim, stage, 1, 4.0)
    sim.qpos[:, q + 2] = 2.0
    sim.qvel[:, v] = 1.0
    sim.qvel[:, v + 5] = 1.0
    sim.step(10)
    mass, inertia = (getattr(stage.model, name)[body] for name in ("body_mass", "body_inertia"))
    dt = stage.model.opt.timestep
    for k, s in enumerate((1.0, 4.0, 1.0)):
        for column, damping, inert in ((v, 0.8, mass), (v + 5, 1e-4, inertia[2])):
            speed = (1 + damping * dt / (s * inert)) ** -10
            assert float(sim.qvel[k, column]) == pytest.approx(speed, rel=1e-4), k
        # Gravity pulls a heavy cube as fast as a light one, apart from the damping.
        fall = 0.0
        for _ in range(10):
            fall = (fall - 9.81 * dt) / (1 + 0.8 * dt / (s * mass))
        assert float(sim.qvel[k, v + 2]) == pytest.approx(fall, rel=1e-3), k


@pytest.mark.full
def test_friction_stops_a_cube_in_one_world_only(
    backend: str, make_fields: MakeSim, get_stage: GetStage
) -> None:
    stage = get_stage("so101")
    _, q, v = cube(stage)
    sim = make_fields(backend)
    start_moving(sim, stage)
    sim.step(50)
    before = sim.qpos.clone()
    sim.fields["geom_friction"][:, :, 0] = torch.tensor([[1.0], [0.02], [1.0]], device=sim.device)
    sim.qvel[:, v + 1] = 0.3
    for _ in range(6):
        sim.step(10)
    slid = (sim.qpos - before)[:, q : q + 2].norm(dim=1).tolist()
    # v^2 / (2 mu g) is 4.6 mm on the rough table; on the smooth one the cube has kept most of its
    # 0.3 m/s for 0.12 s.
    assert slid[0] < 0.008
    assert slid[2] < 0.008
    assert slid[1] > 0.025


STATIC = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <body name="table" pos="0 0 0.3" euler="0 0 20">
      <geom type="box" size="0.2 0.2 0.02"/>
      <body pos="0.1 0 0"><geom type="box" size="0.02 0.02 0.1" pos="0 0 0.05"/></body>
    </body>
    <body name="ball" pos="-0.1 0 0.44"><freejoint/><geom size="0.03"/><site name="centre"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.full
def test_static_geoms_follow_their_fields(backend: str) -> None:
    """MJWarp by itself places geoms that never move once, when the data is made."""
    m = mujoco.MjModel.from_xml_string(STATIC)
    names = ("body_pos", "geom_pos", "geom_quat", "site_pos")
    sim = simulate(m, backend, N, names)
    sim.step(1)
    sim.fields["body_pos"][1, 1, 2] += 0.1  # the table, up to the ball
    sim.fields["geom_pos"][2] += 0.01
    sim.fields["geom_quat"][2] = torch.tensor([0.8, 0.0, 0.0, 0.6]).to(sim.qpos)
    sim.fields["site_pos"][2] += 0.01
    step = partial(sim.step, 1)
    for refresh in (sim.forward, sim.kinematics, step, partial(step, kinematics=True)):
        sim.reset()
        sim.geom_xpos.fill_(float("nan"))
        refresh()
        for k in range(N):
            own = copy.copy(m)
            own.geom_sameframe[:] = 0
            own.site_sameframe[:] = 0
            for name in names:
                getattr(own, name)[:] = sim.fields[name][k].double().cpu()
            data = mujoco.MjData(own)
            mujoco.mj_kinematics(own, data)
            np.testing.assert_allclose(sim.geom_xpos[k].double().cpu(), data.geom_xpos, atol=1e-4)
            np.testing.assert_allclose(sim.site_xpos[k].double().cpu(), data.site_xpos, atol=1e-4)
    assert sim.contact_count.tolist() == [0, 1, 0]


@pytest.mark.full
def test_reset_leaves_fields(backend: str, make_fields: MakeSim, get_stage: GetStage) -> None:
    sim = make_fields(backend)
    randomise(sim, get_stage("so101"))
    before = {name: field.clone() for name, field in sim.fields.items()}
    sim.reset(torch.tensor([True, False, True], device=sim.device))
    sim.step(2)
    sim.reset()
    for name, field in sim.fields.items():
        assert torch.equal(field, before[name]), name


@pytest.mark.full
def test_reset_starts_from_the_worlds_own_qpos0(backend: str, make_fields: MakeSim) -> None:
    sim = make_fields(backend, N, ("qpos0",))
    expected = sim.qpos.clone()
    sim.fields["qpos0"][1, 0] += 0.25
    expected[1, 0] += 0.25
    sim.reset()
    assert torch.equal(sim.qpos, expected)


@pytest.mark.parametrize("mjwarp", ["mjwarp", pytest.param("mjwarp-cuda", marks=CUDA)])
def test_backends_agree(make_fields: MakeSim, get_stage: GetStage, mjwarp: str) -> None:
    finals = []
    for backend in ("native", mjwarp):
        sim = make_fields(backend)
        randomise(sim, get_stage("so101"))
        start_moving(sim, get_stage("so101"))
        for _ in range(5):
            sim.step(10, kinematics=True)
        finals.append((sim.qpos.double().cpu(), sim.site_xpos.double().cpu()))
    for a, b in zip(*finals, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-4)


def test_a_scaled_free_body_is_what_set_const_computes(get_stage: GetStage) -> None:
    """All that mj_setConst derives for a body of its own scales with its mass, or with
    one over it.
    """
    stage = get_stage("so101")
    body, _, v = cube(stage)
    s = 1.7
    dofs = slice(v, v + 6)
    scaled = copy.copy(stage.model)
    derived = copy.copy(stage.model)
    for name, where, factor in (
        ("body_mass", body, s),
        ("body_inertia", body, s),
        ("body_subtreemass", body, s),
        ("body_invweight0", body, 1 / s),
        ("dof_invweight0", dofs, 1 / s),
    ):
        getattr(scaled, name)[where] *= factor
    derived.body_mass[body] *= s
    derived.body_inertia[body] *= s
    mujoco.mj_setConst(derived, mujoco.MjData(derived))
    # The mass of the whole scene, which no physics reads
    derived.body_subtreemass[0] = scaled.body_subtreemass[0]
    compared = 0
    for name in dir(derived):
        value = getattr(derived, name)
        # Native worlds take care of dof_M0 themselves: the next test.
        if isinstance(value, np.ndarray) and value.dtype.kind == "f" and name != "dof_M0":
            got = getattr(scaled, name)
            np.testing.assert_allclose(got, value, rtol=1e-9, atol=1e-12, err_msg=name)
            compared += 1
    assert compared > 100
    assert derived.body_mass[body] == s * stage.model.body_mass[body]


@pytest.mark.full
@pytest.mark.parametrize(
    "joints",
    [
        "<freejoint/>",
        "<joint type='ball'/>",
        "<joint type='slide' axis='1 0 0' armature='0.1'/><joint type='slide' axis='0 0 1'/>",
        "<joint type='hinge' axis='0 0 1' armature='0.2'/>",
        "<joint type='hinge' axis='0 0 1' pos='0.1 0.2 0'/>",
    ],
)
def test_native_mass_matrix_of_a_simple_body_follows_its_mass(joints: str) -> None:
    """MuJoCo reads the inertia of such a body from dof_M0, made at compile time, and its weight
    from body_mass.
    """
    body = f"<body pos='0 0 1'>{joints}<geom type='box' size='.1 .2 .3'/></body>"
    m = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    fields = ("body_mass", "body_inertia", "dof_armature")
    sim = simulate(m, "native", 2, fields)
    sim.fields["body_mass"][1] *= 3.0
    sim.fields["body_inertia"][1] *= torch.tensor([2.0, 3.0, 4.0])
    sim.fields["dof_armature"][1] += 0.05
    own = copy.copy(m)
    for name in fields:
        getattr(own, name)[:] = sim.fields[name][1]
    mujoco.mj_setConst(own, mujoco.MjData(own))
    sim.qvel[:, -1] = 1.0
    initial = sim.qvel.clone()
    sim.step(5)
    for model, k in ((m, 0), (own, 1)):
        data = mujoco.MjData(model)
        data.qvel[:] = initial[k]
        mujoco.mj_step(model, data, 5)
        np.testing.assert_allclose(sim.qvel[k], data.qvel, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(sim.qpos[k], data.qpos, rtol=1e-12, atol=1e-14)
