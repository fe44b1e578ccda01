"""The built-in mesh-free robots against MuJoCo Menagerie, and on their own.

The comparison needs Menagerie's files: the folder named by MENAGERIE_ROOT, else
`../shared/menagerie` beside the checkout."""

import os
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest

REPO = Path(__file__).resolve().parents[1]
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

OPTIONS = [
    "timestep",
    "integrator",
    "cone",
    "impratio",
    "iterations",
    "ls_iterations",
    "tolerance",
    "solver",
]
OPTIONS += [
    "jacobian",
    "gravity",
    "noslip_iterations",
    "disableflags",
    "enableflags",
    "density",
    "viscosity",
]
JOINT_FIELDS = [
    "jnt_type",
    "jnt_axis",
    "jnt_pos",
    "jnt_range",
    "jnt_limited",
    "jnt_stiffness",
    "jnt_margin",
]
JOINT_FIELDS += [
    "jnt_solref",
    "jnt_solimp",
    "jnt_actfrclimited",
    "jnt_actfrcrange",
    "qpos0",
    "qpos_spring",
]
DOF_FIELDS = ["dof_damping", "dof_armature", "dof_frictionloss", "dof_solref", "dof_solimp"]
ACTUATOR_FIELDS = ["gaintype", "gainprm", "biastype", "biasprm", "dyntype", "gear", "trntype"]
ACTUATOR_FIELDS += ["ctrllimited", "ctrlrange", "forcelimited", "forcerange"]
EQUALITY_FIELDS = ["eq_type", "eq_data", "eq_solref", "eq_solimp", "eq_active0"]
CONTACT_FIELDS = [
    "type",
    "pos",
    "size",
    "contype",
    "conaffinity",
    "condim",
    "friction",
    "solref",
    "solimp",
]
CONTACT_FIELDS += ["priority", "solmix", "margin", "gap"]
CAMERA_FIELDS = [
    "cam_mode",
    "cam_pos",
    "cam_resolution",
    "cam_sensorsize",
    "cam_intrinsic",
    "cam_fovy",
]

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


def assert_fields(ours: object, theirs: object, fields: list[str], **tolerance: float) -> None:
    """Every listed array is equal (within 1e-12 unless told)."""
    tol = {"rtol": 1e-12, "atol": 1e-14} | tolerance
    for field in fields:
        np.testing.assert_allclose(
            getattr(ours, field), getattr(theirs, field), err_msg=field, **tol
        )


def assert_same_rotation(ours: np.ndarray, theirs: np.ndarray, atol: float = 1e-12) -> None:
    """Unit quaternions, row by row, equal up to sign."""
    a = np.atleast_2d(ours)
    b = np.atleast_2d(theirs)
    sign = np.where(np.sum(a * b, axis=1) < 0, -1.0, 1.0)
    np.testing.assert_allclose(a * sign[:, None], b, rtol=0, atol=atol)


def inertia_tensor(model: mujoco.MjModel, body: int) -> np.ndarray:
    """Full inertia tensor about the centre of mass, in the body frame's axes."""
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, model.body_iquat[body])
    rot = flat.reshape(3, 3)
    return rot @ np.diag(model.body_inertia[body]) @ rot.T


def collision_geoms(model: mujoco.MjModel, body: int) -> list[int]:
    """Non-mesh geoms of a body that can touch something, in order."""
    return [
        g
        for g in range(model.ngeom)
        if model.geom_bodyid[g] == body
        and (model.geom_contype[g] or model.geom_conaffinity[g])
        and model.geom_type[g] != mujoco.mjtGeom.mjGEOM_MESH
    ]


# ---- against upstream
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["body", "joint", "actuator", "camera"])
def test_same_names(pair: Pair, kind: str) -> None:
    _, ours, theirs = pair
    assert names(ours, kind) == names(theirs, kind)


def test_same_tree_and_steps(pair: Pair) -> None:
    _, ours, theirs = pair
    np.testing.assert_array_equal(ours.body_parentid, theirs.body_parentid)
    assert_fields(ours, theirs, ["body_pos", "body_gravcomp"])
    assert_same_rotation(ours.body_quat, theirs.body_quat)


