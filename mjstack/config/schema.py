"""The configuration as dataclasses: one per group, and `Config`, which the library receives.

Hydra merges `conf/` into these types, so that a misspelt key or a value of the wrong type is an error before anything runs.
Lengths are in m, angles in rad, times in s. Values live in `conf/`, not here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from omegaconf import MISSING


class ModelSource(Enum):
    """Where the robot description comes from."""

    builtin = "builtin"
    menagerie = "menagerie"


class Backend(Enum):
    """Which physics engine steps the worlds of batch and throughput."""

    auto = "auto"
    native = "native"
    mjwarp = "mjwarp"


class GraphMode(Enum):
    """Whether MJWarp's substeps are captured into a graph and replayed."""

    auto = "auto"
    require = "require"
    off = "off"


class Cone(Enum):
    """Shape of the friction cone."""

    elliptic = "elliptic"
    pyramidal = "pyramidal"


@dataclass(kw_only=True, slots=True)
class LayoutCfg:
    """Where a scene's objects stand for one robot, and the buffer sizes its contacts need.

    ``random_xy`` is how far ``reset=randomized`` moves each cube off its place in x and y. ``nconmax`` and ``njmax`` are for
    the scripted task, ``env_nconmax`` and ``env_njmax`` for random actions. A scene with a box has a ``home`` of its own, clear
    of it.
    """

    table_center: list[float] = MISSING
    table_half: list[float] = MISSING
    red_xy: list[float] = MISSING
    blue_xy: list[float] = MISSING
    random_xy: list[float] = MISSING
    box_center: list[float] | None = None
    red_slot: list[float] | None = None
    blue_slot: list[float] | None = None
    grasp_offset: float = 0.0
    home: list[float] | None = None
    nconmax: int = MISSING
    njmax: int = MISSING
    env_nconmax: int = MISSING
    env_njmax: int = MISSING


@dataclass(kw_only=True, slots=True)
class RobotCfg:
    """An arm: names of its parts and the commands of the task.

    ``home`` is where the scripted task starts; ``start`` is clear of the table, for environments. ``finger_room`` is what the
    open jaws need around a cube.
    """

    name: str = MISSING
    title: str = MISSING
    menagerie_name: str = MISSING
    menagerie_file: str = MISSING
    arm_joints: list[str] = MISSING
    gripper_joints: list[str] = MISSING
    home: list[float] = MISSING
    start: list[float] = MISSING
    gripper_open: list[float] = MISSING
    gripper_closed: list[float] = MISSING
    ik_joints: list[str] = MISSING
    locked: dict[str, float] = MISSING
    arm_force_limit: float | None = None
    aperture_sites: list[str] = MISSING
    aperture_geoms: dict[str, list[str]] = field(default_factory=dict)
    aperture_bodies: dict[str, str] = field(default_factory=dict)
    approach_body: str = MISSING
    approach_axis: list[float] = MISSING
    jaw_bodies: list[str] = MISSING
    replace_collision: bool = False
    roll_joint: str = MISSING
    posture_gain: float = MISSING
    approach_gain: float = MISSING
    align: float = MISSING
    approach_height: float = MISSING
    finger_room: float = MISSING
    layouts: dict[str, LayoutCfg] = MISSING


@dataclass(kw_only=True, slots=True)
class ModelCfg:
    """Source of the robot description."""

    source: ModelSource = MISSING


@dataclass(kw_only=True, slots=True)
class BoxCfg:
    """A receiving box on the table: a floor and four walls, fixed to the world.

    ``center`` and ``half`` are of its inside, in x and y. Walls stand on the table around the floor; ``height`` is their rim's
    above the table.
    """

    center: list[float] = MISSING
    half: list[float] = MISSING
    floor: float = MISSING
    wall: float = MISSING
    height: float = MISSING
    friction: list[float] = MISSING
    floor_solref: list[float] = MISSING
    wall_solref: list[float] = MISSING


@dataclass(kw_only=True, slots=True)
class SceneCfg:
    """Table and cubes, and perhaps a box."""

    name: str = MISSING
    table_center: list[float] = MISSING
    table_half: list[float] = MISSING
    table_friction: list[float] = MISSING
    red_xy: list[float] = MISSING
    blue_xy: list[float] = MISSING
    random_xy: list[float] = MISSING
    cube_half: float = MISSING
    cube_mass: float = MISSING
    cube_friction: list[float] = MISSING
    # A box, the cubes' places in it, and how far above a cube's centre it is held.
    box: BoxCfg | None = None
    red_slot: list[float] | None = MISSING  # OmegaConf cannot merge an interpolation into null
    blue_slot: list[float] | None = MISSING
    grasp_offset: float = 0.0


