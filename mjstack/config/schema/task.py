"""The managers' terms, and the task with the scripted motion that does it."""

from dataclasses import dataclass
from typing import Any

from mjstack.config.fields import FITS, spec


@dataclass(slots=True)
class TermCfg:
    """A function or class, and the values of its keyword parameters."""

    func: str = spec()
    """Dotted name of the function or class."""
    params: dict[str, Any] = spec({}, finite=False)
    """Keyword parameters."""


@dataclass(slots=True)
class ObservationTermCfg(TermCfg):
    """A part of an observation group: value, plus noise, clipped, times scale."""

    scale: float = spec(1.0)
    """Factor, applied last."""
    clip: list[float] | None = spec(None, unit="the term's", length=2, finite=False)
    """Smallest and largest value."""
    noise: float = spec(0.0, unit="the term's", ge=0.0)
    """Half-width of uniform noise, added first."""
    history: int = spec(1, unit="steps", ge=1, le=1000)
    """Steps that are kept, oldest first."""


@dataclass(slots=True)
class ObservationGroupCfg:
    """Terms that are concatenated into one tensor."""

    noise: bool = True
    """Whether its terms have their noise."""
    terms: dict[str, Any] = spec({}, finite=False)
    """Its terms, by name."""


@dataclass(slots=True)
class RewardTermCfg(TermCfg):
    """A reward per second of simulated time."""

    weight: float = spec()
    """Each step adds weight x value x step_dt."""


@dataclass(slots=True)
class TerminationTermCfg(TermCfg):
    """A reason for which an episode ends."""

    time_out: bool = False
    """Whether the episode is truncated then, not terminated."""


@dataclass(slots=True)
class TaskCfg:
    """The goal of an episode, sampled at step ends."""

    name: str = spec(changes=FITS)
    """Name of the task."""
    instruction: str | None = None
    """The task in words, for datasets; null: its name."""
    control_hz: float = spec("${timing.control_hz}", unit="Hz", gt=0.0, le=1e6, changes=FITS)
    """Control steps per second; a number only for a task that works at no other rate."""
    episode_seconds: float | None = spec(None, unit="s", gt=0.0)
    """Length of an episode of the environment; null: that of the phases."""
    episode_steps: int = spec("${steps:${task.episode_seconds}}", unit="steps", ge=1, le=1_000_000)
    """The same in control steps."""
    params: dict[str, Any] = spec({}, changes=FITS)
    """Numbers that several terms of the task share, as ``${task.params.NAME}``."""
    check: dict[str, Any] | None = None
    """Judges an episode: ``func`` names a subclass of ``EpisodeCheck``, the other keys are its
    thresholds; null: the task can be trained, not verified."""
    success: TermCfg | None = None
    """Term that is true where the task is achieved; null: it never is."""

    @property
    def words(self) -> str:
        """The task in words."""
        return self.instruction or self.name


@dataclass(slots=True)
class PhaseCfg:
    """One phase of the scripted motion: where it brings the grasp point, and the gripper."""

    anchor: str | None = None
    """Object or place from which the target counts; null: the last target holds."""
    level: str = spec("center", choices=("center", "table", "on_top"))
    """Height of the target: center (of the anchor as it stands; a place is on the table), table
    (its surface at the anchor), or on_top (centre of the object grasped last, standing on the
    anchor)."""
    offset: list[float] = spec([0.0, 0.0, 0.0], unit="m", length=3)
    """Added to the target in x, y and z."""
    h_scale: float = 0.0
    """How many ``robot.approach_height`` higher the target is."""
    toward: str | None = None
    """Object or place to which the offset's x axis points from the anchor; null: world axes."""
    in_hand: bool = False
    """Whether ``scene.grasp_offset`` is added to the height."""
    gripper: str = spec(choices=("open", "closed"))
    """open or closed."""
    width: float | None = spec(None, unit="m", ge=0.0)
    """Width of an object around which the jaws close as much; null: that of the grasped object, and
    without one ``robot.closed_width``."""
    seconds: float = spec(unit="s", gt=0.0, le=600.0)
    """Duration."""
    observe: bool = False
    """With controller=closed_loop: measure anchor and ``toward`` anew when the phase begins."""
    grasps: str | None = None
    """Object on which the jaws must press when the phase ends."""
    align: bool = False
    """With controller=closed_loop: bring the grasped object to the target, not the grasp point: by
    how it lies in the hand when the phase begins, and turned to a face of the anchor."""
    until_force: float | None = spec(None, unit="N", gt=0.0)
    """With controller=closed_loop: the phase ends before its time once every jaw presses with that
    force on the object that it grasps or carries."""
    until_within: float | None = spec(None, unit="m", gt=0.0)
    """The same once the grasp point, as measured, is so near the target."""
    retry: str | None = None
    """With controller=closed_loop: phase to go back to if they do not."""


@dataclass(slots=True)
class ControllerCfg:
    """Drives the worlds. Its actions go through the action terms of ``action``."""

    name: str = spec()
    """open_loop, closed_loop, policy, lerobot, custom, or one of your own."""
    func: str = spec()
    """Its driver: a subclass of ``mjstack.drivers.driver.Driver``."""
    params: dict[str, Any] = spec({})
    """Parameters of a driver of your own, by name."""
    action: dict[str, Any] = spec()
    """Its action terms, by name."""
    phases: dict[str, PhaseCfg] = spec({})
    """Phases in their order."""
    knots: int = spec(ge=3, le=1000)
    """Inverse-kinematics solutions per phase of a plan."""
    ik_tolerance: float = spec(unit="m", gt=0.0)
    """Largest distance of the grasp point from a target."""
    clock: bool = True
    """Whether closed_loop goes through the phases by a clock. Without one it decides from the state
    alone, in every step, so that trainer=dagger can ask it in any state."""
    step_iterations: int = spec(ge=1, le=1000)
    """Iterations of batched inverse kinematics per step of closed_loop."""
    posture_gain: float = spec(ge=0.0, le=1.0)
    """How strongly redundant joints follow the nominal plan per iteration."""
    approach_gain: float = spec(ge=0.0, le=1.0)
    """How strongly the gripper takes the tilt that the release needs, per iteration."""
    yaw_alignment: float = spec(ge=0.0, le=1.0)
    """Share of the turn of the jaws to an object's nearest face."""
    speed_limit: float = spec(ge=1.0, le=100.0)
    """How many times as fast a world may go after a retry."""
