"""The built-in mesh-free robots against MuJoCo Menagerie, and on their own.

The comparison needs Menagerie's files: the folder named by MENAGERIE_ROOT, else
`../shared/menagerie` beside the checkout."""

import os
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
from compositions import load_config, put

from mjstack.scene import build_model

REPO = Path(__file__).resolve().parents[2]
BUILT_IN = REPO / "mjstack" / "robots"
UPSTREAM = {
    "so101": "robotstudio_so101/so101.xml",
    "rebot": "seeed_rebot_devarm/seeed_rebot_devarm.xml",
}
ROBOTS = list(UPSTREAM)

GRASP_SITES = {"so101": ("grasp_fixed", "grasp_moving"), "rebot": ("grasp_left", "grasp_right")}
SO101_TIPS = [[f"{jaw}_jaw_sph_tip{i}" for i in (1, 2, 3)] for jaw in ("fixed", "moving")]
SO101_JAW_BODIES = {"gripper", "camera_mount", "moving_jaw_so101_v1"}
# Total mass in kg, generous on both sides.
MASS_BOUNDS = {"so101": (0.4, 1.0), "rebot": (4.0, 8.0)}

KIND_COUNT = {"body": "nbody", "joint": "njnt", "site": "nsite", "actuator": "nu", "camera": "ncam"}

OPTIONS = """timestep integrator cone impratio iterations ls_iterations tolerance solver jacobian
gravity noslip_iterations disableflags enableflags density viscosity"""
FIELDS = """body_parentid body_pos body_gravcomp
jnt_bodyid jnt_type jnt_axis jnt_pos jnt_range jnt_limited jnt_stiffness jnt_margin jnt_solref
jnt_solimp jnt_actfrclimited jnt_actfrcrange qpos0 qpos_spring
dof_damping dof_armature dof_frictionloss dof_solref dof_solimp
actuator_gaintype actuator_gainprm actuator_biastype actuator_biasprm actuator_dyntype actuator_gear
actuator_trntype actuator_ctrllimited actuator_ctrlrange actuator_forcelimited actuator_forcerange
eq_obj1id eq_obj2id eq_type eq_data eq_solref eq_solimp eq_active0 key_qpos key_ctrl
cam_bodyid cam_mode cam_pos cam_resolution cam_sensorsize cam_intrinsic cam_fovy"""
CONTACT_FIELDS = """type pos size contype conaffinity condim friction solref solimp priority solmix
margin gap"""

# Name, built-in model, upstream model.
Pair = tuple[str, mujoco.MjModel, mujoco.MjModel]


@cache
def built_in(robot: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(BUILT_IN / f"{robot}.xml"))


@cache
def _compile(path: Path) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(path))


def upstream(robot: str) -> mujoco.MjModel:
    """Menagerie's model; skips the test where there is no copy, fails where MENAGERIE_ROOT points
    beside one.
    """
    named = os.environ.get("MENAGERIE_ROOT")
    path = (Path(named) if named else REPO.parent / "shared" / "menagerie") / UPSTREAM[robot]
    if path.is_file():
        return _compile(path)
    if named:
        pytest.fail(f"MENAGERIE_ROOT is set, but there is no {UPSTREAM[robot]} in it")
    pytest.skip(
        f"no copy of MuJoCo Menagerie: set MENAGERIE_ROOT to a folder that holds {UPSTREAM[robot]}"
    )


@pytest.fixture(params=ROBOTS)
def pair(request: pytest.FixtureRequest) -> Pair:
    return request.param, built_in(request.param), upstream(request.param)


def names(model: mujoco.MjModel, kind: str) -> list[str]:
    """Names of all objects of a kind, in the model's order."""
    return [getattr(model, kind)(i).name for i in range(getattr(model, KIND_COUNT[kind]))]


def assert_same_rotation(a: np.ndarray, b: np.ndarray) -> None:
    """Unit quaternions, row by row, equal up to sign."""
    sign = np.where(np.sum(a * b, axis=-1, keepdims=True) < 0, -1.0, 1.0)
    np.testing.assert_allclose(a * sign, b, rtol=0, atol=1e-12)


def inertia_tensor(model: mujoco.MjModel, body: int) -> np.ndarray:
    """Full inertia tensor about the centre of mass, in the body frame's axes."""
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, model.body_iquat[body])
    rot = flat.reshape(3, 3)
    return rot @ np.diag(model.body_inertia[body]) @ rot.T


def collision_geoms(model: mujoco.MjModel, body: int) -> list[int]:
    """Non-mesh geoms of a body that can touch something, in order."""
    solid = (model.geom_bodyid == body) & (model.geom_type != mujoco.mjtGeom.mjGEOM_MESH)
    touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return np.flatnonzero(solid & touching).tolist()


# Against upstream


