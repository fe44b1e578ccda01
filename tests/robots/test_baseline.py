"""Gate *baseline*: a scene that is not as configured, and an arm that is not where it is sent."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from compositions import load_config, refusal
from environments import Patch, few

import mjstack
from mjstack.config.schema import Config
from mjstack.drivers import driver
from mjstack.episodes.rollout import State
from mjstack.episodes.stage import Stage
from mjstack.gates.scene_physics import _fall_faults, scene_faults
from mjstack.gates.tracking import find_cause
from mjstack.report.record import GateResult
from mjstack.robots.guest import gravity_sag
from mjstack.scene import build_model
from mjstack.scene.build import add_scene
from mjstack.scene.index import SceneIndex

SCARA = Path(__file__).parents[2] / "examples" / "scara"
MJCF = (SCARA / "scara.xml").read_text()
CONFIG = [f"hydra.searchpath=[file://{SCARA}/conf]", "robot=scara"]
RUN = ["sim=native", "nworld=1", "gates=[baseline]", "web.episode=false"]


def scara(*overrides: str) -> Config:
    return load_config([*CONFIG, *overrides])


def baseline(*overrides: str, arm: Path | None = None) -> GateResult:
    file = [] if arm is None else [f"robot.file={arm}"]
    return mjstack.verify([*RUN, *CONFIG, *file, *overrides]).gates["baseline"]


def arm_file(tmp_path: Path, *pairs: tuple[str, str]) -> Path:
    """The SCARA's file with parts replaced."""
    text = MJCF
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "arm.xml"
    path.write_text(text)
    return path


def geom(name: str, field: str, value: Any) -> Callable[[mujoco.MjModel], None]:
    return lambda model: setattr(model.geom(name), field, value)


def option(name: str, value: Any) -> Callable[[mujoco.MjModel], None]:
    return lambda model: setattr(model.opt, name, value)


def body(name: str, field: str, value: Any) -> Callable[[mujoco.MjModel], None]:
    def alter(model: mujoco.MjModel) -> None:
        getattr(model, f"body_{field}")[model.body(name).id] = value

    return alter


def joint(name: str, field: str, value: float) -> Callable[[mujoco.MjModel], None]:
    def alter(model: mujoco.MjModel) -> None:
        first = int(model.joint(name).dofadr[0])
        getattr(model, f"dof_{field}")[first : first + 6] = value

    return alter


def ghost(model: mujoco.MjModel) -> None:
    model.geom("blue").contype = model.geom("blue").conaffinity = 0


ALTERATIONS: dict[str, tuple[Callable[[mujoco.MjModel], None], str]] = {
    "gravity": (option("gravity", [0, 0, 0]), "option gravity 0 0 0, configured 0 0 -9.81"),
    "mass": (
        body("red", "mass", 0.0808),
        r"red body_mass 0.0808, configured 0.08 (scene.objects.red.mass)",
    ),
    "inertia": (
        body("red", "inertia", 3e-5),
        "red body_inertia 3e-05 3e-05 3e-05, configured 2.58",
    ),
    "friction": (
        geom("red", "friction", [0.9, 0.005, 0.0005]),
        "red geom_friction 0.9 0.005 0.0005, configured 1.2 0.005 0.0005"
        " (scene.objects.red.friction)",
    ),
    "size": (
        geom("red", "size", [0.03, 0.022, 0.022]),
        "red geom_size 0.03 0.022 0.022, configured 0.022 0.022 0.022 (scene.objects.red.size)",
    ),
    "flags": (option("disableflags", 1 << 4), "option disableflags 16, configured 0"),
    "ghost": (ghost, "blue has 0 geom for collisions, configured 1"),
    "damping": (joint("red", "damping", 0.01), "red dof_damping 0.01"),
    "fluid": (option("density", 1.2), "option density 1.2, configured 0"),
    "gravcomp": (body("red", "gravcomp", 1.0), "red body_gravcomp 1, configured 0"),
    "solref": (geom("table", "solref", [0.01, 1.0]), "table geom_solref 0.01 1, configured 0.02 1"),
    "margin": (geom("floor", "margin", 0.01), "floor geom_margin 0.01, configured 0"),
    "condim": (geom("red", "condim", 1), "red geom_condim 1, configured 3"),
}


