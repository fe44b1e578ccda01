"""Joints that follow, idle joints, and jaws: where they are at home, at starts and in inverse
kinematics, against the equalities of native MuJoCo.
"""

import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from arm_file import MJCF, SCARA, changed, scara, write_arm
from arms import model_of
from compositions import load_config, make_env, refusal
from environments import few
from ik_arm import Arm

from mjstack.config.schema import Config
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError
from mjstack.kinematics.mink_ik import GraspIk
from mjstack.robots import read_robot
from mjstack.robots.guest import left_behind
from mjstack.robots.jaws import Jaws
from mjstack.robots.posture import Posture
from mjstack.scene import build_model
from mjstack.scene.index import SceneIndex, gripper_targets, jaws_of

SERVO = '<position name="right" class="finger" joint="right"/>'
FINGERS = '<joint name="fingers" joint1="left" joint2="right" polycoef="0 1 0 0 0"/>'
RIGHT = '<joint name="right" class="finger" axis="0 -1 0"/>'
QUILL = '<body name="quill" pos="0 0 0" gravcomp="1">'
WRIST = (
    '<body name="wrist" pos="0.28 0 -0.315"><joint name="wrist" range="-3 3"/>'
    '<inertial mass="0.1" pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/>' + QUILL
)
LEFT = {
    "gripper_joints": ["left"],
    "home": [-0.8, 1.6, 0.2, 0.0, 0.042],
    "start": [-0.8, 1.6, 0.2, 0.0, 0.042],
    "gripper_open": [0.042],
    "gripper_closed": [0.0175],
}


def equality(first: str, second: str, coefs: str) -> str:
    return f'<joint joint1="{first}" joint2="{second}" polycoef="{coefs}"/>'


FOLLOWERS = {
    "plain": ((FINGERS, equality("right", "left", "0 1 0 0 0")),),
    "wrong sign": (
        (FINGERS, equality("right", "left", "0 -1 0 0 0")),
        (RIGHT, '<joint name="right" class="finger" axis="0 1 0" range="-0.05 0"/>'),
    ),
    "leader second": ((FINGERS, equality("left", "right", "0 1 0 0 0")),),
    "tendons": (
        (FINGERS, '<tendon tendon1="a" tendon2="b" polycoef="0 1 0 0 0"/>'),
        (
            "<equality>",
            '<tendon><fixed name="a"><joint joint="left" coef="2"/></fixed><fixed name="b">'
            '<joint joint="right" coef="2"/></fixed></tendon><equality>',
        ),
    ),
    "connect": (
        (FINGERS, '<connect body1="right_finger" body2="mirror" anchor="0 0 0"/>'),
        (
            '<body name="right_finger"',
            '<body name="mirror"><joint name="mirror" class="finger" axis="0 -1 0"/>'
            '<inertial mass="0.03" pos="0 0 0" diaginertia="2e-5 2e-5 4e-6"/></body>'
            '<body name="right_finger"',
        ),
        ("</equality>", equality("mirror", "left", "0 1 0 0 0") + "</equality>"),
    ),
}


def follower(tmp_path: Path, kind: str) -> Config:
    """The SCARA with one servo at its gripper."""
    return changed(tmp_path, (SERVO, ""), *FOLLOWERS[kind], **LEFT)


def equality_error(model: mujoco.MjModel, qpos: np.ndarray) -> float:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    rows = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
    return float(np.abs(data.efc_pos[rows]).max(initial=0.0))


@pytest.mark.parametrize("kind", FOLLOWERS)
def test_a_finger_that_follows_has_its_place(kind: str, tmp_path: Path) -> None:
    """As with two servos: the start, the grasp point, and how far the jaws close."""
    cfg = follower(tmp_path, kind)
    model = build_model(cfg)
    qpos = SceneIndex(model, cfg.robot, cfg.scene).posture.qpos(np.array(cfg.robot.home))
    assert equality_error(model, qpos) < 1e-9
    right = float(qpos[model.joint("right").qposadr[0]])
    assert right == pytest.approx(-0.042 if kind == "wrong sign" else 0.042, abs=1e-9)
    ik = GraspIk(cfg.robot, cfg.model, tolerance=1e-4)
    two = GraspIk(scara().robot, cfg.model, tolerance=1e-4)
    expected = two.grasp_point(np.array([*cfg.robot.home, 0.042]))
    np.testing.assert_allclose(ik.grasp_point(ik.home), expected, atol=1e-9)
    targets = gripper_targets(model, cfg.robot, [0.030, 0.044, 0.060])
    np.testing.assert_allclose(targets[:, 0], [0.0105, 0.0175, 0.0255], atol=1e-6)


