"""A run: physics, and the gates and their parameters."""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from mjstack.config.fields import FITS, MOST_COUNT, MOST_WORLDS, spec


class Backend(StrEnum):
    """Which physics engine steps the worlds of batch and throughput."""

    auto = "auto"
    native = "native"
    mjwarp = "mjwarp"


@dataclass(slots=True)
class TimingCfg:
    """Physics step and control interval."""

    physics_dt: float = spec(unit="s", gt=0.0, le=1.0)
    """Duration of one physics step."""
    decimation: int = spec(unit="physics steps", ge=1, le=10_000)
    """Physics steps of one control step."""
    policy_decimation: int = spec(1, unit="control steps", ge=1, le=1000)
    """Control steps in which an action of a policy is repeated. Only training uses this: in a gate
    the policy's driver repeats each action."""
    control_hz: float = spec(50.0, unit="Hz", gt=0.0, le=1e6)
    """Control rate that these make: ``task.control_hz`` of the built-in tasks."""
    command_delay: int = spec(0, unit="control steps", ge=0, le=1000, changes=FITS)
    """Control steps between a command and its effect; until then the start's command holds."""
    random_delay: int = spec(0, unit="control steps", ge=0, le=1000)
    """The most that commands are later still: each world draws 0 to this for each episode."""

    @property
    def step_dt(self) -> float:
        """Time of a control step [s]."""
        return self.physics_dt * self.decimation

    @property
    def decision_dt(self) -> float:
        """Time of a decision of a policy in training [s]."""
        return self.step_dt * self.policy_decimation


@dataclass(slots=True)
class SolverCfg:
    """Constraint solver. null keeps the model file's own value."""

    iterations: int | None = spec(None, ge=1, le=1000)
    """Most iterations of the solver."""
    ls_iterations: int | None = spec(None, ge=1, le=1000)
    """Most iterations of its line search."""
    impratio: float | None = spec(None, gt=0.0)
    """Ratio of frictional to normal constraint impedance."""
    tolerance: float | None = spec(None, gt=0.0)
    """Improvement below which the solver stops."""
    cone: str = spec("elliptic", choices=("elliptic", "pyramidal"))
    """Shape of the friction cone."""
    gripper_condim: int | None = spec(None, choices=(1, 3, 4, 6))
    """Contact dimension of the geoms of ``robot.jaw_bodies``."""


@dataclass(slots=True)
class BatchCfg:
    """MJWarp's buffer sizes. null takes the default of this robot and scene (nconmax, njmax) or of
    MJWarp.
    """

    auto: bool = False
    """Whether sizes that are null are measured first, as ``gate.capacity`` says."""
    nconmax: int | None = spec(None, unit="contacts per world", ge=1, le=100_000)
    """Contacts, as a mean over the worlds."""
    njmax: int | None = spec(None, unit="rows per world", ge=1, le=100_000)
    """Constraint rows."""
    nccdmax: int | None = spec(None, unit="pairs per world", ge=1, le=100_000)
    """Pairs of convex geoms in collision, as a mean over the worlds."""


@dataclass(slots=True)
class SimCfg:
    """Backend and device."""

    backend: Backend = spec()
    """Physics engine of batch and throughput: auto is MJWarp where there is CUDA."""
    device: str = spec(changes=("report",))
    """auto, cpu or cuda:N."""
    step: str = spec(choices=("auto", "stock"), changes=("training",))
    """MJWarp's step. stock: ``mujoco_warp.step``; auto: its stages as parallel branches, and
    contact rows, the solver and smooth dynamics as a few kernels, where these do all that the model
    needs."""


@dataclass(slots=True)
class WebCfg:
    """Worlds in a browser, which the extra ``web`` shows."""

    episode: bool = True
    """Write episode.html, which plays worlds of the run in 3-D."""
    host: str = "127.0.0.1"
    """view=web: address that serves the page. 0.0.0.0 lets other machines in that know the
    token of the printed address."""
    port: int = spec(8080, ge=1, le=65_535)
    """view=web: its port."""


@dataclass(slots=True)
class GateFuncCfg:
    """A gate: a function of the run, and its parameters."""

    func: str = spec()
    """Dotted name of the function: ``func(run) -> list[GateResult]``."""


@dataclass(slots=True)
class BaselineCfg(GateFuncCfg):
    """The one world of baseline and parity."""

    reset: dict[str, Any] = spec({})
    """Reset terms of that world: the nominal start, and the terms of the task's own."""


@dataclass(slots=True)
class ParityCfg(GateFuncCfg):
    """Tolerances of MJWarp against native MuJoCo."""

    states: dict[str, str] = spec()
    """States from which both step: a name, and the phase at whose end the state is taken. Empty:
    the first phase, the one after the first grasp (without grasps, the last with a closed gripper),
    and the last. A driver without phases has those after each third of its episode instead."""
    step1_ranges: float = spec(ge=0.0)
    """Largest difference after one physics step, in ranges of native MuJoCo that rounds."""
    step50_ranges: float = spec(ge=0.0)
    """The same after 50 physics steps."""
    object_position: float = spec(unit="m", ge=0.0)
    """Largest difference of an object's position after the whole task."""
    object_rotation_deg: float = spec(unit="deg", ge=0.0)
    """Largest difference of an object's orientation after the whole task."""
    images: str | None = None
    """With cameras: ``parity_images.npz`` of a run elsewhere, whose images are compared with native
    MuJoCo's instead of images that MJWarp draws here."""
    image_states: int = spec(unit="states", ge=1, le=10_000)
    """With cameras: states of the reference episode that both backends draw."""
    image_same: float = spec(ge=0.0, le=1.0)
    """Smallest share of the pixels in which both backends show the same thing."""
    image_iou: float = spec(ge=0.0, le=1.0)
    """Smallest intersection over union of a thing in the images of both backends."""
    image_pixels: int = spec(unit="pixels", ge=1, le=MOST_COUNT)
    """Things with fewer pixels in all images of a camera are not compared. A camera in which only
    the background has as many fails."""
    image_color: float = spec(unit="of 255", ge=0.0)
    """Largest mean difference of colours, where both show the same thing."""
    image_depth: float = spec(unit="m", ge=0.0)
    """Largest median difference of depths, where both show the same thing."""


