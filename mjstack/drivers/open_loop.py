"""Planning before the episode: targets of the grasp point and joint trajectories of every world."""

import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import active_children, get_context, parent_process
from threading import Thread
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mjstack.config.schema import Config
from mjstack.errors import MjstackError, Unreachable
from mjstack.interrupt import check_interrupt
from mjstack.kinematics.mink_ik import GraspIk
from mjstack.process import available_cores
from mjstack.scene.phases import build_phases, nominal_xy, target_xy

# Distinct worlds: some 6 s of planning; a process needs 3 s before its first plan.
PARALLEL_FROM = 512
WORLDS_PER_PROCESS = 128  # distinct worlds that pay for one process more
_POLL = 0.2  # s, between two looks at whether the command was interrupted
_CHUNK = 8  # worlds, 0.1 s of planning: messages cost little beside it

# Variables of a planning process, each 1: no threads, and no imports from the working folder.
_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "PYTHONSAFEPATH")

# Commands at the knots (n, nu), and the largest distance [m] from a target.
Plan = tuple[np.ndarray, float]

_planner: "OpenLoopPlanner"  # of a process that plans for another one


@dataclass(frozen=True)
class JointTrajectory:
    """Commands of every world for the whole episode, held as a few knots per phase.

    The arm's motion between two targets is a polynomial in the smoothstep parameter through
    Chebyshev points, so that 600 steps need some 40 solutions of inverse kinematics a world, and
    memory does not grow with the episode.

    Attributes:
        knots: Commands, shape ``(nworld, n, nu)``.
        weights: Weights of the knots of each step's phase, shape ``(steps, k)``.
        numbers: Which knots those are, shape ``(steps, k)``, int64.
        waypoint_error: Largest distance [m] from a target at any knot, shape ``(nworld,)``.
    """

    knots: Tensor
    weights: Tensor
    numbers: Tensor
    waypoint_error: np.ndarray

    @property
    def steps(self) -> int:
        """Length of the episode."""
        return len(self.weights)

    def to(self, device: torch.device, dtype: torch.dtype) -> "JointTrajectory":
        """The same trajectory on a device."""
        return replace(
            self,
            knots=self.knots.to(device, dtype),
            weights=self.weights.to(device, dtype),
            numbers=self.numbers.to(device),
        )

    def command(self, step: int | Tensor) -> Tensor:
        """Commands of one step.

        Args:
            step: Its number; or shape ``(1,)``, int64, on the same device, for a captured graph.

        Returns:
            Shape ``(nworld, nu)``.
        """
        if isinstance(step, int):
            step = torch.tensor([step], device=self.numbers.device)
        knots = self.knots.index_select(1, self.numbers.index_select(0, step)[0])
        # Not einsum, whose rounding depends on nworld: a world's commands would not be those it
        # gets alone.
        return (self.weights.index_select(0, step)[0][:, None] * knots).sum(1)


