"""Checks values that types cannot: ranges, lengths, names, and how they fit together."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from mjstack.config.schema import (
    BoxCfg,
    CollectJobCfg,
    Config,
    ReachabilityJobCfg,
    ScalingJobCfg,
    SceneCfg,
    SolverCfg,
    StudyJobCfg,
    TermCfg,
)
from mjstack.errors import ConfigError, UnknownName

GATES = ("baseline", "parity", "capacity", "batch", "throughput", "success")
JOBS = ("gates", "replay", "scaling", "study", "reachability", "collect")
CONDIMS = (1, 3, 4, 6)
SCALING_BACKENDS = ("mjwarp", "native")
SECTIONS = ("physics", "episode", "env_step")
ANCHORS = ("red", "blue", "on_blue", "over_red", "over_blue", "red_slot", "blue_slot")
PARITY_FIELDS = ("qpos", "qvel", "xpos", "xquat", "site_xpos", "qfrc_actuator", "contact_count")
BOX_ROLES = ("approach", "descend", "close", "lift", "carry", "hold", "open", "retreat", "settle")  # phases of each cube
_DEVICE = re.compile(r"auto|cpu|cuda:\d+")
_WORLD = re.compile(r"((batch|success):)?(\d+:)?\d+")


def validate(cfg: Config) -> None:
    """Raises a `ConfigError` or `UnknownName` for the first value that cannot be used."""
    _positive_int("nworld", cfg.nworld)
    if not 0 <= cfg.seed < 1 << 32:
        raise ConfigError("seed", cfg.seed, "an integer from 0 to 4294967295")
    if not cfg.gates:
        raise ConfigError("gates", "[]", f"at least one of {', '.join(GATES)}")
    for name in cfg.gates:
        if name not in GATES:
            raise UnknownName("gate", name, GATES)
    if cfg.job.name not in JOBS:
        raise UnknownName("job", cfg.job.name, JOBS)
    if cfg.world is not None and not _WORLD.fullmatch(cfg.world):
        raise ConfigError("world", cfg.world, "a world such as 17, or a seed and a world such as 3:17")
    for key in ("run", "world"):
        if getattr(cfg, key) is not None and cfg.job.name != "replay":
            raise ConfigError(key, getattr(cfg, key), "null, because it is for job=replay alone", "Add job=replay")
    if cfg.layout is not None and not reads_layout(cfg.reset):
        raise ConfigError("layout", cfg.layout, "null, because no reset term reads it", "Add reset=layout")
    if not _DEVICE.fullmatch(cfg.sim.device):
        raise ConfigError("sim.device", cfg.sim.device, "auto, cpu or cuda:N")
    _timing(cfg)
    _solver_and_batch(cfg)
    _robot(cfg)
    _scene(cfg)
    _controller(cfg)
    _gates(cfg)
    _success(cfg)
    if isinstance(cfg.job, ScalingJobCfg):
        _scaling(cfg.job)
    if isinstance(cfg.job, StudyJobCfg):
        _study(cfg.job)
    if isinstance(cfg.job, ReachabilityJobCfg):
        _positive("job.step", cfg.job.step, "m")
        _not_negative("job.margin", cfg.job.margin, "m")
    if isinstance(cfg.job, CollectJobCfg):
        _positive_int("job.episodes", cfg.job.episodes)
        _positive("job.buffer_gib", cfg.job.buffer_gib, "GiB")
        if cfg.job.folder is not None and not cfg.job.folder.strip():
            raise ConfigError("job.folder", "''", "a folder, or null for outputs/collect/<hash>")


def reads_layout(reset: Mapping[str, TermCfg]) -> bool:
    """Whether worlds start as a file says."""
    return any(term.func.endswith(".FromLayout") for term in reset.values())


def places_cubes(term: TermCfg) -> bool:
    """Whether a reset term puts cubes anywhere in a region, its parameter ``xy``."""
    return term.func.endswith(".RandomizeCubes")


def _timing(cfg: Config) -> None:
    _positive("timing.physics_dt", cfg.timing.physics_dt, "s")
    _positive_int("timing.substeps", cfg.timing.substeps)
    _positive("task.control_hz", cfg.task.control_hz, "Hz")
    _positive_int("task.episode_frames", cfg.task.episode_frames)
    wanted = 1.0 / cfg.task.control_hz
    if not math.isclose(cfg.timing.frame_dt, wanted, rel_tol=1e-9):
        raise ConfigError(
            "timing.physics_dt x timing.substeps",
            f"{cfg.timing.frame_dt:g}",
            f"{wanted:g} s, because task '{cfg.task.name}' is controlled at {cfg.task.control_hz:g} Hz",
            "Change both together",
        )


def _solver_and_batch(cfg: Config) -> None:
    for name in ("nconmax", "naconmax", "njmax", "nccdmax", "naccdmax"):
        value = getattr(cfg.batch, name)
        if value is not None:
            _positive_int(f"batch.{name}", value)
    _solver("solver", cfg.solver)


def _solver(key: str, solver: SolverCfg) -> None:
    for name in ("iterations", "ls_iterations"):
        value = getattr(solver, name)
        if value is not None:
            _positive_int(f"{key}.{name}", value)
    for name in ("impratio", "tolerance"):
        value = getattr(solver, name)
        if value is not None:
            _positive(f"{key}.{name}", value)
    if solver.gripper_condim is not None and solver.gripper_condim not in CONDIMS:
        raise ConfigError(f"{key}.gripper_condim", solver.gripper_condim, "1, 3, 4, 6, or null for the model's own")


def _study(job: StudyJobCfg) -> None:
    _positive_int("job.repetitions", job.repetitions)
    _positive_int("job.frames", job.frames)
    _positive("job.max_seconds", job.max_seconds, "s")
    if not job.variants:
        raise ConfigError("job.variants", "{}", "at least one variant of the solver")
    for name, variant in job.variants.items():
        _solver(f"job.variants.{name}", variant)


def _robot(cfg: Config) -> None:
    robot = cfg.robot
    n_arm, n_grip = len(robot.arm_joints), len(robot.gripper_joints)
    _length("robot.home", robot.home, n_arm + n_grip)
    _length("robot.start", robot.start, n_arm + n_grip)
    _length("robot.gripper_open", robot.gripper_open, n_grip)
    _length("robot.gripper_closed", robot.gripper_closed, n_grip)
    _length("robot.aperture_sites", robot.aperture_sites, 2)
    _length("robot.approach_axis", robot.approach_axis, 3)
    if abs(math.hypot(*robot.approach_axis) - 1.0) > 1e-3:
        raise ConfigError("robot.approach_axis", robot.approach_axis, "a vector of length 1, such as [0, 0, -1]")
    for key, names in (
        ("robot.ik_joints", robot.ik_joints),
        ("robot.locked", list(robot.locked)),
        ("robot.roll_joint", [robot.roll_joint]),
    ):
        for name in names:
            if name not in robot.arm_joints:
                raise UnknownName(f"{key}: arm joint", name, robot.arm_joints)
    if set(robot.ik_joints) & set(robot.locked):
        raise ConfigError("robot.locked", list(robot.locked), "joints that robot.ik_joints does not move")
    _length("robot.locked", list(robot.locked.values()), len(robot.locked))
    if robot.arm_force_limit is not None:
        _positive("robot.arm_force_limit", robot.arm_force_limit, "N m")
    _positive("robot.approach_height", robot.approach_height, "m")
    _not_negative("robot.finger_room", robot.finger_room, "m")
    if cfg.scene.name not in robot.layouts:
        raise UnknownName(f"robot.layouts of {robot.name}: scene", cfg.scene.name, robot.layouts)


def _scene(cfg: Config) -> None:
    scene = cfg.scene
    for key, size in (("table_center", 3), ("table_half", 3), ("table_friction", 3), ("cube_friction", 3)):
        _length(f"scene.{key}", getattr(scene, key), size)
    _positive("scene.cube_half", scene.cube_half, "m")
    _positive("scene.cube_mass", scene.cube_mass, "kg")
    for key in ("table_half", "table_friction", "cube_friction"):
        for number in getattr(scene, key):
            _positive(f"scene.{key}", number)
    for key in ("red_xy", "blue_xy"):
        value = getattr(scene, key)
        _length(f"scene.{key}", value, 2)
        for axis in (0, 1):
            reach = scene.table_half[axis] - scene.cube_half
            if not abs(value[axis] - scene.table_center[axis]) <= reach:
                low, high = scene.table_center[axis] - reach, scene.table_center[axis] + reach
                raise ConfigError(
                    f"scene.{key}",
                    value,
                    f"{'xy'[axis]} within [{low:.3f}, {high:.3f}] m, so that the cube is on the table",
                )
    _length("scene.random_xy", scene.random_xy, 2)
    for number in scene.random_xy:
        _not_negative("scene.random_xy", number, "m")
    apart = math.dist(scene.red_xy, scene.blue_xy)
    if not apart >= 2.0 * math.sqrt(2.0) * scene.cube_half:
        raise ConfigError("scene.red_xy", scene.red_xy, f"a cube that does not touch the blue one at {scene.blue_xy}")
    if scene.box is not None:
        _box(scene, scene.box)


def _box(scene: SceneCfg, box: BoxCfg) -> None:
    for key, size in (("center", 2), ("half", 2), ("friction", 3), ("floor_solref", 2), ("wall_solref", 2)):
        _length(f"scene.box.{key}", getattr(box, key), size)
    for name in ("floor", "wall", "height"):
        _positive(f"scene.box.{name}", getattr(box, name), "m")
    for key in ("half", "friction"):
        for number in getattr(box, key):
            _positive(f"scene.box.{key}", number)
    if not box.height > box.floor:
        raise ConfigError("scene.box.height", box.height, f"more than the floor's thickness, {box.floor:g} m")
    for key in ("floor_solref", "wall_solref"):
        first, second = getattr(box, key)
        if not (min(first, second) > 0.0 or max(first, second) < 0.0):
            expected = "a time constant [s] and a damping ratio, or stiffness and damping as two negative numbers"
            raise ConfigError(f"scene.box.{key}", getattr(box, key), expected)
    outer = [half + box.wall for half in box.half]
    for axis in (0, 1):
        if not abs(box.center[axis] - scene.table_center[axis]) + outer[axis] <= scene.table_half[axis] + 1e-9:
            raise ConfigError("scene.box.center", box.center, "a box that is on the table with all its walls")
    for key in ("red_xy", "blue_xy"):
        xy = getattr(scene, key)
        if not any(abs(xy[i] - box.center[i]) >= outer[i] + scene.cube_half for i in (0, 1)):
            raise ConfigError(f"scene.{key}", xy, "a cube beside the box")
    for key in ("red_slot", "blue_slot"):
        slot = getattr(scene, key)
        _length(f"scene.{key}", slot or [], 2)
        if not all(abs(slot[i] - box.center[i]) <= box.half[i] - scene.cube_half for i in (0, 1)):
            raise ConfigError(f"scene.{key}", slot, "a place in the box")


def _controller(cfg: Config) -> None:
    names, watches = list(cfg.controller.phases), cfg.controller.name == "scripted" or "success" in cfg.gates
    looked: set[str] = set()
    for number, (name, phase) in enumerate(cfg.controller.phases.items()):
        key = f"controller.phases.{name}"
        if phase.anchor is not None and phase.anchor not in ANCHORS:
            raise UnknownName(f"{key}.anchor:", phase.anchor, ANCHORS)
        if phase.anchor in ("red_slot", "blue_slot") and getattr(cfg.scene, phase.anchor) is None:
            raise ConfigError(f"{key}.anchor", phase.anchor, f"an anchor of scene {cfg.scene.name}, which has no box")
        if phase.gripper not in ("open", "closed"):
            raise ConfigError(f"{key}.gripper", phase.gripper, "open or closed")
        _positive(f"{key}.seconds", phase.seconds, "s")
        for part in ("h_scale", "offset"):
            if not math.isfinite(getattr(phase, part)):
                raise ConfigError(f"{key}.{part}", getattr(phase, part), "a finite number")
        if phase.grasps not in (None, "red", "blue"):
            raise ConfigError(f"{key}.grasps", phase.grasps, "red, blue or null")
        if phase.retry is not None and phase.retry not in cfg.controller.phases:
            raise UnknownName(f"{key}.retry: phase", phase.retry, cfg.controller.phases)
        cube = {"on_blue": "blue", "over_red": "red", "over_blue": "blue"}.get(phase.anchor or "", phase.anchor)
        if cube in ("red", "blue"):
            if phase.look:
                looked.add(cube)
            elif watches and cube not in looked:
                expected = f"true here or in a phase before, because controller=scripted does not know yet where {cube} is"
                raise ConfigError(f"{key}.look", "false", expected)
        if phase.retry is not None and phase.grasps is None:
            raise ConfigError(
                f"{key}.retry", phase.retry, f"null, or {key}.grasps=red or blue, whose empty grasp is tried again"
            )
        if phase.retry is not None and names.index(phase.retry) > number:
            raise ConfigError(f"{key}.retry", phase.retry, "this phase or one before it")
        frames = phase.seconds / cfg.timing.frame_dt
        if abs(frames - round(frames)) > 1e-6:
            raise ConfigError(f"{key}.seconds", phase.seconds, f"a multiple of the frame, {cfg.timing.frame_dt:g} s")
    if next(iter(cfg.controller.phases.values())).anchor is None:
        raise ConfigError("controller.phases", next(iter(cfg.controller.phases)), "a first phase with an anchor")
    if cfg.controller.knots < 3:
        raise ConfigError("controller.knots", cfg.controller.knots, "at least 3")
    _positive("controller.ik_tolerance", cfg.controller.ik_tolerance, "m")
    _positive_int("controller.ik_iterations", cfg.controller.ik_iterations)
    _positive_int("controller.frame_iterations", cfg.controller.frame_iterations)
    for key in ("posture_gain", "approach_gain", "align"):
        if not 0.0 <= getattr(cfg.controller, key) <= 1.0:
            raise ConfigError(f"controller.{key}", getattr(cfg.controller, key), "a share from 0 to 1")
    if max(cfg.controller.posture_gain, cfg.controller.approach_gain) > 0.0 and cfg.controller.frame_iterations < 4:
        expected = "at least 4 with a posture_gain or an approach_gain, which the last iterations make up for"
        raise ConfigError("controller.frame_iterations", cfg.controller.frame_iterations, expected)
    _not_negative("controller.rest_seconds", cfg.controller.rest_seconds, "s")
    if not (math.isfinite(cfg.controller.hurry) and cfg.controller.hurry >= 1.0):
        raise ConfigError("controller.hurry", cfg.controller.hurry, "a number of at least 1")


def _gates(cfg: Config) -> None:
    gate, phases = cfg.gate, cfg.controller.phases
    named = [("gate.parity.states", name) for name in gate.parity.states.values()]
    if cfg.task.evidence.endswith(".StackEvidence"):
        named += [("gate.acceptance.carry_phase", gate.acceptance.carry_phase)]
        named += [("gate.acceptance.lift_phases", name) for name in gate.acceptance.lift_phases]
    if cfg.task.evidence.endswith(".BoxEvidence"):
        if cfg.scene.box is None:
            raise ConfigError("scene", cfg.scene.name, "a scene with a box, for task.evidence BoxEvidence", "Set scene=box")
        named += [("task.evidence", f"{role}_{cube}") for cube in ("red", "blue") for role in BOX_ROLES]
    named += [("gate.throughput.from_phase", gate.throughput.from_phase)]
    for key, name in named:
        if name not in phases:
            raise UnknownName(f"{key}: phase", name, phases)
    frames = sum(round(phase.seconds / cfg.timing.frame_dt) for phase in phases.values())
    if not 2 <= gate.acceptance.window <= frames:
        raise ConfigError("gate.acceptance.window", gate.acceptance.window, f"2 to {frames} frames (the episode)")
    for name in ("lift_frames", "carry_frames"):
        _positive_int(f"gate.acceptance.{name}", getattr(gate.acceptance, name))
    for name in ("carry_distance", "xy_err", "support_gap", "rest_speed", "rest_position", "rest_rotation_deg"):
        _positive(f"gate.acceptance.{name}", getattr(gate.acceptance, name))
    for name in ("grasp_frames", "lift_frames", "carry_frames"):
        _positive_int(f"gate.box.{name}", getattr(gate.box, name))
    for name in ("force", "lift_height", "carry_distance", "rest_speed", "jaw_clearance"):
        _positive(f"gate.box.{name}", getattr(gate.box, name))
    if not 1 <= gate.box.window <= frames:
        raise ConfigError("gate.box.window", gate.box.window, f"1 to {frames} frames (the episode)")
    if not 0.0 < gate.box.open_fraction <= 1.0:
        raise ConfigError("gate.box.open_fraction", gate.box.open_fraction, "a number above 0 and up to 1")
    if not (math.isfinite(gate.box.inside) and gate.box.inside >= 0.0):
        raise ConfigError("gate.box.inside", gate.box.inside, "a number that is not negative [m]")
    _positive_int("gate.batch.seeds", gate.batch.seeds)
    if cfg.seed + gate.batch.seeds > 1 << 32:
        raise ConfigError("gate.batch.seeds", gate.batch.seeds, f"at most {(1 << 32) - cfg.seed}, because seeds are 32-bit")
    if gate.batch.failed_worlds < 0:
        raise ConfigError("gate.batch.failed_worlds", gate.batch.failed_worlds, "an integer of at least 0")
    for name in ("step1", "step50"):
        limits = getattr(gate.parity, name)
        for field in limits:
            if field not in PARITY_FIELDS:
                raise UnknownName(f"gate.parity.{name}: field", field, PARITY_FIELDS)
        for field in PARITY_FIELDS:
            if not (field in limits and math.isfinite(limits[field]) and limits[field] >= 0.0):
                raise ConfigError(f"gate.parity.{name}.{field}", limits.get(field), "a number that is not negative")
    for name in ("cpu_nworld", "probe_nworld", "probe_frames"):
        _positive_int(f"gate.capacity.{name}", getattr(gate.capacity, name))
    if gate.capacity.random_frames is not None:
        _positive_int("gate.capacity.random_frames", gate.capacity.random_frames)
    if not (math.isfinite(gate.capacity.margin) and gate.capacity.margin >= 1.0):
        raise ConfigError("gate.capacity.margin", gate.capacity.margin, "a number of at least 1, such as 1.25")
    for name in ("repetitions", "frames", "env_frames", "start_worlds"):
        _positive_int(f"gate.throughput.{name}", getattr(gate.throughput, name))
    for name in ("max_seconds", "cpu_max_seconds"):
        _positive(f"gate.throughput.{name}", getattr(gate.throughput, name), "s")
    if not gate.throughput.sections:
        raise ConfigError("gate.throughput.sections", "[]", f"at least one of {', '.join(SECTIONS)}")
    for name in gate.throughput.sections:
        if name not in SECTIONS:
            raise UnknownName("gate.throughput.sections: section", name, SECTIONS)


def _success(cfg: Config) -> None:
    t = cfg.gate.success
    from_file = reads_layout(cfg.reset)
    _positive_int("gate.success.seeds", t.seeds)
    if cfg.seed + t.seeds > 1 << 32:
        raise ConfigError("gate.success.seeds", t.seeds, f"at most {(1 << 32) - cfg.seed}, because seeds are 32-bit")
    if from_file and t.seeds > 1:
        raise ConfigError("gate.success.seeds", t.seeds, "1, because with reset=layout worlds start alike under every seed")
    if not 0.0 <= t.rate <= 1.0:
        raise ConfigError("gate.success.rate", t.rate, "a share from 0 to 1")
    _positive("gate.success.cell", t.cell, "m")
    if not 0.0 < t.yaw_cell_deg <= 90.0:
        raise ConfigError("gate.success.yaw_cell_deg", t.yaw_cell_deg, "degrees, more than 0 and at most 90")
    for name in ("cell_episodes", "worst_regions"):
        _positive_int(f"gate.success.{name}", getattr(t, name))
    if t.region is None:
        return
    _length("gate.success.region", t.region, 2)
    if from_file:
        raise ConfigError("gate.success.region", t.region, "null, because reset=layout says where cubes start")
    if not any(places_cubes(term) for term in t.reset.values()):
        raise ConfigError("gate.success.region", t.region, "null, because no term of gate.success.reset has a region")
    scene = cfg.scene
    for axis in (0, 1):
        # A cube of any yaw is a disc of half its diagonal.
        room = scene.table_half[axis] - math.sqrt(2.0) * scene.cube_half
        most = min(room - abs(place[axis] - scene.table_center[axis]) for place in (scene.red_xy, scene.blue_xy))
        if not 0.0 <= t.region[axis] <= most:
            raise ConfigError(
                "gate.success.region",
                t.region,
                f"half-widths that leave both cubes on the table, {'xy'[axis]} from 0 to {max(most, 0.0):.3f} m",
            )


def _scaling(job: ScalingJobCfg) -> None:
    if not job.nworlds or len(set(job.nworlds)) < len(job.nworlds):
        raise ConfigError("job.nworlds", job.nworlds, "at least one number of worlds, each once")
    for nworld in job.nworlds:
        _positive_int("job.nworlds", nworld)
    for name in job.backends or ():
        if name not in SCALING_BACKENDS:
            raise UnknownName("job.backends: backend", name, SCALING_BACKENDS)
    if job.backends is not None and not job.backends:
        raise ConfigError("job.backends", "[]", f"null, or at least one of {', '.join(SCALING_BACKENDS)}")
    for key in ("repetitions", "large", "repetitions_large", "native_frames", "native_env_frames"):
        _positive_int(f"job.{key}", getattr(job, key))
    _positive("job.case_minutes", job.case_minutes, "min")
    if job.max_minutes is not None:
        _positive("job.max_minutes", job.max_minutes, "min")


def _positive_int(key: str, value: int) -> None:
    if value < 1:
        raise ConfigError(key, value, "an integer of at least 1")


def _positive(key: str, value: float, unit: str = "") -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise ConfigError(key, value, f"a positive number{f' [{unit}]' if unit else ''}")


def _not_negative(key: str, value: float, unit: str = "") -> None:
    if not (math.isfinite(value) and value >= 0.0):
        raise ConfigError(key, value, f"a number that is not negative{f' [{unit}]' if unit else ''}")


def _length(key: str, value: list, size: int) -> None:
    if len(value) != size:
        raise ConfigError(key, value, f"{size} numbers or names")
    if any(isinstance(item, float) and not math.isfinite(item) for item in value):
        raise ConfigError(key, value, "finite numbers")