@pytest.mark.parametrize("sim", ["native", pytest.param("mjwarp", marks=pytest.mark.full)])
def test_a_follower_starts_in_its_place(sim: str, tmp_path: Path) -> None:
    cfg = follower(tmp_path, "wrong sign")
    overrides = [f"sim={sim}", "nworld=4", "reset=randomized", "+reset.joints.params.gripper=0.003"]
    options = [f"robot.{key}={value}" for key, value in LEFT.items()]
    search = f"hydra.searchpath=[file://{SCARA}/conf]"
    options = [o.replace(" ", "").replace("'", "") for o in options]
    env = make_env([search, "robot=scara", f"robot.file={cfg.robot.file}", *options, *overrides])
    env.reset(seed=3)
    left, right = (env.sim.qpos[:, env.sim.model.joint(n).qposadr[0]] for n in ("left", "right"))
    assert len(set(left.tolist())) == 4
    torch.testing.assert_close(right, -left, atol=1e-7, rtol=0.0)


IDLE = '<body name="mast"><joint name="mast" axis="0 1 0" range="0.5 2"/><inertial mass="0.1" '
IDLE += 'pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/></body><body name="base">'


COUPLINGS = {
    "cubic": [equality("wrist", "elbow", "0.1 -0.5 0.1 0.02 0")],
    "chain": [
        equality("wrist", "mast", "0.05 -0.5 0 0 0"),
        equality("mast", "shoulder", "0 0 1 0 0"),
    ],
}


def coupled_arm(tmp_path: Path, kind: str) -> Config:
    """The SCARA with a wrist that follows its arm."""
    mast = '<body name="mast"><joint name="mast" axis="1 0 0" range="-9 9"/><inertial mass="0.1" '
    mast += 'pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/></body><body name="base">'
    tail = "            </body>\n          </body>\n        </body>"
    return changed(
        tmp_path,
        ('<body name="quill" pos="0.28 0 -0.315" gravcomp="1">', WRIST),
        (tail, "</body>" + tail),
        ('<body name="base">', mast),
        ("</equality>", "".join(COUPLINGS[kind]) + "</equality>"),
    )


@pytest.mark.parametrize("kind", COUPLINGS)
def test_inverse_kinematics_takes_what_follows_along(kind: str, tmp_path: Path) -> None:
    """mink and the batched solver agree with MuJoCo's grasp point, and reach it."""
    cfg = coupled_arm(tmp_path, kind)
    ik = GraspIk(cfg.robot, cfg.model, tolerance=1e-4)
    places = Posture(ik.model, cfg.robot.joints)
    arm = Arm(ik.model, cfg.robot)
    goals = np.tile(ik.home, (8, 1))
    goals[:, :3] += np.random.default_rng(1).uniform(-0.15, 0.15, (8, 3)) * [1.0, 1.0, 0.2]
    assert max(equality_error(ik.model, places.qpos(goal)) for goal in goals) < 1e-7
    points = np.array([ik.grasp_point(goal) for goal in goals])
    solver = arm.solver(8, iterations=40)
    np.testing.assert_allclose(solver.forward(torch.from_numpy(goals))[0], points, atol=1e-6)
    start = torch.from_numpy(np.tile(ik.home, (8, 1)))
    command, distance = solver.solve(start, torch.from_numpy(points))
    assert distance.max() < 1e-5
    for k, point in enumerate(points):
        assert np.linalg.norm(ik.grasp_point(command[k].double().numpy()) - point) < 1e-5
        assert ik.solve(point, ik.home)[1] < 1e-4


