"""Drivers give the actions of every world, step by step, and the phase of each world. Scene, plan
and policy, of which they are made.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import mujoco
import torch
from torch import Tensor
from typing_extensions import override

from mjstack.config.functions import resolve_func
from mjstack.config.schema import Config, TermCfg
from mjstack.drivers.open_loop import JointTrajectory, OpenLoopPlanner
from mjstack.envs import Env
from mjstack.errors import ArgumentError, ConfigError, TermError
from mjstack.managers.term import blamed, check_params
from mjstack.managers.view import offers
from mjstack.math import describe_tensor
from mjstack.mdp.geometry import source_xy
from mjstack.policy import Policy, load_policy
from mjstack.scene import SceneIndex, build_model
from mjstack.scene.phases import Phase


@dataclass(eq=False)
class Assets:
    """Scene, plan and policy, each built once when it is first needed.

    Attributes:
        cfg: The configuration of scene, robot and phases.
    """

    cfg: Config

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The scene for physics."""
        return build_model(self.cfg)

    @cached_property
    def visual_model(self) -> mujoco.MjModel:
        """The same scene with everything that only pictures need."""
        return build_model(self.cfg, visuals=True)

    @cached_property
    def index(self) -> SceneIndex:
        """Addresses in the model."""
        return SceneIndex(self.model, self.cfg.robot, self.cfg.scene)

    @cached_property
    def planner(self) -> OpenLoopPlanner:
        """The planner, its nominal plan made."""
        return OpenLoopPlanner(self.cfg)

    @cached_property
    def policy(self) -> Policy:
        """The policy that ``policy`` names; a MjstackError if none can be read."""
        if self.cfg.policy is None:
            expected = "the folder of a trained policy, which controller=policy plays"
            raise ConfigError("policy", None, expected)
        return load_policy(self.cfg.policy)


class Driver(ABC):
    """Gives the actions of every world, one step at a time. Fixed shapes, no host read: a captured
    graph may hold it. The actions are those of its environment's terms, ``controller.action``:
    joint targets unless the configuration says otherwise.

    A subclass of your own, which ``controller.func`` names, takes the environment and the keyword
    parameters of ``controller.params``. Its class attributes say what it can do.

    Attributes:
        needs_phases: Whether it follows ``controller.phases``; a task without some is refused.
        phased: Whether each world goes through them by a clock. A check then judges by phase.
        planned: Whether it plays a plan without looking: gate *success* takes the closed-loop
            expert in its place.
        stateless: Whether it decides by the state alone, in any state: trainer=dagger asks it.
        plays_policy: Whether it plays the policy that ``policy`` names.
        on_host: Whether it acts on the host, so that no graph can hold it.
        noun: Its name in sentences.
        phases: The phases, laid out as a world without a retry goes through them. Empty for a
            driver without phases, such as a policy: a check judges every step of its episode.
        steps: Length of the episode.
        phase: Number of the phase that each world's last command belonged to, shape ``(nworld,)``,
            int64.
        error: Largest distance from a target that inverse kinematics left [m], shape ``(nworld,)``.
        retries: Grasps that were tried again, shape ``(nworld,)``, int32.
    """

    needs_phases = False
    phased = False
    planned = False
    stateless = False
    plays_policy = False
    on_host = False
    noun = "driver"

    def __init__(
        self, nworld: int, steps: int, device: torch.device, phases: Sequence[Phase] = ()
    ) -> None:
        """Allocate for the worlds; ``steps`` is the length of the episode."""
        self.phases = list(phases)
        self.steps = steps
        self.phase = torch.zeros(nworld, dtype=torch.int64, device=device)
        self.error = torch.zeros(nworld, device=device)
        self.retries = torch.zeros(nworld, dtype=torch.int32, device=device)

    @abstractmethod
    def command(self) -> Tensor:
        """Actions of the next step, shape ``(nworld, action_dim)``."""

    @classmethod
    def build(cls, env: Env, cfg: Config, assets: Assets) -> "Driver":
        """Make the driver of worlds that have started, in an environment whose configuration has
        neither observations nor cameras; ``cfg`` is the whole one. Plan and policy are made when
        they are asked for.
        """
        return cls.with_params(cfg, env)

    @classmethod
    def chosen(cls, cfg: Config) -> type["Driver"]:
        """The class that drives a configuration: this one, or one that stands behind it."""
        return cls

    @classmethod
    def trained_policy(cls, assets: Assets) -> Policy | None:
        """The policy whose observation and action terms its environment has; None without one."""
        return None

    @classmethod
    def with_params(cls, cfg: Config, *args: Any) -> "Driver":
        """Construct the driver from arguments and ``controller.params``, which are checked."""
        check_params("controller", cls, cfg.controller.params, len(args))
        return cls(*args, **cfg.controller.params)


