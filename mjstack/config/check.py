"""Checks values that types and ranges cannot: how they fit together."""

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjstack.config.fields import check_fields
from mjstack.config.functions import offered
from mjstack.config.schema import OUTPUTS, SHAPES, BoxCfg, Config, SceneCfg, TermCfg
from mjstack.errors import ConfigError, UnknownName

PARITY_FIELDS = ("qpos", "qvel", "xpos", "xquat", "site_xpos", "qfrc_actuator", "contact_count")
_DEVICE = re.compile(r"auto|cpu|cuda:\d+")
_DEVICES = re.compile(r"all|[1-9]\d*")
_WORLD = re.compile(r"((batch|success):)?((\d+:)?\d+|failing)")


def validate(cfg: Config) -> None:
    """Raise a `ConfigError` or `UnknownName` for the first value that cannot be used."""
    check_fields("", cfg)
    known = cfg.gate.functions()
    _refuse(not cfg.gates, cfg, "gates", f"at least one of {', '.join(known)}")
    for name in (*cfg.gates, *cfg.gate.added):  # a misspelt one has no function
        _require("gate", name, known)
    expected = "auto, cpu or cuda:N, such as cuda:0"
    _refuse(not _DEVICE.fullmatch(cfg.sim.device), cfg, "sim.device", expected)
    step_dt = 1.0 / cfg.task.control_hz
    if not math.isclose(cfg.timing.step_dt, step_dt, rel_tol=1e-9):
        raise ConfigError(
            "timing.physics_dt x timing.decimation",
            f"{cfg.timing.step_dt:g}",
            f"{step_dt:g} s, because task '{cfg.task.name}' is controlled at"
            f" {cfg.task.control_hz:g} Hz",
            "Change both together",
        )
    _jobs(cfg)
    _robot(cfg)
    _scene(cfg)
    _cameras(cfg)
    _phases(cfg)
    _gates(cfg)


def reads_starts_file(reset: Mapping[str, TermCfg]) -> bool:
    """Whether worlds start as a file says."""
    return any(
        "path" in term.params and offered(term.func, "reads_file") for term in reset.values()
    )


def places_objects(term: TermCfg) -> bool:
    """Whether a reset term puts objects anywhere in a region, its parameter ``xy``."""
    return "xy" in term.params and bool(offered(term.func, "places_objects"))


def starts_midway(term: TermCfg) -> bool:
    """Whether a reset term starts worlds in the middle of an episode, which cannot be judged."""
    return bool(offered(term.func, "starts_midway"))


def _require(what: str, name: str | None, known: Mapping | Sequence) -> None:
    if name is not None and name not in known:
        raise UnknownName(what, name, known)


def _refuse(wrong: bool, cfg: Config, key: str, expected: str) -> None:
    """Raise a `ConfigError` for the value of a key that is wrong."""
    if wrong:
        value: Any = cfg
        for name in key.split("."):
            value = value[name] if isinstance(value, dict) else getattr(value, name)
        value = list(value) if isinstance(value, dict) else value
        raise ConfigError(key, value, expected)


def _jobs(cfg: Config) -> None:
    """Keys that only one job or one group reads."""
    wrong = cfg.world is not None and not _WORLD.fullmatch(cfg.world)
    _refuse(wrong, cfg, "world", "a world such as 17, a seed and a world such as 3:17, or failing")
    for key in ("run", "world"):
        wrong = getattr(cfg, key) is not None and cfg.job.name != "replay"
        _refuse(wrong, cfg, key, "null, because it is for job=replay alone. Add job=replay")
    plays = cfg.controller.name == "policy" or cfg.job.name in ("play", "export")
    wrong = cfg.resume is not None and cfg.job.name != "gates"
    expected = "null, because it is for job=gates. Other jobs that can go on do so by themselves"
    _refuse(wrong, cfg, "resume", expected)
    wrong = cfg.devices is not None and not _DEVICES.fullmatch(cfg.devices)
    _refuse(wrong, cfg, "devices", "all, or a number of GPUs of at least 1")
    wrong = cfg.policy is not None and not plays
    expected = "null, because no policy drives the worlds. Add controller=policy"
    _refuse(wrong, cfg, "policy", expected)
    wrong = cfg.starts is not None and not reads_starts_file(cfg.reset)
    expected = "null, because no reset term reads it. Add reset=starts_file"
    _refuse(wrong, cfg, "starts", expected)