def test_a_joint_that_follows_two_is_refused(tmp_path: Path) -> None:
    joints = "".join(
        f'<joint joint="{name}" coef="{coef}"/>'
        for name, coef in (("mast", 1), ("shoulder", 0.5), ("elbow", 0.5))
    )
    tendon = f'<tendon><fixed name="t">{joints}</fixed></tendon><equality>'
    pairs = (
        ('<body name="base">', IDLE.replace("0.5 2", "-9 9")),
        (FINGERS, '<tendon tendon1="t" polycoef="0 0 0 0 0"/>'),
        ("<equality>", tendon),
    )
    cfg = changed(tmp_path, *pairs)
    line = "joint mast follows shoulder and elbow"
    refusal(lambda: GraspIk(cfg.robot, cfg.model, tolerance=1e-4), line)


def test_a_value_that_the_equalities_do_not_allow_is_refused(tmp_path: Path) -> None:
    """By every environment, with a planner or without."""
    home, scene = [-0.8, 1.6, 0.2, 0.0, 0.045, 0.045], scara().scene
    equalities = "as the file's equalities have it"
    for changes, line in (
        ({"home": [*home[:5], 0.02]}, f"robot.home of right=0.02: expected 0.045, {equalities}"),
        ({"start": [*home[:5], 0.01]}, f"robot.start of right=0.01: expected 0.045, {equalities}"),
        ({"home": [*home[:2], 0.9, *home[3:]]}, "robot.home of lift=0.9: expected a value within"),
        ({"locked": {"roll": 9.0}}, "robot.locked of roll=9.0: expected a value within"),
        ({"gripper_open": [0.045, 0.03]}, "robot.gripper_open of right=0.03: expected 0.045"),
    ):
        robot = replace(scara().robot, **changes)  # type: ignore[arg-type]
        refusal(lambda r=robot: SceneIndex(build_model(scara()), r, scene), line, kind=ConfigError)


MAST = '<actuator><position name="mast" joint="mast" kp="5" kv="1" inheritrange="1"/>'
KEY = '<keyframe><key name="home" qpos="1.2 0 1 0 0 0 0"/></keyframe></mujoco>'


@pytest.mark.parametrize(("key", "angle"), [("</mujoco>", 0.5), (KEY, 1.2)])
def test_an_idle_joint_keeps_the_files_home_within_its_range(
    key: str, angle: float, tmp_path: Path
) -> None:
    """Whatever its range, inverse kinematics is not held by it."""
    cfg = changed(tmp_path, ('<body name="base">', IDLE), ("<actuator>", MAST), ("</mujoco>", key))
    ik = GraspIk(cfg.robot, cfg.model, tolerance=1e-4)
    off = np.array([0.02, 0.03, -0.05])
    _, distance = ik.solve(ik.grasp_point(ik.home) + off, ik.home)
    assert distance < 1e-4
    search = f"hydra.searchpath=[file://{SCARA}/conf]"
    overrides = ["robot=scara", f"robot.file={cfg.robot.file}", "sim=native", "nworld=2"]
    env = make_env([search, *overrides])
    env.reset(seed=0)
    mast = int(env.sim.model.joint("mast").qposadr[0])
    assert env.sim.qpos[:, mast].tolist() == pytest.approx([angle] * 2)
    env.sim.step(100)
    assert env.sim.qpos[:, mast].tolist() == pytest.approx([angle] * 2, abs=0.02)


SPARE = """<body name="other" pos="-0.5 0 0.5" gravcomp="1">
  <joint name="spare" axis="0 1 0" range="-2 2"/>
  <inertial mass="0.3" pos="0.1 0 0" diaginertia="1e-3 1e-3 1e-3"/></body></worldbody>"""
VALUES = 'kp="50" kv="5" ctrlrange="-2 2"'