@dataclass(kw_only=True, slots=True)
class TimingCfg:
    """Physics step and control interval."""

    physics_dt: float = MISSING
    substeps: int = MISSING

    @property
    def frame_dt(self) -> float:
        """Time between two commands [s]."""
        return self.physics_dt * self.substeps


@dataclass(kw_only=True, slots=True)
class SolverCfg:
    """Constraint solver. ``null`` keeps the model file's own value.

    ``gripper_condim`` is the contact dimension of the geoms of ``robot.jaw_bodies``.
    """

    iterations: int | None = None
    ls_iterations: int | None = None
    impratio: float | None = None
    tolerance: float | None = None
    cone: Cone = Cone.elliptic
    gripper_condim: int | None = None


@dataclass(kw_only=True, slots=True)
class BatchCfg:
    """MJWarp's buffer sizes. ``null`` takes the default of this robot and scene (nconmax, njmax) or of MJWarp.

    With ``auto``, what is null is measured first, as `CapacityCfg` says.
    """

    auto: bool = False
    nconmax: int | None = None
    naconmax: int | None = None
    njmax: int | None = None
    nccdmax: int | None = None
    naccdmax: int | None = None


@dataclass(kw_only=True, slots=True)
class SimCfg:
    """Backend and device."""

    backend: Backend = MISSING
    device: str = MISSING


@dataclass(kw_only=True, slots=True)
class TermCfg:
    """A function or class by its dotted name, and the values of its keyword parameters."""

    func: str = MISSING
    params: dict[str, Any] = field(default_factory=dict)


@dataclass(kw_only=True, slots=True)
class ActionTermCfg(TermCfg):
    """A part of the action vector; ``func`` names a subclass of ``ActionTerm``."""


@dataclass(kw_only=True, slots=True)
class ObservationTermCfg(TermCfg):
    """A part of an observation group.

    ``noise`` is the half-width of uniform noise in the term's own unit, added first; then values are clipped to ``clip``
    (low, high) and multiplied by ``scale``. ``history`` frames are kept, oldest first.
    """

    scale: float = 1.0
    clip: list[float] | None = None
    noise: float = 0.0
    history: int = 1


@dataclass(kw_only=True, slots=True)
class ObservationGroupCfg:
    """Terms that are concatenated into one tensor; ``noise: false`` switches the noise of all of them off."""

    noise: bool = True
    terms: dict[str, Any] = field(default_factory=dict)


@dataclass(kw_only=True, slots=True)
class RewardTermCfg(TermCfg):
    """A reward per second of simulated time: each frame adds weight x value x frame_dt."""

    weight: float = MISSING


@dataclass(kw_only=True, slots=True)
class TerminationTermCfg(TermCfg):
    """Ends an episode; with ``time_out`` it is truncated, otherwise terminated."""

    time_out: bool = False


@dataclass(kw_only=True, slots=True)
class TaskCfg:
    """What has to be achieved, sampled at frame ends. The rules' thresholds are in `AcceptanceCfg` and
    `BoxAcceptanceCfg`.

    ``evidence`` names the subclass of ``Evidence`` that judges a scripted episode. ``instruction`` says in words what is to be
    done, for datasets; null: the task's name.
    """

    name: str = MISSING
    instruction: str | None = None
    control_hz: float = MISSING
    episode_frames: int = MISSING
    goal_height: float = MISSING
    evidence: str = MISSING
    success: TermCfg | None = None


@dataclass(kw_only=True, slots=True)
class PhaseCfg:
    """One phase of the scripted grasp.

    ``anchor`` is one of `mjstack.scene.phases.build_anchors`, such as ``red`` (a cube's centre), or null (the last target
    holds). The target lies ``h_scale`` approach heights plus ``offset`` above it, and ``scene.grasp_offset`` too where the cube
    is ``in_hand``.

    The rest is for a controller that watches (``controller=scripted``): ``look`` measures the anchor's cube anew when the phase
    begins, ``grasps`` names the cube that both jaws must press on when it ends, and ``retry`` the phase to go back to if they
    do not.
    """

    anchor: str | None = None
    h_scale: float = 0.0
    offset: float = 0.0
    in_hand: bool = False
    gripper: str = MISSING
    seconds: float = MISSING
    look: bool = False
    grasps: str | None = None
    retry: str | None = None


