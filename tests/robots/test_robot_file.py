"""A robot from anybody's MJCF file: where it is found, what follows from it, what is refused, and
kinematics of an arm with a slide against MuJoCo's.
"""

import re
import shutil
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import mujoco
import numpy as np
import pytest
from compositions import refusal
from environments import Patch, few, one_second_episode
from ik_arm import Arm

from mjstack import load_config
from mjstack.cli import run
from mjstack.config.fingerprint import config_content
from mjstack.config.load import load_saved
from mjstack.config.schema import Config, RobotCfg
from mjstack.config.session import search_path
from mjstack.drivers.open_loop import OpenLoopPlanner
from mjstack.errors import ConfigError, MjstackError, UnknownName
from mjstack.kinematics.batched_ik import find_reach
from mjstack.robots import robot_spec
from mjstack.scene import build_model

SCARA = Path(__file__).parents[2] / "examples" / "scara"
MJCF = (SCARA / "scara.xml").read_text()


@cache
def scara() -> Config:
    return load_config([f"hydra.searchpath=[file://{SCARA}/conf]", "robot=scara"])


def changed(tmp_path: Path, old: str, new: str) -> Config:
    """The SCARA with a part of its file replaced."""
    assert old in MJCF
    file = tmp_path / "arm.xml"
    file.write_text(MJCF.replace(old, new))
    return replace(scara(), robot=replace(scara().robot, file=str(file)))


def test_the_file_is_relative_to_the_yaml_that_names_it() -> None:
    assert scara().robot.file == str(SCARA / "scara.xml")


BESIDE = """# @package _global_
task: {params: {mug: ../../mug.xml}}
scene:
  objects:
    rack: {fixed: true, xy: [0.3, 0.1], file: ../../mug.xml}
    mug: {fixed: true, xy: [0.3, 0.1], file: "${task.params.mug}"}
    copy: {fixed: true, xy: [0.3, 0.1], file: "${robot.file}"}
"""


@pytest.mark.parametrize("folders", [("alpha", "beta"), ("beta", "alpha")])
def test_each_file_is_beside_the_yaml_that_names_it(
    tmp_path: Path, monkeypatch: Patch, folders: tuple[str, str]
) -> None:
    """With files of the same name beside each folder, and from groups of any depth."""
    profile = (SCARA / "conf/robot/scara.yaml").read_text()
    for name in folders:
        conf = tmp_path / name / "conf"
        (conf / "experiment").mkdir(parents=True)
        (conf / "experiment" / f"{name}_mugs.yaml").write_text(BESIDE)
        for group, up in (("robot", "../.."), ("robot/vendor", "../../..")):
            (conf / group).mkdir(parents=True, exist_ok=True)
            (conf / group / f"{name}.yaml").write_text(profile.replace("../..", up))
        for file in ("scara.xml", "mug.xml"):
            shutil.copy(SCARA / "scara.xml", tmp_path / name / file)
    monkeypatch.chdir(tmp_path / "alpha")
    search = f"hydra.searchpath=[{','.join(f'file://{tmp_path / n}/conf' for n in folders)}]"
    alpha, beta = tmp_path / "alpha", tmp_path / "beta"
    for choice in ("beta", "vendor/beta"):
        assert load_config([search, f"robot={choice}"]).files == {
            "robot.file": str(beta / "scara.xml")
        }
    cfg = load_config([search, "robot=beta", "experiment=alpha_mugs"])
    assert cfg.files == {
        "robot.file": str(beta / "scara.xml"),
        "scene.objects.rack.file": str(alpha / "mug.xml"),
        "scene.objects.mug.file": str(alpha / "mug.xml"),
        "scene.objects.copy.file": str(beta / "scara.xml"),
    }
    # An override's is relative to the working folder.
    wall = "+scene.objects.wall={fixed: true, xy: [0.3, 0.1], file: mug.xml}"
    cfg = load_config([search, "robot=beta", "robot.file=scara.xml", wall])
    assert cfg.files == {
        "robot.file": str(alpha / "scara.xml"),
        "scene.objects.wall.file": str(alpha / "mug.xml"),
    }