@pytest.mark.parametrize(
    "actuator",
    few(
        [
            f'<position joint="spare" {VALUES}/>',
            f'<position joint="spare" {VALUES} timeconst="0.2"/>',
            f'<position jointinparent="spare" {VALUES} gear="-2"/>',
            f'<position tendon="t" {VALUES} timeconst="0.5"/>',
            '<intvelocity joint="spare" kp="50" kv="5" actrange="-2 2" ctrlrange="-1 1"/>',
            '<general joint="spare" dyntype="filter" dynprm="0.3" gainprm="7" biastype="affine"'
            ' biasprm="3 -40 -5"/>',
        ],
        2,
    ),
    ids=["position", "timeconst", "in parent", "tendon", "intvelocity", "general"],
)
def test_a_servo_without_a_command_holds_its_joint(actuator: str, tmp_path: Path) -> None:
    """For seconds, whatever it is; a dynamics that is left out is said."""
    tendon = '<tendon><fixed name="t"><joint joint="spare" coef="1"/></fixed></tendon>'
    key = "<keyframe><key name='home' qpos='0 0 0 0 0 0 1.0'/></keyframe>"
    cfg = changed(
        tmp_path, ("</worldbody>", SPARE), ("</actuator>", f"{actuator}</actuator>{tendon}{key}")
    )
    search = f"hydra.searchpath=[file://{SCARA}/conf]"
    overrides = ["robot=scara", f"robot.file={cfg.robot.file}", "sim=native", "nworld=1"]
    env = make_env([search, *overrides, "reset=nominal"])
    env.reset(seed=0)
    spare = int(env.sim.model.joint("spare").qposadr[0])
    for _ in range(4):
        env.sim.step(100)
        assert env.sim.qpos[0, spare] == pytest.approx(1.0, abs=1e-3)
    said = "without activation, which an idle joint does not need: actuator" in "".join(
        left_behind(read_robot(cfg.robot, cfg.model), cfg.robot, env.sim.model, [])
    )
    assert said == ("position" not in actuator or "timeconst" in actuator)


def test_an_idle_joint_without_a_name_keeps_the_files_home(tmp_path: Path) -> None:
    key = "</actuator><keyframe><key name='home' qpos='0 0 0 0 0 0 1.0'/></keyframe>"
    body = SPARE.replace('name="spare" ', "").replace(
        "range=", 'stiffness="9" springref="1" range='
    )
    cfg = changed(tmp_path, ("</worldbody>", body), ("</actuator>", key))
    model = build_model(cfg)
    (number,) = model.body("other").jntadr
    rest = Posture(model, cfg.robot.joints).rest
    assert rest[model.jnt_qposadr[number]] == 1.0


def test_a_servo_that_no_command_reaches_does_not_fight_others(tmp_path: Path) -> None:
    """A follower's, or one of a tendon over arm joints."""
    line = "actuator without a command={}: expected none that pulls at joint {}"
    cfg = changed(tmp_path, FOLLOWERS["plain"][0], **LEFT)
    cases = [(cfg, "right", "right")]
    for name, dynamics in (("belt", 'kv="9"'), ("slow", 'timeconst="0.1"')):
        extra = f"""<position name="{name}" tendon="t" kp="90" inheritrange="0" {dynamics}/>
        </actuator><tendon><fixed name="t"><joint joint="shoulder" coef="1"/>
        <joint joint="elbow" coef="1"/></fixed></tendon>"""
        folder = tmp_path / name
        folder.mkdir()
        cases.append((changed(folder, ("</actuator>", extra)), name, "shoulder"))
    for cfg, *names in cases:
        model = build_model(cfg)
        refusal(lambda m=model, c=cfg: SceneIndex(m, c.robot, c.scene), line.format(*names))


def test_a_target_out_of_reach_is_a_finite_distance_away(tmp_path: Path) -> None:
    ik = GraspIk(scara().robot, scara().model, tolerance=1e-4)
    start = ik.home.copy()
    start[1] = 9.0  # beyond its range
    assert np.isfinite(ik.solve(np.array([0.4, 0.0, 0.2]), start)[1])


def test_a_range_ends_where_what_follows_can_go_no_farther(tmp_path: Path) -> None:
    """A linkage that locks, and a follower with a shorter range."""
    model = model_of("linkage")
    places = Posture(model, ("lift", "turn", "right_driver"))
    low, high = places.limits[2]
    assert -0.2 < low < -0.01
    assert high == 0.8
    for driver in np.linspace(low, high, 50):
        assert equality_error(model, places.qpos([0.0, 0.0, driver])) < 1e-5
    short = (RIGHT, RIGHT.replace("/>", ' range="0 0.04"/>'))
    cfg = changed(tmp_path, (SERVO, ""), short, **{**LEFT, "home": [*LEFT["home"][:4], 0.04]})  # type: ignore[dict-item, index]
    model = build_model(cfg)
    line = "robot.start of left=0.042: expected a value within [0, 0.04]"
    refusal(lambda: SceneIndex(model, cfg.robot, cfg.scene), line, kind=ConfigError)
    robot = replace(cfg.robot, start=cfg.robot.home, gripper_open=None, gripper_closed=None)
    index = SceneIndex(model, robot, cfg.scene)
    assert index.ctrl_range[4, 1] == pytest.approx(0.04, abs=1e-5)
    assert gripper_targets(model, robot, [None])[0, 0] == pytest.approx(0.04, abs=1e-5)