@dataclass(kw_only=True, slots=True)
class ControllerCfg:
    """The scripted motion. Its commands go through the action terms of ``action``.

    ``knots``, ``ik_tolerance`` and ``ik_iterations`` are mink's, which plans. A controller that watches makes
    ``frame_iterations`` of batched inverse kinematics per frame; ``posture_gain`` pulls redundant joints to mink's nominal
    plan and ``approach_gain`` turns the gripper upright; ``align`` is the share by which the jaws turn towards a cube's nearest
    face; a retry may go up to ``hurry`` times as fast, and must be over ``rest_seconds`` before the window of rest.
    """

    name: str = MISSING
    action: dict[str, Any] = MISSING
    phases: dict[str, PhaseCfg] = MISSING
    knots: int = MISSING
    ik_tolerance: float = MISSING
    ik_iterations: int = MISSING
    frame_iterations: int = MISSING
    posture_gain: float = MISSING
    approach_gain: float = MISSING
    align: float = MISSING
    hurry: float = MISSING
    rest_seconds: float = MISSING


@dataclass(kw_only=True, slots=True)
class AcceptanceCfg:
    """Thresholds of the stack task's acceptance."""

    lift_phases: list[str] = MISSING
    carry_phase: str = MISSING
    airborne_height: float = MISSING
    lift_frames: int = MISSING
    carry_frames: int = MISSING
    carry_distance: float = MISSING
    window: int = MISSING
    xy_err: float = MISSING
    dz_min: float = MISSING
    dz_max: float = MISSING
    support_gap: float = MISSING
    rest_speed: float = MISSING
    rest_position: float = MISSING
    rest_rotation_deg: float = MISSING


@dataclass(kw_only=True, slots=True)
class BoxAcceptanceCfg:
    """Thresholds of the box task's acceptance."""

    force: float = MISSING
    grasp_frames: int = MISSING
    lift_height: float = MISSING
    lift_frames: int = MISSING
    carry_frames: int = MISSING
    carry_distance: float = MISSING
    open_fraction: float = MISSING
    inside: float = MISSING
    rest_speed: float = MISSING
    window: int = MISSING
    jaw_clearance: float = MISSING


@dataclass(kw_only=True, slots=True)
class ParityCfg:
    """Tolerances of MJWarp against native MuJoCo: ``step1`` and ``step50`` map a field to its largest difference."""

    states: dict[str, str] = MISSING
    step1: dict[str, float] = MISSING
    step50: dict[str, float] = MISSING
    cube_position: float = MISSING
    cube_rotation_deg: float = MISSING


@dataclass(kw_only=True, slots=True)
class CapacityCfg:
    """How buffers are sized.

    ``cpu_nworld`` worlds do where worlds are slow (any CPU backend); on CUDA all nworld do. Recommended sizes are ``margin``
    times the peaks. Random actions last ``random_frames``, one whole episode if null. ``reset`` is how worlds start in the
    workload of randomised starts. An environment with ``batch=auto`` is sized by ``probe_frames`` of random actions, on
    CUDA in at most ``probe_nworld`` worlds.
    """

    cpu_nworld: int = MISSING
    margin: float = MISSING
    random_frames: int | None = None
    probe_nworld: int = MISSING
    probe_frames: int = MISSING
    reset: dict[str, Any] = field(default_factory=dict)


@dataclass(kw_only=True, slots=True)
class BatchGateCfg:
    """The batch gate. It plays ``seeds`` seeds, the configured one and those after it, and judges their worlds together."""

    seeds: int = MISSING
    failed_worlds: int = MISSING
    distinct_fraction: float = MISSING


@dataclass(kw_only=True, slots=True)
class ThroughputCfg:
    """How throughput is measured."""

    sections: list[str] = MISSING
    repetitions: int = MISSING
    frames: int = MISSING
    env_frames: int = MISSING
    max_seconds: float = MISSING
    cpu_max_seconds: float = MISSING
    from_phase: str = MISSING
    start_worlds: int = MISSING
    native_baseline: bool = MISSING


@dataclass(kw_only=True, slots=True)
class SuccessGateCfg:
    """The success gate: ``seeds`` seeds of nworld episodes each, of which the share ``rate`` must be accepted.

    ``reset`` is how worlds start, unless ``reset=layout`` names a file. ``region`` sets the half-widths of the cubes' region in
    x and y; null leaves them as ``reset`` has them. Start places are counted in cells ``cell`` wide, directions of a cube
    relative to that of its place as seen from the base in bins of ``yaw_cell_deg``. The ``worst_regions`` worst cells with at
    least ``cell_episodes`` episodes are in the report's text.
    """

    seeds: int = MISSING
    rate: float = MISSING
    region: list[float] | None = None
    cell: float = MISSING
    yaw_cell_deg: float = MISSING
    cell_episodes: int = MISSING
    worst_regions: int = MISSING
    reset: dict[str, Any] = field(default_factory=dict)