@dataclass(slots=True)
class CapacityCfg(GateFuncCfg):
    """How buffers are sized, in the gate and with ``batch=auto``."""

    cpu_nworld: int = spec(unit="worlds", ge=1, le=MOST_WORLDS)
    """Most worlds that size the buffers on a CPU; on CUDA all nworld do."""
    margin: float = spec(ge=1.0)
    """Recommended sizes over the peaks."""
    random_steps: int | None = spec(None, unit="steps", ge=1, le=MOST_COUNT)
    """Steps of random actions, which size environments; null: one whole episode, on CUDA 200 steps
    at most."""


@dataclass(slots=True)
class ThroughputCfg(GateFuncCfg):
    """How throughput is measured."""

    measurements: list[str] = spec(choices=("physics", "episode", "env_step", "cameras"))
    """Measurements that are made; ``cameras`` where there are some."""
    repetitions: int = spec(ge=1, le=1000)
    """Repetitions of each measurement, at most."""
    precision: float = spec(0.01, ge=0.0)
    """Stop, after at least two repetitions, when half the range of their times is below this share
    of their median (env_step, cameras: of the ratio to physics)."""
    episodes: int = spec(ge=1, le=MOST_COUNT)
    """episode: repetitions at most."""
    steps: int = spec(unit="steps", ge=1, le=MOST_COUNT)
    """physics: control steps per repetition."""
    env_steps: int = spec(unit="steps", ge=1, le=MOST_COUNT)
    """env_step and cameras: steps per repetition."""
    action_share: float = spec(gt=0.0, le=1.0)
    """env_step and cameras: share of the action range, about its middle, that actions come from."""
    max_seconds: float = spec(unit="s", gt=0.0)
    """Time budget of each measurement on CUDA."""
    cpu_max_seconds: float = spec(unit="s", gt=0.0)
    """Time budget of each measurement on a CPU."""
    from_phase: str = spec()
    """Phase at whose start physics begins; it holds the joint target from there. Empty: the one
    after the first grasp, or without grasps after the last phase with a closed gripper."""
    start_worlds: int = spec(unit="worlds", ge=1, le=MOST_WORLDS)
    """Worlds that are played to that phase where the batch gate has not; the others are copies."""
    native_baseline: bool = spec()
    """Whether native MuJoCo is measured too on CUDA machines."""


EPISODES = "mjstack.gates.episodes.judge_episodes"  # the function of every gate of episodes


@dataclass(slots=True)
class EpisodesGateCfg(GateFuncCfg):
    """A gate that plays episodes in nworld worlds under some seeds, and needs a success rate."""

    seeds: int = spec(1, unit="seeds", ge=1, le=100_000)
    """Seeds of nworld episodes each: the configured one and those after it."""
    rate: float = spec(1.0, ge=0.0, le=1.0)
    """Share of the episodes that must succeed."""
    distinct_fraction: float = spec(0.0, ge=0.0, le=1.0)
    """Smallest share of distinct starts, or of distinct final states."""
    reset: dict[str, Any] = spec({}, changes=("gates",))
    """Reset terms of its own: what they add to the task's own terms of ``reset``, or replace by
    name. ``reset=starts_file`` takes the place of those that read no file. With some, closed_loop
    plays in place of a plan, and starts and signs of failure are recorded. Empty: those of
    ``reset``."""


@dataclass  # without slots: OmegaConf sets what is no field, see `complete`
class GateCfg:
    """The gates by name, in the order in which they run; those of the search path come last."""

    baseline: BaselineCfg = field(default_factory=BaselineCfg)
    """A single native world."""
    parity: ParityCfg = field(default_factory=ParityCfg)
    """MJWarp against native MuJoCo."""
    capacity: CapacityCfg = field(default_factory=CapacityCfg)
    """Buffer sizes."""
    batch: EpisodesGateCfg = field(default_factory=EpisodesGateCfg)
    """Every world of a batch."""
    throughput: ThroughputCfg = field(default_factory=ThroughputCfg)
    """Speed."""
    success: EpisodesGateCfg = field(default_factory=EpisodesGateCfg)
    """Success rate from randomised starts."""
    added: dict[str, Any] = spec({})
    """Gates of the search path by name; their keys are ``gate.NAME.KEY``."""

    def __getitem__(self, name: str) -> Any:
        """The parameters of a gate."""
        return self.added[name] if name in self.added else getattr(self, name)

    def episodes(self) -> dict[str, EpisodesGateCfg]:
        """Parameters of every gate of episodes, by the gate's name."""
        gates = {name: self[name] for name in self.functions()}
        return {name: gate for name, gate in gates.items() if isinstance(gate, EpisodesGateCfg)}

    def functions(self) -> dict[str, str]:
        """Dotted name of every gate's function, by the gate's name."""
        return {
            name: gate.func if isinstance(gate, GateFuncCfg) else gate["func"]
            for name, gate in (vars(self) | self.added).items()
            if isinstance(gate, GateFuncCfg) or (isinstance(gate, dict) and "func" in gate)
        }
