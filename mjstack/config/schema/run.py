"""A run: physics, the gates and their parameters, and the jobs."""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from mjstack.config.fields import MOST_SEEDS, MOST_WORLDS, spec


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
    """Control steps in which an action of a policy is repeated, in training. A driver decides in
    every control step; a policy that was trained so repeats its answers by itself.
    """
    command_delay: int = spec(0, unit="control steps", ge=0, le=1000)
    """Control steps between a command and its effect; until then the start's command holds."""

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

    iterations: int | None = spec(None, ge=1)
    """Most iterations of the solver."""
    ls_iterations: int | None = spec(None, ge=1)
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
    nconmax: int | None = spec(None, unit="contacts per world", ge=1)
    """Contacts, as a mean over the worlds."""
    naconmax: int | None = spec(None, unit="contacts", ge=1)
    """Contacts of all worlds; takes precedence over nconmax."""
    njmax: int | None = spec(None, unit="rows per world", ge=1)
    """Constraint rows."""
    nccdmax: int | None = spec(None, unit="pairs per world", ge=1)
    """Pairs of convex geoms in collision, as a mean over the worlds."""
    naccdmax: int | None = spec(None, unit="pairs", ge=1)
    """Such pairs of all worlds; takes precedence over nccdmax."""


@dataclass(slots=True)
class SimCfg:
    """Backend and device."""

    backend: Backend = spec()
    """Physics engine of batch and throughput: auto is MJWarp where there is CUDA."""
    device: str = spec()
    """auto, cpu or cuda:N."""
    step: str = spec(choices=("auto", "fused", "arranged", "stock"))
    """MJWarp's step. stock: ``mujoco_warp.step``; arranged: its stages as parallel branches; fused:
    contact rows, the solver and smooth dynamics as a few kernels, too; auto: fused where it does
    all that the model needs.
    """


@dataclass(slots=True)
class GateFuncCfg:
    """A gate: a function of the run's context, and its parameters."""

    func: str = spec()
    """Dotted name of the function: ``func(context) -> list[GateResult]``."""


@dataclass(slots=True)
class ParityCfg(GateFuncCfg):
    """Tolerances of MJWarp against native MuJoCo."""

    states: dict[str, str] = spec()
    """States from which both step: a name, and the phase at whose end the state is taken. Empty:
    the first phase, the one after the first grasp (without grasps, the last with a closed gripper),
    and the last. A driver without phases has those after each third of its episode instead.
    """
    step1: dict[str, float] = spec(unit="SI", ge=0.0)
    """Largest difference of each field after one physics step."""
    step50: dict[str, float] = spec(unit="SI", ge=0.0)
    """Largest difference of each field after 50 physics steps."""
    object_position: float = spec(unit="m", ge=0.0)
    """Largest difference of an object's position after the whole task."""
    object_rotation_deg: float = spec(unit="deg", ge=0.0)
    """Largest difference of an object's orientation after the whole task."""


@dataclass(slots=True)
class CapacityCfg(GateFuncCfg):
    """How buffers are sized."""

    cpu_nworld: int = spec(unit="worlds", ge=1)
    """Worlds that size the buffers on a CPU; on CUDA all nworld do."""
    margin: float = spec(ge=1.0)
    """Recommended sizes over the peaks."""
    random_steps: int | None = spec(None, unit="steps", ge=1)
    """Steps of random actions; null: one whole episode."""
    probe_nworld: int = spec(unit="worlds", ge=1)
    """Most worlds that size an environment with ``batch=auto`` on CUDA; on a CPU, cpu_nworld."""
    probe_steps: int = spec(unit="steps", ge=1)
    """Steps of random actions that size an environment with ``batch=auto``."""
    reset: dict[str, Any] = spec(factory=dict)
    """Reset terms of the workload with randomised starts."""


