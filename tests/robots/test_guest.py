"""A robot's file is a guest in the scene, and each of its servos keeps its meaning."""

import contextlib
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from arm_file import MJCF, SERVOS, changed, scara
from compositions import refusal

from mjstack.config.mjcf import compile_scene
from mjstack.config.schema import Backend, Config
from mjstack.config.schema.robot import BasePoseCfg, ServoCfg
from mjstack.envs import build_env
from mjstack.errors import ConfigError, MjstackError
from mjstack.robots import read_robot, robot_spec
from mjstack.robots.guest import left_behind
from mjstack.scene import build_model
from mjstack.scene.build import scene_names

ROOT = "<worldbody>"
ELBOW = SERVOS["elbow"]
FURNITURE = """
    <geom name="floor" type="plane" size="1 1 .1"/>
    <light pos="0 0 3"/>
    <body name="table" pos="2 0 0">
      <geom name="table" type="box" size=".1 .1 .1" contype="1"/>
    </body>
    <body name="toy" pos="1 1 1"><freejoint/><geom name="toy" size=".02"/></body>"""


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
    assert note in (text := notes(cfg, model))
    assert bool(note) == bool(text)
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


def test_joints_keep_names_that_the_scene_has(tmp_path: Path) -> None:
    """With their servos, equalities and sensors; what names the renamed bodies has the new name."""
    bodies = "".join(
        f"""<body name="{name}"><joint name="{name}" axis="0 0 1" range="-1 1"/>
        <inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/></body>"""
        for name in ("table", "floor")
    )
    extra = """<adhesion body="table" ctrlrange="0 1"/><position joint="table" kp="9"/></actuator>
    <equality><joint joint1="table" joint2="floor"/><weld body1="table" body2="floor"/></equality>
    <sensor><jointpos joint="table"/><framepos objtype="xbody" objname="table"/></sensor>"""
    model = build_model(changed(tmp_path, (PALM, bodies + PALM), ("</actuator>", extra)))
    plain = build_model(scara())
    counts = [[getattr(m, n) for n in ("nu", "neq", "nsensor")] for m in (model, plain)]
    assert np.subtract(*counts).tolist() == [2, 2, 2]
    joint, body = model.joint("table").id, model.body("robot_table").id
    assert model.actuator_trnid[-2:, 0].tolist() == [body, joint]
    assert model.eq_obj1id[-2:].tolist() == [joint, body]
    assert sorted(model.sensor_objid[:2]) == sorted([joint, body])
    names = {"arm_joints": ["table", *scara().robot.arm_joints[1:]]}
    swap = [(f'{k}="shoulder"', f'{k}="table"') for k in ("name", "joint")]
    swap += [('<body name="base">', '<body name="table">')]
    robot = changed(tmp_path, *swap, **names).robot
    named = compile_scene(robot_spec(robot, scara().model, ["table"]))
    assert named.actuator("table").trnid[0] == named.joint("table").id


def test_a_camera_of_what_stays_behind_stays_behind_too(tmp_path: Path) -> None:
    cameras = """<camera name="eye" mode="targetbody" target="toy"/>
    <camera name="other" mode="targetbody" target="hand"/>"""
    model = build_model(changed(tmp_path, (ROOT, ROOT + FURNITURE + cameras)))
    assert [model.camera(k).name for k in range(model.ncam)] == ["other"]


@pytest.mark.parametrize(
    "pairs",
    [
        [('diaginertia="0.005 0.025 0.027"', 'fullinertia="0.005 0.025 0.027 0.001 0.002 0"')],
        [
            ('contype="0" conaffinity="0" mass="0"', 'contype="0" conaffinity="0" mass="0.3"'),
            (ROOT, f'<compiler inertiafromgeom="true"/>{ROOT}'),
        ],
    ],
    ids=["fullinertia", "inertiafromgeom"],
)
def test_a_total_mass_scales_the_robot_alone(pairs: list, tmp_path: Path) -> None:
    cfg = changed(tmp_path, *pairs, ("<option", '<compiler settotalmass="50"/><option'))
    model, alone = build_model(cfg), mujoco.MjModel.from_xml_path(str(cfg.robot.file))
    assert alone.body_mass.sum() == pytest.approx(50.0)
    for body in range(1, alone.nbody):
        there = model.body(alone.body(body).name)
        for name in ("mass", "inertia", "ipos"):
            right = getattr(alone.body(body), name)
            np.testing.assert_allclose(getattr(there, name), right, rtol=1e-9, atol=1e-12)
    assert float(model.body("red").mass[0]) == cfg.scene.objects["red"].mass


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
    elbow = mujoco.MjModel.from_xml_string(MJCF).body("outer_arm").name
    refusal(lambda: build_model(changed(tmp_path, root=elbow)), f"robot.root={elbow}: joint")
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


