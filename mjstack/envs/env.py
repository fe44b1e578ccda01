"""The environment: one step order over any simulation."""

from __future__ import annotations

import operator
from collections.abc import Callable
from enum import Enum
from typing import Any

import torch

from mjstack.config.schema import Config
from mjstack.envs.outputs import Outputs
from mjstack.envs.parts import Eager, Repeated, StepParts
from mjstack.envs.statistics import EpisodeStatistics
from mjstack.errors import ArgumentError, FaultError, name_worlds
from mjstack.managers.action import ActionManager
from mjstack.managers.base import Term, first_value, one_pass, running
from mjstack.managers.observation import ObservationManager
from mjstack.managers.reset import ResetManager
from mjstack.managers.reward import RewardManager
from mjstack.managers.termination import TerminationManager
from mjstack.scene import SceneIndex
from mjstack.sim import LOST_PHYSICS, Overflow, Simulation, describe_overflow

FAULT_WINDOW = 200  # steps between two looks at the faults on CUDA; on the CPU looking costs nothing


class Fault(Enum):
    """What went wrong in a world, latched on the device until the host looks; in the order of `Env._latch`."""

    ACTION = "actions were not finite"
    STATE = "the state is not finite"
    REWARD = "the reward is not finite"
    OBSERVATION = "an observation is not finite"