@pytest.mark.parametrize("kind", ["follower", "coupled"])
def test_what_follows_moves_with_its_leaders_zero(kind: str, tmp_path: Path) -> None:
    """Fingers of a linkage stay together where a servo's zero is elsewhere."""
    options = [f"robot.file={write_arm(tmp_path)}"]
    if kind == "follower":
        options = [f"robot.{key}={value}" for key, value in LEFT.items()]
        options = [o.replace(" ", "").replace("'", "") for o in options]
        options.append(f"robot.file={follower(tmp_path, 'plain').robot.file}")
    for term in ("Zeros", "Noise"):  # the second starts from what the first has written
        params = "params: {arm: 0.0, gripper: 0.004}"
        options.append(f"+reset.{term}={{func: mjstack.mdp.reset.Joint{term}, {params}}}")
    search = f"hydra.searchpath=[file://{SCARA}/conf]"
    env = make_env([search, "robot=scara", "sim=native", "nworld=4", "reset=nominal", *options])
    env.reset(seed=1)
    zero = env.sim.fields["qpos0"]
    assert len(set(zero[:, env.sim.model.joint("left").qposadr[0]].tolist())) == 4
    left, right = (
        (env.sim.qpos - zero)[:, env.sim.model.joint(n).qposadr[0]] for n in ("left", "right")
    )
    torch.testing.assert_close(right, left, atol=1e-7, rtol=0.0)


@pytest.mark.parametrize("where", ["base", "finger"])
def test_an_idle_joint_follows_none(where: str, tmp_path: Path) -> None:
    """Inverse kinematics need not ask MuJoCo about it, wherever it is in the arm."""
    idle = '<joint name="spare" axis="0 0 1" range="0.1 2"/>'
    pairs = [('<body name="base">', IDLE)]
    if where == "finger":
        pairs = [(RIGHT, f"{RIGHT}{idle}")]
    cfg = changed(tmp_path, *pairs)
    ik = GraspIk(cfg.robot, cfg.model, tolerance=1e-4)
    assert Posture(ik.model, cfg.robot.joints).leader.max(initial=-1) <= 4  # the fingers' alone
    assert not ik._frozen.along
    goals = np.tile(ik.home, (4, 1))
    goals[:, :3] += np.random.default_rng(1).uniform(-0.15, 0.15, (4, 3)) * [1.0, 1.0, 0.2]
    points = np.array([ik.grasp_point(goal) for goal in goals])
    solver = Arm(ik.model, cfg.robot).solver(4, iterations=40)
    np.testing.assert_allclose(solver.forward(torch.from_numpy(goals))[0], points, atol=1e-6)


@pytest.mark.parametrize("name", ["rest/foo", "rest/mast"])
def test_numbers_of_a_file_say_nothing_about_rest(name: str, tmp_path: Path) -> None:
    custom = f'<custom><numeric name="{name}" data="1.5"/></custom><equality>'
    cfg = changed(tmp_path, ('<body name="base">', IDLE), ("<equality>", custom))
    model = build_model(cfg)
    index = SceneIndex(model, cfg.robot, cfg.scene)
    assert index.posture.rest[model.joint("mast").qposadr[0]] == 0.5


# --- Grip


@pytest.mark.parametrize("sites", ["fingers", "palm"])
def test_widths_of_the_grip_need_no_sites_on_the_fingers(sites: str, tmp_path: Path) -> None:
    """With sites on the palm the pads' distance counts, as with those on the pads."""
    pairs = []
    if sites == "palm":
        for y, side in ((0.022, "left"), (-0.022, "right")):
            pairs.append((f'<site name="{side}_grasp" pos="0 0 -0.13"/>', ""))
            site = f'<site name="{side}_grasp" pos="0 {y} -0.13"/><body name="left_finger"'
            pairs.append(('<body name="left_finger"', site))
    cfg = changed(tmp_path, *pairs)
    targets = gripper_targets(build_model(cfg), cfg.robot, [0.030, 0.044, 0.060])
    np.testing.assert_allclose(targets[:, 0], [0.011, 0.018, 0.026], atol=1e-6)


