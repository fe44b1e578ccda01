"""Kinds of robots' files that other people had trouble with: each has its right values, or is
refused in one line that names the cause.

Each case is the SCARA with one difference. What it does not name is as without the difference: the
cube, the scene's options, servos, bounds, the pose at a reset, and that the arm stays there.
"""

import contextlib
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import yaml
from arm_file import MJCF, SERVOS, changed, scara
from compositions import load_config, refusal
from environments import few

from mjstack.config.schema import Config
from mjstack.config.schema.robot import BasePoseCfg
from mjstack.envs import build_env
from mjstack.episodes.stage import Stage
from mjstack.report.page import Map
from mjstack.report.sections import table_map
from mjstack.robots import read_robot
from mjstack.robots.guest import left_behind
from mjstack.robots.new import write_new
from mjstack.scene import build_model
from mjstack.scene.build import scene_names

SETTINGS = '<compiler angle="radian" autolimits="true"/>'
OPTION = '<option integrator="implicitfast" cone="elliptic"/>'
BASE = '<body name="base">'
JOINTS = list(SERVOS)
NATIVE = ("sim=native", "nworld=1", "reset=nominal", "action=joint_delta")
EQUALITY = re.search(r"<joint name=\"fingers\".*?/>", MJCF)[0]  # type: ignore[index]
PALM = '<geom name="palm"'
TOOL = (PALM, f'<body name="tool" pos="0 0 -0.06"><geom size="0.01 0.01 0.01"/></body>{PALM}')
MAST = """<body name="mast" pos="0.3 0.6 0.3">
  <inertial mass="0.5" pos="0 0 0.1" diaginertia="0.002 0.002 0.0004"/>
  <joint name="mast" axis="0 1 0" range="0.5 2.0" damping="0.5"/>
</body>"""

Pair = tuple[str, str]
Values = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """A difference of the file, and what is right.

    Attributes:
        pairs: Parts of the file and what is in their place.
        robot: Fields of the profile.
        scene: Fields of the scene.
        right: Values that differ from those without the difference.
        line: Words of the line that refuses it.
        note: Words of *baseline*'s details on what stays behind.
        check: Looks at the environment after a reset.
    """

    pairs: list[Pair] = field(default_factory=list)
    robot: Values = field(default_factory=dict)
    scene: Values = field(default_factory=dict)
    right: Values = field(default_factory=dict)
    line: str = ""
    note: str = ""
    check: Callable[[Any], None] = lambda env: None


def servo(joint: str, values: str, kind: str = "position") -> Pair:
    """A joint's actuator, which has nothing of the file's defaults."""
    return SERVOS[joint], f'<{kind} name="{joint}" joint="{joint}" {values}/>'


FOLLOWS = (EQUALITY, '<joint joint1="right" joint2="left" polycoef="0 1 0 0 0"/>')
MIRRORED = [  # the right finger's axis and range
    ('class="finger" axis="0 -1 0"', 'class="finger" range="-0.05 0"'),
    (EQUALITY, FOLLOWS[1].replace("0 1 0", "0 -1 0")),
]


def compiler(settings: str) -> Case:
    return Case([(SETTINGS, SETTINGS.replace("/>", f" {settings}/>"))])


def option(settings: str, note: str = "") -> Case:
    return Case([(OPTION, f"<option {settings}")], note=note)


def renamed(names: dict[str, str]) -> Case:
    """Other names for joints and their servos."""
    kinds = ("name", "joint", "joint1", "joint2")
    pairs = [(f' {k}="{a}"', f' {k}="{b}"') for a, b in names.items() for k in kinds]
    return Case(
        [pair for pair in pairs if pair[0] in MJCF],
        {
            "arm_joints": [names[name] for name in JOINTS[:4]],
            "gripper_joints": [names[name] for name in JOINTS[4:]],
            "locked": {names["roll"]: 0.0},
            "roll_joint": names["roll"],
            "ik_joints": [names[name] for name in JOINTS[:3]],
        },
        check=lambda env: new_names(Path(env.cfg.robot.file), list(names.values())),
    )


def new_names(file: Path, names: list[str]) -> None:
    """The file that ``mjstack new robot`` writes has the names as they are."""
    write_new(["robot", "odd", str(file)])
    profile = yaml.safe_load(Path("odd/conf/robot/odd.yaml").read_text())
    assert sorted(profile["arm_joints"] + profile["gripper_joints"]) == sorted(names)