@dataclass(slots=True)
class BatchGateCfg(GateFuncCfg):
    """The batch gate plays every world of some seeds and judges them together."""

    seeds: int = spec(unit="seeds", ge=1)
    """Seeds that are played: the configured one and those after it."""
    failed_worlds: int = spec(unit="worlds", ge=0)
    """Worlds that may fail, over all seeds."""
    distinct_fraction: float = spec(ge=0.0, le=1.0)
    """Smallest share of distinct final states."""


@dataclass(slots=True)
class ThroughputCfg(GateFuncCfg):
    """How throughput is measured."""

    measurements: list[str] = spec(choices=("physics", "episode", "env_step"))
    """Measurements that are made."""
    repetitions: int = spec(ge=1)
    """Repetitions of each measurement."""
    episodes: int = spec(ge=1)
    """episode: repetitions at most."""
    steps: int = spec(unit="steps", ge=1)
    """physics: control steps per repetition."""
    env_steps: int = spec(unit="steps", ge=1)
    """env_step: steps per repetition."""
    max_seconds: float = spec(unit="s", gt=0.0)
    """Time budget of each measurement on CUDA."""
    cpu_max_seconds: float = spec(unit="s", gt=0.0)
    """Time budget of each measurement on a CPU."""
    from_phase: str = spec()
    """Phase at whose start physics begins; it holds the joint target from there. Empty: the one
    after the first grasp, or without grasps after the last phase with a closed gripper.
    """
    start_worlds: int = spec(unit="worlds", ge=1)
    """Worlds that are played to that phase where the batch gate has not; the others are copies."""
    native_baseline: bool = spec()
    """Whether native MuJoCo is measured too on CUDA machines."""


@dataclass(slots=True)
class SuccessGateCfg(GateFuncCfg):
    """The success gate plays episodes from randomised starts and needs a success rate."""

    seeds: int = spec(unit="seeds", ge=1)
    """Seeds of nworld episodes each: the configured one and those after it."""
    rate: float = spec(ge=0.0, le=1.0)
    """Share of the episodes that must succeed."""
    region: list[float] | None = spec(None, unit="m", length=2, ge=0.0)
    """Half-widths of the objects' region in x and y; null: as ``reset`` has them."""
    cell: float = spec(unit="m", gt=0.0)
    """Width of the cells in which start positions are counted, in x and y."""
    yaw_cell_deg: float = spec(unit="deg", gt=0.0, le=90.0)
    """Width of the bins of an object's yaw relative to its direction as seen from the base."""
    cell_episodes: int = spec(unit="episodes", ge=1)
    """Episodes below which a cell has no rate."""
    worst_regions: int = spec(unit="cells", ge=1)
    """Worst cells in report.md."""
    reset: dict[str, Any] = spec(factory=dict)
    """Reset terms, unless ``reset=starts_file`` names a file."""


@dataclass  # without slots: OmegaConf sets what is no field, see `complete`
class GateCfg:
    """The gates by name, in the order in which they run; those of the search path come last."""

    baseline: GateFuncCfg = field(default_factory=GateFuncCfg)
    """A single native world."""
    parity: ParityCfg = field(default_factory=ParityCfg)
    """MJWarp against native MuJoCo."""
    capacity: CapacityCfg = field(default_factory=CapacityCfg)
    """Buffer sizes."""
    batch: BatchGateCfg = field(default_factory=BatchGateCfg)
    """Every world of a batch."""
    throughput: ThroughputCfg = field(default_factory=ThroughputCfg)
    """Speed."""
    success: SuccessGateCfg = field(default_factory=SuccessGateCfg)
    """Success rate from randomised starts."""
    added: dict[str, Any] = spec(factory=dict)
    """Gates of the search path by name; their keys are ``gate.NAME.KEY``."""

    def __getitem__(self, name: str) -> Any:
        """The parameters of a gate."""
        return self.added[name] if name in self.added else getattr(self, name)

    def functions(self) -> dict[str, str]:
        """Dotted name of every gate's function, by the gate's name."""
        gates = vars(self) | self.added
        return {
            name: gate.func if isinstance(gate, GateFuncCfg) else gate["func"]
            for name, gate in gates.items()
            if isinstance(gate, GateFuncCfg) or (isinstance(gate, dict) and "func" in gate)
        }


