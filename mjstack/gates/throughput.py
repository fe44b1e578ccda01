"""Gate *throughput*: the speed of physics, of the validated episode and of ``env.step``."""

import gc
import os
import time
from collections.abc import Callable
from contextlib import closing
from typing import Any

import torch

from mjstack.bench.env_step import measure_env_step
from mjstack.bench.episode import measure_episode
from mjstack.bench.physics import measure_physics
from mjstack.bench.timing import EnergyMeter, Measurement
from mjstack.config.schema import Backend
from mjstack.envs import build_env, decided_every_step, without_images
from mjstack.episodes.context import RunContext, each_rank, lacks_episode
from mjstack.errors import MjstackError
from mjstack.gates.runner import log_error
from mjstack.report.gl import require_offscreen
from mjstack.report.record import GateResult, Status

CUDA = "throughput_cuda"
_UNVERIFIED = "a figure counts only where the task was verified"


@each_rank
def run_throughput(context: RunContext) -> list[GateResult]:
    """Measure the CPU-side backend as ``throughput`` and MJWarp on CUDA as ``throughput_cuda``.

    On a machine without CUDA the second is a skip; with CUDA the first is native MuJoCo on all
    cores, as the baseline.
    """
    backend, device = context.backend
    if not device.startswith("cuda"):
        cause = f"sim={backend} sim.device={device}"
        if not torch.cuda.is_available():
            cause = "this machine has none"
        reason = f"no CUDA device was used: {cause}"
        skip = GateResult(name=CUDA, status=Status.skipped, reason=reason)
        return [_measure(context, "throughput", backend, device), skip]
    if context.cfg.gate.throughput.native_baseline:
        native = _measure(context, "throughput", Backend.native, "cpu")
    else:
        reason = "gate.throughput.native_baseline=false"
        native = GateResult(name="throughput", status=Status.skipped, reason=reason)
    return [native, _measure(context, CUDA, backend, device)]


def _measure(context: RunContext, name: str, backend: Backend, device: str) -> GateResult:
    """Measure one backend. A measurement that breaks leaves the others their figures."""
    cfg = context.cfg
    t = cfg.gate.throughput
    result = GateResult(name=name, status=Status.failed)
    batch = context.artifacts.results.get("batch")
    if batch is not None and batch.status is Status.failed:
        result.reason = f"no figure: the batch gate failed, and {_UNVERIFIED}"
        return result
    began = time.perf_counter()
    on_cuda = device.startswith("cuda")
    seconds = t.max_seconds if on_cuda else t.cpu_max_seconds
    limits = {"seconds": seconds, "repetitions": t.repetitions, "meter": EnergyMeter(device)}
    result.metrics = {
        "worlds": cfg.nworld,
        "cpu_count": os.cpu_count() or 1,
        "time_budget_s": seconds,
    }

    # The measurements
    found: dict[str, Measurement] = {}
    if {"physics", "episode"} & set(t.measurements):
        found |= _on_driven_worlds(context, backend, device, result, limits)
    if "env_step" in t.measurements:
        found["env_step"] = _guarded(
            "env_step", _on_environment, context, backend, device, result, limits
        )
    if "cameras" in t.measurements and cfg.scene.cameras and _draws(context, backend, found):
        found["cameras"] = _guarded(
            "cameras", _on_environment, context, backend, device, result, limits, cameras=True
        )
    if not on_cuda:
        result.notes["gpu_power_and_memory"] = "not measured: no GPU"

    # Whether they count
    episode = found.get("episode", Measurement(name="episode"))
    if episode.facts.get("succeeded", cfg.nworld) < cfg.nworld:
        for one in found.values():
            one.problem = one.problem or f"the episode failed, and {_UNVERIFIED}"
    verified = batch is not None and batch.status is Status.passed
    verified |= bool(episode.samples) and not episode.problem
    result.reason = "; ".join(f"{key}: {_describe(one, on_cuda)}" for key, one in found.items())
    if not verified and not lacks_episode(cfg):
        result.reason += " (the task was not verified in this run: add batch to gates)"
    for one in found.values():
        result.metrics |= one.metrics()
        result.notes |= one.named_notes()
    if not any(one.problem for one in found.values()):
        measured = any(one.samples for one in found.values())
        result.status = Status.passed if measured else Status.skipped
    if result.status is not Status.skipped:
        result.seconds = time.perf_counter() - began
    return result


