"""``robot.collision``: what collides in place of a robot's meshes."""

import mujoco
import numpy as np
import pytest

from mjstack.config.mjcf import unit_vectors
from mjstack.config.schema import RobotCfg
from mjstack.errors import ConfigError
from mjstack.robots.collision import change_collision

_BALL = 0.03 * unit_vectors(200)  # m
_LONG = np.array([[x, y, z] for x in (0, 0.2) for y in (0, 0.02) for z in (0, 0.03)])


def arm() -> mujoco.MjSpec:
    """Two links with meshes, turned in frames, one of them with a stranger's scale."""
    spec = mujoco.MjSpec()
    spec.add_mesh(name="ball", uservert=(1e3 * _BALL).ravel(), scale=[1e-3, 1e-3, 2e-3])
    spec.add_mesh(name="long", uservert=_LONG.ravel())
    parent = spec.worldbody
    for number, mesh in enumerate(("ball", "long", "long")):
        frame = parent.add_frame(pos=[0.1 * (number > 0), 0, 0.05], euler=[0, 20, 10 * number])
        parent = parent.add_body(name=f"link{number}")
        parent.set_frame(frame)
        parent.add_joint(name=f"joint{number}", axis=[0, 1, 0], range=[-90, 90])
        parent.add_geom(
            name=f"geom{number}",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=mesh,
            pos=[0.01, 0.02, 0.0],
            quat=[0.8, 0.6, 0.0, 0.0],
            friction=[0.3 + number, 0.005, 0.0001],
        )
    return spec


def changed(collision: str) -> tuple[mujoco.MjModel, mujoco.MjModel, list[str]]:
    spec = arm()
    before = spec.copy().compile()
    names = [f"joint{number}" for number in range(3)]
    robot = RobotCfg(name="arm", arm_joints=names, gripper_joints=[], home=[0.0, 0.3, 0.3])
    robot.collision = collision
    lines = change_collision(spec, robot)
    return before, spec.compile(), lines


def heights(model: mujoco.MjModel, name: str, along: np.ndarray) -> np.ndarray:
    """How far a mesh geom reaches in some directions of the world [m]."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    geom = model.geom(name).id
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    world = points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
    return (world @ along.T).max(axis=0)


def assert_same_dynamics(before: mujoco.MjModel, after: mujoco.MjModel) -> None:
    for name in ("body_mass", "body_inertia", "body_ipos", "body_pos", "dof_M0"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    for number in range(3):
        old, new = before.geom(f"geom{number}").id, after.geom(f"geom{number}").id
        for name in ("friction", "contype", "condim", "solref"):
            np.testing.assert_array_equal(
                getattr(before, f"geom_{name}")[old], getattr(after, f"geom_{name}")[new]
            )


def test_a_hull_has_its_vertices_and_lies_where_the_mesh_does() -> None:
    before, after, (line,) = changed("hull 40")
    assert_same_dynamics(before, after)
    along = unit_vectors(500)
    lost = heights(before, "geom0", along) - heights(after, "geom0", along)
    assert after.mesh_vertnum[after.geom_dataid[after.geom("geom0").id]] == 40
    assert lost.min() > -1e-6
    stated = float(line.split("up to ")[-1].split(" mm")[0])
    assert 1e3 * lost.max() == pytest.approx(stated, abs=0.3)
    assert 0.0 < stated < 8.0
    assert line.startswith("1 meshes collide as hulls of 40 vertices, not of up to 204")
    np.testing.assert_allclose(
        heights(after, "geom1", along), heights(before, "geom1", along), atol=1e-7
    )
    assert (after.geom_contype != 0).sum() == 3


@pytest.mark.parametrize("scale", ["1e-3 1e-3 1e-3", "1 1 -1", "2 1 .5"])
def test_a_default_scale_of_the_file_acts_once(scale: str) -> None:
    """Of meshes whose vertices are in millimetres, mirrored or stretched."""
    vertices = " ".join(map(str, (_BALL / [float(k) for k in scale.split()]).ravel()))
    spec = mujoco.MjSpec.from_string(f"""<mujoco><default><mesh scale="{scale}"/></default>
      <asset><mesh name="ball" vertex="{vertices}"/></asset><worldbody><body name="link">
      <joint name="joint" axis="0 1 0"/><geom name="geom" type="mesh" mesh="ball"/></body>
      </worldbody></mujoco>""")
    robot = RobotCfg(name="arm", arm_joints=["joint"], gripper_joints=[], home=[0.0])
    robot.collision = "hull 64"
    change_collision(spec, robot)
    assert spec.compile().geom("geom").rbound[0] == pytest.approx(0.03 * 3**0.5, rel=0.05)


def test_primitives_are_around_their_meshes() -> None:
    before, after, (line,) = changed("primitives")
    assert_same_dynamics(before, after)
    along = unit_vectors(200)
    data = mujoco.MjData(after)
    mujoco.mj_kinematics(after, data)
    for number, kind in enumerate((mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX)):
        geom = after.geom(f"geom{number}").id
        assert after.geom_type[geom] == int(kind)
        local = along @ data.geom_xmat[geom].reshape(3, 3)
        if number:
            reach = np.abs(local) @ after.geom_size[geom]
        else:
            reach = after.geom_size[geom, 0] + np.abs(local[:, 2]) * after.geom_size[geom, 1]
        outside = along @ data.geom_xpos[geom] + reach - heights(before, f"geom{number}", along)
        assert outside.min() > -1e-6
        assert outside.max() < 0.03
    assert line.startswith(
        "2 meshes collide as boxes and 1 as capsules" if "2 meshes" in line else "1 meshes"
    )


def test_what_a_file_has_stays() -> None:
    before, after, lines = changed("file")
    assert lines == []
    assert before.ngeom == after.ngeom
    assert_same_dynamics(before, after)


@pytest.mark.parametrize("value", ["hull", "hull 7", "hull -8", "box", "hull 8 9", 64, None, True])
def test_other_values_are_refused(value: object) -> None:
    with pytest.raises(ConfigError, match=r"robot\.collision.*hull N with 8 vertices"):
        changed(value)  # type: ignore[arg-type]
