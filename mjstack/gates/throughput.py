"""Gate *throughput*: how fast the worlds step, cube in hand, warm-up and compilation apart."""

from __future__ import annotations

import logging
import os
import statistics
import time
from collections.abc import Callable

import torch

from mjstack.config.schema import Backend
from mjstack.errors import MjstackError
from mjstack.gates.episode import State, restore, snapshot, start_worlds
from mjstack.gates.gate import GateContext
from mjstack.report.record import GateResult, Status, Value
from mjstack.sim import LOST_PHYSICS, Simulation, resolve_sizes

log = logging.getLogger(__name__)

CUDA = "throughput_cuda"


def run_throughput(context: GateContext) -> list[GateResult]:
    """Measures the CPU-side backend as ``throughput`` and MJWarp on CUDA as ``throughput_cuda``.

    On a machine without CUDA the second is a skip; with CUDA the first is native MuJoCo on all cores, as the baseline.
    """
    backend, device = context.backend
    if device.startswith("cuda"):
        native = _guarded(context, "throughput", Backend.native, "cpu")
        return [native, _guarded(context, CUDA, Backend.mjwarp, device)]
    reason = "no CUDA device was used: " + (
        "this machine has none" if not torch.cuda.is_available() else f"sim={backend.value} sim.device={device}"
    )
    return [
        _guarded(context, "throughput", backend, device),
        GateResult(name=CUDA, status=Status.skipped, reason=reason),
    ]


def _guarded(context: GateContext, name: str, backend: Backend, device: str) -> GateResult:
    """One measurement; if it breaks, out of memory say, the other one is kept."""
    began = time.perf_counter()
    try:
        result = _measure(context, name, backend, device)
    except MjstackError as error:
        result = GateResult(name=name, status=Status.failed, reason=str(error))
    except Exception as error:
        log.exception("%s broke", name)
        reason = f"{type(error).__name__}: {(str(error) or 'no message').splitlines()[0]} (run.log has the traceback)"
        result = GateResult(name=name, status=Status.failed, reason=reason)
    result.seconds = time.perf_counter() - began
    return result


def _measure(context: GateContext, name: str, backend: Backend, device: str) -> GateResult:
    cfg, t = context.cfg, context.cfg.gate.throughput
    began = time.perf_counter()
    sim = context.simulation(cfg.nworld, backend, device)
    build_seconds = time.perf_counter() - began
    env, tape = start_worlds(sim, context.index, cfg, cfg.reset, context.planner, context.advance)
    first = context.phase_start(t.from_phase)

    def play(start: int, frames: int) -> float:
        """Seconds that some frames take, the device idle at both ends."""
        sim.synchronize()
        began = time.perf_counter()
        for frame in range(start, start + frames):
            env.action_manager.process(tape.command(frame))
            env.action_manager.write_commands()
            sim.step(cfg.timing.substeps)
        sim.synchronize()
        return time.perf_counter() - began

    state = context.carry_start
    if state is None or state.qpos.shape[0] != cfg.nworld:
        state = _play_up_to(context, sim, first, play)
        context.carry_start = state
    restore(sim, state)
    warm_seconds = play(first, 1)
    frame_seconds = play(first + 1, 1)
    frames = max(1, min(t.frames, int(t.max_seconds / frame_seconds), tape.frames - first))
    times: list[float] = []
    bad = torch.zeros(sim.nworld, dtype=torch.bool, device=sim.device)
    for repetition in range(t.repetitions):
        restore(sim, state)
        times.append(play(first, frames))
        bad |= (sim.overflow & LOST_PHYSICS) != 0
        bad |= ~(torch.isfinite(sim.qpos).all(1) & torch.isfinite(sim.qvel).all(1))
        bad |= sim.step_count != frames * cfg.timing.substeps
        if context.advance is not None:
            context.advance("repetitions", repetition + 1, t.repetitions)
    lost = int(bad.sum())
    steps = frames * cfg.timing.substeps
    ms = [1e3 * seconds / steps for seconds in times]
    rate = [cfg.nworld * steps / seconds for seconds in times]
    sizes = getattr(sim, "sizes", None) or resolve_sizes(cfg)
    metrics: dict[str, Value] = {
        "backend": sim.description,
        "cpu_count": os.cpu_count(),
        "worlds": cfg.nworld,
        "frames_per_repetition": frames,
        "repetitions": len(times),
        "ms_per_batched_step.median": statistics.median(ms),
        "ms_per_batched_step.min": min(ms),
        "ms_per_batched_step.max": max(ms),
        "world_steps_per_s.median": statistics.median(rate),
        "world_steps_per_s.min": min(rate),
        "world_steps_per_s.max": max(rate),
        "build_and_compile_s": build_seconds,
        "warm_up_s": warm_seconds,
        "nconmax": sizes.nconmax,
        "naconmax": sizes.contact_pool(cfg.nworld),
        "njmax": sizes.njmax,
        "sizes_from": sizes.source,
    }
    sim.close()
    batch = context.results.get("batch")
    status = Status.passed
    reason = f"{statistics.median(rate):,.0f} world-steps/s, {statistics.median(ms):.3g} ms per step of {cfg.nworld} worlds"
    if lost or (batch is not None and batch.status is Status.failed):
        why = f"{lost} worlds overflowed, diverged or were not stepped" if lost else "the batch gate failed"
        metrics = {key: value for key, value in metrics.items() if "_per_" not in key or key == "frames_per_repetition"}
        status, reason = Status.failed, f"no figure: {why}, and a figure counts only where the task was verified"
    elif batch is None:
        reason += " (the task was not verified in this run: add batch to gates)"
    return GateResult(
        name=name,
        status=status,
        reason=reason,
        thresholds={"repetitions": t.repetitions, "max_seconds_per_repetition": t.max_seconds},
        metrics=metrics,
    )


def _play_up_to(context: GateContext, sim: Simulation, first: int, play: Callable[[int, int], float]) -> State:
    for frame in range(first):
        play(frame, 1)
        if context.advance is not None:
            context.advance("frames to the start", frame + 1, first)
    return snapshot(sim)