@pytest.mark.parametrize(
    "pairs",
    [
        [(ELBOW, ELBOW.replace("/>", ' ctrllimited="false" inheritrange="0" ctrlrange="1 2"/>'))],
        [
            (ELBOW, '<position tendon="t" kp="90" kv="9" gear="3" inheritrange="0"'
             ' ctrllimited="false" ctrlrange="1 2"/>'),
            ("</actuator>", '</actuator><tendon><fixed name="t"><joint joint="elbow" coef="2"/>'
             "</fixed></tendon>"),
        ],
    ],
    ids=["joint", "tendon"],
)  # fmt: skip
def test_a_range_that_the_file_does_not_use_is_no_limit(pairs: list, tmp_path: Path) -> None:
    model = build_model(changed(tmp_path, *pairs))
    np.testing.assert_allclose(model.actuator("elbow").ctrlrange, model.joint("elbow").range)


def test_a_base_and_a_grasp_site_have_a_place(tmp_path: Path) -> None:
    refusal(lambda: scara("robot.base.quat=[0,0,0,0]"), "robot.base.quat=[0.0, 0.0, 0.0, 0.0]")
    cfg = changed(tmp_path, grasp_sites=["x", "right_grasp"], grasp_parts={"x": []})
    refusal(lambda: build_model(cfg), "robot.grasp_parts.x=[]: expected geoms of one body")


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


COUPLING = '<joint name="fingers" joint1="left" joint2="right" polycoef="0 1 0 0 0"/>'
CHAIN = """<joint joint1="middle" joint2="left" polycoef="0.002 -2 0 0 0"/>
    <joint joint1="right" joint2="middle" polycoef="0.001 -0.25 0 0 0"/>"""
PALM = '<geom name="palm"'
MIDDLE = """<body name="middle" gravcomp="1">
      <joint name="middle" type="slide" axis="1 0 0" ref="0.01" armature="0.1"/>
      <inertial mass="0.01" pos="0 0 0" diaginertia="1e-5 1e-5 1e-5"/></body>"""
GRIP = '<position name="grip" tendon="split" kp="9000" kv="90" ctrlrange="0 0.05"/>'
GENERAL = """<general name="grip" tendon="split" ctrlrange="0 255" biastype="affine" gainprm="2"
    biasprm="3 -8000 -70" forcerange="-50 60"/>"""
ROTOR = GRIP.replace("/>", ' gear="3" armature="0.02" damping="4"/>')
ALIKE = {"left": (0.0, 1.0), "right": (0.0, 1.0)}
ONE = {"gripper_joints": ["left"], "home": [-0.8, 1.6, 0.2, 0.0, 0.045]}
ONE |= {"gripper_open": [0.045], "gripper_closed": [0.018]}


def hung(left: float, right: float, actuator: str, equality: str = COUPLING) -> list:
    """The fingers on a tendon, with one actuator."""
    tendon = "".join(
        f'<joint joint="{name}" coef="{coef}"/>'
        for name, coef in (("left", left), ("right", right))
        if coef
    )
    tendon = f'<tendon><fixed name="split" range="0 0.06">{tendon}</fixed></tendon>'
    return [
        (SERVOS["left"], ""),
        (SERVOS["right"], ""),
        ("</actuator>", f"{actuator}</actuator>{tendon}"),
        (COUPLING, equality),
    ]