@pytest.mark.parametrize("ends", [(0.0, 0.05), (0.0, 0.03), (0.004, 0.06)])
def test_joint_targets_follow_from_the_jaws_where_none_are_given(ends: tuple[float, float]) -> None:
    """The jaws press with 20 N on each object, and open as far as joints and servos can."""
    robot = replace(scara().robot, gripper_open=None, gripper_closed=None)
    model = build_model(scara())
    for name in robot.gripper_joints:
        model.actuator(name).ctrlrange = ends
    widths = (None, 0.030, 0.050)
    opened, *closed = gripper_targets(model, robot, widths)
    assert opened.tolist() == [min(ends[1], 0.05)] * 2
    stiffness = model.actuator("left").gainprm[0]
    for target, width in zip(closed, widths[1:], strict=True):
        assert stiffness * (0.5 * width - target[0]) == pytest.approx(20.0, rel=1e-3)


def test_one_jaw_closes_where_no_target_is_given() -> None:
    """It presses with 20 N too; its pads are beside its own site, wherever it is open."""
    cfg = load_config()
    model = build_model(cfg)
    robot = replace(cfg.robot, gripper_closed=None)
    (closed,) = gripper_targets(model, robot, [0.044])
    assert jaws_of(model, robot).gap([closed]) == pytest.approx([0.044], abs=1e-3)
    assert closed[0] == pytest.approx(0.40, abs=0.02)


def test_a_joint_target_of_a_task_is_for_any_object(tmp_path: Path) -> None:
    """A robot's own is for 44 mm; one that a task or the command line sets means just that."""
    task = tmp_path / "conf" / "task" / "peg.yaml"
    task.parent.mkdir(parents=True)
    task.write_text("# @package _global_\ndefaults: [stack]\nrobot: {gripper_closed: [0.22]}\n")
    folder = tmp_path / "conf"
    model = build_model(load_config())

    def targets(*overrides: str) -> list[float]:
        robot = load_config(overrides, config_dir=folder).robot
        return gripper_targets(model, robot, [0.032, 0.044])[:, 0].tolist()

    assert targets("task=peg") == [0.22, 0.22]
    assert targets("robot.gripper_closed=[0.3]") == [0.3, 0.3]
    narrow, cube = targets()
    assert narrow < 0.25
    assert cube == 0.3
    with_width = targets("task=peg", "robot.closed_width=0.032")
    assert with_width[0] == 0.22
    assert with_width[1] > 0.25
    line = "controller.phases.lift_red.width=0.03: expected null, because robot.gripper_closed"
    refusal(lambda: targets("task=peg", "controller.phases.lift_red.width=0.03"), line)


def test_a_jaw_is_all_that_hangs_below_its_body(tmp_path: Path) -> None:
    """Pads are children of the bodies that the profile names, as those of a linkage are."""
    text = MJCF
    for side in ("left", "right"):
        pad = re.search(rf' *<geom name="{side}_pad".*/>\n', text)
        assert pad is not None
        body = f'<body name="{side}_tip" gravcomp="1">{pad[0]}</body>\n'
        text = text.replace(pad[0], body)
    file = tmp_path / "arm.xml"
    file.write_text(text)
    search = f"hydra.searchpath=[file://{SCARA}/conf]"
    cfg = load_config([search, "robot=scara", f"robot.file={file}", "sim=native", "nworld=1"])
    stage = Stage(cfg)
    outcome = stage.play(stage.batch_simulation(1), cfg.reset)
    assert not bool(outcome.result.failed.any())
    jaws = Jaws(
        stage.model,
        *(tuple(n) for n in (cfg.robot.joints, cfg.robot.gripper_joints)),
        cfg.robot.jaw_bodies,
        cfg.robot.grasp_sites,
    )
    np.testing.assert_allclose(jaws.gap([np.array([0.01, 0.01])]), [0.02], atol=1e-9)