def moved(base: str, pos: list[float], yaw: float, line: str = "") -> Case:
    """The arm stands elsewhere; with the table, where positions that are the world's are so."""
    scene: Values = {}
    if not line:
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        table = scara().scene
        half = np.abs(turn @ table.table_half[:2])
        scene["table_center"] = [*(turn @ table.table_center[:2] + pos[:2]), pos[2] + 0.012]
        scene["table_half"] = [*half, 0.012]
        scene["xy"] = {n: (turn @ o.xy + pos[:2]).tolist() for n, o in table.objects.items()}
        if pos[2]:
            scene["table_center"][2], scene["table_half"][2] = (
                pos[2] / 2 + 0.012,
                pos[2] / 2 + 0.012,
            )
    right = {"base": pos[:2]}
    return Case([(BASE, f'<body name="base" {base}>')], scene=scene, right=right, line=line)


FOLLOWER: Values = {
    "gripper_joints": ["left"],
    "home": [-0.8, 1.6, 0.2, 0.0, 0.045],
    "start": [-0.8, 1.6, 0.2, 0.0, 0.045],
    "gripper_open": [0.045],
    "gripper_closed": [0.018],
}
DOUBLE = [(SERVOS["right"], ""), servo("left", 'kp="10000" kv="80" forcerange="-200 200"')]
DOUBLED = {"servos": {"left": [10000, 80, -200, 200, 0, 0.05]}}
PAD = '<geom name="left_pad" class="touch" pos="0 0.006 -0.13" size="0.012 0.006 0.016"/>'
SITE = '<site name="left_grasp" pos="0 0 -0.13"/>'
PARTS: Values = {"grasp_parts": {"left_grasp": ["left_pad"]}}
PAD_SITE: Values = {"sites": {"left_grasp": [0.0, 0.006, -0.13]}}
WIDE = 'kv="{}" forcerange="{}" inheritrange="0" ctrlrange="-6.283 6.283"'


CASES = {
    "c00_base": Case(),
    "c01_default_joint": Case(
        [('armature="0.01" damping="1"/>', 'damping="1" frictionloss="0.5" stiffness="0.1"/>')]
    ),
    "c03_fusestatic": Case([*compiler('fusestatic="true"').pairs, TOOL], {"approach_body": "tool"}),
    "c03_nofuse": Case([*compiler('fusestatic="false"').pairs, TOOL], {"approach_body": "tool"}),
    "c04_follower": Case([*DOUBLE, FOLLOWS], FOLLOWER, right=DOUBLED),
    "c04_follower_neg": Case(
        [*DOUBLE, *MIRRORED], FOLLOWER, right=DOUBLED | {"fingers": [0.045, -0.045]}
    ),
    "c04_both_named": Case([*DOUBLE, FOLLOWS], line="actuators of joint right=none"),
    "c06_degctrl": Case(
        [servo("shoulder", 'kp="900" ' + WIDE.format(50, "-60 60").replace("6.283", "130"))]
    ),
    "c07_shift": moved('pos="0.5 0.3 0"', [0.5, 0.3, 0.0], 0.0),
    "c07_turned": moved('pos="0.5 0.3 0" euler="0 0 1.5707963267949"', [0.5, 0.3, 0.0], np.pi / 2),
    "c07_pedestal": moved('pos="0 0 0.6"', [0.0, 0.0, 0.6], 0.0),
    "c07_shift_basecoords": moved('pos="0.5 0.3 0"', [0.5, 0.3, 0.0], 0.0, "out of reach"),
    "c07_turned_basecoords": moved(
        'pos="0.9 0.9 0" euler="0 0 1.5707963267949"', [0.9, 0.9, 0.0], np.pi / 2, "out of reach"
    ),
    "c07_pedestal_basecoords": moved('pos="0 0 0.6"', [0.0, 0.0, 0.6], 0.0, "out of reach"),
    "c08_numbers": renamed(dict(zip(JOINTS, "123456", strict=True))),
    "c08_zeros": renamed(
        dict(zip(JOINTS, ["01", "02", "03", "04", "05_finger", "06_finger"], strict=True))
    ),
    "c08_odd": renamed(
        dict(
            zip(
                JOINTS,
                [
                    *("Revolute 1", "Revolute: 2", "Slider, 3", "回転#4"),
                    *("arm/left.finger", "arm/right.finger"),
                ],
                strict=True,
            )
        )
    ),
    "c10_pgs": option('solver="PGS"/>', "option solver"),
    "c10_cg": option('solver="CG"/>', "option solver"),
    "c10_multiccd": option('><flag multiccd="enable"/></option>'),
    "c10_noconstraint": option('><flag constraint="disable"/></option>', "flags constraint"),
    "c10_noact": option('><flag actuation="disable"/></option>', "flags actuation"),
    "c10_energy": option('><flag energy="enable" fwdinv="enable"/></option>', "flags energy"),
    "c10_midphase": option('jacobian="sparse"/>', "option jacobian"),
    "c10_invdiscrete": option('><flag invdiscrete="enable"/></option>', "flags invdiscrete"),
    "c10_island": option('><flag sleep="enable"/></option>', "flags sleep"),
    "c11_memory": Case([(OPTION, f'{OPTION}<size memory="60K"/>')]),
    "c11_nconmax": Case([(OPTION, f'{OPTION}<size nconmax="6" njmax="40"/>')]),
    "c13_frame": Case(
        [
            (SITE, ""),
            (PAD, f'<frame pos="0 0.006 -0.13">{PAD.replace("0 0.006 -0.13", "0 0 0")}</frame>'),
        ],
        PARTS,
        right=PAD_SITE,
    ),
    "c13_fromto": Case(
        [(SITE, ""), (PAD, PAD.replace("pos", "fromto").replace("-0.13", "-0.114 0 0.006 -0.146"))],
        PARTS,
        right=PAD_SITE,
    ),
    "c13_body": Case(
        [(SITE, "")],
        {
            "grasp_parts": {"left_grasp": ["left_finger"]},
            "grasp_pos": {"left_grasp": [0, 0, -0.13]},
        },
    ),
    "c15_windup": Case(
        [
            servo("shoulder", 'kp="900" ' + WIDE.format(50, "-60 60")),
            servo("elbow", 'kp="500" ' + WIDE.format(20, "-40 40")),
            servo("lift", 'kp="5000" ' + WIDE.format(140, "-150 150")),
            servo("roll", 'kp="60" ' + WIDE.format(1.5, "-8 8")),
        ]
    ),
    "c21_unlisted": Case(
        [("<worldbody>", f"<worldbody>{MAST}")], check=lambda env: mast_is_within_its_range(env)
    ),
    "c22_degree": Case(
        [
            (SETTINGS, '<compiler angle="degree" autolimits="true"/>'),
            *(
                (f'range="{low} {high}"', f'range="{np.degrees(low)} {np.degrees(high)}"')
                for low, high in ((-2.4, 2.4), (0.1, 2.6), (-3.1, 3.1))
            ),
        ]
    ),
    "c22_noautolimits": Case(
        [(SETTINGS, SETTINGS.replace('autolimits="true"', 'autolimits="false"'))], line="`limited`"
    ),
}


