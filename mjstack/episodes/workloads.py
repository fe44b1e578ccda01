"""The runs that size MJWarp's buffers: the scripted task, and random actions."""

from __future__ import annotations

import gc
import time
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
from mjstack.managers.reset import required_fields
from mjstack.sim import BatchSizes, Simulation, device_memory, make_simulation

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
        seconds: Wall time, with the building of the worlds.
        data_bytes: What MJWarp's arrays take, or None.
        device_bytes: What the CUDA device gave out for these worlds, model included, or None.
        description: Backend and hardware.
    """

    peaks: Peaks
    sizes: BatchSizes | None
    final: np.ndarray
    failed: np.ndarray
    seconds: float
    data_bytes: int | None
    device_bytes: int | None
    description: str

    @property
    def succeeded(self) -> int:
        """Worlds that broke no rule."""
        return int((self.failed == 0).sum())


def measuring_worlds(context: RunContext) -> int:
    """How many worlds size the buffers."""
    on_cuda = context.backend[1].startswith("cuda")
    return (
        context.cfg.nworld
        if on_cuda
        else min(context.cfg.nworld, context.cfg.gate.capacity.cpu_nworld)
    )


def measure_task(context: RunContext, reset: Reset) -> Workload:
    """The scripted task from some start, with room to spare."""
    return _measure(context, lambda sizes: play_task(context, reset, sizes))


def measure_random(context: RunContext) -> Workload:
    """Random actions, with room to spare."""
    return _measure(context, lambda sizes: play_random(context, sizes))


def play_task(context: RunContext, reset: Reset, sizes: BatchSizes | None) -> Workload:
    """Plays the scripted task once in worlds of exactly these sizes."""

    def play(sim: Simulation) -> np.ndarray:
        return context.play(sim, reset).result.failed.cpu().numpy()

    return _play(context, reset, sizes, play)


def play_random(context: RunContext, sizes: BatchSizes | None) -> Workload:
    """Steps the task's own environment with random actions; worlds end and start anew as its
    managers say.
    """
    cfg = context.cfg
    advance = context.advance
    steps = cfg.gate.capacity.random_steps or cfg.task.episode_steps

    def play(sim: Simulation) -> np.ndarray:
        env = Env(
            sim, context.index, cfg, check_faults=False
        )  # a lack of room is what this looks for
        env.reset(seed=cfg.seed)
        play_random_actions(
            env, steps, advance and (lambda done: advance("random actions", done, steps))
        )
        return np.zeros(sim.nworld, dtype=np.int64)

    return _play(context, cfg.reset, sizes, play)


def size_batch(context: RunContext) -> BatchSizes:
    """Sizes for ``batch=auto`` where the capacity gate does not run before.

    Raises:
        FaultError: Physics was lost in all the room that was tried.
    """
    worlds = measuring_worlds(context)
    margin = context.cfg.gate.capacity.margin
    task = measure_task(context, context.cfg.reset)
    require_physics("the scripted task", task.peaks, task.sizes)
    return recommend_sizes(
        task.peaks, margin, f"batch=auto: the scripted task in {worlds} worlds, times {margin:g}"
    )


def _measure(context: RunContext, play: Callable[[BatchSizes | None], Workload]) -> Workload:
    if context.backend[0] is Backend.native:
        return play(None)
    runs: list[Workload] = []

    def run(sizes: BatchSizes) -> Peaks:
        runs.append(play(sizes))
        return runs[-1].peaks

    measure_peaks(context.cfg, run)
    return runs[-1]


def _play(
    context: RunContext,
    reset: Reset,
    sizes: BatchSizes | None,
    play: Callable[[Simulation], np.ndarray],
) -> Workload:
    """Builds worlds, plays in them, and reads what there is to know before they go."""
    backend, device = context.backend
    nworld = measuring_worlds(context)
    began = time.perf_counter()
    warp = backend is not Backend.native
    before = _used(device) if warp else None
    fields = required_fields(reset)
    sim = make_simulation(
        context.model,
        context.cfg,
        nworld,
        backend=backend,
        device=device,
        fields=fields,
        sizes=sizes,
    )
    failed = play(sim)
    after = _used(device) if warp else None
    workload = Workload(
        peaks=read_peaks(sim),
        sizes=sizes,
        final=sim.qpos.cpu().numpy().copy(),
        failed=failed,
        seconds=time.perf_counter() - began,
        data_bytes=sim.memory_bytes(),
        device_bytes=None if before is None or after is None else after - before,
        description=sim.description,
    )
    sim.close()
    return workload


def _used(device: str) -> int | None:
    gc.collect()  # the worlds of the run before
    memory = device_memory(device)
    return None if memory is None else memory[0]