@dataclass(slots=True)
class JobCfg:
    """A job: the work of one command."""

    name: str = spec()
    """Its name."""
    func: str = spec()
    """Dotted name of its ``mjstack.jobs.Job``."""


@dataclass(slots=True)
class ScalingJobCfg(JobCfg):
    """Throughput over numbers of worlds, each in a process."""

    nworlds: list[int] = spec(unit="worlds", ge=1, le=MOST_WORLDS)
    """Numbers of worlds, each once."""
    backends: list[str] | None = spec(None, choices=("mjwarp", "native"))
    """Backends; null: native, and MJWarp where there is CUDA, as far as ``sim`` allows."""
    repetitions: int = spec(ge=1)
    """Repetitions of each measurement."""
    large: int = spec(unit="worlds", ge=1)
    """A run of more worlds makes ``repetitions_large`` repetitions."""
    repetitions_large: int = spec(ge=1)
    """Repetitions of each measurement of a large run."""
    native_steps: int = spec(unit="steps", ge=1)
    """Physics steps per repetition on native MuJoCo, whose worlds play no episode."""
    native_env_steps: int = spec(unit="steps", ge=1)
    """Environment steps per repetition on native MuJoCo."""
    run_minutes: float = spec(unit="min", gt=0.0)
    """A run that takes longer has failed."""
    max_minutes: float | None = spec(None, unit="min", gt=0.0)
    """Time budget of a call; the next one goes on. null: unlimited."""
    retry: bool = spec()
    """Whether runs that failed are repeated."""


@dataclass(slots=True)
class StudyJobCfg(JobCfg):
    """Cost and success of settings of the solver."""

    repetitions: int = spec(ge=1)
    """Repetitions of each variant."""
    steps: int = spec(unit="steps", ge=1)
    """Control steps per repetition, or as many as fit into ``max_seconds``."""
    max_seconds: float = spec(unit="s", gt=0.0)
    """Time budget of a repetition."""
    # Variants are untyped until `complete`, so that the command line may add one.
    variants: dict[str, Any] = spec(factory=dict)
    """Variants by name: the keys of ``solver`` that each changes."""


@dataclass(slots=True)
class ReachabilityJobCfg(JobCfg):
    """A map of the positions that the arm reaches, and the largest region for random starts."""

    step: float = spec(unit="m", gt=0.0)
    """Distance of the map's points."""
    margin: float = spec(unit="m", ge=0.0)
    """A region counts as reached if it is still reached with this margin all round."""


@dataclass(slots=True)
class CollectJobCfg(JobCfg):
    """Demonstrations of the closed-loop expert, as a dataset."""

    episodes: int = spec(unit="episodes", ge=1)
    """Episodes of the dataset; a call adds the missing ones."""
    keep_failures: bool = spec()
    """Whether failed episodes are kept too, marked; they count."""
    folder: str | None = spec(None)
    """Folder of the dataset; null: ``outputs/collect/<hash>`` of everything episodes depend on."""
    buffer_gib: float = spec(unit="GiB", gt=0.0)
    """Device memory for the steps of one batch of worlds; more worlds are played in turns."""


@dataclass(slots=True)
class TrainJobCfg(JobCfg):
    """A policy is trained, and judged from starts that training has not used."""

    trainer: str = spec()
    """Dotted name of its ``mjstack.train.trainer.Trainer``."""
    folder: str | None = spec(None)
    """Folder of the training; null: ``outputs/train/<hash>`` of everything training depends on."""
    test_seed: int = spec(ge=0, le=MOST_SEEDS - 1)
    """First seed of the starts from which the policy is judged, gate.success.seeds of them."""