def mast_is_within_its_range(env: Any) -> None:
    q = float(env.sim.qpos[0, env.sim.model.joint("mast").qposadr[0]])
    assert 0.5 <= q <= 2.0


def configure(case: Case, folder: Path) -> Config:
    cfg = changed(folder, *case.pairs, cfg=scara(*NATIVE), **case.robot)
    scene = replace(cfg.scene, objects={n: replace(o) for n, o in cfg.scene.objects.items()})
    for key, value in case.scene.items():
        if key == "xy":
            for name, xy in value.items():
                scene.objects[name].xy = xy
        else:
            setattr(scene, key, value)
    return replace(cfg, scene=scene)


def measure(env: Any) -> Values:
    """Values of a scene, in the robot's order: the cube, options, servos, and poses."""
    model, index, robot = env.sim.model, env.index, env.cfg.robot
    red = model.body("red")
    dofs = index.objects["red"][1] + np.arange(6)
    servos = {}
    for joint, number, (low, high) in zip(JOINTS, index.ctrl, index.ctrl_range, strict=False):
        actuator = model.actuator(number)
        assert actuator.trnid[0] == model.joint(robot.joints[JOINTS.index(joint)]).id
        assert actuator.gear[0] == 1.0
        assert actuator.gainprm[0] == -actuator.biasprm[1]
        assert actuator.dyntype[0] == mujoco.mjtDyn.mjDYN_NONE
        kp, kv = actuator.gainprm[0], -actuator.biasprm[2]
        servos[joint] = [kp, kv, *actuator.forcerange, low, high]
    option = model.opt
    fingers = [
        model.jnt_qposadr[model.body(f"{side}_finger").jntadr[0]] for side in ("left", "right")
    ]
    base = model.body("base")
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, base.quat)
    sites = torch.stack([env.sim.site_xpos[0, site] for site in index.grasp_sites])
    return {
        "red": [red.mass[0], *red.inertia, *(model.dof_damping + model.dof_armature)[dofs]],
        "options": [*option.gravity, option.density, option.viscosity, option.disableflags,
                    option.enableflags, option.disableactuator, option.noslip_iterations,
                    option.solver, option.jacobian],
        "servos": servos,
        "sites": {name: model.site(name).pos.tolist() for name in robot.grasp_sites},
        "base": index.base,
        "fingers": env.sim.qpos[0, fingers].tolist(),
        "grasp": ((sites.mean(0).numpy() - base.pos) @ turn.reshape(3, 3)).tolist(),
    }  # fmt: skip