@dataclass(kw_only=True, slots=True)
class GateCfg:
    """Thresholds of every gate."""

    acceptance: AcceptanceCfg = field(default_factory=AcceptanceCfg)
    box: BoxAcceptanceCfg = field(default_factory=BoxAcceptanceCfg)
    parity: ParityCfg = field(default_factory=ParityCfg)
    capacity: CapacityCfg = field(default_factory=CapacityCfg)
    batch: BatchGateCfg = field(default_factory=BatchGateCfg)
    throughput: ThroughputCfg = field(default_factory=ThroughputCfg)
    success: SuccessGateCfg = field(default_factory=SuccessGateCfg)


@dataclass(kw_only=True, slots=True)
class JobCfg:
    """What the command line runs."""

    name: str = MISSING


@dataclass(kw_only=True, slots=True)
class ScalingJobCfg(JobCfg):
    """Throughput over numbers of worlds, each in a process of its own.

    ``backends`` null: native, and MJWarp where there is CUDA, as far as ``sim`` allows. Above ``large`` worlds a case makes
    ``repetitions_large`` repetitions. ``case_minutes`` ends a case that hangs; ``max_minutes`` ends a call, and the next one
    goes on. ``retry``: cases that failed run again.
    """

    nworlds: list[int] = MISSING
    backends: list[str] | None = None
    repetitions: int = MISSING
    large: int = MISSING
    repetitions_large: int = MISSING
    native_frames: int = MISSING
    native_env_frames: int = MISSING
    case_minutes: float = MISSING
    max_minutes: float | None = None
    retry: bool = MISSING


@dataclass(kw_only=True, slots=True)
class StudyJobCfg(JobCfg):
    """What settings of the solver cost, and whether every world is still accepted.

    ``variants`` maps a name to what it changes in `SolverCfg`; typed, each is a whole one. ``repetitions`` of ``frames`` frames
    are timed, or of as many as fit into ``max_seconds``.
    """

    repetitions: int = MISSING
    frames: int = MISSING
    max_seconds: float = MISSING
    # Variants by name, untyped until `type_terms`, so that the command line may add one.
    variants: dict[str, Any] = field(default_factory=dict)


@dataclass(kw_only=True, slots=True)
class ReachabilityJobCfg(JobCfg):
    """What the arm reaches on the table, and how far cubes may stand from their places.

    ``step`` is the distance of the map's points. A region counts as reached if it is still ``margin`` wider all round.
    """

    step: float = MISSING
    margin: float = MISSING


@dataclass(kw_only=True, slots=True)
class CollectJobCfg(JobCfg):
    """Demonstrations of the scripted expert, as a dataset.

    ``episodes`` is how many the dataset is to have; a call adds what is missing. ``folder`` null: ``outputs/collect/<hash>``,
    by what episodes depend on. Frames are kept on the device until their batch is over: ``buffer_gib`` is the most that they
    may take, and fewer worlds are played at a time where more would not fit.
    """

    episodes: int = MISSING
    keep_failures: bool = MISSING
    folder: str | None = None
    buffer_gib: float = MISSING


@dataclass(kw_only=True, slots=True)
class Config:
    """Everything a run needs."""

    robot: RobotCfg = field(default_factory=RobotCfg)
    model: ModelCfg = field(default_factory=ModelCfg)
    scene: SceneCfg = field(default_factory=SceneCfg)
    timing: TimingCfg = field(default_factory=TimingCfg)
    solver: SolverCfg = field(default_factory=SolverCfg)
    batch: BatchCfg = field(default_factory=BatchCfg)
    sim: SimCfg = field(default_factory=SimCfg)
    # Terms by name. OmegaConf would not let a command line add a term to a typed dict, so the store types them:
    # ActionTermCfg, ObservationGroupCfg, TermCfg, TerminationTermCfg and RewardTermCfg.
    action: dict[str, Any] = field(default_factory=dict)
    observation: dict[str, Any] = field(default_factory=dict)
    reset: dict[str, Any] = field(default_factory=dict)
    termination: dict[str, Any] = field(default_factory=dict)
    reward: dict[str, Any] = field(default_factory=dict)
    task: TaskCfg = field(default_factory=TaskCfg)
    controller: ControllerCfg = field(default_factory=ControllerCfg)
    gate: GateCfg = field(default_factory=GateCfg)
    job: JobCfg = field(default_factory=JobCfg)
    nworld: int = MISSING
    seed: int = MISSING
    gates: list[str] = MISSING
    graph: GraphMode = MISSING
    view: bool = MISSING
    video: bool = MISSING
    layout: str | None = None
    run: str | None = None
    world: str | None = None