class OpenLoopPlanner:
    """Plans joint trajectories for objects and places at given positions, with mink.

    Attributes:
        phases: The phases.
        ik: Inverse kinematics of the robot alone.
        nominal: Commands at the end of each phase of the nominal plan, shape ``(phases, nu)``.
    """

    def __init__(self, cfg: Config) -> None:
        """Plan the nominal start, from which every other plan starts.

        Raises:
            Unreachable: A nominal target is out of reach.
        """
        self._cfg = cfg
        self.phases = build_phases(cfg)
        self.ik = GraspIk(
            cfg.robot,
            cfg.model,
            tolerance=cfg.controller.ik_tolerance,
            iterations=cfg.controller.ik_iterations,
        )
        self._nodes = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, cfg.controller.knots))
        self._weights, self._numbers = self._step_weights()
        self._seed: np.ndarray | None = None
        self._last: tuple[np.ndarray, JointTrajectory] | None = None
        self._pool: ProcessPoolExecutor | None = None
        self._seed = self.plan_world(0, nominal_xy(cfg.scene))[0]
        self.nominal = self._seed[len(self._nodes) - 1 :: len(self._nodes)]

    def plan(
        self,
        sources_xy: np.ndarray,
        progress: Callable[[int], None] = lambda done: None,
        names: Sequence[int] | None = None,
    ) -> JointTrajectory:
        """Plan one trajectory per world; worlds that start alike share the work.

        Args:
            sources_xy: Position of each object and place at the start [m], shape ``(nworld,
                sources, 2)``; see `source_names`.
            progress: Called with the number of worlds done.
            names: Numbers of the worlds, for the error; from 0 on if None.

        Raises:
            Unreachable: A target is out of reach; names the world (the first one), the phase and
                the distance.
            MjstackError: A process that helps has ended.
        """
        if self._last is not None and np.array_equal(self._last[0], sources_xy):
            return self._last[1]  # the gates of one run play the same batch
        nworld = sources_xy.shape[0]
        flat = sources_xy.reshape(nworld, -1)
        _, first, kind = np.unique(flat, axis=0, return_index=True, return_inverse=True)
        twin = first[kind.reshape(-1)]
        worlds = sorted(first.tolist())
        done = np.cumsum(np.bincount(twin)[worlds]).tolist()
        plans: dict[int, Plan] = {}
        try:
            with self.processes(len(worlds)):
                batch = zip(worlds, done, self._plans(worlds, sources_xy), strict=True)
                for world, count, plan in batch:
                    plans[world] = plan
                    progress(count)
        except Unreachable as unreachable:
            if names is not None:
                unreachable.world = names[unreachable.world]
            raise
        parts = zip(*(plans[world] for world in twin), strict=True)
        knots, error = (np.array(part) for part in parts)
        trajectory = JointTrajectory(torch.from_numpy(knots), self._weights, self._numbers, error)
        if nworld > 1:
            self._last = (sources_xy.copy(), trajectory)
        return trajectory

    def _plans(self, worlds: Sequence[int], sources_xy: np.ndarray) -> Iterator[Plan]:
        """The plan of each world, in their order."""
        if self._pool is not None:
            return plan_in_parallel(self._pool, worlds, sources_xy)
        return (self.plan_world(world, sources_xy[world]) for world in worlds)

    @contextmanager
    def processes(self, worlds: int) -> Iterator[None]:
        """Keep processes for every `plan` inside, if so many distinct worlds pay for them. They
        load beside whatever comes before the first plan.
        """
        count = min(available_cores(), worlds // WORLDS_PER_PROCESS)
        if self._pool is not None or worlds < PARALLEL_FROM or count < 2:
            yield
            return
        with _start_processes(self._cfg, count) as self._pool:
            try:
                yield
            finally:
                self._pool = None

    def path_error(self) -> float:
        """Largest distance [m] of the grasp point from its straight path at any step of the nominal
        plan.
        """
        nominal = nominal_xy(self._cfg.scene)
        trajectory = self.plan(nominal[None])
        targets = self._targets(nominal)
        worst = 0.0
        for step, (number, s) in enumerate(self._progress()):
            start, end = targets[number]
            at = self.ik.grasp_point(trajectory.command(step)[0].numpy())
            worst = max(worst, float(np.linalg.norm(at - (start + s * (end - start))[:3])))
        return worst

    def plan_world(self, world: int, xy: np.ndarray) -> Plan:
        """Plan one world, starting from the nominal plan, so that its neighbours do not matter.

        Args:
            world: Its number, for the error.
            xy: Position of each object and place at the start [m], shape ``(sources, 2)``.

        Returns:
            Commands at the knots, shape ``(n, nu)``, and the largest distance [m] from a target at
            any.

        Raises:
            Unreachable: A target is out of reach.
        """
        n = len(self._nodes)
        knots = np.empty((len(self.phases) * n, len(self._cfg.robot.home)))
        worst = 0.0
        command = self.ik.home
        for i, (phase, (start, end)) in enumerate(zip(self.phases, self._targets(xy), strict=True)):
            still = bool((start == end).all())
            for j, s in enumerate(self._nodes):
                k = i * n + j
                repeated = (still and j > 0) or (j == 0 and i > 0)
                if not repeated:
                    guess = command if self._seed is None else self._seed[k]
                    way = start + s * (end - start)
                    command, distance = self.ik.solve(way[:3], way[3:], guess)
                    if not distance <= self.ik.tolerance:
                        facts = (phase.spec.anchor, way[:3].tolist(), distance, self.ik.tolerance)
                        raise Unreachable(world, phase.name, *facts)
                    worst = max(worst, distance)
                knots[k] = command
        return knots, worst

    def _targets(self, xy: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Start and end of each phase: the grasp point [m] and then the gripper's command."""
        robot = self._cfg.robot
        where = xy.copy()  # of each object after the phases so far
        in_hand = -1
        out: list[tuple[np.ndarray, np.ndarray]] = []
        for phase in self.phases:
            if in_hand >= 0 and phase.carried < 0:  # let go where the last target was
                where[in_hand] = out[-1][1][:2]
            in_hand = phase.carried
            target = phase.target
            point = out[-1][1][:3] if target is None else [*target_xy(target, where), target.z]
            end = np.array([*point, *robot.grips[phase.spec.gripper]])
            # The first phase's target stands from the first step; only the gripper moves from home.
            home = np.array([*point, *robot.home[len(robot.arm_joints) :]])
            out.append((out[-1][1] if out else home, end))
        return out

    def _progress(self) -> Iterator[tuple[int, float]]:
        """Number of the phase, and the smoothstep parameter at the end, of every step."""
        for number, phase in enumerate(self.phases):
            steps = phase.stop - phase.start
            for step in range(steps):
                yield number, smoothstep((step + 1) / steps)

    def _step_weights(self) -> tuple[Tensor, Tensor]:
        """Barycentric Lagrange weights of the Chebyshev points, and their numbers, for every
        step.
        """
        n = len(self._nodes)
        bary = (-1.0) ** np.arange(n)
        bary[[0, -1]] *= 0.5
        phase, s = (np.array(part)[:, None] for part in zip(*self._progress(), strict=True))
        gap = s - self._nodes
        hit = np.abs(gap) < 1e-12
        share = bary / np.where(hit, 1.0, gap)
        rows = np.where(hit.any(1, keepdims=True), hit, share / share.sum(1, keepdims=True))
        return torch.from_numpy(rows), torch.from_numpy(phase * n + np.arange(n))


def plan_in_parallel(
    pool: ProcessPoolExecutor, worlds: Sequence[int], sources_xy: np.ndarray
) -> Iterator[Plan]:
    """Plan worlds, their numbers ascending, in processes; ``sources_xy`` as of
    `OpenLoopPlanner.plan`.

    Raises:
        Unreachable: A target is out of reach; of several such worlds it names the first, as one
            process would.
        MjstackError: A process has ended by itself.
    """
    jobs: list[Future[list[Plan]]] = []
    try:
        with _as_programs():
            chunks = [worlds[first : first + _CHUNK] for first in range(0, len(worlds), _CHUNK)]
            jobs += [pool.submit(_plan, chunk, sources_xy[list(chunk)]) for chunk in chunks]
        for job in jobs:
            while not wait([job], _POLL).done:
                check_interrupt()
            yield from job.result()
    except BrokenProcessPool:
        raise MjstackError(
            "a planning process was killed or ended before every world was planned",
            "Run again with more free memory, or on one core (taskset -c 0), which starts no"
            " processes",
        ) from None
    finally:
        for job in jobs:  # after an error the rest is not wanted
            job.cancel()


@contextmanager
def _start_processes(cfg: Config, count: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that plan, which are gone when this has ended in any way."""
    before = active_children()
    # Processes are not forks: this one may hold a CUDA context and threads.
    with _as_programs():
        pool = ProcessPoolExecutor(count, get_context("spawn"), _start_process, (cfg,))
        for _ in range(count):  # a process starts where a job finds none idle
            pool.submit(int)
    try:
        yield pool
    finally:
        for process in set(active_children()).difference(before):
            process.kill()  # it may still be loading
        pool.shutdown(cancel_futures=True)


@contextmanager
def _as_programs() -> Iterator[None]:
    """Processes that start in here do not import the main module again, which need not bear it,
    leave Ctrl-C to this process, and use one core each.
    """
    main = sys.modules["__main__"]
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    sys.modules["__main__"] = ModuleType("__main__")
    limits = {name: "1" for name in _VARIABLES if name not in os.environ}
    os.environ.update(limits)
    try:
        yield
    finally:
        for name in limits:
            del os.environ[name]
        sys.modules["__main__"] = main
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _start_process(cfg: Config) -> None:
    """Make the planner of a process, which ends when the one that started it does."""
    global _planner
    Thread(target=_end_with_parent, daemon=True).start()
    _planner = OpenLoopPlanner(cfg)


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _plan(worlds: Sequence[int], xy: np.ndarray) -> list[Plan]:
    return [_planner.plan_world(world, row) for world, row in zip(worlds, xy, strict=True)]


def smoothstep(u: Any) -> Any:
    """From 0 to 1 with no speed at either end, for numbers or tensors ``u`` from 0 to 1."""
    return u * u * (3.0 - 2.0 * u)