@dataclass(slots=True)
class CloneSizes:
    """How much is trained; as the keys of the job of these names."""

    episodes: int = spec(unit="episodes", ge=1)
    """Episodes that the expert plays."""
    noisy_episodes: int = spec(unit="episodes", ge=0)
    """Episodes more with noise on the executed commands."""
    hidden: list[int] = spec(ge=1, le=65536)
    """Widths of the network's hidden layers."""
    batches: int = spec(ge=1)
    """Steps of the optimizer."""
    batch_size: int = spec(ge=1)
    """Answers of a batch."""
    save_every: int = spec(unit="batches", ge=1)
    """Batches between two saved policies."""
    input_noise: float = spec(ge=0.0)
    """Noise on the observations that training sees, in their standard deviations."""
    weight_decay: float = spec(ge=0.0)
    """Of AdamW."""
    leave_out: list[str] = spec(factory=list)
    """Terms of the observation group that the policy does not see."""


@dataclass(slots=True)
class CloneJobCfg(TrainJobCfg):
    """A network learns to answer as the expert does. What is null is as ``sizes`` has it."""

    observation: dict[str, Any] = spec(factory=dict, finite=False)
    """What the policy can see; ``observation@job.observation`` chooses it."""
    group: str = spec()
    """The group that it sees."""
    dataset: str | None = spec(None)
    """Folder of a dataset from which it learns; null: from the expert, who plays now."""
    observation_noise: bool = spec()
    """Whether its observations have their noise."""
    command_noise: float = spec(unit="rad", ge=0.0)
    """Standard deviation of that noise, which changes slowly."""
    chunk: int = spec(unit="steps", ge=1, le=1000)
    """Joint targets of one answer."""
    execute: int = spec(unit="steps", ge=1, le=1000)
    """Control steps between two answers."""
    learning_rate: float = spec(gt=0.0)
    """Of AdamW at the start; a cosine brings it to 0."""
    averaging: float = spec(ge=0.0, le=1.0)
    """Share of the policy's weights that a batch keeps: they are an average."""
    episodes: int | None = spec(None, unit="episodes", ge=1)
    """Episodes that the expert plays."""
    noisy_episodes: int | None = spec(None, unit="episodes", ge=0)
    """Episodes more with noise on the executed commands; labels stay the expert's."""
    hidden: list[int] | None = spec(None, ge=1, le=65536)
    """Widths of the network's hidden layers."""
    batches: int | None = spec(None, ge=1)
    """Steps of the optimizer."""
    batch_size: int | None = spec(None, ge=1)
    """Answers of a batch."""
    save_every: int | None = spec(None, unit="batches", ge=1)
    """Batches between two saved policies."""
    input_noise: float | None = spec(None, ge=0.0)
    """Noise on the observations that training sees, in their standard deviations."""
    weight_decay: float | None = spec(None, ge=0.0)
    """Of AdamW."""
    leave_out: list[str] | None = spec(None)
    """Terms of the group that the policy does not see."""
    sizes: dict[str, CloneSizes] = spec(factory=dict)
    """Values of the keys that are null above, for ``cuda`` and for ``cpu``."""


@dataclass(slots=True)
class DaggerJobCfg(CloneJobCfg):
    """In every round the expert and the policy drive, and the policy learns the expert's answers to
    all states of all rounds. Sizes are those of a round, and ``noisy_episodes`` are not played.
    """

    rounds: int = spec(ge=1, le=1000)
    """Rounds: the expert alone drives in the first one."""
    beta: float = spec(ge=0.0, le=1.0)
    """Share of the time in which the expert drives in the second round."""
    beta_decay: float = spec(ge=0.0, le=1.0)
    """What it is multiplied by from round to round."""
    alone: float = spec(gt=0.0, le=1.0)
    """Share of the worlds in which the policy drives alone: their success is that of a round."""