def _robot(cfg: Config) -> None:
    """The robot's lists have its joints' length, and its names are its joints'."""
    robot = cfg.robot
    grip = len(robot.gripper_joints)
    joints = len(robot.arm_joints) + grip
    lengths = {"home": joints, "start": joints, "gripper_open": grip, "gripper_closed": grip}
    for key, size in lengths.items():
        wrong = len(getattr(robot, key)) != size
        _refuse(wrong, cfg, f"robot.{key}", f"{size} numbers, one per joint")
    wrong = abs(math.hypot(*robot.approach_axis) - 1.0) > 1e-3
    _refuse(wrong, cfg, "robot.approach_axis", "a vector of length 1, such as [0, 0, -1]")
    for key in ("name", "menagerie_name", "menagerie_file"):  # they become paths
        path = Path(getattr(robot, key))
        wrong = path.is_absolute() or ".." in path.parts
        _refuse(wrong, cfg, f"robot.{key}", "a name that does not lead out of a folder")
    for name in (*robot.ik_joints, *robot.locked):
        _require("robot.ik_joints, robot.locked: arm joint", name, robot.arm_joints)
    _require("robot.roll_joint: arm joint", robot.roll_joint, robot.arm_joints)
    wrong = cfg.controller.yaw_alignment > 0.0 and robot.roll_joint is None
    _refuse(wrong, cfg, "controller.yaw_alignment", "0, because robot.roll_joint is null")


def _scene(cfg: Config) -> None:
    """Objects, places and the box are on the table and clear of each other."""
    scene = cfg.scene
    needs_free = cfg.task.check is not None or any(map(places_objects, cfg.reset.values()))
    expected = "at least one object that is not fixed, for the check and for random starts"
    _refuse(needs_free and not scene.free, cfg, "scene.objects", expected)
    for name, thing in scene.objects.items():
        key = f"scene.objects.{name}"
        count, words = SHAPES[thing.shape]
        expected = f"{count} number{'s' * (count > 1)}: {words}"
        _refuse(len(thing.size) != count, cfg, f"{key}.size", expected)
        edge = min(thing.size[:2]) if thing.shape == "box" else thing.footprint
        _on_table(scene, f"{key}.xy", thing.xy, (edge, edge))
    for name, place in scene.places.items():
        _refuse(name in scene.objects, cfg, "scene.places", "names that no object has")
        _on_table(scene, f"scene.places.{name}.xy", place.xy, place.random_xy)
    for (one, first), (other, second) in itertools.combinations(scene.objects.items(), 2):
        wrong = math.dist(first.xy, second.xy) < first.footprint + second.footprint
        expected = f"a position clear of {other}, which is at {second.xy}"
        _refuse(wrong, cfg, f"scene.objects.{one}.xy", expected)
    if scene.box is not None:
        _box(cfg, scene.box)


def _cameras(cfg: Config) -> None:
    """Poses, rates and names of the cameras."""
    for name, camera in cfg.scene.cameras.items():
        key = f"scene.cameras.{name}"
        wrong = not re.fullmatch(r"[a-z][a-z0-9_]*", name)
        _refuse(wrong, cfg, "scene.cameras", "names of small letters, digits and _")
        pose = camera.pose
        if pose is None:
            expected = f"a pose, because robot.wrist_camera of {cfg.robot.name} is null"
            raise ConfigError(f"{key}.pose", None, expected)
        along = [b - a for a, b in zip(pose.pos, pose.target, strict=True)]
        wrong = math.hypot(*along) < 1e-6
        _refuse(wrong, cfg, f"{key}.pose.target", "a point away from pos")
        x, y, z = along
        a, b, c = pose.up
        side = math.hypot(y * c - z * b, z * a - x * c, x * b - y * a)
        wrong = side < 1e-3 * math.hypot(*along) * math.hypot(*pose.up) or not any(pose.up)
        _refuse(wrong, cfg, f"{key}.pose.up", "a direction across that from pos to target")
        wrong = len(set(camera.outputs)) != len(camera.outputs) or not camera.outputs
        _refuse(wrong, cfg, f"{key}.outputs", f"some of {', '.join(OUTPUTS)}, each once")
        steps = cfg.task.control_hz / (camera.rate or cfg.task.control_hz)
        wrong = steps < 1.0 - 1e-9 or not math.isclose(steps, round(steps), rel_tol=1e-9)
        expected = f"{cfg.task.control_hz:g} Hz over an integer, as that is the control rate"
        _refuse(wrong, cfg, f"{key}.rate", expected)