TAKEN = {
    "object": "v: ${scene.objects.w}",
    "relative": "v: {fixed: true, xy: [0.3, 0.1], file: '${..w.file}'}",
    "chain": "v: {fixed: true, xy: [0.3, 0.1], file: '${..u.file}'}\n    u: ${scene.objects.w}",
}


@pytest.mark.parametrize("case", few(TAKEN, 2))
def test_a_file_taken_from_a_later_object_is_beside_its_yaml(tmp_path: Path, case: str) -> None:
    conf = tmp_path / "conf/experiment"
    conf.mkdir(parents=True)
    shutil.copy(SCARA / "scara.xml", tmp_path / "mug.xml")
    (conf / "taken.yaml").write_text(
        "# @package _global_\nscene:\n  objects:\n    " + TAKEN[case] + "\n"
        "    w: {fixed: true, xy: [0.3, 0.1], file: ../../mug.xml}\n"
    )
    files = load_config(["experiment=taken"], config_dir=tmp_path / "conf").files
    assert set(files) >= {"scene.objects.v.file", "scene.objects.w.file"}
    assert set(files.values()) == {str(tmp_path / "mug.xml")}


@pytest.mark.full
def test_a_run_finds_its_files_where_the_project_has_moved(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    """Though the other project, which stayed, has a file of that name."""
    monkeypatch.chdir(tmp_path)
    for name in ("old", "other"):
        shutil.copytree(SCARA, tmp_path / name)
    (tmp_path / "other/conf/robot/scara.yaml").unlink()
    search = f"hydra.searchpath=[file://{tmp_path}/other/conf,file://{tmp_path}/old/conf]"
    robot = [search, "robot=scara", "sim=native", "nworld=2", "gates=[batch]"]
    args = [*robot, "web.episode=false", *one_second_episode()]
    assert run([*args, "hydra.run.dir=old/out"]) in (0, 1)
    saved = Path("new/out/.hydra/config.yaml")
    Path("old").rename("new")
    with search_path([tmp_path / "new/conf", tmp_path / "other/conf"]):
        cfg = load_saved(saved)
        assert cfg.robot.file == str(tmp_path / "new/scara.xml")
        text = saved.read_text().replace(str(tmp_path / "old"), str(tmp_path / "old/../elsewhere"))
        saved.write_text(text)
        refusal(partial(load_saved, saved), "expected a file beside a folder of the search path")
    refusal(partial(load_saved, saved), f"--config-dir {tmp_path}/old/conf")  # where it was


@pytest.mark.full
def test_the_file_can_be_absolute_or_relative_to_the_working_folder(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    shutil.copy(SCARA / "scara.xml", tmp_path / "arm.xml")
    monkeypatch.chdir(tmp_path)
    search = f"hydra.searchpath=[file://{SCARA}/conf]"
    for file in ("arm.xml", tmp_path / "arm.xml"):
        cfg = load_config([search, "robot=scara", f"robot.file={file}"])
        assert cfg.robot.file == str(tmp_path / "arm.xml")
        # A configuration counts by what its files hold, not by where they are.
        assert config_content(cfg) == config_content(scara())


def test_a_profile_without_start_title_and_ik_joints_gets_them() -> None:
    robot = scara().robot
    assert robot.start == robot.home
    assert robot.ik_joints == ["shoulder", "elbow", "lift"]
    assert load_config(["robot.title=''"]).robot.title == "so101"


@pytest.mark.full
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["robot.file=arm.xml"], "/arm.xml: expected an MJCF file; there is no such file"),
        (["robot.file=/no/folder/arm.xml"], "robot.file=/no/folder/arm.xml: expected an MJCF file"),
        (["robot.name=mine"], "robot.file=null: expected the MJCF file of robot mine"),
        (["model=menagerie", "robot.menagerie_name=''"], "robot.menagerie_name=: expected"),
        (
            [f"robot.file={SCARA / 'scara.xml'}", "model=menagerie"],
            "scara.xml: expected null, because",
        ),
    ],
)
def test_a_robot_without_its_file_is_refused(overrides: list[str], message: str) -> None:
    refusal(lambda: build_model(load_config(overrides)), message, kind=ConfigError)


