"""Checks values that types and ranges cannot: how they fit together."""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mjstack.config.fields import check_fields
from mjstack.config.functions import offered
from mjstack.config.schema import OUTPUTS, SHAPES, Config, GateCfg, SceneCfg, TermCfg
from mjstack.errors import ConfigError, require_names
from mjstack.files import MESHES

_DEVICE = re.compile(r"auto|cpu|cuda:\d+")
_DEVICES = re.compile(r"all|[1-9]\d*")
_WORLD = re.compile(r"([A-Za-z_]\w*:)?(\d+:)?\d+")

Checks = Iterator[tuple[str, bool, str]]  # a key, whether its value is wrong, and what is expected


def validate(cfg: Config) -> None:
    """Raise a `ConfigError` or `UnknownName` for the first value that cannot be used."""
    check_fields("", cfg)
    for check in (_run, _robot, _scene, _cameras, _phases, _gates):
        for key, invalid, expected in check(cfg):
            if invalid:
                raise ConfigError(key, _value(cfg, key), expected)


def reads_starts_file(reset: Mapping[str, TermCfg]) -> bool:
    """Whether worlds start as a file says."""
    return any(
        "path" in term.params and offered(term.func, "reads_file") for term in reset.values()
    )


def gate_reset(cfg: Config, gate: str) -> dict[str, TermCfg]:
    """Reset terms under which a gate of episodes plays."""
    reset = cfg.gate[gate].reset
    from_file = reads_starts_file(cfg.reset) and not reads_starts_file(reset)
    return cfg.reset if from_file or not reset else reset


def places_objects(term: TermCfg) -> bool:
    """Whether a reset term puts objects anywhere in a region, its parameter ``xy``."""
    return "xy" in term.params and bool(offered(term.func, "places_objects"))


def with_region(reset: Mapping[str, TermCfg], change: Callable[[Any], Any]) -> dict[str, TermCfg]:
    """Reset terms with other regions for the objects' starts: a function of the configured value,
    which no term has checked yet.
    """
    return {
        name: replace(term, params=term.params | {"xy": change(term.params["xy"])})
        if places_objects(term)
        else term
        for name, term in reset.items()
    }


def starts_midway(term: TermCfg) -> bool:
    """Whether a reset term starts worlds in the middle of an episode, which cannot be judged."""
    return bool(offered(term.func, "starts_midway"))


def _value(cfg: Config, key: str) -> Any:
    value: Any = cfg
    while key:
        if isinstance(value, GateCfg):
            value = vars(value) | value.added
        names = value if isinstance(value, dict) else dir(value)
        name = max((n for n in names if f"{key}.".startswith(f"{n}.")), key=len)  # it may have dots
        value = value[name] if isinstance(value, dict) else getattr(value, name)
        key = key[len(name) + 1 :]
    return list(value) if isinstance(value, dict) else value


def _run(cfg: Config) -> Checks:
    """Gates, device and step, and keys that only one job or one group reads."""
    known = cfg.gate.functions()
    yield "gates", not cfg.gates, f"at least one of {', '.join(known)}"
    require_names("gate", (*cfg.gates, *cfg.gate.added), known)  # a misspelt one has no function
    yield "sim.device", not _DEVICE.fullmatch(cfg.sim.device), "auto, cpu or cuda:N, such as cuda:0"
    step_dt = 1.0 / cfg.task.control_hz
    if not math.isclose(cfg.timing.step_dt, step_dt, rel_tol=1e-9):
        key = "timing.physics_dt x timing.decimation"
        expected = f"{step_dt:g} s, because task.control_hz={cfg.task.control_hz:g}"
        fix = (
            "Change both together, with timing.control_hz; a task that works at any rate sets none"
        )
        raise ConfigError(key, f"{cfg.timing.step_dt:g}", expected, fix)
    invalid = cfg.world is not None and not _WORLD.fullmatch(cfg.world)
    yield "world", invalid, "a world such as 17, or a seed and a world such as 3:17"
    for key in ("run", "world"):
        invalid = getattr(cfg, key) is not None and cfg.job.name != "replay"
        yield key, invalid, "null, because it is for job=replay alone. Add job=replay"
    invalid = cfg.devices is not None and not _DEVICES.fullmatch(cfg.devices)
    yield "devices", invalid, "all, or a number of GPUs of at least 1"
    expected = "null, because no policy drives the worlds. Add controller=policy"
    invalid = cfg.policy is not None and cfg.job.name != "export"
    invalid = invalid and not offered(cfg.controller.func, "plays_policy")
    yield "policy", invalid, expected
    resets = (cfg.reset, *(t.reset for t in cfg.gate.episodes().values()))
    invalid = cfg.starts is not None and not any(map(reads_starts_file, resets))
    yield "starts", invalid, "null, because no reset term reads it. Add reset=starts_file"


