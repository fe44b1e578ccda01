"""A robot's file is a guest in the scene, and each of its servos keeps its meaning."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
from compositions import refusal

from mjstack import load_config
from mjstack.config.schema import Config
from mjstack.config.schema.robot import BasePoseCfg, ServoCfg
from mjstack.errors import ConfigError, MjstackError
from mjstack.robots import read_robot, robot_spec
from mjstack.robots.guest import left_behind
from mjstack.scene import build_model
from mjstack.scene.build import scene_names

SCARA = Path(__file__).parents[1] / "examples" / "scara"
MJCF = (SCARA / "scara.xml").read_text()
ROOT = "<worldbody>"
ELBOW = '<position name="elbow" joint="elbow" kp="500" kv="20" forcerange="-40 40"/>'
FURNITURE = """
    <geom name="floor" type="plane" size="1 1 .1"/>
    <light pos="0 0 3"/>
    <body name="table" pos="2 0 0">
      <geom name="table" type="box" size=".1 .1 .1" contype="1"/>
    </body>
    <body name="toy" pos="1 1 1"><freejoint/><geom name="toy" size=".02"/></body>"""


@cache
def scara() -> Config:
    return load_config([f"hydra.searchpath=[file://{SCARA}/conf]", "robot=scara"])


def changed(tmp_path: Path, *pairs: tuple[str, str], **fields: object) -> Config:
    """The SCARA with parts of its file replaced, and other fields of its profile."""
    text = MJCF
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    file = tmp_path / "arm.xml"
    file.write_text(text)
    return replace(scara(), robot=replace(scara().robot, file=str(file), **fields))  # type: ignore[arg-type]


def notes(cfg: Config, model: mujoco.MjModel) -> str:
    spec = read_robot(cfg.robot, cfg.model)
    return "\n".join(left_behind(spec, cfg.robot, model, scene_names(cfg.scene)))


@pytest.mark.parametrize(
    ("setting", "note"),
    [
        ('<compiler settotalmass="50"/>', ""),
        ('<compiler boundmass="1" boundinertia="0.1"/>', ""),
        ('<compiler inertiagrouprange="4 5"/>', ""),
        ('<compiler balanceinertia="true"/>', ""),
        ('<option gravity="0 0 0"/>', "option gravity 0 0 0: the scene has 0 0 -9.81"),
        ('<option density="1000" viscosity="0.9"/>', "option density 1000: the scene has 0"),
        ('<option><flag contact="disable"/></option>', "flags contact"),
        ('<option><flag gravity="disable" limit="disable"/></option>', "flags limit, gravity"),
        ('<option><flag override="enable"/></option>', "flags override"),
        ('<option actuatorgroupdisable="0"/>', "option disableactuator 1: the scene has 0"),
        ('<option noslip_iterations="9"/>', "option noslip_iterations 9: the scene has 0"),
    ],
)
def test_its_settings_do_not_reach_the_scene(setting: str, note: str, tmp_path: Path) -> None:
    cfg = changed(tmp_path, (ROOT, f"{setting}\n{ROOT}"))
    model, plain = build_model(cfg), build_model(scara())
    for name in ("red", "blue"):
        body = model.body(name)
        assert float(body.mass[0]) == cfg.scene.objects[name].mass
        np.testing.assert_array_equal(body.inertia, plain.body(name).inertia)
    for name in ("gravity", "density", "viscosity", "disableflags", "enableflags", "wind"):
        np.testing.assert_array_equal(getattr(model.opt, name), getattr(plain.opt, name))
    assert model.opt.disableactuator == model.opt.noslip_iterations == 0
    assert note in notes(cfg, model)
    alone = mujoco.MjModel.from_xml_path(str(cfg.robot.file))  # they act on its own bodies
    robot = [b for b in range(1, alone.nbody) if alone.body(b).name]
    mass = [float(model.body(alone.body(b).name).mass[0]) for b in robot]
    np.testing.assert_allclose(mass, alone.body_mass[robot])


def test_its_furniture_stays_behind(tmp_path: Path) -> None:
    cfg = changed(tmp_path, (ROOT, ROOT + FURNITURE))
    model, plain = build_model(cfg), build_model(scara())
    assert model.nq == plain.nq
    assert model.geom("table").size.tolist() == cfg.scene.table_half
    assert model.geom("robot_table").size.tolist() == [0.1, 0.1, 0.1]
    text = notes(cfg, model)
    assert "left out: body toy, geom floor, light" in text
    assert "renamed to robot_NAME: table" in text
    assert notes(scara(), plain) == ""


def test_where_it_stands_and_which_subtree_it_is(tmp_path: Path) -> None:
    base = BasePoseCfg(pos=[0.1, 0.2, 0.3], quat=[0.0, 0.0, 0.0, 1.0])
    moved, plain = (robot_spec(c.robot, c.model).compile() for c in (
        replace(scara(), robot=replace(scara().robot, base=base)), scara(),
    ))  # fmt: skip
    for model in (moved, plain):
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        model.site_pos[0] = data.site_xpos[0]
    expected = np.array([0.1, 0.2, 0.3]) + plain.site_pos[0] * [-1, -1, 1]
    np.testing.assert_allclose(moved.site_pos[0], expected, atol=1e-12)

    root = mujoco.MjModel.from_xml_string(MJCF).body(1).name
    cfg = changed(tmp_path, (ROOT, ROOT + FURNITURE), root=root)
    assert {"toy", "table"}.isdisjoint(b.name for b in robot_spec(cfg.robot, cfg.model).bodies)
    refusal(lambda: build_model(changed(tmp_path, root="left_finger")), "robot.root=left_finger")
    refusal(lambda: build_model(changed(tmp_path, root="nope")), "robot.root: body 'nope'")


def force_of(model: mujoco.MjModel, joint: str, q: float, v: float, command: float) -> float:
    """Force of the actuators on a joint."""
    data = mujoco.MjData(model)
    data.qpos[model.joint(joint).qposadr[0]] = q
    data.qvel[model.joint(joint).dofadr[0]] = v
    (number,) = np.flatnonzero(model.actuator_trnid[:, 0] == model.joint(joint).id)
    data.ctrl[number] = command
    mujoco.mj_forward(model, data)
    return float(data.qfrc_actuator[model.joint(joint).dofadr[0]])


@pytest.mark.parametrize(
    ("servo", "offset", "slope"),
    [
        (
            '<position name="elbow" joint="elbow" kp="125" kv="5" gear="2" inheritrange="0"/>',
            0.0,
            2.0,
        ),
        (
            '<position name="elbow" joint="elbow" kp="800" kv="45" gear="-1" inheritrange="0"/>',
            0.0,
            -1.0,
        ),
        (
            '<position name="elbow" joint="elbow" kp="90" dampratio="1" gear="3"'
            ' inheritrange="0"/>',
            0.0,
            3.0,
        ),
        (
            '<general name="elbow" joint="elbow" gaintype="fixed" gainprm="50" biastype="affine"'
            ' biasprm="30 -200 -7" forcerange="-35 90" ctrlrange="0 8"/>',
            -0.6,
            4.0,
        ),
        ('<position name="lift" joint="elbow" kp="500" kv="20"/>', 0.0, 1.0),
    ],
    ids=["gear", "minus", "damping ratio", "affine", "another joint's name"],
)
def test_a_servo_makes_the_same_force(
    servo: str, offset: float, slope: float, tmp_path: Path
) -> None:
    pairs = [(ELBOW, servo)]
    if 'name="lift"' in servo:  # names of two joints, swapped
        pairs.append(('<position name="lift" joint="lift"', '<position name="elbow" joint="lift"'))
    cfg = changed(tmp_path, *pairs)
    alone = mujoco.MjModel.from_xml_path(str(cfg.robot.file))
    model = robot_spec(cfg.robot, cfg.model).compile()
    assert model.actuator("elbow").trnid[0] == model.joint("elbow").id
    low, high = model.actuator("elbow").ctrlrange
    for q, v, target in ((0.5, 0.0, 0.9), (1.2, -0.7, 1.0), (1.5, 0.4, 1.1)):
        assert low <= target <= high
        force = force_of(model, "elbow", q, v, target)
        expected = force_of(alone, "elbow", q, v, offset + slope * target)
        np.testing.assert_allclose(force, expected, rtol=1e-9)


@pytest.mark.parametrize(
    ("servo", "words"),
    [
        ('<position name="elbow" joint="elbow" kp="500" timeconst="0.05"/>', "dyntype filterexact"),
        (
            '<intvelocity name="elbow" joint="elbow" kp="500" actrange="-1 1" ctrlrange="-1 1"/>',
            "dyntype integrator",
        ),
        ('<velocity name="elbow" joint="elbow" kv="5"/>', "biasprm of the position 0"),
        ('<motor name="elbow" joint="elbow"/>', "biastype none"),
    ],
)
def test_another_actuator_is_refused_or_replaced(servo: str, words: str, tmp_path: Path) -> None:
    cfg = changed(tmp_path, (ELBOW, servo))
    line = "actuators of joint elbow=elbow: expected one <position> in the robot's file (elbow has"
    refusal(lambda: build_model(cfg), f"{line} {words}", "robot.servos.elbow", kind=ConfigError)
    made = ServoCfg(stiffness=300.0, damping=9.0, effort=30.0)
    for kept in (servo, ""):
        cfg = changed(tmp_path, (ELBOW, kept), servos={"elbow": made})
        model = build_model(cfg)
        elbow = model.actuator("elbow")
        assert elbow.gainprm[0] == 300.0
        assert elbow.biasprm[1:3].tolist() == [-300.0, -9.0]
        assert elbow.forcerange.tolist() == [-30.0, 30.0]
        np.testing.assert_allclose(elbow.ctrlrange, model.joint("elbow").range)


def test_a_joint_gets_a_range(tmp_path: Path) -> None:
    pair = (' range="0.1 2.6"', "")
    refusal(lambda: build_model(changed(tmp_path, pair)), "robot.ranges.elbow=[LOW,HIGH]")
    model = build_model(changed(tmp_path, pair, ranges={"elbow": [0.2, 2.5]}))
    assert model.joint("elbow").range.tolist() == [0.2, 2.5]
    np.testing.assert_allclose(model.actuator("elbow").ctrlrange, [0.2, 2.5])
    with pytest.raises(MjstackError, match=r"robot.ranges: joint 'elbo' does not exist"):
        build_model(changed(tmp_path, ranges={"elbo": [0.2, 2.5]}))


def test_a_made_servo_has_nothing_of_the_files_defaults(tmp_path: Path) -> None:
    default = '<position inheritrange="1"/>'
    motor = '<motor gear="30" ctrlrange="-1 1" forcelimited="false"/>'
    made = ServoCfg(stiffness=10.0, damping=1.0, effort=4.0)
    cfg = changed(tmp_path, (default, default + motor), (ELBOW, ""), servos={"elbow": made})
    model = robot_spec(cfg.robot, cfg.model).compile()
    assert force_of(model, "elbow", 0.5, 0.0, 0.7) == pytest.approx(2.0)
    assert force_of(model, "elbow", 0.2, 0.0, 2.0) == pytest.approx(4.0)  # its effort
