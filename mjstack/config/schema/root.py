"""The whole configuration."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mjstack.config.fields import MOST_SEEDS, MOST_WORLDS, spec
from mjstack.config.schema.jobs import JobCfg
from mjstack.config.schema.robot import ModelCfg, RobotCfg
from mjstack.config.schema.run import (
    BatchCfg,
    GateCfg,
    SimCfg,
    SolverCfg,
    TimingCfg,
    WebCfg,
)
from mjstack.config.schema.scene import SceneCfg
from mjstack.config.schema.task import ControllerCfg, TaskCfg

if TYPE_CHECKING:  # each job has keys of its own class
    AnyJob = Any
else:
    AnyJob = JobCfg


@dataclass(slots=True)
class Config:
    """Everything a run needs."""

    robot: RobotCfg = spec()
    """The arm."""
    model: ModelCfg = spec()
    """Source of the arm's MJCF file."""
    scene: SceneCfg = spec()
    """Table and objects."""
    timing: TimingCfg = spec()
    """Physics step and control step."""
    solver: SolverCfg = spec()
    """Limits of the constraint solver, and the friction cone."""
    batch: BatchCfg = spec(changes=("report",))
    """MJWarp's buffer sizes."""
    sim: SimCfg = spec()
    """Physics engine and device."""
    # Terms by name, which `complete` types.
    action: dict[str, Any] = spec({}, changes=("training",))
    """Action of a policy."""
    observation: dict[str, Any] = spec({})
    """Observations of a policy."""
    reset: dict[str, Any] = spec({})
    """Start states of the worlds."""
    termination: dict[str, Any] = spec({}, changes=("training",))
    """Ends of an episode."""
    reward: dict[str, Any] = spec({})
    """Rewards of a policy."""
    task: TaskCfg = spec()
    """The task; it chooses some of the groups above."""
    controller: ControllerCfg = spec()
    """Joint trajectories planned before the episode, feedback, or a trained policy."""
    gate: GateCfg = spec(GateCfg, changes=("report",))
    """Parameters of the gates, all in use at once; gates=[...] chooses gates."""
    job: AnyJob = spec(changes=("training",))
    """Work of the command."""
    nworld: int = spec(unit="worlds", ge=1, le=MOST_WORLDS, changes=("training",))
    """Worlds of the batch, capacity and throughput gates."""
    seed: int = spec(ge=0, le=MOST_SEEDS - 1)
    """Seed of every random number."""
    gates: list[str] = spec(changes=("report",))
    """Gates that run; their order is fixed. There is also success."""
    graph: str = spec(choices=("auto", "require", "off"), changes=("report",))
    """Capture the step as a CUDA graph: auto, require or off. Ignored on native MuJoCo; on Warp's
    CPU device, of physics alone."""
    view: str = spec(choices=("false", "web"), changes=("report",))
    """web: worlds of the gates, of replay and play, and training, in a browser."""
    video: bool = spec(changes=("report",))
    """Write a video of the parity world, or without that gate of the baseline world; job=play
    without view does so of every world."""
    web: WebCfg = spec(WebCfg, changes=("nothing",))
    """Worlds in a browser."""
    range_scale: float = spec(1.0, ge=0.0, le=10.0)
    """How wide the ranges of ``randomization`` are, of their own; 1.5: wider by half."""
    starts: str | None = spec(None)
    """reset=starts_file: an npz file with one row per world, from which all of them start."""
    policy: str | None = spec(None)
    """controller=policy, controller=lerobot, job=export: the folder of a trained policy."""
    run: str | None = spec(None, changes=("report",))
    """job=replay: the folder of an earlier run."""
    devices: str | None = spec(None, changes=("nothing",))
    """GPUs that share the job's worlds, a process for each: all, or how many. null: as torchrun
    has it, or one."""
    world: str | None = spec(None, changes=("report",))
    """job=replay: 17; of seed 3, 3:17; success:3:17 where batch ran too."""
    unused_terms: list[str] = spec([], changes=("nothing",))
    """Terms of the task that this job does not use, a line each; mjstack fills it in."""

    @property
    def episode_gates(self) -> list[str]:
        """The gates that run and play episodes, in their order."""
        return [name for name in self.gate.episodes() if name in self.gates]

    @property
    def files(self) -> dict[str, str]:
        """Paths of its MJCF files, by key."""
        named = {"robot.file": self.robot.file}
        named |= {
            f"scene.objects.{n}.file": object_cfg.file
            for n, object_cfg in self.scene.objects.items()
        }
        return {key: path for key, path in named.items() if path is not None}