def test_same_mass_and_inertia(pair: Pair) -> None:
    _, ours, theirs = pair
    for body, name in enumerate(names(theirs, "body")):
        # The camera mount's inertia comes from a mesh upstream and may move a little between MuJoCo
        # versions.
        rtol = 1e-7 if name == "camera_mount" else 1e-10
        np.testing.assert_allclose(
            ours.body_mass[body], theirs.body_mass[body], rtol=rtol, err_msg=name
        )
        np.testing.assert_allclose(
            ours.body_ipos[body], theirs.body_ipos[body], rtol=0, atol=0.1 * rtol, err_msg=name
        )
        expected = inertia_tensor(theirs, body)
        atol = rtol * np.abs(expected).max()
        np.testing.assert_allclose(
            inertia_tensor(ours, body), expected, rtol=0, atol=atol, err_msg=name
        )


def test_same_joints(pair: Pair) -> None:
    _, ours, theirs = pair
    np.testing.assert_array_equal(ours.jnt_bodyid, theirs.jnt_bodyid)
    assert_fields(ours, theirs, JOINT_FIELDS + DOF_FIELDS)


def test_same_actuators(pair: Pair) -> None:
    _, ours, theirs = pair
    np.testing.assert_array_equal(
        ours.actuator_trnid[:, 0], theirs.actuator_trnid[:, 0]
    )  # same joint
    assert_fields(ours, theirs, [f"actuator_{field}" for field in ACTUATOR_FIELDS])


def test_same_equalities(pair: Pair) -> None:
    robot, ours, theirs = pair
    assert ours.neq == theirs.neq == {"so101": 0, "rebot": 1}[robot]
    np.testing.assert_array_equal(ours.eq_obj1id, theirs.eq_obj1id)
    np.testing.assert_array_equal(ours.eq_obj2id, theirs.eq_obj2id)
    assert_fields(ours, theirs, EQUALITY_FIELDS)


def test_same_options(pair: Pair) -> None:
    _, ours, theirs = pair
    assert_fields(ours.opt, theirs.opt, OPTIONS)


def test_same_keyframes(pair: Pair) -> None:
    _, ours, theirs = pair
    assert [ours.key(i).name for i in range(ours.nkey)] == [
        theirs.key(i).name for i in range(theirs.nkey)
    ]
    assert_fields(ours, theirs, ["key_qpos", "key_ctrl"])


def test_same_cameras_and_upstream_sites(pair: Pair) -> None:
    _, ours, theirs = pair
    assert_fields(ours, theirs, CAMERA_FIELDS)
    np.testing.assert_array_equal(ours.cam_bodyid, theirs.cam_bodyid)
    assert_same_rotation(ours.cam_quat, theirs.cam_quat)
    for name in names(theirs, "site"):
        a = ours.site(name)
        b = theirs.site(name)
        assert a.bodyid == b.bodyid, name
        np.testing.assert_allclose(a.pos, b.pos, rtol=0, atol=1e-14, err_msg=name)
        assert_same_rotation(a.quat, b.quat)


def test_so101_keeps_every_primitive_collision_geom() -> None:
    ours = built_in("so101")
    theirs = upstream("so101")
    count = 0
    for body, name in enumerate(names(theirs, "body")):
        kept = collision_geoms(ours, body)
        expected = collision_geoms(theirs, body)
        assert len(kept) == len(expected), name
        for mine, its in zip(kept, expected, strict=True):
            if theirs.geom(its).name:
                assert ours.geom(mine).name == theirs.geom(its).name
            for field in CONTACT_FIELDS:
                a = getattr(ours, f"geom_{field}")[mine]
                b = getattr(theirs, f"geom_{field}")[its]
                np.testing.assert_allclose(
                    a, b, rtol=1e-12, atol=1e-14, err_msg=f"{ours.geom(mine).name} {field}"
                )
            assert_same_rotation(ours.geom_quat[mine], theirs.geom_quat[its])
            count += 1
    assert count == 27


