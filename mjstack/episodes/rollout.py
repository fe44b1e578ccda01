"""The rollout: the only loop over an episode, which everything else observes."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from typing_extensions import override

from mjstack.config.schema import Config, TermCfg
from mjstack.drivers.driver import Driver, find_driver
from mjstack.envs import Env
from mjstack.envs.buffers import Advance
from mjstack.errors import ConfigError
from mjstack.managers.state import in_one_pass
from mjstack.managers.term import current_term
from mjstack.mdp.geometry import place_xy, pose_w
from mjstack.sim import Simulation
from mjstack.sim.graph import StepGraph
from mjstack.tasks.check import CheckResult

Reset = dict[str, TermCfg]


class Observer:
    """Base class of everything that looks on at a rollout. Every method may be left out.

    Attributes:
        env: The environment, from `start` on.
        driver: The driver, from `start` on.
        aside: Time spent in `after_step` that is not part of the episode's [s].
    """

    env: Env
    driver: Driver
    aside: float = 0.0

    def start(self, env: Env, driver: Driver) -> None:
        """Prepare for an episode. Called once, when every world is at its start."""
        self.env = env
        self.driver = driver

    def update(self) -> None:
        """Process the end of a step, inside the captured graph: fixed shapes, no host read."""

    def after_step(self, step: int) -> None:
        """Process the end of a step on the host, after `update`."""

    def finish(self) -> None:
        """Conclude. Called once when the device has done the last step, the last observer first."""


@dataclass(frozen=True, kw_only=True)
class RolloutTiming:
    """The time of a rollout.

    Attributes:
        steps: Number of control steps.
        seconds: Wall time of the steps [s]; where they are captured, of as many replayed ones.
        warm_up_seconds: The eager first call of the captured work [s]; 0 without one.
        capture_seconds: The capture alone [s]; 0 without one.
        captured: Whether whole steps were replayed. On Warp's CPU device, where physics alone is
            captured, they are not.
    """

    steps: int
    seconds: float
    warm_up_seconds: float
    capture_seconds: float
    captured: bool


def rollout(
    env: Env,
    driver: Driver,
    observers: Sequence[Observer] = (),
    *,
    steps: int | None = None,
    advance: Advance | None = None,
    label: str = "steps",
) -> RolloutTiming:
    """Drive every world through an episode. On CUDA a step is one captured graph.

    Args:
        env: The environment, its worlds at their start.
        driver: Gives the actions.
        observers: Look on, in this order.
        steps: Number of control steps; the driver's if None.
        advance: Told about progress.
        label: Name of the steps in the progress.
    """
    sim = env.sim
    steps = driver.steps if steps is None else steps
    for observer in observers:
        observer.start(env, driver)

    # A step, and its graph
    def updates() -> None:
        for observer in observers:
            observer.update()

    def work() -> None:
        current_term.label = "controller"
        env.action_manager.process(in_one_pass(driver.command))
        env.advance()
        in_one_pass(updates)

    play = env.captured(work, "a step of the episode")
    # On Warp's CPU device physics alone is captured, once for all episodes.
    graph: StepGraph | None = play
    if sim.device.type != "cuda":
        graph = sim.graph_of(env.cfg.timing.decimation, kinematics=True)

    def graph_seconds() -> tuple[float, float]:
        """Warm-up and capture so far [s]."""
        return (0.0, 0.0) if graph is None else (graph.warm_up_seconds, graph.capture_seconds)

    graph_start = graph_seconds()

    # The episode
    sim.synchronize()
    began = time.perf_counter()
    for step in range(steps):
        play()
        for observer in observers:
            observer.after_step(step)
        if advance is not None:
            if step % 10 == 9:
                sim.synchronize()  # so that the bar shows work done, not work queued
            advance(label, step + 1, steps)
    sim.synchronize()
    seconds = time.perf_counter() - began - sum(observer.aside for observer in observers)
    for observer in reversed(observers):  # an energy meter, say, before the check computes
        observer.finish()

    # Its time
    warm_up, capture = (
        end if end != start else 0.0
        for end, start in zip(graph_seconds(), graph_start, strict=True)
    )
    captured = play.captured
    play.drop()  # its memory, which only the collector would find otherwise
    seconds -= warm_up + capture
    if warm_up and steps > 1:  # the first step was it
        seconds *= steps / (steps - 1)
    return RolloutTiming(
        steps=steps,
        seconds=seconds,
        warm_up_seconds=warm_up,
        capture_seconds=capture,
        captured=captured,
    )


def reset_worlds(env: Env, seed: int | None, worlds: Sequence[int] | None = None) -> Env:
    """Reset every world, under these numbers if there are any, and bring everything that derives
    from their state up to date.
    """
    if worlds is not None:
        env.world.copy_(torch.tensor(worlds))
    env.reset(seed=seed)
    env.sim.forward()
    return env


class State(NamedTuple):
    """State of every world at a step end, on the host."""

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray


def snapshot(sim: Simulation) -> State:
    """Copy the state of every world to the host."""
    return State(*(getattr(sim, name).double().cpu().numpy().copy() for name in State._fields))


def restore(sim: Simulation, state: State) -> None:
    """Put every world into a kept state: counters and warm starts cleared, all current."""
    sim.reset()
    for name, values in state._asdict().items():
        getattr(sim, name).copy_(torch.from_numpy(values))
    sim.forward()


@dataclass(frozen=True, kw_only=True)
class Episode:
    """A judged episode of every world.

    Attributes:
        result: The check of every world.
        start: Positions before the first step, shape ``(nworld, nq)``, in the backend's precision.
        places: As of `start_places`.
        ik_error: Largest distance from a target that inverse kinematics left [m], shape
            ``(nworld,)``.
        retries: Grasps that were tried again, shape ``(nworld,)``.
        timing: The rollout's.
        description: Backend and hardware.
    """

    result: CheckResult
    start: np.ndarray
    places: dict[str, np.ndarray]
    ik_error: np.ndarray
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


def start_places(env: Env) -> dict[str, np.ndarray]:
    """Where all that an episode may place is at its start: the objects that move, bodies that stand
    still or are joined to what does, where model fields can move them, and the places that each
    episode draws.

    Returns:
        x and y [m] and rotation about z [rad], which is NaN for a place, each ``(nworld, 3)``, by
        name.
    """
    sim = env.sim
    model = sim.model
    poses = {name: pose_w(env, name) for name in env.index.objects}
    if not sim.fields.keys().isdisjoint(("body_pos", "body_quat")):
        for body in np.flatnonzero(model.body_weldid[model.body_parentid] == 0)[1:].tolist():
            pose = torch.cat((sim.xpos[:, body], sim.xquat[:, body]), dim=1)
            poses.setdefault(model.body(body).name or f"body {body}", pose)
    poses_by_name = {}
    for name, pose in poses.items():
        # Objects stand flat at a start, so that all of a rotation is about z.
        x, y, _, w, _, _, z = pose.double().cpu().numpy().T
        poses_by_name[name] = np.column_stack((x, y, 2.0 * np.arctan2(z, w)))
    for name, place_cfg in env.cfg.scene.places.items():
        if any(place_cfg.random_xy):
            xy = place_xy(env, name).double().cpu().numpy()
            poses_by_name[name] = np.column_stack((xy, np.full(len(xy), np.nan)))
    return poses_by_name


def play_episode(
    env: Env,
    driver: Driver,
    observers: Sequence[Observer] = (),
    *,
    advance: Advance | None = None,
    label: str = "steps",
) -> Episode:
    """Roll out one whole episode, judged by the task's check, which looks on before the observers.
    Arguments as of `rollout`.
    """
    start = env.sim.qpos.cpu().numpy().copy()
    places = start_places(env)
    judge = Judge()
    timing = rollout(env, driver, [judge, *observers], advance=advance, label=label)
    return Episode(
        result=judge.result,
        start=start,
        places=places,
        ik_error=driver.error.double().cpu().numpy(),
        retries=driver.retries.cpu().numpy(),
        timing=timing,
        description=env.sim.description,
    )


class Judge(Observer):
    """Judges every world by the task's check; without one, no world fails.

    Attributes:
        result: The check's result, at the end.
    """

    result: CheckResult

    @override
    def start(self, env: Env, driver: Driver) -> None:
        super().start(env, driver)
        self.result = CheckResult(torch.zeros(env.nworld, dtype=torch.int32), {}, False)
        self._check = env.check if env.cfg.task.check is not None else None
        if self._check is not None:
            self._check.start(env, driver.steps, driver.phases)

    @override
    def update(self) -> None:
        if self._check is not None:
            self._check.update(self.driver.phase)

    @override
    def finish(self) -> None:
        if self._check is not None:
            self.result = self._check.result()


@dataclass(eq=False)
class Hook(Observer):
    """Calls a function with the step's number and the simulation after every step, on the host."""

    function: Callable[[int, Simulation], None]

    @override
    def after_step(self, step: int) -> None:
        self.function(step, self.env.sim)


def lacks_episode(cfg: Config) -> str:
    """Why no driver can play a judged episode of the task; empty if one can."""
    if not cfg.controller.phases and find_driver(cfg).needs_phases:
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