@pytest.mark.parametrize(
    ("pairs", "lines", "profile"),
    [
        (hung(1, 0.25, GRIP), ALIKE, {}),
        (hung(-1, -0.5, GENERAL), ALIKE, {}),
        (hung(0.5, 0.5, ROTOR), ALIKE, {}),
        (hung(0.5, 0.5, GRIP.replace('kv="90"', 'dampratio="1"')), ALIKE, {}),
        (hung(1, 1, '<position tendon="split" kp="900" dampratio="0.7"/>'), ALIKE, {}),
        (
            hung(0.5, 0.5, GRIP.replace('ctrlrange="0 0.05"', 'inheritrange="0.8" gear="-2"')),
            ALIKE,
            {},
        ),
        (
            hung(2, 1, GRIP, COUPLING.replace("0 1 0", "0.004 0.5 0")),
            {"left": (0.0, 1.0), "right": (-0.008, 2.0)},
            {},
        ),
        (
            [*hung(1, 1, GENERAL, CHAIN), (PALM, MIDDLE + PALM)],
            # middle - 0.01 = 0.002 - 2 left, right = 0.001 - 0.25 (middle - 0.01)
            {"left": (0.0, 1.0), "right": (0.0005, 0.5)},
            {},
        ),
        (hung(1, 0.25, GRIP), ALIKE, ONE),
        (hung(1, 0, GRIP), {"left": (0.0, 1.0)}, ONE),
    ],
    ids=[
        *("coefs", "affine", "rotor", "dampratio", "unnamed"),
        *("inherit", "offset", "chain", "one", "alone"),
    ],
)  # fmt: skip
def test_a_tendon_pulls_as_in_its_file(
    pairs: list, lines: dict, profile: dict, tmp_path: Path
) -> None:
    cfg = changed(tmp_path, *pairs, **profile)
    alone = mujoco.MjModel.from_xml_path(str(cfg.robot.file))
    model = compile_scene(robot_spec(cfg.robot, cfg.model))
    share = {n: c for n, c in (("left", 0), ("right", 0)) if n in lines}
    data = mujoco.MjData(alone)
    for name in share:
        data.qpos[:] = 0.0
        data.joint(name).qpos = 1.0
        mujoco.mj_forward(alone, data)
        share[name] = data.ten_length[0]
    data.qpos[:] = 0.0
    mujoco.mj_forward(alone, data)
    share = {name: float(length - data.ten_length[0]) for name, length in share.items()}
    start, slope = np.sum([np.multiply(share[n], line) for n, line in lines.items()], axis=0)
    (number,) = np.flatnonzero(alone.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON)
    grip = alone.actuator(number)
    gear, gain, (offset, bias) = grip.gear[0], grip.gainprm[0], grip.biasprm[:2]
    listed = cfg.robot.gripper_joints
    for name in listed:  # bounds
        lengths = -(gain * grip.ctrlrange + offset) / (bias * gear)
        origin, ratio = lines[name]
        np.testing.assert_allclose(
            model.actuator(name).ctrlrange, np.sort(origin + ratio * (lengths - start) / slope)
        )

    def forces(of: mujoco.MjModel, s: float, v: float, target: float) -> dict[str, float]:
        data = mujoco.MjData(of)
        for name, (origin, ratio) in lines.items():
            data.joint(name).qpos = origin + ratio * s
            data.joint(name).qvel = ratio * v
            if of is model and name in listed:
                data.actuator(name).ctrl = origin + ratio * target
        if of is alone:
            data.ctrl[number] = -(offset + bias * gear * (start + slope * target)) / gain
        mujoco.mj_forward(of, data)
        spring = {name: float(data.joint(name).qfrc_passive[0]) for name in lines}
        return {name: float(data.joint(name).qfrc_actuator[0]) + spring[name] for name in lines}

    for s, v, target in ((0.02, 0.0, 0.021), (0.03, -0.01, 0.028), (0.01, 0.02, 0.04)):
        found, right = forces(model, s, v, target), forces(alone, s, v, target)
        if set(listed) >= set(lines):
            assert found == pytest.approx(right, rel=1e-9)
        work = [sum(f[n] * lines[n][1] for n in lines) for f in (found, right)]
        assert work[0] == pytest.approx(work[1], rel=1e-9)
        assert abs(work[0]) > 1.0
    dofs = [[int(m.joint(name).dofadr[0]) for name in lines] for m in (model, alone)]
    np.testing.assert_allclose(model.dof_armature[dofs[0]], alone.dof_armature[dofs[1]])
    for number, m in enumerate((model, alone)):
        data = mujoco.MjData(m)
        mujoco.mj_forward(m, data)
        full = np.zeros((m.nv, m.nv))
        mujoco.mj_fullM(m, data, full)
        share[str(number)] = full[np.ix_(dofs[number], dofs[number])]  # rotors
    np.testing.assert_allclose(share["0"], share["1"], rtol=1e-9)


