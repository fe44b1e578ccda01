"""Observers of a rollout, and the judged episode that most of them look on at."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from mjstack.drivers.driver import Driver, Recorded
from mjstack.envs import Env
from mjstack.envs.buffers import Advance
from mjstack.episodes.rollout import Observer, RolloutTiming, State, rollout, snapshot
from mjstack.sim import Simulation
from mjstack.tasks.check import CheckResult, make_check

StepHook = Callable[[int, Simulation], None]


@dataclass(frozen=True, kw_only=True, slots=True)
class Episode:
    """A judged episode of every world.

    Attributes:
        result: The check of every world.
        start: Positions before the first step, shape ``(nworld, nq)``, in the backend's precision.
        waypoint_error: Largest distance from a target that inverse kinematics left [m], shape
            ``(nworld,)``.
        retries: Grasps that were tried again, shape ``(nworld,)``.
        timing: The rollout's.
        description: Backend and hardware.
    """

    result: CheckResult
    start: np.ndarray
    waypoint_error: np.ndarray
    retries: np.ndarray
    timing: RolloutTiming
    description: str

    @property
    def failed(self) -> np.ndarray:
        """Bits of the task's rules, shape ``(nworld,)``, int32."""
        return self.result.failed.cpu().numpy()

    @property
    def values(self) -> dict[str, np.ndarray]:
        """Measurements of the check, by name with unit, each of shape ``(nworld,)``."""
        return {name: value.double().cpu().numpy() for name, value in self.result.values.items()}


def play_episode(
    env: Env,
    driver: Driver,
    observers: Sequence[Observer] = (),
    *,
    advance: Advance | None = None,
    label: str = "steps",
) -> Episode:
    """Roll out one whole episode, judged by the task's check.

    Args:
        env: The environment, its worlds at their start.
        driver: Gives the actions.
        observers: Look on after the check.
        advance: Told about progress.
        label: Name of the steps in the progress.
    """
    start = env.sim.qpos.cpu().numpy().copy()
    judge = Judge()
    timing = rollout(env, driver, [judge, *observers], advance=advance, label=label)
    return Episode(
        result=judge.result,
        start=start,
        waypoint_error=driver.error.double().cpu().numpy(),
        retries=driver.retries.cpu().numpy(),
        timing=timing,
        description=env.sim.description,
    )


class Judge(Observer):
    """Judges every world by the task's check.

    Attributes:
        result: The check's result, at the end.
    """

    result: CheckResult

    def start(self, env: Env, driver: Driver) -> None:
        """See `Observer`."""
        super().start(env, driver)
        self._check = make_check(env.cfg)
        self._check.start(env, driver.steps, driver.phases)

    def update(self) -> None:
        """See `Observer`."""
        self._check.update(self.driver.phase)

    def finish(self) -> None:
        """See `Observer`."""
        self.result = self._check.result()


class WorldRecorder(Observer):
    """Records world 0.

    Attributes:
        qpos: Positions at every step end, shape ``(steps, nq)``; NaN in steps not made.
        phase: Number of the phase in every step, shape ``(steps,)``; -1 in steps not made.
    """

    qpos: np.ndarray
    phase: np.ndarray

    def start(self, env: Env, driver: Driver) -> None:
        """See `Observer`."""
        super().start(env, driver)
        self.qpos = np.full((driver.steps, env.sim.qpos.shape[1]), np.nan)
        self.phase = np.full(driver.steps, -1)

    def after_step(self, step: int) -> None:
        """See `Observer`."""
        self.qpos[step] = self.env.sim.qpos[0].cpu().numpy()
        self.phase[step] = int(self.driver.phase[0])


class Snapshots(Observer):
    """Keeps the state of all worlds after some steps.

    Attributes:
        states: By step.
    """

    def __init__(self, steps: Collection[int]) -> None:
        """``steps`` after which the state is kept."""
        self._steps = steps
        self.states: dict[int, State] = {}

    def after_step(self, step: int) -> None:
        """See `Observer`."""
        if step in self._steps:
            self.states[step] = snapshot(self.env.sim)


class CommandRecorder(Observer):
    """Records the commands of all worlds, on the device.

    Attributes:
        recorded: A driver that repeats them.
    """

    recorded: Recorded

    def start(self, env: Env, driver: Driver) -> None:
        """See `Observer`."""
        super().start(env, driver)
        self.recorded = Recorded(driver, env.action_manager.action_dim)

    def update(self) -> None:
        """See `Observer`."""
        self.recorded.append(self.env.action_manager.action, self.driver.phase)


class Hook(Observer):
    """Calls a function after every step, on the host."""

    def __init__(self, function: StepHook) -> None:
        """``function`` gets the step's number and the simulation."""
        self._function = function

    def after_step(self, step: int) -> None:
        """See `Observer`."""
        self._function(step, self.env.sim)