def test_same_names_tree_joints_servos_and_cameras(pair: Pair) -> None:
    robot, built, menagerie = pair
    for kind in ("body", "joint", "actuator", "camera"):
        assert names(built, kind) == names(menagerie, kind)
    keys = [[model.key(i).name for i in range(model.nkey)] for model in (built, menagerie)]
    assert keys[0] == keys[1]
    assert built.neq == {"so101": 0, "rebot": 1}[robot]
    for field in FIELDS.split():
        values = (getattr(built, field), getattr(menagerie, field))
        np.testing.assert_allclose(*values, rtol=1e-12, atol=1e-14, err_msg=field)
    for field in OPTIONS.split():
        values = (getattr(built.opt, field), getattr(menagerie.opt, field))
        np.testing.assert_allclose(*values, rtol=1e-12, atol=1e-14, err_msg=field)
    joints = (built.actuator_trnid[:, 0], menagerie.actuator_trnid[:, 0])
    np.testing.assert_array_equal(*joints)
    assert_same_rotation(built.body_quat, menagerie.body_quat)
    assert_same_rotation(built.cam_quat, menagerie.cam_quat)
    for name in names(menagerie, "site"):
        site = built.site(name)
        assert site.bodyid == menagerie.site(name).bodyid, name
        np.testing.assert_allclose(site.pos, menagerie.site(name).pos, rtol=0, atol=1e-14)
        assert_same_rotation(site.quat, menagerie.site(name).quat)


def test_same_mass_and_inertia(pair: Pair) -> None:
    _, built, menagerie = pair
    for body, name in enumerate(names(menagerie, "body")):
        # The camera mount's inertia comes from a mesh upstream and may move a little between MuJoCo
        # versions.
        rtol = 1e-7 if name == "camera_mount" else 1e-10
        assert built.body_mass[body] == pytest.approx(menagerie.body_mass[body], rel=rtol), name
        off = np.abs(built.body_ipos[body] - menagerie.body_ipos[body]).max()
        assert off <= 0.1 * rtol, name
        expected = inertia_tensor(menagerie, body)
        off = np.abs(inertia_tensor(built, body) - expected).max()
        assert off <= rtol * np.abs(expected).max(), name


def test_so101_keeps_every_primitive_collision_geom() -> None:
    models = (built_in("so101"), upstream("so101"))
    count = 0
    for body, name in enumerate(names(models[1], "body")):
        geoms = [collision_geoms(model, body) for model in models]
        assert len(geoms[0]) == len(geoms[1]), name
        assert all(
            models[1].geom(b).name in ("", models[0].geom(a).name)
            for a, b in zip(*geoms, strict=True)
        )
        for field in CONTACT_FIELDS.split():
            values = [getattr(m, f"geom_{field}")[g] for m, g in zip(models, geoms, strict=True)]
            message = f"{name} {field}"
            np.testing.assert_allclose(*values, rtol=1e-12, atol=1e-14, err_msg=message)
        assert_same_rotation(*(m.geom_quat[g] for m, g in zip(models, geoms, strict=True)))
        count += len(geoms[0])
    assert count == 27