def _on_table(scene: SceneCfg, key: str, xy: list[float], edge: Sequence[float]) -> None:
    for axis, name in enumerate("xy"):
        center = scene.table_center[axis]
        reach = scene.table_half[axis] - edge[axis]
        if abs(xy[axis] - center) > reach + 1e-9:
            low = center - reach
            expected = f"{name} within [{low:.3f}, {center + reach:.3f}] m, so that it is"
            raise ConfigError(key, xy, f"{expected} on the table")


def _box(cfg: Config, box: BoxCfg) -> None:
    expected = f"more than the floor's thickness, {box.floor:g} m"
    _refuse(box.height <= box.floor, cfg, "scene.box.height", expected)
    outer = [half + box.wall for half in box.half]
    _on_table(cfg.scene, "scene.box.center", box.center, outer)
    for name, thing in cfg.scene.objects.items():
        away = (abs(thing.xy[i] - box.center[i]) - outer[i] for i in (0, 1))
        wrong = all(a < half for a, half in zip(away, thing.half, strict=False))
        _refuse(wrong, cfg, f"scene.objects.{name}.xy", "a position beside the box")


def _phases(cfg: Config) -> None:
    """The scripted phases, and how their targets are followed."""
    controller = cfg.controller
    gain = max(controller.posture_gain, controller.approach_gain)
    wrong = gain > 0 and controller.step_iterations < 4
    expected = "at least 4 with a posture_gain or an approach_gain"
    _refuse(wrong, cfg, "controller.step_iterations", expected)

    # Each phase
    phases = controller.phases
    names = list(phases)
    closed_loop = controller.name == "closed_loop" or "success" in cfg.gates
    observed = set(cfg.scene.places)
    grasped = False
    for number, (name, phase) in enumerate(phases.items()):
        key = f"controller.phases.{name}"
        wrong = number == 0 and phase.anchor is None
        _refuse(wrong, cfg, f"{key}.anchor", "an object or a place, as the phase is the first")
        _require(f"{key}.grasps: object", phase.grasps, cfg.scene.objects)
        _require(f"{key}.retry: phase", phase.retry, phases)
        for role in ("anchor", "toward"):
            source = getattr(phase, role)
            if source is None:
                continue
            known = [*cfg.scene.objects, *cfg.scene.places]
            _require(f"{key}.{role}: object or place", source, known)
            expected = "true here or in a phase before, because controller=closed_loop does not"
            expected += f" know yet where {source} is"
            wrong = closed_loop and not phase.observe and source not in observed
            _refuse(wrong, cfg, f"{key}.observe", expected)
            observed.add(source)
        wrong = phase.level == "on_top" and not grasped
        _refuse(wrong, cfg, f"{key}.level", "center or table, as no phase before grasps")
        grasped = grasped or phase.grasps is not None
        if phase.retry is not None:
            expected = f"null, or {key}.grasps=OBJECT, whose empty grasp is tried again"
            _refuse(phase.grasps is None, cfg, f"{key}.retry", expected)
            later = names.index(phase.retry) > number
            _refuse(later, cfg, f"{key}.retry", "this phase or one before it")
        steps = phase.seconds / cfg.timing.step_dt
        expected = f"a multiple of the step, {cfg.timing.step_dt:g} s"
        _refuse(abs(steps - round(steps)) > 1e-6, cfg, f"{key}.seconds", expected)


def _gates(cfg: Config) -> None:
    """Names in the gates' parameters, and seeds and region that fit random starts."""
    gate = cfg.gate
    phases = cfg.controller.phases
    for name in gate.parity.states.values():
        _require("gate.parity.states: phase", name, phases)
    if phases:
        _require("gate.throughput.from_phase: phase", gate.throughput.from_phase, phases)
    for name in ("step1", "step50"):
        wrong = set(getattr(gate.parity, name)) != set(PARITY_FIELDS)
        expected = f"a number for each of {', '.join(PARITY_FIELDS)}"
        _refuse(wrong, cfg, f"gate.parity.{name}", expected)
    wrong = gate.parity.images is not None and not cfg.scene.cameras
    expected = "null, because there are no cameras. Set cameras to those of that run"
    _refuse(wrong, cfg, "gate.parity.images", expected)
    from_file = reads_starts_file(cfg.reset)
    expected = "1, because with reset=starts_file worlds start alike under every seed"
    _refuse(from_file and gate.success.seeds > 1, cfg, "gate.success.seeds", expected)
    # Looks at functions, which load torch, only where there is a region.
    wrong = gate.success.region is not None and (
        from_file or not any(map(places_objects, gate.success.reset.values()))
    )
    expected = "null, because no reset term of the success gate has a region"
    _refuse(wrong, cfg, "gate.success.region", expected)