def _robot(cfg: Config) -> Checks:
    """The robot's lists have its joints' length, and its names are its joints'."""
    robot = cfg.robot
    grip = len(robot.gripper_joints)
    joints = len(robot.joints)
    lengths = {"home": joints, "start": joints, "gripper_open": grip, "gripper_closed": grip}
    for key, size in lengths.items():
        values = getattr(robot, key)
        invalid = values is not None and len(values) != size
        yield f"robot.{key}", invalid, f"{size} numbers, one per joint"
    invalid = abs(math.hypot(*robot.approach_axis) - 1.0) > 1e-3
    yield "robot.approach_axis", invalid, "a vector of length 1, such as [0, 0, -1]"
    for key in ("name", "menagerie_name", "menagerie_file"):  # they become paths
        path = Path(getattr(robot, key))
        invalid = path.is_absolute() or ".." in path.parts
        yield f"robot.{key}", invalid, "a name that does not lead out of a folder"
    yield "robot.base.quat", not any(robot.base.quat), "a rotation (w, x, y, z)"
    invalid = robot.file is not None and cfg.model.source == "menagerie"
    yield "robot.file", invalid, "null, because model=menagerie has its own. Add model=builtin"
    names = (*robot.ik_joints, *robot.locked)
    require_names("robot.ik_joints, robot.locked: arm joint", names, robot.arm_joints)
    require_names("robot.roll_joint: arm joint", [robot.roll_joint], robot.arm_joints)
    invalid = cfg.controller.yaw_alignment > 0.0 and robot.roll_joint is None
    yield "controller.yaw_alignment", invalid, "0, because robot.roll_joint is null"


def _scene(cfg: Config) -> Checks:
    """Objects and places are on the table; `scene.build` sees what they touch."""
    scene = cfg.scene
    needs_free = cfg.task.check is not None or any(map(places_objects, cfg.reset.values()))
    expected = "at least one object that is not fixed, for the check and for random starts"
    yield "scene.objects", needs_free and not scene.free, expected
    for name, object_cfg in scene.objects.items():
        key = f"scene.objects.{name}"
        made = bool(object_cfg.parts or object_cfg.file)
        invalid = (object_cfg.mass, object_cfg.density) == (None, None) and not object_cfg.fixed
        invalid &= object_cfg.file is None or object_cfg.file.lower().endswith(MESHES)
        yield f"{key}.mass", invalid, "a number [kg], or a density: it moves"
        invalid = object_cfg.density is not None and (
            object_cfg.mass is not None or object_cfg.fixed
        )
        yield f"{key}.density", invalid, "null, because it has a mass or is fixed"
        invalid = bool(object_cfg.file) and object_cfg.fixed and object_cfg.mass is not None
        yield f"{key}.mass", invalid, "null: masses of a fixture are its file's"
        invalid = bool(object_cfg.parts) and not object_cfg.fixed
        yield f"{key}.fixed", invalid, "true, because it has parts"
        invalid = bool(object_cfg.joints) and not (object_cfg.file and object_cfg.fixed)
        yield f"{key}.joints", invalid, "{}, because it is no fixture from a file"
        for joint, values in object_cfg.joints.items():
            if values.range is not None and not values.range[0] < values.range[1]:
                expected = "two numbers, the smaller one first"
                raise ConfigError(f"{key}.joints.{joint}.range", values.range, expected)
        shapes = [(key, object_cfg)] * (not made)
        for where, shape in shapes + [(f"{key}.parts.{n}", p) for n, p in object_cfg.parts.items()]:
            count, meaning = SHAPES[shape.shape]
            invalid = len(shape.size) != count
            yield f"{where}.size", invalid, f"{count} number{'s' * (count > 1)}: {meaning}"
            invalid = shape.quat is not None and (shape.yaw != 0.0 or not any(shape.quat))
            yield f"{where}.quat", invalid, "a rotation (w, x, y, z), or null with a yaw"
        if object_cfg.pos is not None:
            low = scene.table_top + object_cfg.half_height
            expected = f"a height of at least {low:.4f} m in the world, or xy alone"
            yield f"{key}.pos", not object_cfg.fixed and object_cfg.pos[2] < low - 1e-6, expected
        edge = 0.0 if object_cfg.fixed and made else object_cfg.footprint
        if object_cfg.shape == "box" and object_cfg.upright:
            edge = min(edge, *object_cfg.size[:2])
        if object_cfg.fixed and object_cfg.pos is not None:
            continue
        yield from _on_table(scene, f"{key}.xy", object_cfg.xy, (edge, edge))
    for name, place_cfg in scene.places.items():
        yield "scene.places", name in scene.objects, "names that no object has"
        yield from _on_table(scene, f"scene.places.{name}.xy", place_cfg.xy, place_cfg.random_xy)


def _on_table(scene: SceneCfg, key: str, xy: list[float], edge: Sequence[float]) -> Checks:
    for axis, name in enumerate("xy"):
        center = scene.table_center[axis]
        reach = scene.table_half[axis] - edge[axis]
        span = f"[{center - reach:.3f}, {center + reach:.3f}] m"
        invalid = abs(xy[axis] - center) > reach + 1e-9
        yield key, invalid, f"{name} within {span}, so that it is on the table"