def upstream_grasp_point(robot: str, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Grasp point from first principles: midpoint of the tip centroids, or of the finger bodies."""
    if robot == "so101":
        return np.mean(
            [np.mean([data.geom(tip).xpos for tip in jaw], axis=0) for jaw in SO101_TIPS], axis=0
        )
    return (data.body("gripper_left").xpos + data.body("gripper_right").xpos) / 2


def test_same_grasp_point(pair: Pair) -> None:
    """200 random configurations; the largest distance between the two centres is at most 1 um."""
    robot, ours, theirs = pair
    rng = np.random.default_rng(20240817)
    mine = mujoco.MjData(ours)
    its = mujoco.MjData(theirs)
    low, high = theirs.jnt_range.T
    centres = []
    errors = []
    for _ in range(200):
        q = rng.uniform(low, high)
        mine.qpos[:] = its.qpos[:] = q
        mujoco.mj_kinematics(ours, mine)
        mujoco.mj_kinematics(theirs, its)
        centre = np.mean([mine.site(site).xpos for site in GRASP_SITES[robot]], axis=0)
        centres.append(centre)
        errors.append(np.linalg.norm(centre - upstream_grasp_point(robot, theirs, its)))
    assert np.ptp(centres, axis=0).min() > 0.2  # the configurations do move the hand
    assert max(errors) <= 1e-6


# ---- on their own
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", ROBOTS)
def test_mesh_free_and_standalone(robot: str, tmp_path: Path) -> None:
    """Nothing but the file itself is needed: it compiles from an empty folder."""
    copy = tmp_path / "robot.xml"
    copy.write_text((BUILT_IN / f"{robot}.xml").read_text())
    model = mujoco.MjModel.from_xml_path(str(copy))
    assert (model.nmesh, model.nhfield, model.ntex, model.nskin) == (0, 0, 0, 0)
    assert (model.geom_type != mujoco.mjtGeom.mjGEOM_MESH).all()


@pytest.mark.parametrize("robot", ROBOTS)
def test_plausible_mass(robot: str) -> None:
    model = built_in(robot)
    low, high = MASS_BOUNDS[robot]
    assert np.isfinite(model.body_mass).all()
    assert np.isfinite(model.body_inertia).all()
    assert (model.body_mass[1:] > 0.005).all()
    assert (model.body_inertia[1:] > 0).all()
    assert low < model.body_mass.sum() < high


@pytest.mark.parametrize("robot", ROBOTS)
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
    for g in range(model.ngeom):
        if model.geom_group[g] != 3:
            continue
        geom = model.geom(g)
        jaw = (
            model.body(geom.bodyid[0]).name in SO101_JAW_BODIES and geom.name != "gripper_neck_box"
        )
        assert (geom.contype[0], geom.conaffinity[0]) == (1, 1), geom.name
        assert geom.condim[0] == (6 if jaw else 3), geom.name
        assert geom.priority[0] == (1 if jaw else 0), geom.name
        np.testing.assert_allclose(
            geom.friction, [1, 0.005, 0.0005] if jaw else [1, 0.005, 0.0001], err_msg=geom.name
        )
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
    for site, body, tips in zip(
        GRASP_SITES["so101"], ("gripper", "moving_jaw_so101_v1"), SO101_TIPS, strict=True
    ):
        assert so101.body(so101.site(site).bodyid[0]).name == body
        centroid = np.mean([so101.geom(tip).pos for tip in tips], axis=0)
        np.testing.assert_allclose(so101.site(site).pos, centroid, rtol=0, atol=1e-15)
    for site, body in zip(GRASP_SITES["rebot"], ("gripper_left", "gripper_right"), strict=True):
        assert rebot.body(rebot.site(site).bodyid[0]).name == body
        np.testing.assert_array_equal(rebot.site(site).pos, 0)
    assert all(
        m.site(s).group[0] == 4
        for r, m in (("so101", so101), ("rebot", rebot))
        for s in GRASP_SITES[r]
    )