def upstream_grasp_point(robot: str, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Grasp point from first principles: midpoint of the tip centroids, or of the finger bodies."""
    if robot == "so101":
        return np.mean([data.geom(tip).xpos for jaw in SO101_TIPS for tip in jaw], axis=0)
    return (data.body("gripper_left").xpos + data.body("gripper_right").xpos) / 2


def test_same_grasp_point(pair: Pair) -> None:
    """200 random configurations; the largest distance between the two centres is at most 1 um."""
    robot, built, menagerie = pair
    rng = np.random.default_rng(20240817)
    built_data = mujoco.MjData(built)
    menagerie_data = mujoco.MjData(menagerie)
    low, high = menagerie.jnt_range.T
    centres = []
    errors = []
    for _ in range(200):
        q = rng.uniform(low, high)
        built_data.qpos[:] = menagerie_data.qpos[:] = q
        mujoco.mj_kinematics(built, built_data)
        mujoco.mj_kinematics(menagerie, menagerie_data)
        centre = np.mean([built_data.site(site).xpos for site in GRASP_SITES[robot]], axis=0)
        centres.append(centre)
        errors.append(
            np.linalg.norm(centre - upstream_grasp_point(robot, menagerie, menagerie_data))
        )
    assert np.ptp(centres, axis=0).min() > 0.2  # the configurations do move the hand
    assert max(errors) <= 1e-6


# On their own


def test_mesh_free_and_standalone(robot: str, tmp_path: Path) -> None:
    """Nothing but the file itself is needed: it compiles from an empty folder."""
    copy = tmp_path / "robot.xml"
    copy.write_text((BUILT_IN / f"{robot}.xml").read_text())
    model = mujoco.MjModel.from_xml_path(str(copy))
    assert (model.nmesh, model.nhfield, model.ntex, model.nskin) == (0, 0, 0, 0)
    assert (model.geom_type != mujoco.mjtGeom.mjGEOM_MESH).all()


def test_plausible_mass(robot: str) -> None:
    model = built_in(robot)
    low, high = MASS_BOUNDS[robot]
    assert np.isfinite(model.body_mass).all()
    assert np.isfinite(model.body_inertia).all()
    assert (model.body_mass[1:] > 0.005).all()
    assert (model.body_inertia[1:] > 0).all()
    assert low < model.body_mass.sum() < high


def test_visible_parts_never_touch(robot: str) -> None:
    """Group 2 is for the eye only, group 3 is what collides; no geom is in any other group."""
    model = built_in(robot)
    touches = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    assert (model.geom_group[~touches] == 2).all()
    assert (model.geom_group[touches] == 3).all()
    assert all(model.geom(int(g)).name for g in np.flatnonzero(touches)), "unnamed collision geom"
    seen = {int(b) for b in model.geom_bodyid[~touches]}
    assert seen == set(range(1, model.nbody)), "a body without a visible part"


def test_so101_contact_parameters() -> None:
    model = built_in("so101")
    for geom in map(model.geom, np.flatnonzero(model.geom_group == 3)):
        body = model.body(geom.bodyid[0]).name
        jaw = body in SO101_JAW_BODIES and geom.name != "gripper_neck_box"
        flags = [
            getattr(geom, name)[0] for name in ("contype", "conaffinity", "condim", "priority")
        ]
        assert flags == ([1, 1, 6, 1] if jaw else [1, 1, 3, 0]), geom.name
        friction = [1, 0.005, 0.0005 if jaw else 0.0001]
        np.testing.assert_allclose(geom.friction, friction, err_msg=geom.name)
        np.testing.assert_allclose(geom.solref, [0.01 if jaw else 0.02, 1], err_msg=geom.name)


def test_rebot_contact_parameters() -> None:
    """One pad box per finger, no other contact, and the pads never touch each other."""
    model = built_in("rebot")
    touching = [g for body in range(model.nbody) for g in collision_geoms(model, body)]
    assert {model.geom(g).name for g in touching} == {"left_pad", "right_pad"}
    for side, y in (("left", -0.0026), ("right", 0.0026)):
        pad = model.geom(f"{side}_pad")
        assert model.body(pad.bodyid[0]).name == f"gripper_{side}"
        assert pad.type[0] == mujoco.mjtGeom.mjGEOM_BOX
        np.testing.assert_allclose(pad.pos, [0, y, 0.006], atol=1e-15)
        np.testing.assert_allclose(pad.size, [0.0192, 0.0393, 0.006])
        assert_same_rotation(pad.quat, np.array([1.0, 0, 0, 0]))
        assert (pad.contype[0], pad.conaffinity[0], pad.condim[0], pad.priority[0]) == (0, 1, 4, 0)
        np.testing.assert_allclose(pad.friction, [1, 0.005, 0.0005])


def test_grasp_point_sites() -> None:
    """The sites sit at the centroids of the built-in tip spheres, and at the origins of the finger
    bodies.
    """
    so101 = built_in("so101")
    rebot = built_in("rebot")
    sites = [
        (so101, "grasp_fixed", "gripper", SO101_TIPS[0]),
        (so101, "grasp_moving", "moving_jaw_so101_v1", SO101_TIPS[1]),
        (rebot, "grasp_left", "gripper_left", []),
        (rebot, "grasp_right", "gripper_right", []),
    ]
    for model, name, body, tips in sites:
        site = model.site(name)
        assert model.body(site.bodyid[0]).name == body
        centroid = np.mean([model.geom(tip).pos for tip in tips] or [np.zeros(3)], axis=0)
        np.testing.assert_allclose(site.pos, centroid, rtol=0, atol=1e-15 if tips else 0)
        assert site.group[0] == 4


@pytest.mark.full
@pytest.mark.parametrize("condim", [3, 6])
def test_gripper_condim_reaches_the_gripper_alone(robot: str, condim: int) -> None:
    cfg = load_config([f"robot={robot}"])
    plain = build_model(cfg)
    model = build_model(put(cfg, f"solver.gripper_condim={condim}"))
    bodies = [model.body(name).id for name in cfg.robot.jaw_bodies]
    gripper = np.isin(model.geom_bodyid, bodies)
    assert gripper.sum() >= 2
    assert (model.geom_condim[gripper] == condim).all()
    assert np.array_equal(model.geom_condim[~gripper], plain.geom_condim[~gripper])
    assert set(plain.geom_condim[gripper]) <= {3, 4, 6}