SERVO = '<position name="elbow" joint="elbow" kp="500" kv="20" forcerange="-40 40"/>'
MOTOR = '<motor name="elbow" joint="elbow"/>'
ONE = "expected one <position>"
BROKEN = [
    ("<mujoco model", "<mujoko model", MjstackError, "arm.xml cannot be read: "),
    ('joint name="elbow"', 'joint name="ellbow"', UnknownName, "Did you mean 'ellbow'"),
    ('site name="left_grasp"', 'site name="left"', UnknownName, "grasp site 'left_grasp'"),
    ('body name="left_finger"', 'body name="thumb"', UnknownName, "body 'left_finger'"),
    (' range="0.1 2.6"', "", ConfigError, "range of joint elbow=.*: expected a range"),
    (SERVO, MOTOR, ConfigError, f"actuators of joint elbow=elbow: {ONE}"),
    (SERVO, "", ConfigError, f"actuators of joint elbow=none: {ONE}"),
]


@pytest.mark.full
@pytest.mark.parametrize(("old", "new", "error", "message"), BROKEN)
def test_a_file_that_does_not_fit_the_profile_is_refused(
    old: str, new: str, error: type[MjstackError], message: str, tmp_path: Path
) -> None:
    cfg = changed(tmp_path, old, new)
    assert re.search(message, refusal(lambda: robot_spec(cfg.robot, cfg.model), kind=error))


@pytest.mark.parametrize("name", ["floor", "table", "red"])
def test_a_name_of_the_scene_gets_a_prefix(name: str, tmp_path: Path) -> None:
    geom = f'<worldbody><geom name="{name}" type="sphere" size="0.01" pos="0 0 2" contype="1"/>'
    model = build_model(changed(tmp_path, "<worldbody>", geom))
    assert model.geom(f"robot_{name}").size[0] == 0.01
    assert model.geom(name).size[0] != 0.01


def test_a_name_that_robot_and_scene_need_is_refused(tmp_path: Path) -> None:
    cfg = changed(tmp_path, 'body name="left_finger"', 'body name="red"')
    robot = replace(cfg.robot, jaw_bodies=["red", "right_finger"])
    line = "robot scara: the scene has red too, expected other names in the robot's file"
    refusal(lambda: build_model(replace(cfg, robot=robot)), line)


def test_a_servo_is_found_by_its_joint_and_limited_as_the_joint_is(tmp_path: Path) -> None:
    cfg = changed(tmp_path, '<position name="elbow"', '<position name="motor_2" inheritrange="0"')
    model = build_model(cfg)
    assert model.actuator("elbow").trnid[0] == model.joint("elbow").id
    np.testing.assert_allclose(model.actuator("elbow").ctrlrange, [0.1, 2.6])


def test_the_files_defaults_do_not_reach_the_scene() -> None:
    """The SCARA's geoms have no mass and no contact by default."""
    model = build_model(scara())
    for name in ("floor", "table", "red", "blue"):
        geom = model.geom(name)
        assert (geom.contype[0], geom.conaffinity[0], geom.group[0]) == (1, 1, 0)
        assert geom.matid[0] == -1
    assert model.body("red").mass[0] == pytest.approx(0.08)


def test_grasp_sites_are_added_where_the_file_lacks_them(tmp_path: Path) -> None:
    """At the mean of geoms, or at a body's origin."""
    cfg = changed(tmp_path, '<site name="left_grasp" pos="0 0 -0.13"/>', "")
    parts = {"left_grasp": ["left_pad"]}
    site = build_model(replace(cfg, robot=replace(cfg.robot, grasp_parts=parts))).site("left_grasp")
    np.testing.assert_allclose(site.pos, [0.0, 0.006, -0.13])
    parts = {"left_grasp": ["left_finger"]}
    site = build_model(replace(cfg, robot=replace(cfg.robot, grasp_parts=parts))).site("left_grasp")
    np.testing.assert_allclose(site.pos, 0.0)
    robot = replace(cfg.robot, grasp_parts=parts, grasp_pos={"left_grasp": [0.0, 0.0, -0.1]})
    site = build_model(replace(cfg, robot=robot)).site("left_grasp")
    np.testing.assert_allclose(site.pos, [0.0, 0.0, -0.1])