def altered_baseline(alter: Callable[[mujoco.MjModel], None], monkeypatch: Patch) -> GateResult:
    """The gate on a model that is altered behind its back."""

    def altered(*args: Any, **kwargs: Any) -> mujoco.MjModel:
        model = build_model(*args, **kwargs)
        alter(model)
        return model

    monkeypatch.setattr(driver, "build_model", altered)
    return baseline()


def test_a_scene_that_is_changed_behind_its_back_fails(monkeypatch: Patch) -> None:
    cfg = scara()
    for name, (alter, message) in ALTERATIONS.items():
        model = build_model(cfg)
        alter(model)
        assert message in "; ".join(scene_faults(cfg, model)), name
    result = altered_baseline(ALTERATIONS["ghost"][0], monkeypatch)
    assert result.status == "fail"
    assert result.reason.startswith("the compiled scene is not as configured: blue has 0 geom")


def test_a_fall_shows_a_cause_that_no_field_has() -> None:
    """Each object falls alone: its gravity, its mass and its inertia are measured."""
    cfg = scara()
    spec = mujoco.MjSpec()
    add_scene(spec, replace(cfg, robot=replace(cfg.robot, jaw_bodies=[])))
    weld = spec.add_equality(type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY)
    weld.name1 = "red"
    weld.name2 = "world"
    faults = list(scene_faults(cfg, spec.compile()))
    assert faults[0].startswith("red falls with acceleration")
    assert not any(fault.startswith("blue") for fault in faults)

    model = build_model(cfg)
    model.dof_M0[int(model.joint("blue").dofadr[0])] = 0.1  # what its pushes are divided by
    model.dof_M0[int(model.joint("red").dofadr[0]) + 5] = 5e-5
    turned, pushed = list(scene_faults(cfg, model))
    assert pushed == "blue as pushed: mass 0.1, configured 0.08 (scene.objects.blue.mass)"
    assert turned.startswith("red as turned: inertia 2.58133e-05 2.58133e-05 5e-05, configured")


def test_contacts_of_the_scene_that_are_switched_off_are_seen() -> None:
    cfg = scara()
    spec = mujoco.MjSpec()
    add_scene(spec, replace(cfg, robot=replace(cfg.robot, jaw_bodies=[])))
    spec.add_exclude(bodyname1="world", bodyname2="red")
    spec.add_pair(geomname1="red", geomname2="blue")
    assert list(scene_faults(cfg, spec.compile())) == [
        "world and red have an exclude or a pair of contacts, configured none",
        "red and blue have an exclude or a pair of contacts, configured none",
    ]


@pytest.mark.parametrize(
    "overrides",
    few(
        [
            ["task=box", "robot=rebot"],
            ["robot=so101", "cameras=[front,wrist]"],
            ["scene.objects.red={shape: capsule, size: [0.02, 0.02], quat: [0.7, 0.1, 0.7, 0]}"],
            ["+scene.objects.can={shape: cylinder, size: [0.02, 0.03], mass: 0.1, xy: [0.4, 0.0]}"],
            ["timing=fine", "solver=benchmark", "scene.table_friction=[0.5, 0.01, 0.001]"],
        ],
        2,
    ),
)
def test_a_scene_as_configured_passes(overrides: list[str]) -> None:
    cfg = load_config(overrides)
    assert list(scene_faults(cfg, build_model(cfg))) == []


