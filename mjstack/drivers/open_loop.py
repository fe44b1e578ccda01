"""Planning before the episode: targets of the grasp point and joint trajectories of every world."""

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from mjstack.config.schema import Config
from mjstack.errors import Unreachable
from mjstack.interrupt import check_interrupt
from mjstack.kinematics.mink_ik import GraspIk
from mjstack.process import available_cores
from mjstack.scene.index import gripper_targets
from mjstack.scene.phases import build_phases, nominal_xy, target_xy

# Of batched inverse kinematics: enough for a start far from the nominal one.
_ITERATIONS = 40
# Its spare joints end where mink's posture task leaves them: near home.
_POSTURE_GAIN = 0.3
_WORLDS = 256  # one more thread for each: 2,048 plans take twice the time in 16 threads

# Joint positions to start from, shape (nworld, nu), and targets [m], shape (nworld, 3), to the
# solutions and the distances that are left [m], shape (nworld,).
_Solve = Callable[[ndarray, ndarray], tuple[ndarray, ndarray]]


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
        ik_error: Largest distance [m] from a target at any knot, shape ``(nworld,)``.
    """

    knots: Tensor
    weights: Tensor
    numbers: Tensor
    ik_error: ndarray

    def to(self, device: torch.device, dtype: torch.dtype) -> "JointTrajectory":
        """The same trajectory on a device."""
        knots, weights = (part.to(device, dtype) for part in (self.knots, self.weights))
        return replace(self, knots=knots, weights=weights, numbers=self.numbers.to(device))

    def command(self, step: int | Tensor) -> Tensor:
        """Commands of one step, shape ``(nworld, nu)``, by its number; or of shape ``(1,)``, int64,
        on the same device, for a captured graph.
        """
        if isinstance(step, int):
            step = torch.tensor([step], device=self.numbers.device)
        knots = self.knots.index_select(1, self.numbers.index_select(0, step)[0])
        # Not einsum, whose rounding depends on nworld: a world alone gets the same commands.
        return (self.weights.index_select(0, step)[0][:, None] * knots).sum(1)


class OpenLoopPlanner:
    """Plans joint trajectories for objects and places at given positions: the nominal one with
    mink, and all others from there with batched inverse kinematics on the CPU.

    Attributes:
        phases: The phases.
        ik: mink's inverse kinematics of the robot alone.
        nominal: Commands at the end of each phase of the nominal plan, shape ``(phases, nu)``.
    """

    def __init__(self, cfg: Config) -> None:
        """Plan the nominal start, from which every other plan starts; a target out of reach is an
        Unreachable.
        """
        self._cfg = cfg
        self.phases = build_phases(cfg)
        self.ik = GraspIk(cfg.robot, cfg.model, tolerance=cfg.controller.ik_tolerance)
        widths = [phase.width for phase in self.phases]
        self._grips = gripper_targets(self.ik.model, cfg.robot, widths)
        self._nodes = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, cfg.controller.knots))
        self._weights, self._numbers = self._step_weights()
        self._plans: deque[tuple[ndarray, JointTrajectory]] = deque(maxlen=2)  # batches of the run
        self._xy = nominal_xy(cfg.scene)
        (first,), _ = self._solve_knots(self._xy[None], [0], self._solve_nominal)
        self.nominal = first[len(self._nodes) - 1 :: len(self._nodes)]
        # Once more from there: mink stops near the target, where spare joints still move.
        plan = self._solve_knots(self._xy[None], [0], self._solve_nominal, first)
        (self._knots,), (self._error,) = plan

    def plan(self, sources_xy: ndarray, names: Sequence[int] | None = None) -> JointTrajectory:
        """Plan one trajectory per world, which does not depend on the other worlds, from where each
        object and place is at the start [m], shape ``(nworld, sources, 2)``; see `source_names`.
        The worlds are divided among threads. A target out of reach is an Unreachable, with the
        phase, the distance and the number of the first such world; from 0 on without ``names``.
        """
        for sources, plan in self._plans:
            if np.array_equal(sources, sources_xy):
                return plan
        nworld = len(sources_xy)
        knots = np.tile(self._knots, (nworld, 1, 1))
        error = np.full(nworld, self._error)
        displaced = np.flatnonzero((sources_xy != self._xy).any(axis=(1, 2)))
        if displaced.size:
            worlds = displaced if names is None else np.array(names)[displaced]

            def solve_part(part: ndarray) -> tuple[ndarray, ndarray]:
                solve = self._batched_solve(len(part))
                xy = sources_xy[displaced[part]]
                return self._solve_knots(xy, worlds[part].tolist(), solve, self._knots)

            from mjstack.sim.warp_setup import wp  # the nominal plan alone does not need it

            # A launch on the CPU has one thread. Warp's default device is that of all threads.
            parts = min(available_cores(), -(-displaced.size // _WORLDS))
            if parts > 1:
                self._batched_solve(1)  # else each thread compiles the kernels
            with wp.ScopedDevice("cpu"), ThreadPoolExecutor(parts) as pool:
                plans = pool.map(solve_part, np.array_split(np.arange(displaced.size), parts))
                knots[displaced], error[displaced] = map(np.concatenate, zip(*plans, strict=True))
        trajectory = JointTrajectory(torch.from_numpy(knots), self._weights, self._numbers, error)
        if nworld > 1:
            self._plans.append((sources_xy.copy(), trajectory))
        return trajectory

    def _solve_nominal(self, q: ndarray, target: ndarray) -> tuple[ndarray, ndarray]:
        """Solve one world with mink."""
        command, distance = self.ik.solve(target[0], q[0])
        return command[None], np.array([distance])

    def _batched_solve(self, nworld: int) -> _Solve:
        """Batched inverse kinematics of so many worlds."""
        # Loads Warp, which the nominal plan alone does not need.
        from mjstack.kinematics.batched_ik import BatchedIk

        robot = self._cfg.robot
        ik = BatchedIk(
            self.ik.model, robot, nworld, "cpu", iterations=_ITERATIONS, posture_gain=_POSTURE_GAIN
        )
        moved = [robot.joints.index(name) for name in robot.ik_joints]

        def solve(q: ndarray, target: ndarray) -> tuple[ndarray, ndarray]:
            rounded, distance = ik.solve(torch.from_numpy(q), torch.from_numpy(target))
            solution = q.copy()  # the other joints exactly, not in float32
            solution[:, moved] = rounded.numpy()[:, moved]
            return solution, distance.numpy()

        return solve

    def _solve_knots(
        self, xy: ndarray, worlds: Sequence[int], solve: _Solve, seed: ndarray | None = None
    ) -> tuple[ndarray, ndarray]:
        """Commands at the knots, shape ``(nworld, n, nu)``, and the largest distance from a target
        at any [m], shape ``(nworld,)``; arguments as of `plan`. Solutions start at the ``seed``,
        shape ``(n, nu)``, or without one each at that before, the first at home.
        """
        n = len(self._nodes)
        ends = self._targets(xy)
        knots = np.tile(self.ik.home, (len(xy), len(self.phases) * n, 1))
        distances = np.zeros(knots.shape[:2])
        for i in range(len(self.phases)):
            start, end = ends[:, i : i + 2].swapaxes(0, 1)
            still = (start == end).all(axis=1)
            for j, s in enumerate(self._nodes):
                k = i * n + j
                repeated = still if j > 0 else np.full(len(xy), i > 0)
                knots[repeated, k] = knots[repeated, k - 1]
                if repeated.all():
                    continue
                check_interrupt()
                way = start + s * (end - start)
                guess = knots[:, k - 1].copy() if seed is None else np.tile(seed[k], (len(xy), 1))
                guess[:, len(self._cfg.robot.arm_joints) :] = way[:, 3:]
                command, distance = solve(guess, way[:, :3])
                knots[~repeated, k] = command[~repeated]
                distances[~repeated, k] = distance[~repeated]
        failed = np.argwhere(~(distances <= self.ik.tolerance))
        if failed.size:
            row, k = failed[0]
            phase = self.phases[k // n]
            start, end = ends[row, k // n : k // n + 2, :3]
            way = start + self._nodes[k % n] * (end - start)
            facts = (way.tolist(), float(distances[row, k]), self.ik.tolerance)
            raise Unreachable(worlds[row], phase.name, phase.spec.anchor, *facts)
        return knots, distances.max(axis=1)

    def _targets(self, xy: ndarray) -> ndarray:
        """Where each phase ends, after where the first one starts: the grasp point [m] and then the
        gripper's command, shape ``(nworld, phases + 1, 3 + n_gripper)``.
        """
        robot = self._cfg.robot
        where = xy.copy()  # of each object after the phases so far
        in_hand = -1
        ends = np.empty((len(xy), len(self.phases) + 1, 3 + len(robot.gripper_joints)))
        for i, phase in enumerate(self.phases):
            if in_hand >= 0 and phase.carried < 0:  # let go where the last target was
                where[:, in_hand] = ends[:, i, :2]
            in_hand = phase.carried
            ends[:, i + 1] = ends[:, i]
            if phase.target is not None:
                ends[:, i + 1, :2] = target_xy(phase.target, where)
                ends[:, i + 1, 2] = phase.target.z
            ends[:, i + 1, 3:] = self._grips[i]
        # The first phase's target stands from the first step; only the gripper moves from home.
        ends[:, 0, :3] = ends[:, 1, :3]
        ends[:, 0, 3:] = robot.home[len(robot.arm_joints) :]
        return ends

    def _step_weights(self) -> tuple[Tensor, Tensor]:
        """Barycentric weights of the Chebyshev points, and their numbers, for every step."""
        n = len(self._nodes)
        bary = (-1.0) ** np.arange(n)
        bary[[0, -1]] *= 0.5
        lengths = [phase.stop - phase.start for phase in self.phases]
        phase = np.repeat(np.arange(len(lengths)), lengths)[:, None]
        s = smoothstep(np.concatenate([np.arange(1, steps + 1) / steps for steps in lengths]))
        gap = s[:, None] - self._nodes
        hit = np.abs(gap) < 1e-12
        share = bary / np.where(hit, 1.0, gap)
        rows = np.where(hit.any(1, keepdims=True), hit, share / share.sum(1, keepdims=True))
        return torch.from_numpy(rows), torch.from_numpy(phase * n + np.arange(n))


def smoothstep(u: Any) -> Any:
    """From 0 to 1 with no speed at either end, for numbers or tensors ``u`` from 0 to 1."""
    return u * u * (3.0 - 2.0 * u)