# Drivers that jobs choose, by the name of their controller
_CHOSEN = {
    "closed_loop": "mjstack.drivers.closed_loop.ClosedLoopDriver",
    "policy": "mjstack.drivers.policy.PolicyDriver",
}


def with_controller(cfg: Config, name: str) -> Config:
    """The configuration with ``closed_loop`` or ``policy`` as its controller."""
    controller = replace(cfg.controller, name=name, func=_CHOSEN[name], params={})
    return replace(cfg, controller=controller)


def find_driver(cfg: Config) -> type[Driver]:
    """The class that ``controller.func`` names; a TermError if there is none, or it lacks a method
    of `Driver`.
    """
    driver: Any = resolve_func("controller", cfg.controller.func, base=Driver)
    if lacking := sorted(driver.__abstractmethods__):
        problem = f"func={cfg.controller.func}: expected a class with {', '.join(lacking)}()"
        raise TermError("controller", problem)
    return driver.chosen(cfg)


def check_driver(env: Env, cfg: Config, assets: Assets) -> None:
    """Build the configured driver and take its first actions; a policy, whose widths are compared,
    is not asked. Arguments as of `Driver.build`; the worlds are not used afterwards. A TermError
    if its actions cannot be used, or one of its attributes.
    """
    with blamed("controller"):
        driver = find_driver(cfg).build(env, cfg, assets)
        if driver.plays_policy:
            return
        if bool(driver.phases) != driver.phased:
            expected = "phases if, and only if, its class has phased=True"
            raise ArgumentError("phases", driver.phases or "none", expected)
        steps = driver.phases[-1].stop if driver.phased else cfg.task.episode_steps
        if driver.steps != steps:
            raise ArgumentError("steps", driver.steps, f"{steps}, those of the episode")
        for name in ("phase", "error", "retries"):
            value = getattr(driver, name)
            if not isinstance(value, Tensor) or value.shape != (env.nworld,):
                expected = f"shape ({env.nworld},), a number for each world"
                raise ArgumentError(name, describe_tensor(value), expected)
        env.action_manager.process(driver.command())


def require_actions(cfg: Config, terms: Mapping[str, TermCfg], expected: str) -> None:
    """Check that an environment of a configuration takes a driver's actions, ``expected`` in words,
    in every control step; other action terms or repeated actions are an ArgumentError.
    """
    if list(cfg.action.values()) != list(terms.values()):
        targets = terms == cfg.controller.action
        fix = "action=joint_absolute" if targets else "the action terms of its policy.json"
        raise ArgumentError("env", "other actions", expected, f"Build it with {fix}")
    repeats = cfg.timing.policy_decimation
    if repeats > 1:
        expected = "one for each, which a driver gives"
        fix = "Build it with timing.policy_decimation=1"
        raise ArgumentError("env", f"actions for {repeats} control steps", expected, fix)


@offers("driver")
class OpenLoopDriver(Driver):
    """Plays joint trajectories once, from the start that they were planned for: every world is in
    the same phase.
    """

    needs_phases = phased = planned = True
    noun = "expert"

    def __init__(self, trajectory: JointTrajectory, phases: list[Phase]) -> None:
        """Take the trajectory, which must be on the device, and its phases, if it has any."""
        device = trajectory.knots.device
        super().__init__(len(trajectory.knots), len(trajectory.weights), device, phases)
        self.error = torch.as_tensor(trajectory.ik_error, device=device)
        self._trajectory = trajectory
        numbers = [k for k, phase in enumerate(phases) for _ in range(phase.start, phase.stop)]
        self._phase_at = torch.tensor(numbers or [0] * self.steps, device=device)
        self._next = torch.zeros(1, dtype=torch.int64, device=device)

    def command(self) -> Tensor:
        """Commands of the next step, shape ``(nworld, nu)``."""
        out = self._trajectory.command(self._next)
        self.phase.copy_(self._phase_at.index_select(0, self._next).expand_as(self.phase))
        self._next.add_(1).clamp_(max=self.steps - 1)  # past the end the last one holds
        return out

    @classmethod
    @override
    def build(cls, env: Env, cfg: Config, assets: Assets) -> Driver:
        sources = source_xy(env).double().cpu().numpy()
        trajectory = assets.planner.plan(sources, names=env.world.tolist())
        trajectory = trajectory.to(env.device, env.sim.ctrl.dtype)
        return cls.with_params(cfg, trajectory, assets.planner.phases)
