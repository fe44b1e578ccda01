"""The runs that size MJWarp's buffers: the scripted task, and random actions."""

import gc
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mjstack.config.schema import Backend
from mjstack.envs import Env
from mjstack.envs.buffers import (
    Peaks,
    measure_peaks,
    play_random_actions,
    read_peaks,
    recommend_sizes,
    require_physics,
)
from mjstack.episodes.rollout import Reset
from mjstack.sim import BatchSizes, Simulation

if TYPE_CHECKING:
    from mjstack.episodes.context import RunContext


@dataclass(frozen=True, kw_only=True, slots=True)
class Workload:
    """One run and what it used.

    Attributes:
        peaks: The most it used.
        sizes: The room it had, or None on native MuJoCo, which has no fixed buffers.
        final: State at the end, shape ``(nworld, nq)``.
        failed: Bits of the rules that each world broke, shape ``(nworld,)``; zero for random
            actions, which nothing judges.
        description: Backend and hardware.
    """

    peaks: Peaks
    sizes: BatchSizes | None
    final: np.ndarray
    failed: np.ndarray
    description: str

    @property
    def succeeded(self) -> int:
        """Worlds that broke no rule."""
        return int((self.failed == 0).sum())


def measuring_worlds(context: "RunContext") -> int:
    """How many worlds size the buffers."""
    nworld = context.cfg.nworld
    on_cuda = context.backend[1].startswith("cuda")
    return nworld if on_cuda else min(nworld, context.cfg.gate.capacity.cpu_nworld)


def play_task(context: "RunContext", reset: Reset, sizes: BatchSizes | None = None) -> Workload:
    """Play the driven task once, in worlds of exactly these sizes; without, with room to spare."""

    def play(sim: Simulation) -> np.ndarray:
        return context.play(sim, reset).result.failed.cpu().numpy()

    return _run(context, reset, sizes, play)


def play_random(context: "RunContext", sizes: BatchSizes | None = None) -> Workload:
    """Step the task's environment with random actions; worlds end and start anew as its managers
    say. Sizes as in `play_task`.
    """
    cfg = context.cfg
    advance = context.advance
    steps = cfg.gate.capacity.random_steps or cfg.task.episode_steps

    def play(sim: Simulation) -> np.ndarray:
        # A lack of room is what this looks for.
        env = Env(sim, context.index, cfg, check_faults=False)
        env.reset(seed=cfg.seed)
        play_random_actions(
            env, steps, advance and (lambda done: advance("random actions", done, steps))
        )
        return np.zeros(sim.nworld, dtype=np.int64)

    return _run(context, cfg.reset, sizes, play)


def size_batch(context: "RunContext") -> BatchSizes:
    """Sizes for ``batch=auto`` where the capacity gate does not run before.

    Raises:
        FaultError: Physics was lost in all the room that was tried.
    """
    worlds = measuring_worlds(context)
    margin = context.cfg.gate.capacity.margin
    task = play_task(context, context.cfg.reset)
    require_physics("the scripted task", task.peaks, task.sizes)
    return recommend_sizes(
        task.peaks, margin, f"batch=auto: the scripted task in {worlds} worlds, times {margin:g}"
    )


def _run(
    context: "RunContext",
    reset: Reset,
    sizes: BatchSizes | None,
    play: Callable[[Simulation], np.ndarray],
) -> Workload:
    """Play in worlds of these sizes; without, on MJWarp, with room to spare."""
    if sizes is not None or context.backend[0] is Backend.native:
        return _play(context, reset, sizes, play)
    runs: list[Workload] = []

    def run(sizes: BatchSizes) -> Peaks:
        runs.append(_play(context, reset, sizes, play))
        return runs[-1].peaks

    measure_peaks(context.cfg, run)
    return runs[-1]


def _play(
    context: "RunContext",
    reset: Reset,
    sizes: BatchSizes | None,
    play: Callable[[Simulation], np.ndarray],
) -> Workload:
    """Build worlds, play in them, and read what there is to know before they go."""
    backend, device = context.backend
    gc.collect()  # the worlds of the run before, for whose memory these may have no room
    sim = context.simulation(measuring_worlds(context), backend, device, reset=reset, sizes=sizes)
    failed = play(sim)
    workload = Workload(
        peaks=read_peaks(sim),
        sizes=sizes,
        final=sim.qpos.cpu().numpy().copy(),
        failed=failed,
        description=sim.description,
    )
    sim.close()
    return workload
