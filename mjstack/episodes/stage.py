"""The stage: scene, plan and policy, and the simulations, environments and drivers that are made of
them. All that a trainer or a benchmark needs of a run.
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import mujoco

from mjstack.config.schema import Backend, Config, TermCfg
from mjstack.distributed import Ranks, current_ranks
from mjstack.drivers.driver import Assets, Driver, find_driver
from mjstack.drivers.open_loop import OpenLoopPlanner
from mjstack.envs import Env, build_env, driven_config
from mjstack.envs.buffers import Advance, Peaks, measure_peaks, measured_sizes
from mjstack.episodes.rollout import (
    Episode,
    Observer,
    Reset,
    play_episode,
    reset_worlds,
    rollout,
)
from mjstack.managers.episode import required_fields
from mjstack.policy import Policy
from mjstack.scene import SceneIndex
from mjstack.scene.phases import Phase
from mjstack.sim import (
    BatchSizes,
    Simulation,
    StateRenderer,
    make_simulation,
    resolve_backend,
    resolve_sizes,
)
from mjstack.sim.cameras import with_outputs
from mjstack.tasks.check import EpisodeCheck, make_check

TextHook = Callable[[str], None]
_SHARES = 4  # of the contact pool, for a world that is alone


@dataclass(frozen=True)
class Progress:
    """Where a run prints. By default nowhere.

    Attributes:
        print_line: Prints a line, which has no markup.
        advance: Shows how much of a part is done.
    """

    print_line: TextHook = lambda line: None
    advance: Advance = lambda what, done, total: None


@dataclass(eq=False)
class Stage:
    """Makes the simulations, environments and drivers of a configuration.

    Attributes:
        cfg: The configuration.
        assets: Scene, plan and policy, which several configurations may share; by default those of
            this one.
        ranks: The processes of the run.
        measured: Buffer sizes of ``batch=auto`` that were measured: those of the driven ``task``,
            and from *capacity* those of environments (``env``).
        progress: Where the run prints.
        observers: Look on at every rollout of many worlds, such as the live view.
    """

    cfg: Config
    assets: Assets = None  # type: ignore[assignment]
    ranks: Ranks = field(default_factory=current_ranks)
    measured: dict[str, BatchSizes] = field(default_factory=dict)
    progress: Progress = field(default_factory=Progress)
    observers: Sequence[Observer] = ()

    def __post_init__(self) -> None:
        """Make the assets of the configuration, if there are none."""
        self.assets = self.assets or Assets(self.cfg)

    def with_config(self, cfg: Config, **changes: Any) -> "Stage":
        """A stage for another configuration, which shares all attributes that do not change. It
        measures sizes itself unless it is given some: other starts, say, have other peaks.
        """
        return replace(self, cfg=cfg, **({"measured": {}} | changes))

    # What is built once

    @property
    def model(self) -> mujoco.MjModel:
        """The scene for physics."""
        return self.assets.model

    @property
    def index(self) -> SceneIndex:
        """Addresses in the model."""
        return self.assets.index

    @property
    def planner(self) -> OpenLoopPlanner:
        """The planner, its nominal plan made."""
        return self.assets.planner

    @cached_property
    def check(self) -> EpisodeCheck:
        """The task's check, for its rules, thresholds and report."""
        return make_check(self.cfg)

    @cached_property
    def backend(self) -> tuple[Backend, str]:
        """Backend and device of batch, capacity and throughput."""
        return resolve_backend(self.cfg)

    # The driven episode

    @property
    def worlds(self) -> range:
        """Numbers of the worlds that this rank plays."""
        return self.ranks.share(self.cfg.nworld)

    @property
    def driver_class(self) -> type[Driver]:
        """The configured driver's, which says what it can do."""
        return find_driver(self.cfg)

    @property
    def policy(self) -> Policy | None:
        """The policy that drives, with its action terms; None of any other driver."""
        return self.driver_class.trained_policy(self.assets)

    @property
    def phases(self) -> list[Phase]:
        """Those that the driver's worlds go through; none of a policy and other drivers without."""
        return self.planner.phases if self.driver_class.phased else []

    @property
    def episode_steps(self) -> int:
        """Length of a driven episode."""
        return self.phases[-1].stop if self.phases else self.cfg.task.episode_steps

    def phase(self, name: str) -> Phase:
        """A phase of the scripted motion by its name."""
        return next(phase for phase in self.planner.phases if phase.name == name)

    @cached_property
    def action(self) -> dict[str, TermCfg]:
        """Action terms of the driver: a policy's own, or joint targets.

        Raises:
            MjstackError: The policy cannot be read, or was trained for something else.
        """
        policy = self.policy
        if policy is None:
            return self.cfg.controller.action
        policy.check_fit(self.cfg)
        return policy.action

    def driven(self, reset: Reset) -> Config:
        """The configuration of a driven episode. Of a driver that needs no phases it has success in
        every step.
        """
        cfg = driven_config(self.cfg, reset, self.action)
        if not self.driver_class.needs_phases:
            graph = "off" if self.driver_class.on_host else cfg.graph
            cfg = replace(cfg, task=self.cfg.task, graph=graph)
        return cfg

    def start(
        self,
        sim: Simulation,
        reset: Reset,
        *,
        seed: int | None = None,
        worlds: Sequence[int] | None = None,
    ) -> Env:
        """Build the environment of a driven episode, whose action terms are the driver's, and reset
        every world.

        Args:
            sim: The worlds.
            reset: How worlds differ at the start.
            seed: Seed, if not the configured one.
            worlds: Their numbers, which random numbers depend on: ``[17]`` starts one world as
                world 17 of any batch starts. By default they are numbered from 0 on.
        """
        env = Env(sim, self.index, self.driven(reset), check_faults=False)
        return reset_worlds(env, seed, worlds)

    def driver(self, env: Env) -> Driver:
        """The configured driver, for worlds that have started."""
        return find_driver(env.cfg).build(env, self.cfg, self.assets)

    def play(
        self, sim: Simulation, reset: Reset, observers: Sequence[Observer] = (), **options: Any
    ) -> Episode:
        """Roll out one judged episode, at which the observers look on; options as of `start`."""
        env = self.start(sim, reset, **options)
        return play_episode(env, self.driver(env), observers, advance=self.progress.advance)

    def drive(self, sim: Simulation) -> None:
        """Roll out one episode without the task's check."""
        env = self.start(sim, self.cfg.reset)
        rollout(env, self.driver(env), advance=self.progress.advance)

    # Simulations

    def batch_simulation(self, nworld: int) -> Simulation:
        """Worlds on the backend of the batch."""
        return self.simulation(nworld, *self.backend)

    def simulation(
        self, nworld: int, backend: Backend, device: str, *, sizes: BatchSizes | None = None
    ) -> Simulation:
        """So many worlds that can start as the configuration says, on a backend and a device,
        ``cpu`` or ``cuda:N``, with buffer sizes of the batch unless there are others.
        """
        if sizes is None and backend is Backend.mjwarp:
            sizes = self.sizes
        return make_simulation(
            self.model,
            self.cfg,
            nworld,
            backend=backend,
            device=device,
            fields=required_fields(self.cfg.reset),
            sizes=sizes,
        )

    def simulate_alone(self, backend: Backend, device: str) -> Simulation:
        """A world of the batch without the others. In its batch it could take more than its share
        of the contact pool, so it gets some more.
        """
        sizes = resolve_sizes(self.cfg)
        nconmax = min(_SHARES, self.cfg.nworld) * sizes.nconmax
        sizes = replace(sizes, nconmax=nconmax, nccdmax=None)
        return self.simulation(1, backend, device, sizes=sizes)

    @property
    def sizes(self) -> BatchSizes:
        """Buffer sizes of the batch; with ``batch=auto`` they are measured first, unless *capacity*
        has done so.
        """
        # Native MuJoCo has no fixed buffers.
        if not self.cfg.batch.auto or self.backend[0] is Backend.native:
            return resolve_sizes(self.cfg)
        if "task" not in self.measured:
            self.measured["task"] = measured_sizes(self.cfg, self.measure(), "the driven task")
            self.progress.print_line(str(self.measured["task"]))
        return self.measured["task"]

    def measure(self, *, driven: bool = True) -> Peaks:
        """The most that the driven task, or else random actions, use of the buffers."""
        cfg = self.cfg
        worlds = (cfg, self.model, cfg.nworld, *self.backend)
        drive = self.drive if driven else None
        return measure_peaks(*worlds, drive=drive, advance=self.progress.advance)

    def native_env(self, cfg: Config, nworld: int = 1) -> closing[Env]:
        """An environment of the scene on native MuJoCo, to find out about its terms."""
        return closing(
            build_env(cfg, model=self.model, nworld=nworld, backend=Backend.native, device="cpu")
        )

    def color_renderer(
        self, count: int, fields: Sequence[str], cameras: Sequence[str] | None = None
    ) -> StateRenderer:
        """Renderer of the cameras' colours, on the backend of the batch.

        Args:
            count: Most states that are drawn at once.
            fields: Model fields that differ between them.
            cameras: Names of the cameras; all if None.
        """
        scene = self.cfg.scene
        chosen = with_outputs(scene.cameras, ["rgb"], cameras)
        cfg = replace(self.cfg, scene=replace(scene, cameras=chosen))
        return StateRenderer(self.model, cfg, count, fields=fields)