def test_grasp_sites_need_not_be_named(tmp_path: Path) -> None:
    """They go to where the jaws touch an object, or the line says why there is no such place."""
    cfg = scara()
    robot = replace(cfg.robot, grasp_sites=RobotCfg().grasp_sites, grasp_parts={})
    model = build_model(replace(cfg, robot=robot))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    own, made = (
        np.mean([data.site(name).xpos for name in sites], axis=0)
        for sites in (cfg.robot.grasp_sites, robot.grasp_sites)
    )
    assert made == pytest.approx(own, abs=0.012)
    assert made[:2] == pytest.approx(own[:2], abs=1e-4)
    thick = changed(tmp_path, 'range="0 0.05"', 'range="0 0.01"')
    lost = replace(thick.robot, grasp_sites=robot.grasp_sites, grasp_parts={})
    line = "expected two sites of the robot's file. Name them: its fingers open by"
    refusal(lambda: build_model(replace(thick, robot=lost)), line)


def test_fingers_on_a_tendon_move_as_its_own_servo_moves_them(tmp_path: Path) -> None:
    """The file's servo takes 0 to 250 for 0 to 0.05 m, and pushes with 3 N at most."""
    fingers = re.search(r'<position name="left".*<position name="right"[^>]*>', MJCF, re.DOTALL)
    assert fingers is not None
    parts = "".join(f'<joint joint="{name}" coef="0.5"/>' for name in ("left", "right"))
    servo = """<general name="hand" tendon="split" ctrlrange="0 250" forcerange="-3 3"
      biastype="affine" gainprm="0.1" biasprm="0 -500 -20"/>"""
    tendon = f'</actuator><tendon><fixed name="split">{parts}</fixed></tendon>'
    cfg = changed(tmp_path, f"{fingers[0]}\n  </actuator>", servo + tendon)
    file = mujoco.MjModel.from_xml_path(str(cfg.robot.file))
    split = robot_spec(cfg.robot, cfg.model).compile()
    np.testing.assert_allclose(split.actuator("left").ctrlrange, [0.0, 0.05])
    moved = []
    for model, names, target in ((file, ["hand"], 100.0), (split, ["left", "right"], 0.02)):
        data = mujoco.MjData(model)
        data.ctrl[[model.actuator(name).id for name in names]] = target
        for _ in range(400):
            mujoco.mj_step(model, data)
        moved.append([float(data.joint(name).qpos[0]) for name in ("left", "right")])
    assert 0.01 < moved[0][0] < 0.021
    np.testing.assert_allclose(moved[1], moved[0], rtol=0.0, atol=1e-7)


def scara_points(n: int) -> np.ndarray:
    """Points over the table of the SCARA [m], shape ``(n, 3)``."""
    return np.random.default_rng(0).uniform([0.33, -0.22, 0.04], [0.49, 0.22, 0.24], (n, 3))


def test_reach_of_an_arm_with_a_slide_is_mujocos() -> None:
    cfg = scara()
    model = build_model(cfg)
    arm = Arm(model, cfg.robot)
    points = scara_points(30)
    commands, distances = find_reach(model, cfg.robot, points, cfg.robot.gripper_open)
    assert distances.max() < 1e-5
    for start in commands.double().numpy():
        assert np.linalg.norm(arm.grasp_point(start) - points, axis=1).max() < 1e-5
    # Above the slide's range the point is as far away as it is above.
    point = np.array([[0.4, 0.0, 0.28 + 0.1]])
    q, distances = find_reach(model, cfg.robot, point, cfg.robot.gripper_open)
    assert distances.min() == pytest.approx(0.1, abs=1e-4)
    assert q[distances[:, 0].argmin(), 0, 2] == pytest.approx(0.25, abs=1e-6)


def test_mink_plans_an_arm_with_a_slide() -> None:
    cfg = scara()
    planner = OpenLoopPlanner(cfg)
    arm = Arm(build_model(cfg), cfg.robot)
    start = np.array([*planner.ik.home[:-2], 0.02, 0.02])
    for point in scara_points(10):
        command, distance = planner.ik.solve(point, start)
        assert distance < 0.1 * planner.ik.tolerance
        miss = np.linalg.norm(arm.grasp_point(command[None])[0] - point)
        assert miss == pytest.approx(distance, abs=1e-9)
        assert abs(command[arm.names.index("roll")]) < 1e-12
