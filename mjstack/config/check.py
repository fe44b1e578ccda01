"""Checks values that types and ranges cannot: how they fit together."""

import itertools
import math
import re
from collections.abc import Mapping, Sequence

from mjstack.config.fields import check_fields
from mjstack.config.functions import offered
from mjstack.config.schema import SHAPES, BoxCfg, Config, SceneCfg, TermCfg
from mjstack.errors import ConfigError, UnknownName

PARITY_FIELDS = ("qpos", "qvel", "xpos", "xquat", "site_xpos", "qfrc_actuator", "contact_count")
_DEVICE = re.compile(r"auto|cpu|cuda:\d+")
_WORLD = re.compile(r"((batch|success):)?(\d+:)?\d+")


def validate(cfg: Config) -> None:
    """Raise a `ConfigError` or `UnknownName` for the first value that cannot be used."""
    check_fields("", cfg)
    known = cfg.gate.functions()
    _refuse(not cfg.gates, "gates", "[]", f"at least one of {', '.join(known)}")
    for name in (*cfg.gates, *cfg.gate.added):  # a misspelt one has no function
        _require("gate", name, known)
    _refuse(
        not _DEVICE.fullmatch(cfg.sim.device),
        "sim.device",
        cfg.sim.device,
        "auto, cpu or cuda:N, such as cuda:0",
    )
    step_dt = 1.0 / cfg.task.control_hz
    if not math.isclose(cfg.timing.step_dt, step_dt, rel_tol=1e-9):
        raise ConfigError(
            "timing.physics_dt x timing.decimation",
            f"{cfg.timing.step_dt:g}",
            f"{step_dt:g} s, because task '{cfg.task.name}' is controlled at"
            f" {cfg.task.control_hz:g} Hz",
            "Change both together",
        )
    _replay(cfg)
    _robot(cfg)
    needs_free = cfg.task.check is not None or any(map(places_objects, cfg.reset.values()))
    _refuse(
        needs_free and not cfg.scene.free,
        "scene.objects",
        list(cfg.scene.objects),
        "at least one object that is not fixed, for the check and for random starts",
    )
    _scene(cfg.scene)
    _phases(cfg)
    _gates(cfg)
    _success(cfg)


def reads_starts_file(reset: Mapping[str, TermCfg]) -> bool:
    """Whether worlds start as a file says."""
    return any(
        "path" in term.params and offered(term.func, "reads_file") for term in reset.values()
    )


def places_objects(term: TermCfg) -> bool:
    """Whether a reset term puts objects anywhere in a region, its parameter ``xy``."""
    return "xy" in term.params and bool(offered(term.func, "places_objects"))


def _require(what: str, name: str | None, known: Mapping | Sequence) -> None:
    if name is not None and name not in known:
        raise UnknownName(what, name, known)


def _refuse(wrong: bool, key: str, value: object, expected: str, fix: str = "") -> None:
    """Raise a `ConfigError` for a value that is wrong."""
    if wrong:
        raise ConfigError(key, value, expected, fix)


def _replay(cfg: Config) -> None:
    """Keys that only one job or one group reads."""
    _refuse(
        cfg.world is not None and not _WORLD.fullmatch(cfg.world),
        "world",
        cfg.world,
        "a world such as 17, or a seed and a world such as 3:17",
    )
    for key in ("run", "world"):
        _refuse(
            getattr(cfg, key) is not None and cfg.job.name != "replay",
            key,
            getattr(cfg, key),
            "null, because it is for job=replay alone",
            "Add job=replay",
        )
    _refuse(
        cfg.starts is not None and not reads_starts_file(cfg.reset),
        "starts",
        cfg.starts,
        "null, because no reset term reads it",
        "Add reset=starts_file",
    )


def _robot(cfg: Config) -> None:
    """The robot's lists have its joints' length, and its names are its joints'."""
    robot = cfg.robot
    grip = len(robot.gripper_joints)
    joints = len(robot.arm_joints) + grip
    lengths = {"home": joints, "start": joints, "gripper_open": grip, "gripper_closed": grip}
    for key, size in lengths.items():
        values = getattr(robot, key)
        _refuse(len(values) != size, f"robot.{key}", values, f"{size} numbers, one per joint")
    _refuse(
        abs(math.hypot(*robot.approach_axis) - 1.0) > 1e-3,
        "robot.approach_axis",
        robot.approach_axis,
        "a vector of length 1, such as [0, 0, -1]",
    )
    for name in (*robot.ik_joints, *robot.locked):
        _require("robot.ik_joints, robot.locked: arm joint", name, robot.arm_joints)
    _require("robot.roll_joint: arm joint", robot.roll_joint, robot.arm_joints)
    _refuse(
        cfg.controller.yaw_alignment > 0.0 and robot.roll_joint is None,
        "controller.yaw_alignment",
        cfg.controller.yaw_alignment,
        "0, because robot.roll_joint is null",
    )


