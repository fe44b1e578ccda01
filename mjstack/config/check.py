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
        for key, wrong, expected in check(cfg):
            if wrong:
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
    wrong = cfg.world is not None and not _WORLD.fullmatch(cfg.world)
    yield "world", wrong, "a world such as 17, or a seed and a world such as 3:17"
    for key in ("run", "world"):
        wrong = getattr(cfg, key) is not None and cfg.job.name != "replay"
        yield key, wrong, "null, because it is for job=replay alone. Add job=replay"
    wrong = cfg.devices is not None and not _DEVICES.fullmatch(cfg.devices)
    yield "devices", wrong, "all, or a number of GPUs of at least 1"
    expected = "null, because no policy drives the worlds. Add controller=policy"
    wrong = cfg.policy is not None and cfg.job.name != "export"
    wrong = wrong and not offered(cfg.controller.func, "plays_policy")
    yield "policy", wrong, expected
    resets = (cfg.reset, *(t.reset for t in cfg.gate.episodes().values()))
    wrong = cfg.starts is not None and not any(map(reads_starts_file, resets))
    yield "starts", wrong, "null, because no reset term reads it. Add reset=starts_file"


def _robot(cfg: Config) -> Checks:
    """The robot's lists have its joints' length, and its names are its joints'."""
    robot = cfg.robot
    grip = len(robot.gripper_joints)
    joints = len(robot.joints)
    lengths = {"home": joints, "start": joints, "gripper_open": grip, "gripper_closed": grip}
    for key, size in lengths.items():
        values = getattr(robot, key)
        wrong = values is not None and len(values) != size
        yield f"robot.{key}", wrong, f"{size} numbers, one per joint"
    wrong = abs(math.hypot(*robot.approach_axis) - 1.0) > 1e-3
    yield "robot.approach_axis", wrong, "a vector of length 1, such as [0, 0, -1]"
    for key in ("name", "menagerie_name", "menagerie_file"):  # they become paths
        path = Path(getattr(robot, key))
        wrong = path.is_absolute() or ".." in path.parts
        yield f"robot.{key}", wrong, "a name that does not lead out of a folder"
    yield "robot.base.quat", not any(robot.base.quat), "a rotation (w, x, y, z)"
    wrong = robot.file is not None and cfg.model.source == "menagerie"
    yield "robot.file", wrong, "null, because model=menagerie has its own. Add model=builtin"
    names = (*robot.ik_joints, *robot.locked)
    require_names("robot.ik_joints, robot.locked: arm joint", names, robot.arm_joints)
    require_names("robot.roll_joint: arm joint", [robot.roll_joint], robot.arm_joints)
    wrong = cfg.controller.yaw_alignment > 0.0 and robot.roll_joint is None
    yield "controller.yaw_alignment", wrong, "0, because robot.roll_joint is null"


def _scene(cfg: Config) -> Checks:
    """Objects and places are on the table; `scene.build` sees what they touch."""
    scene = cfg.scene
    needs_free = cfg.task.check is not None or any(map(places_objects, cfg.reset.values()))
    expected = "at least one object that is not fixed, for the check and for random starts"
    yield "scene.objects", needs_free and not scene.free, expected
    for name, thing in scene.objects.items():
        key = f"scene.objects.{name}"
        made = bool(thing.parts or thing.file)
        wrong = (thing.mass, thing.density) == (None, None) and not thing.fixed
        wrong &= thing.file is None or thing.file.lower().endswith(MESHES)
        yield f"{key}.mass", wrong, "a number [kg], or a density: it moves"
        wrong = thing.density is not None and (thing.mass is not None or thing.fixed)
        yield f"{key}.density", wrong, "null, because it has a mass or is fixed"
        wrong = bool(thing.file) and thing.fixed and thing.mass is not None
        yield f"{key}.mass", wrong, "null: masses of a fixture are its file's"
        wrong = bool(thing.parts) and not thing.fixed
        yield f"{key}.fixed", wrong, "true, because it has parts"
        wrong = bool(thing.joints) and not (thing.file and thing.fixed)
        yield f"{key}.joints", wrong, "{}, because it is no fixture from a file"
        for joint, values in thing.joints.items():
            if values.range is not None and not values.range[0] < values.range[1]:
                expected = "two numbers, the smaller one first"
                raise ConfigError(f"{key}.joints.{joint}.range", values.range, expected)
        shapes = [(key, thing)] * (not made)
        for where, shape in shapes + [(f"{key}.parts.{n}", p) for n, p in thing.parts.items()]:
            count, words = SHAPES[shape.shape]
            wrong = len(shape.size) != count
            yield f"{where}.size", wrong, f"{count} number{'s' * (count > 1)}: {words}"
            wrong = shape.quat is not None and (shape.yaw != 0.0 or not any(shape.quat))
            yield f"{where}.quat", wrong, "a rotation (w, x, y, z), or null with a yaw"
        if thing.pos is not None:
            low = scene.table_top + thing.half_height
            expected = f"a height of at least {low:.4f} m in the world, or xy alone"
            yield f"{key}.pos", not thing.fixed and thing.pos[2] < low - 1e-6, expected
        edge = 0.0 if thing.fixed and made else thing.footprint
        if thing.shape == "box" and thing.upright:
            edge = min(edge, *thing.size[:2])
        if thing.fixed and thing.pos is not None:
            continue
        yield from _on_table(scene, f"{key}.xy", thing.xy, (edge, edge))
    for name, place in scene.places.items():
        yield "scene.places", name in scene.objects, "names that no object has"
        yield from _on_table(scene, f"scene.places.{name}.xy", place.xy, place.random_xy)


