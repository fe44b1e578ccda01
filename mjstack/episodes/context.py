"""The context of a run: its configuration, its stage, and the products of its gates."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import mujoco

from mjstack.config.schema import Backend, Config
from mjstack.distributed import Ranks, current_ranks
from mjstack.drivers.driver import Driver, OpenLoopDriver
from mjstack.drivers.open_loop import OpenLoopPlanner
from mjstack.drivers.policy import PolicyDriver
from mjstack.envs import Env, driven_config
from mjstack.envs.buffers import Advance, Workload, measured_sizes, play_workload
from mjstack.episodes.live import LiveView
from mjstack.episodes.rollout import (
    CLOSED_LOOP,
    NOMINAL,
    PHASELESS,
    POLICY,
    STATE_BASED,
    Episode,
    Observer,
    Reset,
    Snapshots,
    State,
    WorldRecorder,
    play_episode,
    reset_worlds,
)
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError
from mjstack.managers.episode import required_fields
from mjstack.managers.view import offers
from mjstack.mdp.geometry import source_xy
from mjstack.report.html import Page
from mjstack.report.record import GateResult, Status
from mjstack.scene import SceneIndex
from mjstack.scene.phases import Phase
from mjstack.sim import BatchSizes, Simulation, make_simulation, resolve_backend, resolve_sizes
from mjstack.sim.sizes import apply_configured
from mjstack.tasks.check import EpisodeCheck, make_check

TextHook = Callable[[str], None]

needs_episode = offers(needs_episode=True)
"""Marks a gate that plays judged episodes. It is skipped for a task that has none."""
spread = offers(spread="worlds")
"""Marks a gate whose ranks play their worlds and gather the results. Of others rank 0 alone plays
all worlds.
"""
each_rank = offers(spread="ranks")
"""Marks a gate that measures the worlds of a rank, in all of them at the same time."""


@dataclass(eq=False, kw_only=True, slots=True)
class NominalRun:
    """The reference episode.

    Attributes:
        sim: Its world.
        episode: The episode.
        world: Its recording.
        states: At the ends of the phases that gate *parity* compares, by step.
    """

    sim: Simulation
    episode: Episode
    world: WorldRecorder
    states: dict[int, State]


@dataclass(eq=False, kw_only=True, slots=True)
class Artifacts:
    """Products of gates that later gates and the report use.

    Attributes:
        results: Results so far, by gate.
        sizes: Buffer sizes that the driven task needs, with a margin, from *capacity* or from
            ``batch=auto``.
        env_sizes: Buffer sizes that environments need, from *capacity*.
        carry_start: States of all worlds as the phase ``gate.throughput.from_phase`` begins, from
            *batch*.
        timed_episode: Time of the first seed's episode, from *batch*.
        shown: Title of the one-world episode that pictures show, and its recording.
    """

    results: dict[str, GateResult] = field(default_factory=dict)
    sizes: BatchSizes | None = None
    env_sizes: BatchSizes | None = None
    carry_start: State | None = None
    timed_episode: Episode | None = None
    shown: tuple[str, WorldRecorder] | None = None


@dataclass(eq=False)
class RunContext:
    """A run's configuration, scene, plan and output.

    A job's check makes it, and the job's run gets it, so that everything is built once.

    Attributes:
        cfg: The configuration.
        stage: Scene and plan; by default those of the configuration.
        folder: Where the run's files go, or None for none.
        overrides: The command line of the run.
        print_line: Prints a line, which has no markup.
        begin: Told the name of each part of the run as it begins.
        record: Gets each result as soon as there is one.
        advance: Told about progress.
        viewers: Look on at the one-world episode that is shown.
        live: Looks on at everything else too; None without ``view=web``.
        ranks: The processes of the run. Those that write nothing have no folder.
        artifacts: Products of gates.
        page: What the run shows besides its results.
    """

    cfg: Config
    stage: Stage = None  # type: ignore[assignment]
    folder: Path | None = None
    overrides: Sequence[str] = ()
    print_line: TextHook = lambda line: None
    begin: TextHook = lambda name: None
    record: Callable[[GateResult], None] = lambda result: None
    advance: Advance = lambda what, done, total: None
    viewers: Sequence[Observer] = ()
    live: LiveView | None = None
    artifacts: Artifacts = field(default_factory=Artifacts)
    page: Page = field(default_factory=Page)
    ranks: Ranks = field(default_factory=current_ranks)

    def __post_init__(self) -> None:
        if self.stage is None:
            self.stage = Stage(self.cfg)

    def with_config(self, cfg: Config) -> "RunContext":
        """A context for another configuration of the same scene and plan, which it shares. Its
        artifacts are its own: other starts, say, have other peaks.
        """
        return replace(self, cfg=cfg, artifacts=Artifacts())

    @property
    def spectators(self) -> list[LiveView]:
        """The live view, for episodes of many worlds."""
        return [] if self.live is None else [self.live]

    @property
    def model(self) -> mujoco.MjModel:
        """The scene for physics."""
        return self.stage.model

    @property
    def index(self) -> SceneIndex:
        """Addresses in the model."""
        return self.stage.index

    @property
    def planner(self) -> OpenLoopPlanner:
        """The planner, its nominal plan made."""
        return self.stage.planner

    @property
    def worlds(self) -> range:
        """Numbers of the worlds that this rank plays."""
        return self.ranks.share(self.cfg.nworld)

    @property
    def phases(self) -> list[Phase]:
        """Those of the driver: a policy and the state-based expert have none."""
        return [] if self.cfg.controller.name in PHASELESS else self.planner.phases

    @property
    def episode_steps(self) -> int:
        """Length of a driven episode."""
        return self.phases[-1].stop if self.phases else self.cfg.task.episode_steps

    @cached_property
    def check(self) -> EpisodeCheck:
        """The task's check, for its rules, thresholds and report."""
        return make_check(self.cfg)

    @cached_property
    def backend(self) -> tuple[Backend, str]:
        """Backend and device of batch, capacity and throughput."""
        return resolve_backend(self.cfg)

    @cached_property
    def nominal(self) -> NominalRun:
        """One native world's episode from the nominal starts: the reference of baseline
        and parity.
        """
        sim = make_simulation(self.model, self.cfg, 1, backend=Backend.native)
        world = WorldRecorder()
        snapshots = Snapshots(self.parity_steps.values())
        shown = () if "parity" in self.cfg.gates else self.viewers
        episode = self.play(sim, NOMINAL, [*shown, world, snapshots])
        return NominalRun(sim=sim, episode=episode, world=world, states=snapshots.states)

    @property
    def parity_steps(self) -> dict[str, int]:
        """Steps after which gate *parity* takes its states, by their names: the last ones of
        phases, or, without phases, of thirds of the episode.
        """
        if self.phases:
            states = self.cfg.gate.parity.states
            return {name: self.phase(phase).stop - 1 for name, phase in states.items()}
        return {f"third_{k}": k * self.episode_steps // 3 - 1 for k in (1, 2, 3)}

    def driven(self, reset: Reset) -> Config:
        """The configuration of a driven episode. The live view also shows rewards and success."""
        cfg = driven_config(self.cfg, reset)
        if self.cfg.view == "web":
            cfg = replace(cfg, reward=self.cfg.reward, task=self.cfg.task)
        return cfg

    def start(
        self,
        sim: Simulation,
        reset: Reset,
        *,
        seed: int | None = None,
        worlds: Sequence[int] | None = None,
    ) -> Env:
        """Build the environment of a driven episode, whose actions are the driver's commands, and
        reset every world.

        Args:
            sim: The worlds.
            reset: How worlds differ at the start.
            seed: Seed, if not the configured one.
            worlds: Their numbers, which random numbers depend on: ``[17]`` starts one world as
                world 17 of any batch starts. By default they are numbered from 0 on.
        """
        cfg = self.driven(reset)
        env = Env(sim, self.index, cfg, check_faults=False)
        return reset_worlds(env, cfg.seed if seed is None else seed, worlds)

    def driver(self, env: Env) -> Driver:
        """The configured driver, for worlds that have started."""
        sim = env.sim
        if env.cfg.controller.name == POLICY:
            return PolicyDriver(env, self.stage.policy, self.cfg.scene.cameras)
        if env.cfg.controller.name == CLOSED_LOOP:
            # Loads Warp, which a native open-loop run does not need.
            from mjstack.drivers.closed_loop import ClosedLoopDriver

            return ClosedLoopDriver(env, self.planner.nominal)
        if env.cfg.controller.name == STATE_BASED:
            from mjstack.drivers.state_based import StateBasedDriver

            return StateBasedDriver(env, self.planner.nominal)
        sources = source_xy(env).double().cpu().numpy()
        trajectory = self.planner.plan(
            sources,
            lambda done: self.advance("planning", done, sim.nworld),
            names=env.world.tolist(),
        ).to(sim.device, sim.ctrl.dtype)
        return OpenLoopDriver(trajectory, self.planner.phases)

    def play(
        self,
        sim: Simulation,
        reset: Reset,
        observers: Sequence[Observer] = (),
        *,
        seed: int | None = None,
        worlds: Sequence[int] | None = None,
    ) -> Episode:
        """Roll out one judged episode, at which the observers look on; other arguments as of
        `start`.
        """
        env = self.start(sim, reset, seed=seed, worlds=worlds)
        return play_episode(env, self.driver(env), observers, advance=self.advance)

    def batch_simulation(self, nworld: int) -> Simulation:
        """Worlds on the backend of the batch."""
        return self.simulation(nworld, *self.backend)

    def simulation(
        self,
        nworld: int,
        backend: Backend,
        device: str,
        *,
        reset: Reset | None = None,
        sizes: BatchSizes | None = None,
    ) -> Simulation:
        """Worlds that can start as the configuration says.

        Args:
            nworld: How many.
            backend: Native or MJWarp.
            device: ``cpu`` or ``cuda:N``.
            reset: How they start, if not as configured.
            sizes: Buffer sizes, if not those of the batch.
        """
        if sizes is None and backend is Backend.mjwarp:
            sizes = self.sizes
        return make_simulation(
            self.model,
            self.cfg,
            nworld,
            backend=backend,
            device=device,
            fields=required_fields(self.cfg.reset if reset is None else reset),
            sizes=sizes,
        )

    @property
    def sizes(self) -> BatchSizes:
        """Buffer sizes of the batch; with ``batch=auto`` they are measured first, unless *capacity*
        has done so.
        """
        # Native MuJoCo has no fixed buffers.
        if not self.cfg.batch.auto or self.backend[0] is Backend.native:
            return resolve_sizes(self.cfg)
        found = self.artifacts.sizes
        if found is None:
            what = "the driven task"
            source = f"{what} in {self.measuring_nworld} worlds"
            task = self.play_task(self.cfg.reset)
            found = self.artifacts.sizes = measured_sizes(self.cfg, what, task, source)
            self.print_line(str(apply_configured(self.cfg, found)))
        return apply_configured(self.cfg, found)

    @property
    def measuring_nworld(self) -> int:
        """How many worlds size the buffers."""
        most = self.cfg.gate.capacity.cpu_nworld
        on_cuda = self.backend[1].startswith("cuda")
        return self.cfg.nworld if on_cuda else min(self.cfg.nworld, most)

    def measuring_simulation(self, sizes: BatchSizes, reset: Reset | None = None) -> Simulation:
        """Worlds that size the buffers."""
        return self.simulation(self.measuring_nworld, *self.backend, reset=reset, sizes=sizes)

    def play_task(self, reset: Reset, sizes: BatchSizes | None = None) -> Workload:
        """Play the driven task once, in worlds of exactly these sizes; without, with room to
        spare.
        """
        return play_workload(
            self.cfg,
            lambda sizes: self.measuring_simulation(sizes, reset),
            lambda sim: self.play(sim, reset).failed,
            sizes,
        )

    @property
    def env_sizes(self) -> BatchSizes | None:
        """Buffer sizes of environments with ``batch=auto``, if *capacity* has measured them; None
        leaves it to `build_env`.
        """
        found = self.artifacts.env_sizes
        return apply_configured(self.cfg, found) if self.cfg.batch.auto and found else None

    def phase(self, name: str) -> Phase:
        """A phase of the scripted motion by its name."""
        return next(phase for phase in self.planner.phases if phase.name == name)


def lacks_episode(cfg: Config) -> str:
    """Why no driver can play a judged episode of the task; empty if one can."""
    if not cfg.controller.phases and cfg.controller.name != POLICY:
        return f"task {cfg.task.name} has no phases: no open- or closed-loop driver"
    if cfg.task.check is None:
        return f"task {cfg.task.name} has no check"
    return ""


def require_episode(cfg: Config) -> None:
    """Refuse a job that plays episodes of a task that has none.

    Raises:
        ConfigError: The task has no phases, or no check.
    """
    if reason := lacks_episode(cfg):
        expected = f"a task with phases and a check, which job={cfg.job.name} plays ({reason})"
        raise ConfigError("task", cfg.task.name, expected, "Train it: mjstack.make_env")


def judge_one(context: RunContext, episode: Episode) -> tuple[Status, str, dict]:
    """Status, reason and metrics of a one-world episode."""
    bits = int(episode.failed[0])
    metrics = {name: float(values[0]) for name, values in episode.values.items()}
    status = Status.failed if bits else Status.passed
    return status, f"failed: {context.check.rules.describe(bits)}" if bits else "", metrics