def environment(cfg: Config) -> Any:
    env = build_env(cfg)
    env.reset()
    return contextlib.closing(env)


@cache
def plain() -> Values:
    with environment(scara(*NATIVE)) as env:
        return measure(env)


def agree(found: Any, right: Any, where: str) -> None:
    """None stands for a value that another assertion has."""
    if isinstance(right, dict):
        for name in right:
            agree(found[name], right[name], f"{where}.{name}")
    else:
        pairs = [(f, r) for f, r in zip(found, right, strict=True) if r is not None]
        np.testing.assert_allclose(*np.transpose(pairs), rtol=1e-6, atol=1e-7, err_msg=where)


@pytest.mark.parametrize("name", few(CASES, 2))
def test_a_file_of_this_kind_is_right_or_refused(
    name: str, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    case = CASES[name]
    cfg = configure(case, tmp_path)
    if case.line:
        refusal(lambda: Stage(cfg).planner, case.line)
        return
    right = plain() | {"servos": plain()["servos"] | case.right.get("servos", {})}
    right["sites"] = right["sites"] | case.right.get("sites", {})
    with environment(cfg) as env:
        found = measure(env)
        right |= {k: v for k, v in case.right.items() if k not in ("servos", "sites")}
        right["servos"] = {joint: right["servos"][joint] for joint in found["servos"]}
        for key, value in right.items():
            if key != "grasp" or "sites" not in case.right:
                agree(found[key], value, key)
        case.check(env)
        if "base" in case.right or name == "c00_base":
            assert Stage(cfg).planner.nominal is not None  # within reach
        hold = torch.zeros((1, env.action_manager.action_dim))
        hold[:, -1] = 1.0  # open
        for _ in range(5):
            env.step(hold)
        for key in ("grasp", "fingers"):
            np.testing.assert_allclose(measure(env)[key], found[key], atol=1e-3)
    lines = left_behind(
        read_robot(cfg.robot, cfg.model), cfg.robot, build_model(cfg), scene_names(cfg.scene)
    )
    notes = "\n".join(lines)
    assert case.note in notes
    assert case.note or not notes


@pytest.mark.parametrize(
    ("limits", "right"),
    [
        ('ctrlrange="-6.283 6.283"', (-2.4, 2.4)),
        ('ctrlrange="-1 3"', (-1.0, 2.4)),
        ('ctrlrange="-6 6" ctrllimited="false"', (-2.4, 2.4)),
        ('inheritrange="2"', (-2.4, 2.4)),
        ('inheritrange="0.5" gear="-2"', (-0.6, 0.6)),
    ],
)
def test_a_command_stops_at_the_narrower_range(
    limits: str, right: tuple[float, float], tmp_path: Path
) -> None:
    """However long it was pressed against the end, three steps back are three steps."""
    limits = limits if "inherit" in limits else f'inheritrange="0" {limits}'
    case = Case([servo("shoulder", f'kp="900" kv="50" {limits}')])
    with environment(configure(case, tmp_path)) as env:
        column = env.index.ctrl[0]
        np.testing.assert_allclose(env.index.ctrl_range[0], right)
        action = torch.zeros((1, env.action_manager.action_dim))
        for sign, end in ((1.0, right[1]), (-1.0, right[0])):
            action[:, 0] = sign
            for _ in range(130):
                env.step(action)
            assert float(env.sim.ctrl[0, column]) == pytest.approx(end)
            action[:, 0] = -sign
            for _ in range(3):
                env.step(action)
            assert float(env.sim.ctrl[0, column]) == pytest.approx(end - sign * 0.15)


def test_ranges_that_do_not_meet_are_refused(tmp_path: Path) -> None:
    pair = servo("shoulder", 'kp="900" kv="50" inheritrange="0" ctrlrange="3 4"')
    line = "ctrlrange of joint shoulder=[3.0, 4.0]: expected one that meets its range [-2.4, 2.4]"
    refusal(lambda: environment(configure(Case([pair]), tmp_path)), line)


def test_all_actions_have_the_bounds_of_the_joints() -> None:
    """SO-101's wrist_roll has a wider servo."""
    env = build_env(load_config(["sim=native", "nworld=1", "action=joint_absolute"]))
    ranges = env.sim.model.jnt_range[: len(env.cfg.robot.joints)]
    bounds = torch.stack((env.action_manager.low, env.action_manager.high), 1).numpy()
    assert np.abs(bounds - ranges).max() < 1e-5
    assert (bounds[:, 0] >= ranges[:, 0] - 1e-6).all()
    assert (bounds[:, 1] <= ranges[:, 1] + 1e-6).all()
    assert env.index.servo_range[4, 1] == 2.84121
    env.close()


@pytest.mark.parametrize(
    ("pos", "yaw"), [([0.3, -0.25, 0.0], 0.0), ([0.3, -0.25, 0.0], 1.5), ([0.0, -0.4, 0.6], -2.0)]
)
def test_a_tilt_counts_from_the_arms_base(pos: list[float], yaw: float) -> None:
    """An arm that stands elsewhere gets the same commands for the same actions in its frame."""
    cfg = load_config(["sim=native", "nworld=1", "reset=nominal", "action=ee_tilt"])
    quat = [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))]
    elsewhere = replace(cfg, robot=replace(cfg.robot, base=BasePoseCfg(pos=pos, quat=quat)))
    commands = []
    for where, angle in ((cfg, 0.0), (elsewhere, yaw)):
        with environment(where) as env:
            assert env.index.base == pytest.approx([0.0, 0.0] if where is cfg else pos[:2])
            turn = torch.tensor([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            for k in range(12):
                action = torch.zeros((1, env.action_manager.action_dim))
                action[0, :2] = (turn @ torch.tensor([0.6, 0.8 - 0.1 * k]).double()).float()
                action[0, 3] = 1.0
                env.step(action)
            commands.append(env.sim.ctrl[0, env.index.ctrl].numpy().copy())
    assert np.abs(commands[0] - load_config([]).robot.start).max() > 0.1
    np.testing.assert_allclose(commands[1], commands[0], atol=1e-4)


def test_maps_count_from_the_arms_base() -> None:
    angles = np.radians(np.arange(0.0, 90.0, 3.0))
    base = np.array([0.9, -0.4])
    xy = base + 0.3 * np.stack((np.cos(angles), np.sin(angles)), 1)
    plan = Map(title="red", xy=xy, table=([1.2, -0.4], [0.1, 0.2]), base=base.tolist())
    moved = Map(title="red", xy=xy - base, table=([0.3, 0.0], [0.1, 0.2]))
    names = [str(k) for k in range(len(angles))]
    figures = [table_map(m, names, [[]] * len(names), [0]) for m in (plan, moved)]
    assert figures[0] == figures[1]


MESH = """<asset><mesh name="pad" vertex="0 0 0  0.02 0 0  0 0.02 0  0.02 0.02 0
    0 0 0.06  0.02 0 0.06  0 0.02 0.06  0.02 0.02 0.06"/></asset>"""


@pytest.mark.parametrize(
    ("geom", "right"),
    [
        ('<frame pos="0 0 -0.1" euler="0 1.5707963267949 0"><geom name="left_pad" pos="0.03 0.01 0"'
         ' size="0.01 0.01 0.01"/></frame>', [0.0, 0.01, -0.13]),
        ('<geom name="left_pad" type="mesh" mesh="pad" pos="0 0 -0.16"/>', [0.01, 0.01, -0.13]),
        ('<geom name="left_pad" type="capsule" fromto="0 0 -0.1 0.02 0 -0.16" size="0.004"/>',
         [0.01, 0.0, -0.13]),
    ],
    ids=["turned frame", "mesh", "fromto"],
)  # fmt: skip
def test_a_grasp_site_is_where_its_geom_is(geom: str, right: list[float], tmp_path: Path) -> None:
    pairs = [(SITE, ""), (PAD, geom), ("<worldbody>", f"{MESH}<worldbody>")]
    model = build_model(changed(tmp_path, *pairs, **PARTS))
    np.testing.assert_allclose(model.site("left_grasp").pos, right, atol=1e-9)


def test_parts_of_a_grasp_site_are_on_one_body(tmp_path: Path) -> None:
    for parts in (["left_pad", "right_pad"], ["left_finger", "right_finger"]):
        cfg = changed(tmp_path, (SITE, ""), grasp_parts={"left_grasp": parts})
        line = f"robot.grasp_parts.left_grasp={parts}: expected geoms of one body, or one body"
        refusal(lambda cfg=cfg: build_model(cfg), line)  # type: ignore[misc]
    cfg = changed(tmp_path, (SITE, ""), grasp_parts={"left_grasp": ["left_pat"]})
    refusal(
        lambda: build_model(cfg), "geom or body 'left_pat' does not exist. Did you mean 'left_pad'"
    )