def _on_table(scene: SceneCfg, key: str, xy: list[float], edge: Sequence[float]) -> Checks:
    for axis, name in enumerate("xy"):
        center = scene.table_center[axis]
        reach = scene.table_half[axis] - edge[axis]
        span = f"[{center - reach:.3f}, {center + reach:.3f}] m"
        wrong = abs(xy[axis] - center) > reach + 1e-9
        yield key, wrong, f"{name} within {span}, so that it is on the table"


def _cameras(cfg: Config) -> Checks:
    """Poses, rates and names of the cameras."""
    for name, camera in cfg.scene.cameras.items():
        wrong = not re.fullmatch(r"[a-z][a-z0-9_]*", name)
        yield "scene.cameras", wrong, "names of small letters, digits and _"
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
        wrong = side < 1e-3 * length * math.hypot(a, b, c) or not any(pose.up)
        yield f"{key}.pose.up", wrong, "a direction across that from pos to target"
        wrong = len(set(camera.outputs)) != len(camera.outputs) or not camera.outputs
        yield f"{key}.outputs", wrong, f"some of {', '.join(OUTPUTS)}, each once"
        steps = cfg.task.control_hz / (camera.rate or cfg.task.control_hz)
        wrong = steps < 1.0 - 1e-9 or not math.isclose(steps, round(steps), rel_tol=1e-9)
        expected = f"{cfg.task.control_hz:g} Hz over an integer, as that is the control rate"
        yield f"{key}.rate", wrong, expected


def _phases(cfg: Config) -> Checks:
    """The scripted phases, and how their targets are followed."""
    controller = cfg.controller
    gain = max(controller.posture_gain, controller.approach_gain)
    wrong = gain > 0 and controller.step_iterations < 4
    yield "controller.step_iterations", wrong, "at least 4 with a posture_gain or an approach_gain"
    phases = controller.phases
    exact = cfg.robot.closed_width is None and cfg.robot.gripper_closed is not None
    names = list(phases)
    known = [*cfg.scene.objects, *cfg.scene.places]
    observed: set[str | None] = {*cfg.scene.places, None}
    grasped = False
    for number, (name, phase) in enumerate(phases.items()):
        key = f"controller.phases.{name}"
        wrong = number == 0 and phase.anchor is None
        yield f"{key}.anchor", wrong, "an object or a place, as the phase is the first"
        expected = (
            "null, because robot.gripper_closed is for any object. Set robot.closed_width too"
        )
        yield f"{key}.width", exact and phase.width is not None, expected
        require_names(f"{key}.grasps: object that moves", [phase.grasps], cfg.scene.free)
        require_names(f"{key}.retry: phase", [phase.retry], phases)
        for role, source in (("anchor", phase.anchor), ("toward", phase.toward)):
            require_names(f"{key}.{role}: object or place", [source], known)
            wrong = not phase.observe and source not in observed
            # Looks at the driver, which loads torch, only where it may be wrong.
            feedback = any(cfg.gate[gate].reset for gate in cfg.episode_gates)
            wrong = wrong and (feedback or offered(controller.func, "measures"))
            expected = f"true here or before, as closed_loop does not know yet where {source} is"
            yield f"{key}.observe", wrong, expected
            observed.add(source)
        wrong = phase.level == "on_top" and not grasped
        yield f"{key}.level", wrong, "center or table, as no phase before grasps"
        grasped = grasped or phase.grasps is not None
        wrong = phase.align and (not grasped or phase.grasps is not None or phase.anchor is None)
        yield f"{key}.align", wrong, "false: no object is in the hand, or the phase has no anchor"
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
    for name, t in gate.episodes().items():
        from_file = bool(t.reset) and reads_starts_file(gate_reset(cfg, name))
        expected = "1, because with reset=starts_file worlds start alike under every seed"
        yield f"gate.{name}.seeds", from_file and t.seeds > 1, expected