@pytest.mark.parametrize(
    ("pairs", "line"),
    [
        (hung(1, -1, GRIP), "tendon split={'left': 1.0, 'right': -1.0}: expected coefficients"),
        (
            hung(1, 1, GRIP, COUPLING.replace("0 1 0", "0 1 2")),
            "joint of a tendon=right: expected one that moves as left",
        ),
        (
            hung(1, 1, GRIP, COUPLING.replace("0 1 0", "0.01 0 0")),
            "joint of a tendon=right: expected one that moves as left",
        ),
        (
            [*hung(1, 1, GRIP, CHAIN.replace("-2 0 0", "-2 1 0")), (PALM, MIDDLE + PALM)],
            "joint of a tendon=right: expected one that moves as left",
        ),
        (hung(1, 1, '<motor name="grip" tendon="split"/>'), "a position servo (grip has biastype"),
        (hung(1, 1, GRIP.replace("split", "spli")), "actuators of joint left=none"),
    ],
    ids=["cancel", "bent", "still", "bent chain", "motor", "name"],
)
def test_what_a_tendon_cannot_do_is_one_line(pairs: list, line: str, tmp_path: Path) -> None:
    refusal(lambda: build_model(changed(tmp_path, *pairs)), line)


def test_a_finger_that_follows_freely_is_no_follower(tmp_path: Path) -> None:
    cfg = changed(tmp_path, *hung(1, 1, GRIP, ""), **ONE)
    refusal(lambda: build_model(cfg), "joint of a tendon=right: expected one that moves as left")


def test_servos_in_place_of_a_motor_on_a_tendon(tmp_path: Path) -> None:
    made = ServoCfg(stiffness=900.0, damping=9.0, effort=30.0)
    pairs = hung(1, 1, '<motor name="grip" tendon="split"/>')
    model = build_model(changed(tmp_path, *pairs, servos={"left": made, "right": made}))
    assert [model.actuator(k).name for k in range(model.nu)][-2:] == ["left", "right"]
    assert model.actuator("left").gainprm[0] == 900.0


def test_a_tendon_of_one_arm_joint_is_that_joints_servo(tmp_path: Path) -> None:
    """Beside one that wraps around sites and a pulley, which moves on its own."""
    cable = """<spatial name="cable"><site site="left_grasp"/><site site="right_grasp"/>
      <pulley divisor="2"/><site site="left_grasp"/><site site="right_grasp"/></spatial>"""
    pairs = [
        (ELBOW, '<position name="e" tendon="belt" kp="125" kv="5" ctrlrange="0.2 5.2"/>'
         '<motor name="cable" tendon="cable"/>'),
        ("</actuator>", '</actuator><tendon><fixed name="belt"><joint joint="elbow" coef="2"/>'
         f"</fixed>{cable}</tendon>"),
    ]  # fmt: skip
    model = build_model(changed(tmp_path, *pairs))
    elbow = model.actuator("elbow")
    assert (elbow.gainprm[0], elbow.biasprm[2]) == (500.0, -20.0)
    np.testing.assert_allclose(elbow.ctrlrange, [0.1, 2.6])
    assert model.actuator("cable").trntype[0] == mujoco.mjtTrn.mjTRN_TENDON


