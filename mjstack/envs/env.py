"""The environment: one step order over any simulation."""

from collections.abc import Callable
from functools import cached_property, partial

import torch
from torch import Tensor

from mjstack.config.schema import Config
from mjstack.envs.camera_schedule import CameraSchedule
from mjstack.envs.command_delay import CommandDelay
from mjstack.envs.faults import FaultLatch
from mjstack.envs.outputs import EpisodeStatistics, Outputs, ResetResult, StepResult
from mjstack.envs.schedule import run, step_order
from mjstack.envs.threads import few_threads
from mjstack.errors import ArgumentError
from mjstack.managers.action import ActionManager
from mjstack.managers.episode import ResetManager, RewardManager, TerminationManager
from mjstack.managers.observation import ObservationManager
from mjstack.managers.state import in_one_pass, lost_state
from mjstack.managers.term import Term, current_term, first_value
from mjstack.rng import check_seed
from mjstack.scene import SceneIndex
from mjstack.sim import Simulation
from mjstack.sim.graph import StepGraph, where_any
from mjstack.tasks.check import EpisodeCheck, make_check
from mjstack.tasks.view import Step


class Env:
    """Many worlds of one task, stepped by actions.

    One step, in this order:

    1. the action manager takes the action and writes ``sim.ctrl``;
    2. the simulation makes ``decimation`` physics steps and brings body, site and geom poses up to
       date;
    3. success, terminations and rewards look at the new state;
    4. observations are computed: for the worlds that end here, this is the terminal observation;
    5. finished episodes go into the statistics;
    6. the worlds that ended are reset, and observed again;
    7. the cameras of ``scene.cameras`` are drawn, once for all worlds. One that is slower than the
       control rate is drawn in the first step of a world's episode and then in every so many.

    With ``timing.policy_decimation`` 1 to 4 are repeated so many times with the same action, each
    time for a control step. Rewards are summed. A world whose episode ends before the last of them
    goes on without rewards until then, and is reset with the others: its success, its length and
    its way of ending are those of the control step in which it ended. Observations are computed
    after the last one, and with a history after each.

    On CUDA the whole step is one graph: the first step after a build runs eagerly, the second is
    captured, and later ones replay it. After a change of anything that it has baked in, such as a
    term's Python number, call `recapture`.

    Values that derive from contacts (``sensordata``, ``contact_count``) are those of the last
    physics step before, and zero in a world that has just been reset. Attributes are those of
    `EnvView`, and these.

    Attributes:
        action_manager: Actions; ``action_dim`` is the policy's output.
        observation_manager: Observation groups; ``group_dims`` are the policy's inputs.
        reset_manager: How episodes start.
        termination_manager: How they end.
        reward_manager: What they are worth.
        command_delay: The commands that physics has not seen yet, and how late each world's are.
        faults: What went wrong on the device; `FaultLatch.raise_first` raises it.
        graph: What `step` repeats, captured or not.
        images: What the cameras have drawn last, by output and camera, such as ``images.front``;
            see `Cameras.allocate`. It is their own memory, which every step writes.
        cameras: What draws them, with the names in their segmentation; None without cameras.
    """

    termination_manager: TerminationManager
    reward_manager: RewardManager
    observation_manager: ObservationManager
    faults: FaultLatch

    def __init__(
        self,
        sim: Simulation,
        index: SceneIndex,
        cfg: Config,
        *,
        check_faults: bool = True,
        first_world: int = 0,
    ) -> None:
        """Build the managers on a simulation, and check every term once.

        Args:
            sim: The worlds, with the model fields that the reset terms write
                (`managers.required_fields`).
            index: Addresses in the simulation's model.
            cfg: The configuration: action, observation, reset, termination, reward and task.success
                are used.
            check_faults: Raise when physics was lost. Gates judge such worlds themselves.
            first_world: Number of the first world, where other processes have the ones before: a
                world's random numbers depend on its number.

        Raises:
            MjstackError: A term cannot be found, built or used; the message names it.
        """
        self.sim = sim
        self.index = index
        self.cfg = cfg
        self.nworld = sim.nworld
        self.device = sim.device
        self.seed = cfg.seed
        self.key = torch.full((1,), cfg.seed, dtype=torch.int64, device=sim.device)
        self.world = torch.arange(first_world, first_world + sim.nworld, device=sim.device)
        self.episode = torch.full_like(self.world, -1)
        self.episode_step = torch.zeros_like(self.world)
        self.given_places: dict[str, Tensor] = {}
        self.success = torch.zeros(sim.nworld, dtype=torch.bool, device=sim.device)
        self._all_worlds = torch.ones_like(self.success)
        self._version = 0
        self._started = False
        self._closed = False
        self.command_delay = CommandDelay(self)
        if self.device.type != "cuda":  # autograd's records take a tenth of their time
            for name in ("_evaluate", "_begin"):
                setattr(self, name, torch.inference_mode()(getattr(self, name)))

        # Terms are checked on worlds that have started, because a term may read anything.
        self.reset_manager = ResetManager(self, cfg.reset)
        self._start(self._all_worlds)
        self.action_manager = ActionManager(self, cfg.action)
        self.action = self.action_manager.action
        self.previous_action = self.action_manager.previous_action
        self.success_term: Term | None = None
        if cfg.task.success is not None:
            self.success_term = Term("task.success", cfg.task.success, self)
            first_value(self.success_term, self, boolean=True)
        self.termination_manager = TerminationManager(self, cfg.termination)
        self.reward_manager = RewardManager(self, cfg.reward)
        self.observation_manager = ObservationManager(self, cfg.observation)
        self.statistics = EpisodeStatistics(self)
        self._begin(self._all_worlds)
        self._draws = CameraSchedule(self)
        self.images = self._draws.images
        self.cameras = self._draws.cameras
        self.episode.fill_(-1)
        self._outputs = Outputs(self)
        self.faults = FaultLatch(self, check=check_faults)
        self.graph = self.captured(self.advance, "env.step")

    @cached_property
    def check(self) -> EpisodeCheck:
        """The task's check, which terms, drivers and observers of this environment share."""
        return make_check(self.cfg)

    @cached_property
    def state(self) -> Step:
        """The state of the check's objects, without phases, which they share too."""
        return Step(self, self.check.objects, force=self.check.force)

    @property
    def max_episode_steps(self) -> int:
        """Control step after which an episode times out: the time-out term's, else the task's."""
        terms = self.cfg.termination.values()
        limits = [t.params["steps"] for t in terms if t.time_out and "steps" in t.params]
        return min(limits, default=self.cfg.task.episode_steps)

    def reset(self, *, seed: int | None = None, mask: Tensor | None = None) -> ResetResult:
        """Start new episodes.

        Args:
            seed: Starts every world's episode 0 under this seed. Without it, each reset world goes
                on to its next episode.
            mask: Which worlds, shape ``(nworld,)``, bool; all if None.

        Returns:
            Observations by group, each ``(nworld, dim)``, float32, and `images`; and an empty dict.

        Raises:
            ArgumentError: The seed or the mask cannot be used.
        """
        if self._closed:
            raise ArgumentError(
                "env", "reset() after close()", "an open environment", "Make a new one"
            )
        if mask is not None:
            self.sim.check_mask(mask)
            if not self._started:
                expected = "none at the first reset"
                raise ArgumentError("mask", "a part of the worlds", expected, "Call env.reset()")
        if seed is not None:
            self.seed = check_seed(seed, masked=mask is not None)
            self.key.fill_(self.seed)
            self.episode.fill_(-1)
        self._begin(self._all_worlds if mask is None else mask)
        if mask is None:
            self.faults.clear()
            self._started = True
        self._draws.draw_started(mask)
        observed = self.observation_manager.groups.items()
        return {name: group.clone() for name, group in observed} | self.images, {}

    def step(self, action: Tensor) -> StepResult:
        """Advance every world by one decision of the policy; see the class for the order.

        Args:
            action: Shape ``(nworld, action_dim)``, float32 or float64.

        Returns:
            ``obs``: by group, ``(nworld, dim)``, float32; of worlds that ended, the first of the
                new episode. And `images`, not copied: the next step writes into them.
            ``reward``: ``(nworld,)``, float32; the sum over the control steps.
            ``terminated``: ended by what happened, ``(nworld,)``, bool.
            ``truncated``: ended by the clock alone, ``(nworld,)``, bool.
            ``extras``: ``final_obs`` (as ``obs``, before the reset: valid where an episode ended;
                images of cameras with ``terminal`` alone) and ``success`` (at the end of this step,
                before the reset).

        All of them but images are the caller's to keep.

        Raises:
            ArgumentError: The action has a wrong shape, dtype or device, or is not finite.
            FaultError: Physics was lost, or a term gave a number that is not finite; on CUDA within
                200 steps.
        """
        if not self._started:
            call = "step() before reset(), or after close()"
            raise ArgumentError("env", call, "reset() first", "Call env.reset()")
        with few_threads(self.device, self.nworld):
            self.action_manager.process(action)
            self.graph()
            self.faults.after_step()
            return self._outputs.returned(self.images, self._draws.final_images)

    def advance(self) -> None:
        """The part of `step` that is the same at every step: it acts on the action that was
        processed last. On CUDA it has no host read, so that a larger graph may hold it.
        """
        ended = None
        for left in reversed(range(self.cfg.timing.policy_decimation)):
            self.action_manager.apply()
            self._step_physics()
            ended = self._evaluate(ended, last=left == 0)
        current_term.label = ""
        self._draws.draw_step()

    def captured(self, work: Callable[[], None], name: str) -> StepGraph:
        """Work of this environment as a graph on CUDA; elsewhere as it is. It is `advance`, and
        everything that is to be captured along with it; messages use its name.
        """
        return StepGraph(
            few_threads(self.device, self.nworld)(work),
            self.device,
            self.cfg.graph if self.device.type == "cuda" else "off",
            name=name,
            version=lambda: self._version,
            culprit=lambda: current_term.label,
        )

    def recapture(self) -> None:
        """Have graphs captured anew, after a change of something baked in."""
        self._version += 1

    def parts(self) -> tuple[StepGraph, StepGraph, StepGraph]:
        """The physics of a control step, the managers, and the images of all cameras: three graphs,
        for measurements. The first two act on the action that was processed last.
        """

        def managers() -> None:
            self.action_manager.apply()
            self._evaluate()

        physics = self.captured(self._step_physics, "the physics")
        images = self.captured(lambda: self._draws.draw_started(None), "the images")
        return physics, self.captured(managers, "the managers"), images

    def read_statistics(self) -> dict[str, float]:
        """Means over the episodes that ended since the last call; see `EpisodeStatistics.read`."""
        self.faults.raise_first()
        return self.statistics.read()

    def close(self) -> None:
        """Give the simulation's threads and buffers back. Nothing can be stepped afterwards."""
        self._started = False
        self._closed = True
        self.sim.synchronize()
        self.graph.drop()
        self._draws.close()
        self.sim.close()

    def __str__(self) -> str:
        managers = [self.action_manager, self.observation_manager, self.reset_manager]
        managers += [self.termination_manager, self.reward_manager]
        title = f"{self.cfg.task.name} with {self.cfg.robot.title}: {self.nworld} worlds, "
        return "\n".join(map(str, [title + self.sim.description, *managers]))

    def _step_physics(self) -> None:
        current_term.label = ""
        with self.command_delay.late():
            self.sim.step(self.cfg.timing.decimation, kinematics=True)

    def _evaluate(self, ended: Tensor | None = None, *, last: bool = True) -> Tensor | None:
        """Success, terminations and rewards of the new state; after the ``last`` control step of a
        decision observations and resets.

        Takes the worlds whose episode ended in an earlier control step of the decision, shape
        ``(nworld,)``, bool, None in the first one, and returns those for the next; None after the
        last.
        """
        self.episode_step += 1 if ended is None else ~ended

        def evaluate() -> bool:
            run(self.device, step_order(self, self._outputs, ended, last))
            current_term.label = ""
            self.faults.look()
            return lost_state(self) is not self.sim.no_worlds

        maybe_lost = in_one_pass(evaluate)
        done = self.termination_manager.done
        if last:
            self._reset_ended(done, maybe_lost)
        return None if last else done.clone()

    def _reset_ended(self, done: Tensor, maybe_lost: bool) -> None:
        """Terminal images, statistics, the reset of the worlds that are ``done``, and what is
        observed then. The host sees where it cannot be that a state is not finite.
        """
        # On CUDA the host cannot look, because that would stop the device: the graph does.
        ending = self.termination_manager.values.shape[1] > 0 and (done.is_cuda or bool(done.any()))

        def restart() -> None:
            self.statistics.update(done)
            self._begin(done)

        self._draws.draw_ended(done)
        if ending:
            where_any(done, restart)
        elif maybe_lost:
            self._outputs.restore_observations()

    def _begin(self, mask: Tensor) -> None:
        """Begin and observe the next episode of the masked worlds, shape ``(nworld,)``, bool."""
        self._start(mask)
        self.command_delay.reset(mask)
        for manager in (self.action_manager, self.termination_manager, self.reward_manager):
            manager.reset(mask)
        self.success.masked_fill_(mask, False)
        if self.success_term is not None:
            self.success_term.reset(mask)
        in_one_pass(partial(self.observation_manager.refresh, mask))

    def _start(self, mask: Tensor) -> None:
        """Put the masked worlds at their next start, from seed, world and episode alone."""
        self.episode += mask
        self.episode_step.masked_fill_(mask, 0)
        self.reset_manager.reset(mask)
        self.sim.kinematics(mask)