def test_friction_less_than_mujoco_keeps_is_as_configured(tmp_path: Path) -> None:
    """Of files, fixed and free, and of keys: contacts have at least mjMINMU of each direction."""
    geom = '<geom type="box" size="0.02 0.02 0.02" mass="0.05" friction="1 0 0"/>'
    files = {name: tmp_path / f"{name}.xml" for name in ("stop", "cup")}
    for (name, path), free in zip(files.items(), ("", "<freejoint/>"), strict=True):
        body = f'<body name="{name}">{free}{geom}</body>'
        path.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    cfg = scara(
        f"+scene.objects.stop={{file: {files['stop']}, fixed: true, xy: [0.41, 0.0]}}",
        f"+scene.objects.cup={{file: {files['cup']}, xy: [0.33, 0.0]}}",
        "scene.objects.red.friction=[1e-7, 1e-7, 1e-7]",
    )
    assert list(scene_faults(cfg, build_model(cfg))) == []


def test_an_arm_s_own_motion_and_a_ceiling_disturb_no_fall(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    ceiling = '<geom type="box" size="5 5 0.1" pos="0 0 10" contype="1" conaffinity="1"/>'
    for pair in (("<worldbody>", f"<worldbody>{ceiling}"), ('kp="900" kv="50"', 'kp="9e8" kv="0"')):
        cfg = scara(f"robot.file={arm_file(tmp_path, pair)}")
        assert list(scene_faults(cfg, build_model(cfg))) == []
    assert "WARNING" not in capfd.readouterr().err


@pytest.mark.filterwarnings("error")
def test_a_body_without_mass_is_named_before_it_falls() -> None:
    cfg = scara()
    expected = build_model(cfg)
    expected.body("red").mass = 0.0
    faults = list(_fall_faults(cfg, build_model(cfg), expected, "red"))
    assert faults == ["red has no mass: its file keeps it in bodies that MuJoCo cannot make one"]


# Where the arm goes


@pytest.fixture(scope="module")
def passed() -> GateResult:
    return baseline()


def test_the_waypoint_error_is_the_arms(passed: GateResult) -> None:
    assert passed.status == "pass"
    assert 1e-4 < passed.metrics["waypoint_error_m"] < 2e-3
    assert passed.metrics["ik_error_m"] < 1e-4
    assert passed.thresholds["waypoint_error_m"] == 0.5 * scara().robot.approach_height
    assert passed.details == []


def test_jaws_that_stay_apart_are_named() -> None:
    loose = baseline("robot.gripper_closed=[0.03,0.03]", "robot.closed_width=0.044")
    line = "the jaws close to 60.0 mm around an object of 44.0 mm: robot.gripper_closed"
    assert line in loose.details
    assert line in loose.reason


def test_sag_is_compensated_or_named(tmp_path: Path) -> None:
    soft = arm_file(tmp_path, ('gravcomp="1"', ""), ('kp="5000" kv="140"', 'kp="500" kv="40"'))
    held = baseline(arm=soft)
    note = "gravity compensation on (robot.gravcomp=auto; auto: from 2 mm on); without it the hand"
    assert held.details[0] == f"robot's file: {note} sags 15.9 mm at home"
    assert held.status == "pass"
    sagged = baseline("robot.gravcomp=false", arm=soft)
    assert "gravity compensation off (robot.gravcomp=false" in sagged.details[0]
    assert sagged.metrics["waypoint_error_m"] > 0.015 > held.metrics["waypoint_error_m"]
    text = r"the arm is \d\d\.\d mm off its target as \w+ ends: lift is 0\.0\d+ m off; gravity:"
    assert re.search(f"{text} robot.gravcomp=true, or a stiffer servo", sagged.details[1])


def jam(model: mujoco.MjModel) -> None:
    model.dof_frictionloss[model.joint("shoulder").dofadr] = 200.0


def narrow(model: mujoco.MjModel) -> None:
    model.jnt_range[model.joint("shoulder").id] = [-0.9, -0.7]


def bound(model: mujoco.MjModel) -> None:
    model.actuator_ctrlrange[model.actuator("shoulder").id] = [-0.9, -0.7]


def weaken(model: mujoco.MjModel) -> None:
    model.body_gravcomp[:] = 0.0
    model.actuator_forcerange[model.actuator("lift").id] = [-6.0, 6.0]


@pytest.mark.parametrize(
    ("alter", "message"),
    few(
        [
            (jam, r"shoulder is 0\.\d+ rad off.*; dry friction holds it"),
            (bound, r"shoulder is 0\.\d+ rad off; its range bounds its target -?\d\.\d+ to -0"),
            (narrow, r"shoulder is 0\.\d+ rad off; its range bounds its target -?\d\.\d+ to -0"),
            (
                weaken,
                r"lift is 0\.\d+ m off at its servo's largest force, 6 N \(robot.servos.lift.eff",
            ),
        ],
        2,
    ),
)
def test_the_cause_is_named(
    alter: Callable[[mujoco.MjModel], None], message: str, monkeypatch: Patch
) -> None:
    result = altered_baseline(alter, monkeypatch)
    assert result.status == "fail"
    text = r"^(failed: .*; )?the arm is \d+\.\d mm off its target as \w+ ends: "
    assert re.search(text + message, result.reason)
    assert "waypoint_error_m" in result.beyond


@pytest.mark.full
def test_a_late_command_is_no_error_of_the_arm() -> None:
    """Neither one that lags by a constant nor one that lags by chance."""
    for delay in ("timing.command_delay=25", "timing.random_delay=40"):
        late = mjstack.verify([*RUN, delay]).gates["baseline"]
        assert late.metrics["waypoint_error_m"] < 0.03, late.reason
        assert late.status == "pass"
        assert "at the start" not in str(late.details)  # though the jaws touch the table there


def test_the_end_of_a_range_is_a_load() -> None:
    stage = Stage(scara("sim=native"))
    model, index = stage.model, stage.index
    model.actuator_ctrlrange[index.ctrl[0]] = [-3.0, 3.0]
    qpos, ctrl = model.qpos0.copy(), np.zeros(model.nu)
    qpos[index.robot_qpos] = ctrl[index.ctrl] = stage.cfg.robot.home
    qpos[index.robot_qpos[0]], ctrl[index.ctrl[0]] = 2.401, 2.5
    state = State(qpos[None], np.zeros((1, model.nv)), ctrl[None])
    cause = find_cause(stage, state, ctrl[index.ctrl])
    assert cause.startswith("shoulder is 0.099 rad off at its servo's largest force, 60 N m")
    assert "; it is at the end of its range (" in cause


@pytest.mark.full
def test_another_actuator_that_pulls_is_a_load(tmp_path: Path) -> None:
    """Here a tendon with a constant force, which no command reaches."""
    cable = """<general name="cable" tendon="belt" biastype="affine" biasprm="-30 0 0"/></actuator>
      <tendon><fixed name="belt"><joint joint="shoulder" coef="1"/><joint joint="elbow" coef="1"/>
      </fixed></tendon>"""
    result = baseline(arm=arm_file(tmp_path, ("</actuator>", cable)))
    line = (
        r"(elbow|shoulder) is .* rad off; actuator cable of the robot's file pulls at it \(30 N m\)"
    )
    assert result.status == "fail"
    assert re.search(line, result.reason)


POST = '<geom name="post" type="box" pos="POS" size="0.02 0.02 0.1" contype="1" conaffinity="1"/>'
BOOM = '<geom name="boom" pos="0.15 0 0" size="0.15 0.02 0.02" contype="1" conaffinity="1"/>'


def test_a_contact_that_holds_the_arm_is_named_and_excluded(tmp_path: Path) -> None:
    arm = '<joint name="shoulder" range="-2.4 2.4"/>'
    post = POST.replace("POS", "0.20 -0.07 0.41")
    file = arm_file(tmp_path, (arm, arm + BOOM), ("<worldbody>", f"<worldbody>{post}"))
    held = baseline(arm=file)
    assert held.status == "fail"
    assert "shoulder is 0." in held.reason
    assert "world's post" in held.reason
    assert "robot.exclude=[[world,inner_arm]]" in held.reason
    free = baseline("robot.exclude=[[world,inner_arm]]", arm=file)
    assert free.status == "pass"
    assert free.metrics["waypoint_error_m"] < 2e-3


def test_an_excluded_world_is_the_files_alone(tmp_path: Path) -> None:
    """The table still touches the pads, and the arm stands where it stood."""
    post = POST.replace("POS", "0.20 -0.07 0.41")
    file = arm_file(tmp_path, ("<worldbody>", f"<worldbody>{post}"))
    deep = ["scene.table_center=[0.41,0,0.03]", f"robot.file={file}"]
    plain = scara(*deep)
    cfg = scara("robot.exclude=[[world,left_finger],[inner_arm,world]]", *deep)
    bases, touching = [], []
    for c in (plain, cfg):
        model = build_model(c)
        bases.append(SceneIndex(model, c.robot, c.scene).base)
        data = mujoco.MjData(model)
        for name, value in zip(c.robot.joints, [-0.8, 1.6, 0.0, 0.0, 0.045, 0.045], strict=True):
            data.joint(name).qpos = value
        mujoco.mj_forward(model, data)
        touching.append({tuple(model.geom(g).name for g in pair.geom) for pair in data.contact})
    assert touching[0] == touching[1]
    assert ("table", "left_pad") in touching[1]
    assert bases[0] == bases[1]
    own = model.body("robot_world").id
    assert model.geom("post").bodyid[0] == own
    pairs = {tuple(divmod(int(s), 1 << 16)) for s in model.exclude_signature}
    assert pairs == {(own, model.body(name).id) for name in ("left_finger", "inner_arm")}


def test_a_start_inside_of_the_table_is_named() -> None:
    result = baseline(
        "robot.home=[-0.8,1.6,0.0,0.0,0.045,0.045]", "scene.table_center=[0.41,0,0.03]"
    )
    assert re.search(
        r"at the start left_finger presses on table, \d+\.\d mm deep: another", str(result.details)
    )


def test_exclude_and_gravcomp_take_names_and_words(tmp_path: Path) -> None:
    model = build_model(scara("robot.exclude=[[left_finger,right_finger],[world,hand]]"))
    pairs = [{model.body(n).name for n in divmod(int(s), 1 << 16)} for s in model.exclude_signature]
    assert pairs == [{"robot_world", "hand"}, {"left_finger", "right_finger"}]
    near = "robot.exclude: body 'left_fingr' does not exist. Did you mean 'left_finger'?"
    refusal(lambda: build_model(scara("robot.exclude=[[left_fingr,hand]]")), near)
    refusal(lambda: build_model(scara("robot.exclude=[[red,hand]]")), "robot.exclude: body 'red'")
    for pair in ("[hand]", "[hand,hand]", "[hand,world,base]", "hand,world"):
        refusal(
            lambda pair=pair: build_model(scara(f"robot.exclude=[{pair}]")),
            "expected pairs of bodies",
        )
    refusal(lambda: scara("robot.gravcomp=maybe"), "robot.gravcomp=maybe: expected one of auto")
    own = build_model(scara())
    assert build_model(scara("robot.gravcomp=true")).body_gravcomp.sum() == 7
    assert own.body_gravcomp.sum() == 6
    assert build_model(scara("robot.gravcomp=false")).body_gravcomp.sum() == 0
    file = arm_file(tmp_path, ('gravcomp="1"', ""))
    plain = scara(f"robot.file={file}")
    model = build_model(plain)  # 0.78 kg at 5,000 N/m: 1.6 mm
    assert model.body_gravcomp.sum() == 0
    np.testing.assert_allclose(gravity_sag(model, plain.robot), 0.81 * 9.81 / 5000.0)