class Env:
    """Many worlds of one task, stepped by actions.

    One step, in this order:

    1. the action manager takes the action and writes ``sim.ctrl``;
    2. the simulation makes ``substeps`` physics steps and brings body, site and geom poses up to date;
    3. success, terminations and rewards look at the new state;
    4. observations are computed: for the worlds that end here, this is the terminal observation;
    5. finished episodes go into the statistics;
    6. the worlds that ended are reset, and observed again.

    On CUDA the whole step is one graph: the first step after a build runs eagerly, the second is captured, and later ones
    replay it. It is captured anew after ``sim.resize`` and ``sim.set_options``; after a change of anything else that it has
    baked in, such as a term's Python number, call `recapture`.

    What derives from contacts (``sensordata``, ``contact_count``) is that of the last physics step before, and zero in a
    world that has just been reset.

    Attributes:
        sim: The worlds.
        index: Where names lie in their views.
        cfg: The configuration.
        nworld: Number of worlds.
        device: Where tensors live.
        seed: Seed of every random number; `reset` may set it.
        key: The same on the device, shape ``(1,)``, int64.
        world: Number of each world, shape ``(nworld,)``, int64.
        episode: Episode of each world, shape ``(nworld,)``, int64.
        frame: Frames since each world's last reset, shape ``(nworld,)``, int64.
        success: Whether the task is achieved, shape ``(nworld,)``, bool.
        action_manager: Actions; ``action_dim`` is the policy's output.
        observation_manager: Observation groups; ``group_dims`` are the policy's inputs.
        reset_manager: How episodes start.
        termination_manager: How they end.
        reward_manager: What they are worth.
        graph: What `step` repeats, captured or not.
    """

    def __init__(self, sim: Simulation, index: SceneIndex, cfg: Config, *, check_faults: bool = True) -> None:
        """Builds the managers on a simulation, and checks every term once.

        Args:
            sim: The worlds, with the model fields that the reset terms write (`managers.required_fields`).
            index: Addresses in the simulation's model.
            cfg: The configuration: action, observation, reset, termination, reward and task.success are used.
            check_faults: Raise when physics was lost. Gates, which judge such worlds themselves, do without.

        Raises:
            MjstackError: A term cannot be found, built or used; the message names it.
        """
        self.sim, self.index, self.cfg = sim, index, cfg
        self.nworld, self.device = sim.nworld, sim.device
        self.key = torch.zeros(1, dtype=torch.int64, device=sim.device)
        self.seed = cfg.seed
        self.world = torch.arange(sim.nworld, device=sim.device)
        self.episode = torch.full_like(self.world, -1)
        self.frame = torch.zeros_like(self.world)
        self.success = torch.zeros(sim.nworld, dtype=torch.bool, device=sim.device)
        self._everyone = torch.ones_like(self.success)
        self._nobody = torch.zeros_like(self.success)
        self._faults = torch.zeros((sim.nworld, len(Fault)), dtype=torch.bool, device=sim.device)
        self._overflow = torch.zeros(sim.nworld, dtype=torch.int32, device=sim.device)
        self._ends_on_overflow, self._ends_on_non_finite = self._ends_on("overflow"), self._ends_on("non_finite")
        self._steps = self._version = 0
        self._check_faults = check_faults
        self._started = self._closed = False
        self._substeps = cfg.timing.substeps

        # Terms are checked on worlds that have started, because a term may read anything.
        self.reset_manager = ResetManager(self, cfg.reset)
        self.episode.zero_()
        self._write_start(self._everyone)
        self.action_manager = ActionManager(self, cfg.action)
        self._success = None if cfg.task.success is None else Term("task.success", cfg.task.success, self)
        if self._success is not None:
            first_value(self._success, self, dims=(1,), boolean=True)
        self.termination_manager = TerminationManager(self, cfg.termination)
        self.reward_manager = RewardManager(self, cfg.reward)
        self.observation_manager = ObservationManager(self, cfg.observation)
        self.statistics = EpisodeStatistics(self.reward_manager.names, self.termination_manager.names, sim.device)
        self._forget(self._everyone)
        self.episode.fill_(-1)
        self._bind_outputs()
        self.graph = self.captured(self.advance, "env.step")

    @property
    def seed(self) -> int:
        """Seed of every random number."""
        return self._seed

    @seed.setter
    def seed(self, value: int) -> None:
        self._seed = value
        self.key.fill_(value)

    @property
    def action(self) -> torch.Tensor:
        """The policy's last action, shape ``(nworld, action_dim)``."""
        return self.action_manager.action

    @property
    def previous_action(self) -> torch.Tensor:
        """The one before."""
        return self.action_manager.previous_action

    @property
    def max_episode_frames(self) -> int:
        """Frames after which an episode times out: the time-out term's, or the task's where there is none."""
        limits = [t.params["frames"] for t in self.cfg.termination.values() if t.time_out and "frames" in t.params]
        return min(limits, default=self.cfg.task.episode_frames)

    def reset(
        self, *, seed: int | None = None, mask: torch.Tensor | None = None
    ) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Starts new episodes.

        Args:
            seed: Starts every world's episode 0 under this seed. Without it, each reset world goes on to its next episode.
            mask: Which worlds, shape ``(nworld,)``, bool; all if None.

        Returns:
            Observations by group, each ``(nworld, dim)``, float32; and an empty dict.

        Raises:
            ArgumentError: The seed or the mask cannot be used.
            FaultError: The start does not fit the batch sizes.
        """
        if self._closed:
            raise ArgumentError("env", "reset() after close()", "an open environment", "Make a new one")
        mask = self._everyone if mask is None else self._check_mask(mask)
        if seed is not None:
            if mask is not self._everyone:
                raise ArgumentError(
                    "seed", str(seed), "no mask beside it, because a seed starts every world anew", "Leave one out"
                )
            if isinstance(seed, bool) or not hasattr(seed, "__index__") or not 0 <= operator.index(seed) < 1 << 32:
                raise ArgumentError("seed", repr(seed), "an integer from 0 to 4294967295")
            self.seed = operator.index(seed)
            self.episode.fill_(-1)
        self.episode += mask
        self.frame.masked_fill_(mask, 0)
        self._write_start(mask)
        if mask is self._everyone:
            self._require_capacity()
            for latch in (self._faults, self._overflow):
                latch.zero_()
            self._started = True
        self._forget(mask)
        return _copies(self.observation_manager.refresh(mask)), {}

    def step(
        self, action: torch.Tensor
    ) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advances every world by one control interval; see the class for the order.

        Args:
            action: Shape ``(nworld, action_dim)``, float32.

        Returns:
            ``obs``: by group, ``(nworld, dim)``, float32; of worlds that ended, the first of the new episode.
            ``reward``: ``(nworld,)``, float32.
            ``terminated``: ended by what happened, ``(nworld,)``, bool.
            ``truncated``: ended by the clock alone, ``(nworld,)``, bool.
            ``extras``: ``final_obs`` (as ``obs``, before the reset: valid where an episode ended) and ``success`` (at the
            end of this frame, before the reset).

        All of them are the caller's to keep.

        Raises:
            ArgumentError: The action has a wrong shape, dtype or device, or is not finite.
            FaultError: Physics was lost, or a term gave a number that is not finite; on CUDA within 200 steps.
        """
        if not self._started:
            raise ArgumentError("env", "step() before reset(), or after close()", "reset() first", "Call env.reset()")
        self.action_manager.take(action)
        self.graph()
        self._steps += 1
        if self._check_faults and self._everyone.is_cuda and self._steps % FAULT_WINDOW == 0:
            self.raise_faults()
        out = self._outputs.copy()
        obs = {name: out[f"obs/{name}"] for name in self.observation_manager.groups}
        final = {name: out[f"final/{name}"] for name in self.observation_manager.groups}
        return obs, out["reward"], out["terminated"], out["truncated"], {"final_obs": final, "success": out["success"]}

    def advance(self) -> None:
        """The part of `step` that is the same at every frame: it acts on the action that was taken in, and returns nothing.

        On CUDA it has fixed shapes and no host read, so that a larger graph may hold it.
        """
        self._command()
        self._move()
        self._judge()
        running.label = ""

    def captured(self, work: Callable[[], None], name: str) -> Repeated:
        """Work of this environment as a graph on CUDA; elsewhere as it is.

        Args:
            work: `advance`, and whatever is to be captured along with it.
            name: What it is called in messages.
        """
        if self.device.type != "cuda":
            return Eager(work)
        from mjstack.sim.graph import StepGraph  # loads Warp, which native runs do not need

        return StepGraph(
            work,
            self.device,
            self.cfg.graph,
            name=name,
            version=lambda: self.sim.version + self._version,
            culprit=lambda: running.label,
        )

    def recapture(self) -> None:
        """Has every graph of this environment captured anew: for a change of something that a graph has baked in."""
        self._version += 1

    def parts(self) -> StepParts:
        """A step taken apart, for measurements."""

        def managers() -> None:
            self._command()
            self._judge()

        return StepParts(self.captured(self._move, "the physics"), self.captured(managers, "the managers"))

    def read_statistics(self) -> dict[str, float]:
        """Means over the episodes that ended since the last call; see `EpisodeStatistics.read`. Waits for the device."""
        self.raise_faults()
        return self.statistics.read()

    def raise_faults(self) -> None:
        """Looks at what went wrong on the device. Waits for it.

        Raises:
            FaultError: Something did; names the worlds and what to do.
        """
        if not bool(self._faults.any() | (self._overflow != 0).any()):
            return
        overflow = self._overflow.tolist()
        lost = [w for w, bits in enumerate(overflow) if bits]
        if lost:
            bits = 0
            for w in lost:
                bits |= overflow[w]
            raise FaultError(
                f"{describe_overflow(bits)} overflow in {name_worlds(lost, self.nworld)}", self._capacity_hint(bits)
            )
        for column, fault in enumerate(Fault):
            worlds = self._faults[:, column].nonzero()[:, 0].tolist()
            if worlds:
                where = f"{name_worlds(worlds, self.nworld)}{self._culprits(fault, worlds[0])}"
                raise FaultError(f"{fault.value} in {where}", _FIXES[fault])

    def close(self) -> None:
        """Gives the simulation's threads and buffers back. Nothing can be stepped afterwards."""
        self._started = False
        self._closed = True
        self.sim.synchronize()
        self.graph.drop()
        self.sim.close()

    def __str__(self) -> str:
        head = f"{self.cfg.task.name} with {self.cfg.robot.title}: {self.nworld} worlds, {self.sim.description}"
        managers = (
            self.action_manager,
            self.observation_manager,
            self.reset_manager,
            self.termination_manager,
            self.reward_manager,
        )
        return "\n".join((head, *(str(manager) for manager in managers)))

    def _bind_outputs(self) -> None:
        """Moves what `step` returns side by side."""
        rewards, ends, observations = self.reward_manager, self.termination_manager, self.observation_manager
        returned = {f"obs/{name}": group for name, group in observations.groups.items()}
        returned |= {f"final/{name}": group for name, group in observations.groups.items()}
        returned |= {"reward": rewards.reward, "terminated": ends.terminated, "truncated": ends.truncated}
        self._outputs = Outputs(returned | {"success": self.success}, self.device)
        out = self._outputs.tensors
        rewards.reward, ends.terminated, ends.truncated = out["reward"], out["terminated"], out["truncated"]
        for name in observations.groups:
            observations.groups[name] = out[f"obs/{name}"]

    def _command(self) -> None:
        running.label = ""
        self.action_manager.accept()
        self.action_manager.write_commands()

    def _move(self) -> None:
        running.label = ""
        self.sim.step(self._substeps, kinematics=True)

    def _judge(self) -> None:
        """What looks at the new state, and the resets."""
        self.frame += 1
        # 0 times a number that is not finite is NaN, which is no longer 0.
        broken = ((self.sim.qpos * 0.0).sum(1) + (self.sim.qvel * 0.0).sum(1)) != 0.0
        if self._success is not None:
            torch.logical_and(self._success(self), ~broken, out=self.success)

        def reward() -> None:
            with one_pass():
                self.termination_manager.compute()
                self.reward_manager.compute(void=broken)

        def observe() -> None:
            with one_pass():
                self.observation_manager.compute()

        self._side_by_side(reward, observe)
        running.label = ""
        if self._check_faults and not broken.is_cuda:
            self._latch(broken)
            self.raise_faults()
        self._reset_ended(broken)

    def _latch(self, broken: torch.Tensor) -> None:
        """Keeps what went wrong, before a reset can erase it."""
        # A world's own overflow may end its episode; that of the shared pool voids the whole batch.
        self._overflow |= self.sim.overflow & (_POOL if self._ends_on_overflow else LOST_PHYSICS)
        bad_action, reward = self.action_manager.not_finite, self.reward_manager.reward
        seen = torch.zeros_like(reward)
        for group in self.observation_manager.groups.values():
            seen = seen + (group * 0.0).sum(1)
        state = self._nobody if self._ends_on_non_finite else broken
        self._faults |= torch.stack((bad_action, state, reward * 0.0 != 0.0, (seen != 0.0) & ~broken), dim=1)
        bad_action.zero_()

    def _ends_on(self, term: str) -> bool:
        """Whether one of mjstack's own terminations is in use, under whatever name."""
        return any(cfg.func == f"mjstack.mdp.termination.{term}" for cfg in self.cfg.termination.values())

    def _reset_ended(self, broken: torch.Tensor) -> None:
        """The terminal observation, the statistics, the reset of the worlds that ended, and the observation to go on with."""
        ends, rewards, out = self.termination_manager, self.reward_manager, self._outputs.tensors
        on_cuda = broken.is_cuda
        done = ends.terminated | ends.truncated
        # On CUDA, where looking would stop the device, worlds are always reset: those of an empty mask, if need be.
        ending = len(ends.names) > 0 and (on_cuda or bool(done.any()))

        def hand_out() -> None:
            out["success"].copy_(self.success)
            # What a diverged world saw last is 0, not NaN, which a value times 0 would hand on.
            for name, group in self.observation_manager.groups.items():
                torch.where(broken[:, None], group.nan_to_num(0.0, 0.0, 0.0), group, out=out[f"final/{name}"])

        def count() -> None:
            if ending:
                self.statistics.update(done, self.frame, self.success, rewards.episode_sums, ends.values)

        def latch() -> None:
            if on_cuda and self._check_faults:
                self._latch(broken)

        self._side_by_side(hand_out, count, latch)
        if ending:
            self.episode += done
            self.frame.masked_fill_(done, 0)
            self._write_start(done)
            self._forget(done)
            with one_pass():
                self.observation_manager.refresh(done)
        elif on_cuda or bool(broken.any()):
            for name, group in self.observation_manager.groups.items():
                group.copy_(out[f"final/{name}"])

    def _side_by_side(self, *works: Callable[[], None]) -> None:
        """Independent works; parallel branches where a graph is captured."""
        if self.device.type == "cuda":
            from mjstack.sim.graph import side_by_side

            side_by_side(self.device, *works)
        else:
            for work in works:
                work()

    def _write_start(self, mask: torch.Tensor) -> None:
        """Start states of the masked worlds; a function of seed, world and episode alone."""
        self.reset_manager.reset(mask)
        self.sim.kinematics(mask)

    def _forget(self, mask: torch.Tensor) -> None:
        """Whatever is kept from frame to frame starts anew."""
        self.action_manager.reset(mask)
        self.termination_manager.reset(mask)
        self.reward_manager.reset(mask)
        self.success.masked_fill_(mask, False)
        if self._success is not None:
            self._success.reset(mask)

    def _check_mask(self, mask: torch.Tensor) -> torch.Tensor:
        expected = f"a bool tensor of shape ({self.nworld},) on {self.device}"
        if not isinstance(mask, torch.Tensor):
            raise ArgumentError("mask", type(mask).__name__, expected)
        if tuple(mask.shape) != (self.nworld,) or mask.dtype is not torch.bool or mask.device != self.device:
            raise ArgumentError("mask", f"{mask.dtype} of shape {tuple(mask.shape)} on {mask.device}", expected)
        if not self._started:
            raise ArgumentError("mask", "a part of the worlds", "none at the first reset", "Call env.reset()")
        return mask

    def _require_capacity(self) -> None:
        """Counts the contacts of a full start, which MJWarp's pool must hold before the first step."""
        sizes, pool = getattr(self.sim, "sizes", None), getattr(self.sim, "peak_pool", None)
        if sizes is None or pool is None:
            return
        pool.zero_()  # it has the peak of everything before
        self.sim.forward()
        used = max(pool.tolist())
        room = sizes.contact_pool(self.nworld)
        if used > room:
            key, value = ("naconmax", sizes.naconmax) if sizes.naconmax is not None else ("nconmax", sizes.nconmax)
            per_world = -(-used // self.nworld)
            need = used if sizes.naconmax is not None else per_world
            raise FaultError(
                f"batch.{key}={value}: the start of {self.nworld} worlds needs at least {used} contacts and "
                f"collision pairs ({per_world} per world), and there is room for {room}",
                f"Raise it to more than batch.{key}={need}, or choose a reset with fewer contacts",
            )
        self._write_start(self._everyone)  # as if nobody had looked

    def _capacity_hint(self, bits: int) -> str:
        sizes = getattr(self.sim, "sizes", None)
        # The pools' own sizes take precedence where they are set.
        contacts = "nconmax" if getattr(sizes, "naconmax", None) is None else "naconmax"
        convex = "nccdmax" if getattr(sizes, "naccdmax", None) is None else "naccdmax"
        by_key = {"njmax": Overflow.NEFC | Overflow.NJMAX_NNZ, contacts: _POOL, convex: Overflow.CCD}
        keys = [key for key, flags in by_key.items() if bits & flags]
        if not keys:
            return "Simplify the model, or use sim=native"
        held = ", ".join(f"{key}={getattr(sizes, key, None)}" for key in keys)
        peak = f"; up to {int(self.sim.peak_constraints.max())} rows were needed" if "njmax" in keys else ""
        pool = getattr(self.sim, "peak_pool", None)
        if contacts in keys and pool is not None:
            most = max(pool.tolist())
            peak += f"; all worlds together needed {most}, {-(-most // self.nworld)} per world"
        return f"Raise {' and '.join(f'batch.{key}' for key in keys)} ({held}{peak})"

    def _culprits(self, fault: Fault, world: int) -> str:
        """Names the terms behind a number that is not finite, as far as their last values tell."""
        if fault is Fault.REWARD:
            bad = ~torch.isfinite(self.reward_manager.values[world])
            names = [n for n, is_bad in zip(self.reward_manager.names, bad.tolist(), strict=True) if is_bad]
            return f", from reward.{', reward.'.join(names)}" if names else ""
        if fault is Fault.OBSERVATION:
            terms = self.observation_manager.not_finite_terms(world)
            return f", from {', '.join(terms)}" if terms else ""
        return ""


_POOL = int(Overflow.BROADPHASE | Overflow.NARROWPHASE)
_FIXES = {
    Fault.ACTION: "Check what the policy returns",
    Fault.STATE: "Lower the gains or the timestep, or add the termination non_finite",
    Fault.REWARD: "Correct the term",
    Fault.OBSERVATION: "Correct the term",
}


def _copies(groups: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: group.clone() for name, group in groups.items()}