def _cameras(cfg: Config) -> Checks:
    """Poses, rates and names of the cameras."""
    for name, camera in cfg.scene.cameras.items():
        invalid = not re.fullmatch(r"[a-z][a-z0-9_]*", name)
        yield "scene.cameras", invalid, "names of small letters, digits and _"
        key = f"scene.cameras.{name}"
        pose = camera.pose
        expected = f"a pose, because robot.wrist_camera of {cfg.robot.name} is null"
        yield f"{key}.pose", pose is None, expected
        assert pose is not None
        x, y, z = (b - a for a, b in zip(pose.pos, pose.target, strict=True))
        length = math.hypot(x, y, z)
        yield f"{key}.pose.target", length < 1e-6, "a point away from pos"
        a, b, c = pose.up
        side = math.hypot(y * c - z * b, z * a - x * c, x * b - y * a)
        invalid = side < 1e-3 * length * math.hypot(a, b, c) or not any(pose.up)
        yield f"{key}.pose.up", invalid, "a direction across that from pos to target"
        invalid = len(set(camera.outputs)) != len(camera.outputs) or not camera.outputs
        yield f"{key}.outputs", invalid, f"some of {', '.join(OUTPUTS)}, each once"
        steps = cfg.task.control_hz / (camera.rate or cfg.task.control_hz)
        invalid = steps < 1.0 - 1e-9 or not math.isclose(steps, round(steps), rel_tol=1e-9)
        expected = f"{cfg.task.control_hz:g} Hz over an integer, as that is the control rate"
        yield f"{key}.rate", invalid, expected


def _phases(cfg: Config) -> Checks:
    """The scripted phases, and how their targets are followed."""
    controller = cfg.controller
    gain = max(controller.posture_gain, controller.approach_gain)
    invalid = gain > 0 and controller.step_iterations < 4
    yield (
        "controller.step_iterations",
        invalid,
        "at least 4 with a posture_gain or an approach_gain",
    )
    phases = controller.phases
    exact = cfg.robot.closed_width is None and cfg.robot.gripper_closed is not None
    names = list(phases)
    known = [*cfg.scene.objects, *cfg.scene.places]
    observed: set[str | None] = {*cfg.scene.places, None}
    grasped = False
    for number, (name, phase) in enumerate(phases.items()):
        key = f"controller.phases.{name}"
        invalid = number == 0 and phase.anchor is None
        yield f"{key}.anchor", invalid, "an object or a place, as the phase is the first"
        expected = (
            "null, because robot.gripper_closed is for any object. Set robot.closed_width too"
        )
        yield f"{key}.width", exact and phase.width is not None, expected
        require_names(f"{key}.grasps: object that moves", [phase.grasps], cfg.scene.free)
        require_names(f"{key}.retry: phase", [phase.retry], phases)
        for role, source in (("anchor", phase.anchor), ("toward", phase.toward)):
            require_names(f"{key}.{role}: object or place", [source], known)
            invalid = not phase.observe and source not in observed
            # Looks at the driver, which loads torch, only where it may be wrong.
            feedback = any(cfg.gate[gate].reset for gate in cfg.episode_gates)
            invalid = invalid and (feedback or offered(controller.func, "measures"))
            expected = f"true here or before, as closed_loop does not know yet where {source} is"
            yield f"{key}.observe", invalid, expected
            observed.add(source)
        invalid = phase.level == "on_top" and not grasped
        yield f"{key}.level", invalid, "center or table, as no phase before grasps"
        grasped = grasped or phase.grasps is not None
        invalid = phase.align and (not grasped or phase.grasps is not None or phase.anchor is None)
        yield f"{key}.align", invalid, "false: no object is in the hand, or the phase has no anchor"
        if phase.retry is not None:
            expected = f"null, or {key}.grasps=OBJECT, whose empty grasp is tried again"
            yield f"{key}.retry", phase.grasps is None, expected
            later = names.index(phase.retry) > number
            yield f"{key}.retry", later, "this phase or one before it"
        steps = phase.seconds / cfg.timing.step_dt
        expected = f"a multiple of the step, {cfg.timing.step_dt:g} s"
        yield f"{key}.seconds", abs(steps - round(steps)) > 1e-6, expected


def _gates(cfg: Config) -> Checks:
    """Names in the gates' parameters, and seeds and region that fit random starts."""
    gate = cfg.gate
    phases = cfg.controller.phases
    require_names("gate.parity.states: phase", gate.parity.states.values(), phases)
    if phases:
        require_names("gate.throughput.from_phase: phase", [gate.throughput.from_phase], phases)
    invalid = gate.parity.images is not None and not cfg.scene.cameras
    expected = "null, because there are no cameras. Set cameras to those of that run"
    yield "gate.parity.images", invalid, expected
    for name, t in gate.episodes().items():
        from_file = bool(t.reset) and reads_starts_file(gate_reset(cfg, name))
        expected = "1, because with reset=starts_file worlds start alike under every seed"
        yield f"gate.{name}.seeds", from_file and t.seeds > 1, expected