def _scene(scene: SceneCfg) -> None:
    """Objects, places and the box are on the table and clear of each other."""
    for name, thing in scene.objects.items():
        key = f"scene.objects.{name}"
        count, words = SHAPES[thing.shape]
        _refuse(
            len(thing.size) != count,
            f"{key}.size",
            thing.size,
            f"{count} number{'s' * (count > 1)}: {words}",
        )
        edge = min(thing.size[:2]) if thing.shape == "box" else thing.footprint
        _on_table(scene, f"{key}.xy", thing.xy, (edge, edge))
    for name, place in scene.places.items():
        _refuse(name in scene.objects, f"scene.places.{name}", name, "a name that no object has")
        _on_table(scene, f"scene.places.{name}.xy", place.xy, place.random_xy)
    for (one, first), (other, second) in itertools.combinations(scene.objects.items(), 2):
        _refuse(
            math.dist(first.xy, second.xy) < first.footprint + second.footprint,
            f"scene.objects.{one}.xy",
            first.xy,
            f"a position clear of {other}, which is at {second.xy}",
        )
    if scene.box is not None:
        _box(scene, scene.box)


def _on_table(scene: SceneCfg, key: str, xy: list[float], edge: Sequence[float]) -> None:
    for axis, name in enumerate("xy"):
        center = scene.table_center[axis]
        reach = scene.table_half[axis] - edge[axis]
        if abs(xy[axis] - center) > reach + 1e-9:
            low = center - reach
            expected = f"{name} within [{low:.3f}, {center + reach:.3f}] m, so that it is"
            raise ConfigError(key, xy, f"{expected} on the table")


def _box(scene: SceneCfg, box: BoxCfg) -> None:
    _refuse(
        box.height <= box.floor,
        "scene.box.height",
        box.height,
        f"more than the floor's thickness, {box.floor:g} m",
    )
    outer = [half + box.wall for half in box.half]
    _on_table(scene, "scene.box.center", box.center, outer)
    for name, thing in scene.objects.items():
        away = (abs(thing.xy[i] - box.center[i]) - outer[i] for i in (0, 1))
        _refuse(
            all(a < half for a, half in zip(away, thing.half, strict=False)),
            f"scene.objects.{name}.xy",
            thing.xy,
            "a position beside the box",
        )


def _phases(cfg: Config) -> None:
    """The scripted phases, and how their targets are followed."""
    controller = cfg.controller
    gain = max(controller.posture_gain, controller.approach_gain)
    _refuse(
        gain > 0 and controller.step_iterations < 4,
        "controller.step_iterations",
        controller.step_iterations,
        "at least 4 with a posture_gain or an approach_gain",
    )

    # Each phase
    phases = controller.phases
    names = list(phases)
    closed_loop = controller.name == "closed_loop" or "success" in cfg.gates
    observed = set(cfg.scene.places)
    grasped = False
    for number, (name, phase) in enumerate(phases.items()):
        key = f"controller.phases.{name}"
        _require(f"{key}.grasps: object", phase.grasps, cfg.scene.objects)
        _require(f"{key}.retry: phase", phase.retry, phases)
        for role in ("anchor", "toward"):
            source = getattr(phase, role)
            if source is None:
                continue
            known = [*cfg.scene.objects, *cfg.scene.places]
            _require(f"{key}.{role}: object or place", source, known)
            if phase.observe:
                observed.add(source)
            elif closed_loop and source not in observed:
                expected = "true here or in a phase before, because controller=closed_loop does not"
                raise ConfigError(
                    f"{key}.observe", "false", f"{expected} know yet where {source} is"
                )
        _refuse(
            phase.level == "on_top" and not grasped,
            f"{key}.level",
            "on_top",
            "center or table, as no phase before grasps",
        )
        grasped = grasped or phase.grasps is not None
        _refuse(
            phase.retry is not None and phase.grasps is None,
            f"{key}.retry",
            phase.retry,
            f"null, or {key}.grasps=OBJECT, whose empty grasp is tried again",
        )
        _refuse(
            phase.retry is not None and names.index(phase.retry) > number,
            f"{key}.retry",
            phase.retry,
            "this phase or one before it",
        )
        steps = phase.seconds / cfg.timing.step_dt
        _refuse(
            abs(steps - round(steps)) > 1e-6,
            f"{key}.seconds",
            phase.seconds,
            f"a multiple of the step, {cfg.timing.step_dt:g} s",
        )

    # The first one
    for name in names[:1]:
        _refuse(
            phases[name].anchor is None, "controller.phases", name, "a first phase with an anchor"
        )


def _gates(cfg: Config) -> None:
    """Names of phases and fields in the gates' parameters."""
    gate = cfg.gate
    phases = cfg.controller.phases
    for name in gate.parity.states.values():
        _require("gate.parity.states: phase", name, phases)
    if phases:
        _require("gate.throughput.from_phase: phase", gate.throughput.from_phase, phases)
    for name in ("step1", "step50"):
        limits = getattr(gate.parity, name)
        _refuse(
            set(limits) != set(PARITY_FIELDS),
            f"gate.parity.{name}",
            list(limits),
            f"a number for each of {', '.join(PARITY_FIELDS)}",
        )


def _success(cfg: Config) -> None:
    """Seeds and region of the success gate fit its starts."""
    success = cfg.gate.success
    from_file = reads_starts_file(cfg.reset)
    _refuse(
        from_file and success.seeds > 1,
        "gate.success.seeds",
        success.seeds,
        "1, because with reset=starts_file worlds start alike under every seed",
    )
    _refuse(
        success.region is not None
        and (from_file or not any(map(places_objects, success.reset.values()))),
        "gate.success.region",
        success.region,
        "null, because no reset term of the success gate has a region",
    )