def test_another_actuator_of_a_joints_name(tmp_path: Path) -> None:
    """It keeps its joint, with a prefix; sensors go on to measure their actuators."""
    fan = """<body name="fan"><joint name="fan" axis="0 0 1"/>
      <inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/></body>"""
    servo = ELBOW.replace('name="elbow"', 'name="joint2"')
    sensors = "".join(
        f'<actuatorfrc name="of {name}" actuator="{name}"/>' for name in ("elbow", "joint2", "lift")
    )
    pairs = [
        (PALM, fan + PALM),
        (ELBOW, f'{servo}<motor name="elbow" joint="fan"/>'),
        ("</actuator>", f"</actuator><sensor>{sensors}</sensor>"),
    ]
    model = build_model(changed(tmp_path, *pairs))
    for actuator, joint in (("elbow", "elbow"), ("robot_elbow", "fan"), ("lift", "lift")):
        assert model.actuator(actuator).trnid[0] == model.joint(joint).id
    for sensor, actuator in (("elbow", "robot_elbow"), ("joint2", "elbow"), ("lift", "lift")):
        assert model.sensor(f"of {sensor}").objid[0] == model.actuator(actuator).id
    pairs[0] = (PALM, fan.replace('"fan"', '"robot_elbow"') + PALM)
    pairs[1] = (ELBOW, f'{servo}<motor name="elbow" joint="robot_elbow"/>'
                '<motor name="robot_elbow" joint="robot_elbow"/>')  # fmt: skip
    refusal(lambda: build_model(changed(tmp_path, *pairs)), "repeated name 'robot_elbow'")


def test_an_arm_that_a_mocap_body_drives(tmp_path: Path) -> None:
    """It takes no commands; servos can be made, and the mocap body stays behind."""
    mocap = '<body name="puppet" mocap="true"><geom name="puppet" size="0.01"/></body>'
    weld = '<equality><weld body1="puppet" body2="hand"/></equality>'
    pairs = [(ROOT, ROOT + mocap), ("</worldbody>", f"</worldbody>{weld}")]
    pairs += [(servo, "") for servo in SERVOS.values()]
    line = "actuators of joint shoulder=none: expected one <position>"
    lines = (line, "(mocap body puppet takes no commands)", "robot.servos.shoulder")
    refusal(lambda: build_model(changed(tmp_path, *pairs)), *lines)
    made = ServoCfg(stiffness=900.0, damping=9.0, effort=30.0)
    cfg = changed(tmp_path, *pairs, servos=dict.fromkeys(SERVOS, made))
    model = build_model(cfg)
    assert model.nmocap == 0
    assert model.neq == 1  # the fingers'
    assert "left out: body puppet" in notes(cfg, model)


def test_a_wrap_that_the_scene_names_too(tmp_path: Path) -> None:
    """MuJoCo would leave the tendon and its actuator behind."""
    tendon = """<tendon><spatial name="cable"><site site="left_grasp"/><geom geom="table"/>
      <site site="right_grasp"/></spatial></tendon>"""
    drum = '<geom name="table" type="cylinder" size="0.01 0.01"/>'
    pairs = [(PALM, drum + PALM), ("</actuator>", f"</actuator>{tendon}")]
    refusal(lambda: build_model(changed(tmp_path, *pairs)), "the scene has table too")
    pairs = [(old, new.replace('"table"', '"drum"')) for old, new in pairs]
    assert build_model(changed(tmp_path, *pairs)).ntendon == 1


def test_frictions_are_what_contacts_have(tmp_path: Path) -> None:
    """MuJoCo's least counts in a contact of the native physics too, and MJWarp takes it."""
    friction = ('friction="1 0.005 0.0005"', 'friction="0 0 0"')
    pair = '<contact><pair geom1="left_pad" geom2="right_pad" friction="0 0 0 0 0"/></contact>'
    cfg = changed(tmp_path, friction, ("</actuator>", f"</actuator>{pair}"))
    model = build_model(cfg)
    assert model.geom("left_pad").friction.tolist() == [mujoco.mjMINMU] * 3
    assert model.pair_friction.tolist() == [[mujoco.mjMINMU] * 5]
    with contextlib.closing(build_env(cfg, nworld=1, model=model, backend=Backend.mjwarp)) as env:
        assert env.nworld == 1