@dataclass(slots=True)
class PpoSettings:
    """What differs between a random network and one that can do something; as the keys of the job
    of these names.
    """

    std: list[float] = spec(length=3, gt=0.0)
    """Standard deviation of the actions: at the start, smallest and largest."""
    entropy: list[float] = spec(length=2, ge=0.0)
    """Weight of the entropy at the start, and after ``entropy_iterations``."""
    desired_kl: float = spec(gt=0.0)
    """Change of the policy per iteration to which the learning rate adapts."""
    learning_rate: float = spec(gt=0.0)
    """Of the actor at the start."""
    critic_iterations: int = spec(ge=0)
    """First iterations, in which only the critic learns."""


@dataclass(slots=True)
class PpoJobCfg(TrainJobCfg):
    """A policy learns from the task's rewards, by rsl_rl's PPO. What is null is as ``settings`` has
    it.
    """

    observation: dict[str, Any] = spec(factory=dict, finite=False)
    """What the policy can see; ``observation@job.observation`` chooses it."""
    group: str = spec()
    """The group that it sees."""
    leave_out: list[str] = spec(factory=list)
    """Terms of the group that the policy does not see."""
    observation_noise: bool = spec()
    """Whether its observations have their noise."""
    critic: list[str] = spec(factory=list)
    """Observation groups that the critic sees besides the policy's."""
    start_from: str | None = spec(None)
    """Folder of a policy that training starts from, with its observation and its actions; null: a
    random network.
    """
    iterations: int | None = spec(None, ge=1)
    """Iterations of the training, over all calls; null: as ``minutes`` says."""
    minutes: float | None = spec(None, unit="min", gt=0.0)
    """Time of the training, over all calls; null: as ``iterations`` says."""
    max_minutes: float | None = spec(None, unit="min", gt=0.0)
    """Time budget of a call; the next one goes on. null: unlimited."""
    save_every: int = spec(unit="iterations", ge=1)
    """Iterations between two saved policies."""
    expert_worlds: int = spec(unit="worlds", ge=1)
    """reset=expert_states: worlds in which the expert plays at the beginning."""
    hidden: list[int] = spec(ge=1, le=65536)
    """Widths of the hidden layers of actor and critic."""
    horizon: int = spec(unit="decisions", ge=1)
    """Decisions of every world per iteration."""
    epochs: int = spec(ge=1)
    """How often an iteration goes through them."""
    minibatches: int = spec(ge=1)
    """Parts into which they are divided."""
    critic_learning_rate: float = spec(gt=0.0)
    """Of the critic."""
    gamma: float = spec(ge=0.0, le=1.0)
    """Discount per decision."""
    gae_lambda: float = spec(ge=0.0, le=1.0)
    """Of the generalised advantage estimation."""
    clip: float = spec(gt=0.0)
    """Largest change of an action's probability that counts."""
    reward_limit: float = spec(gt=0.0)
    """Limit of the rewards, over the standard deviation of their discounted sum."""
    entropy_iterations: int = spec(ge=1)
    """Iterations over which the weight of the entropy changes."""
    std: list[float] | None = spec(None, length=3, gt=0.0)
    """Standard deviation of the actions: at the start, smallest and largest."""
    entropy: list[float] | None = spec(None, length=2, ge=0.0)
    """Weight of the entropy at the start, and after ``entropy_iterations``."""
    desired_kl: float | None = spec(None, gt=0.0)
    """Change of the policy per iteration to which the learning rate adapts."""
    learning_rate: float | None = spec(None, gt=0.0)
    """Of the actor at the start; it adapts to ``desired_kl``."""
    critic_iterations: int | None = spec(None, ge=0)
    """First iterations, in which only the critic learns."""
    settings: dict[str, PpoSettings] = spec(factory=dict)
    """Values of the keys that are null above, for ``random`` and for ``start_from``."""


# Trainers with keys of their own; the others have those of clone.
TRAINER_SCHEMAS = {"dagger": DaggerJobCfg, "ppo": PpoJobCfg}
# Jobs with keys of their own; the others have `JobCfg`.
JOB_SCHEMAS = {
    "study": StudyJobCfg,
    "scaling": ScalingJobCfg,
    "reachability": ReachabilityJobCfg,
    "collect": CollectJobCfg,
    "train": CloneJobCfg,
}
