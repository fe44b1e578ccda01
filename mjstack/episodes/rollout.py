"""One scripted episode over many worlds: the loop that every gate uses."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch

from mjstack.bench.power import EnergyMeter
from mjstack.bench.timing import step_graph
from mjstack.config.schema import Config, TermCfg
from mjstack.drivers.driver import Controller, OpenLoopDriver, Recorded
from mjstack.drivers.open_loop import OpenLoopPlanner
from mjstack.envs import Env, driven_config
from mjstack.scene import SceneIndex
from mjstack.sim import Simulation
from mjstack.tasks.check import CheckResult, EpisodeCheck, check_class

_EAGER = 2  # steps: the warm-up, and the one that is captured

StepHook = Callable[[int, Simulation], None]
Advance = Callable[[str, int, int], None]
"""Reports progress: what is going on, how much is done, and of how much."""


class Watch(Protocol):
    """Looks on at an episode."""

    def start(self, env: Env) -> None:
        """Called once, when every world is at its start."""

    def update(self, env: Env, controller: Controller, check: EpisodeCheck) -> None:
        """Called at the end of every step, inside what is captured: fixed shapes, no host read."""


CLOSED_LOOP = "closed_loop"  # the controller that watches; any other name plays a plan
Reset = dict[str, TermCfg]
NOMINAL: Reset = {"home": TermCfg(func="mjstack.mdp.reset.home")}


@dataclass(slots=True)
class State:
    """State of every world at a step end, on the host."""

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray


@dataclass(slots=True)
class Episode:
    """What an episode leaves behind.

    Attributes:
        result: The check of every world.
        steps: How many.
        start: Positions of every world before the first one, shape ``(nworld, nq)``, in the
            backend's precision.
        waypoint_error: Largest distance from a target that inverse kinematics left [m], shape
            ``(nworld,)``.
        retries: Grasps that were tried again, shape ``(nworld,)``.
        seconds: Wall time of the steps alone [s]; where they are captured, of as many replayed
            ones.
        qpos: World 0 at every step end, shape ``(steps, nq)``, if it was recorded.
        phase: Number of its phase in every step, shape ``(steps,)``, likewise.
        states: Snapshots of all worlds after the steps that were asked for.
        warm_up_seconds: The eager first call of what is captured [s]; 0 if it was captured before,
            or never is.
        capture_seconds: The capture alone [s], likewise.
        captured: Whether whole steps were replayed; on Warp's CPU device, where physics alone is,
            they are not.
        commands: The commands that were given, if they were recorded.
    """

    result: CheckResult
    steps: int
    start: np.ndarray
    waypoint_error: np.ndarray
    retries: np.ndarray
    seconds: float
    qpos: np.ndarray | None = None
    phase: np.ndarray | None = None
    states: dict[int, State] = field(default_factory=dict)
    warm_up_seconds: float = 0.0
    capture_seconds: float = 0.0
    captured: bool = False
    commands: Recorded | None = None


def start_worlds(
    sim: Simulation,
    index: SceneIndex,
    cfg: Config,
    reset: Reset,
    planner: OpenLoopPlanner,
    advance: Advance | None = None,
    worlds: Sequence[int] | None = None,
) -> tuple[Env, Controller]:
    """Resets every world; the configured controller plans from where its cubes then stand, or looks
    for itself.

    Args:
        sim: The worlds.
        index: Addresses.
        cfg: The configuration.
        reset: How worlds differ at the start.
        planner: Plans the commands.
        advance: Told about progress.
        worlds: Their numbers, which random numbers depend on: ``[17]`` starts one world as world 17
            of any batch starts.

    Returns:
        The environment that the commands go through, and what gives the commands, which are its
        actions.
    """
    env = place_worlds(sim, index, cfg, reset, worlds)
    return env, make_driver(env, planner, advance)


def place_worlds(
    sim: Simulation,
    index: SceneIndex,
    cfg: Config,
    reset: Reset,
    worlds: Sequence[int] | None = None,
) -> Env:
    """Resets every world, and no more; see `start_worlds`."""
    env = Env(
        sim, index, driven_config(cfg, reset=reset), check_faults=False
    )  # the check names lost worlds
    if worlds is not None:
        env.world.copy_(torch.tensor(worlds))
    env.reset(seed=cfg.seed)
    sim.forward()
    return env


def make_driver(env: Env, planner: OpenLoopPlanner, advance: Advance | None = None) -> Controller:
    """The configured controller, for worlds that have started.

    Args:
        env: The environment, whose action terms are the controller's.
        planner: Plans the commands.
        advance: Told about progress.
    """
    sim = env.sim
    if env.cfg.controller.name == CLOSED_LOOP:
        from mjstack.drivers.closed_loop import (
            ClosedLoopDriver,
        )  # loads Warp, which a planned native run does not need

        return ClosedLoopDriver(env, planner.nominal)
    cubes = torch.cat([sim.qpos[:, a : a + 2] for a in env.index.cube_qpos], dim=1)
    progress = None if advance is None else (lambda done: advance("planning", done, sim.nworld))
    tape = planner.plan(cubes.double().cpu().numpy(), progress).to(sim.device, sim.ctrl.dtype)
    return OpenLoopDriver(tape, planner.phases, sim.nworld, sim.device)


def run_episode(
    sim: Simulation,
    index: SceneIndex,
    cfg: Config,
    planner: OpenLoopPlanner,
    reset: Reset,
    *,
    record: bool = False,
    snapshots: frozenset[int] = frozenset(),
    on_step: StepHook | None = None,
    advance: Advance | None = None,
    worlds: Sequence[int] | None = None,
    meter: EnergyMeter | None = None,
    keep_commands: bool = False,
    watch: Watch | None = None,
    repeat: Recorded | None = None,
) -> Episode:
    """Plays the scripted task once in every world and judges it.

    Args:
        sim: The worlds.
        index: Addresses.
        cfg: The configuration.
        planner: Plans the commands.
        reset: How worlds differ at the start.
        record: Keep world 0's qpos at every step end.
        snapshots: Steps after which the state of all worlds is kept.
        on_step: Called after each step.
        advance: Told about progress.
        worlds: Numbers of the worlds, if not 0 to nworld - 1; see `start_worlds`.
        meter: Takes in the energy of the steps from the third on, when all are replayed.
        keep_commands: Record all commands, on the device.
        watch: Looks on, on the device.
        repeat: Give these commands instead of the controller's.
    """
    env, controller = start_worlds(sim, index, cfg, reset, planner, advance, worlds)
    steps = controller.steps
    start = sim.qpos.cpu().numpy().copy()
    recorded = Recorded(controller, env.action_manager.action_dim) if keep_commands else None
    if repeat is not None:
        repeat.rewind()
        controller = repeat
    check = check_class(cfg)(cfg, index, planner.phases, sim.nworld, sim.device)
    if watch is not None:
        watch.start(env)

    def work() -> None:
        command = controller.command()
        if recorded is not None:
            recorded.append(command, controller.phase)
        env.action_manager.take(command)
        env.advance()
        check.update(sim, controller.phase)
        if watch is not None:
            watch.update(env, controller, check)

    play = env.captured(work, "a frame of the episode")
    # On Warp's CPU device physics alone is captured, once for all episodes.
    graph = (
        play
        if sim.device.type == "cuda"
        else step_graph(sim, cfg.timing.decimation, kinematics=True)
    )
    before = (0.0, 0.0) if graph is None else (graph.warm_up_seconds, graph.capture_seconds)
    trajectory = np.full((steps, sim.qpos.shape[1]), np.nan) if record else None
    phase = np.full(steps, -1) if record else None
    states: dict[int, State] = {}
    sim.synchronize()
    began = time.perf_counter()
    aside = 0.0  # what reading the counter takes
    for step in range(steps):
        if meter is not None and step == _EAGER:
            sim.synchronize()
            reading = time.perf_counter()
            meter.start()
            aside = time.perf_counter() - reading
        play()
        if on_step is not None:
            on_step(step, sim)
        if trajectory is not None:
            trajectory[step] = sim.qpos[0].cpu().numpy()
        if phase is not None:
            phase[step] = int(controller.phase[0])
        if step in snapshots:
            states[step] = snapshot(sim)
        if advance is not None:
            if step % 10 == 9:
                sim.synchronize()  # so that the bar shows work done, not work queued
            advance("steps", step + 1, steps)
    sim.synchronize()
    seconds = time.perf_counter() - began - aside
    if meter is not None:
        meter.stop()
    after = before if graph is None else (graph.warm_up_seconds, graph.capture_seconds)
    warm_up, capture = (
        now if now != then else 0.0 for now, then in zip(after, before, strict=True)
    )
    captured = play.captured
    play.drop()  # its memory, which only the collector would find otherwise
    seconds -= warm_up + capture
    if warm_up:  # the first step was it
        seconds *= steps / (steps - 1)
    return Episode(
        check.result(sim),
        steps,
        start,
        controller.error.double().cpu().numpy(),
        controller.retries.cpu().numpy(),
        seconds,
        trajectory,
        phase,
        states,
        warm_up,
        capture,
        captured,
        recorded,
    )


def snapshot(sim: Simulation) -> State:
    """Copies the state of every world to the host."""
    return State(*(view.double().cpu().numpy().copy() for view in (sim.qpos, sim.qvel, sim.ctrl)))


def restore(sim: Simulation, state: State) -> None:
    """Puts every world into a kept state, counters cleared, warm starts zero, derived arrays
    current.
    """
    sim.reset()
    for view, values in ((sim.qpos, state.qpos), (sim.qvel, state.qvel), (sim.ctrl, state.ctrl)):
        view.copy_(torch.from_numpy(values))
    sim.forward()