def _describe(one: Measurement, on_cuda: bool) -> str:
    if one.problem:
        return f"no figure: {one.problem}"
    if one.missing:
        return f"not measured: {one.missing}"
    return f"{one.headline} (eager)" if on_cuda and not one.facts["captured"] else one.headline


def _on_driven_worlds(
    context: RunContext, backend: Backend, device: str, result: GateResult, limits: dict[str, Any]
) -> dict[str, Measurement]:
    """Measurements *physics* and *episode*, on the same worlds."""
    t = context.cfg.gate.throughput
    wanted = [name for name in ("physics", "episode") if name in t.measurements]
    found: dict[str, Measurement] = {}
    if "physics" in wanted and not context.phases:
        wanted.remove("physics")
        missing = "it starts as a phase begins, and a policy has none"
        found["physics"] = Measurement(name="physics", missing=missing)
    if not wanted:
        return found
    if lack := lacks_episode(context.cfg):
        return {name: Measurement(name=name, missing=lack) for name in wanted}
    gc.collect()  # environments hold on to their worlds in cycles, and a GPU has not room for all
    began = time.perf_counter()
    try:
        sim = context.simulation(context.cfg.nworld, backend, device)
    except Exception as error:
        problem = log_error(error)
        return {name: Measurement(name=name, problem=problem) for name in wanted}
    result.metrics["build_and_compile_s"] = time.perf_counter() - began
    result.notes["backend"] = sim.description
    if sim.sizes is not None:
        result.notes["sizes"] = str(sim.sizes)
    step_seconds = 0.0
    if "physics" in wanted:
        found["physics"] = _guarded("physics", measure_physics, context, sim, **limits)
        if found["physics"].samples:
            step_ms = found["physics"].median("ms_per_batched_step")
            step_seconds = 1e-3 * step_ms * context.cfg.timing.decimation
    if "episode" in wanted:
        limits = limits | {"repetitions": min(t.repetitions, t.episodes)}
        found["episode"] = _guarded(
            "episode", measure_episode, context, sim, step_seconds=step_seconds, **limits
        )
    sim.close()
    return found


def _on_environment(
    context: RunContext,
    backend: Backend,
    device: str,
    result: GateResult,
    limits: dict[str, Any],
    *,
    cameras: bool = False,
) -> Measurement:
    """Measurement *env_step* or *cameras*, on an environment with room for random actions."""
    gc.collect()
    began = time.perf_counter()
    cfg = decided_every_step(context.cfg)
    made = build_env(
        cfg if cameras else without_images(cfg),
        model=context.model,
        backend=backend,
        device=device,
        sizes=context.env_sizes,
    )
    build_seconds = time.perf_counter() - began
    with closing(made) as env:
        result.notes.setdefault("backend", env.sim.description)
        found = measure_env_step(
            env,
            steps=cfg.gate.throughput.env_steps,
            **limits,
            advance=context.advance,
            share=cfg.gate.throughput.action_share,
            name="cameras" if cameras else "env_step",
        )
        found.facts["build_and_compile_s"] = build_seconds
        if env.sim.sizes is not None:
            found.notes["sizes"] = str(env.sim.sizes)
        return found


def _draws(context: RunContext, backend: Backend, found: dict[str, Measurement]) -> bool:
    """Whether a backend can draw here; if not, *cameras* is missing."""
    if backend is Backend.native:
        try:
            require_offscreen(context.model)
        except MjstackError as error:
            found["cameras"] = Measurement(name="cameras", missing=str(error).rstrip("."))
            return False
    return True


def _guarded(
    name: str, measure: Callable[..., Measurement], *args: object, **options: object
) -> Measurement:
    """A measurement, or the error that broke it as its problem."""
    try:
        return measure(*args, **options)
    except Exception as error:
        return Measurement(name=name, problem=log_error(error).rstrip("."))
