"""Gate *throughput*: the speed of physics, of the validated episode and of ``env.step``."""

import gc
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial

from mjstack.bench.env_step import measure_env_step
from mjstack.bench.episode import measure_episode, measure_physics
from mjstack.bench.timing import Measurement
from mjstack.config.schema import Backend
from mjstack.envs import build_env, decided_every_step, without_images
from mjstack.episodes.rollout import lacks_episode
from mjstack.episodes.run import Run, each_rank
from mjstack.errors import MjstackError
from mjstack.gates.runner import log_error
from mjstack.report.figure import Figure, figures
from mjstack.report.gl import require_offscreen
from mjstack.report.record import GateResult, Status

CUDA = "throughput_cuda"
_UNVERIFIED = "a figure counts only where the task was verified"


@each_rank
def run_throughput(run: Run) -> list[GateResult]:
    """Measure the CPU-side backend as ``throughput`` and MJWarp on CUDA as ``throughput_cuda``.

    On a machine without CUDA the second is a skip; with CUDA the first is native MuJoCo on all
    cores, as the baseline.
    """
    backend, device = run.stage.backend
    skip = partial(GateResult, status=Status.skipped)
    if not device.startswith("cuda"):
        reason = f"no CUDA device was used: sim={backend} sim.device={device}"
        cuda = skip(name=CUDA, reason=reason)
        return [_measure(run, "throughput", backend, device), cuda]
    if run.cfg.gate.throughput.native_baseline:
        native = _measure(run, "throughput", Backend.native, "cpu")
    else:
        native = skip(name="throughput", reason="gate.throughput.native_baseline=false")
    return [native, _measure(run, CUDA, backend, device)]


def _measure(run: Run, gate: str, backend: Backend, device: str) -> GateResult:
    """Measure one backend. A measurement that breaks leaves the others their figures."""
    cfg = run.cfg
    t = cfg.gate.throughput
    result = GateResult(name=gate, status=Status.failed)
    batch = run.artifacts.results.get("batch")
    if batch is not None and batch.status is Status.failed:
        result.reason = f"no figure: the batch gate failed, and {_UNVERIFIED}"
        return result
    began = time.perf_counter()
    on_cuda = device.startswith("cuda")
    result.figures = figures(worlds=cfg.nworld)

    # The measurements
    worlds = (run, backend, device, result)
    measured = _on_driven_worlds(*worlds)
    for name in ("env_step", "cameras") if cfg.scene.cameras else ("env_step",):
        if name in t.measurements:
            measured[name] = _guarded(name, _on_environment, name, *worlds)
    if not on_cuda:
        result.notes["gpu_power_and_memory"] = "not measured: no GPU"

    # Whether they count
    episode = measured.get("episode", Measurement(name="episode"))
    if episode.failed:
        for measurement in measured.values():
            measurement.problem = measurement.problem or f"the episode failed, and {_UNVERIFIED}"
    verified = batch is not None and batch.status is Status.passed
    verified |= bool(episode.samples) and not episode.problem
    result.reason = "; ".join(f"{key}: {_describe(m, on_cuda)}" for key, m in measured.items())
    if not verified and not lacks_episode(cfg):
        result.reason += " (the task was not verified in this run: add batch to gates)"
    for measurement in measured.values():
        result.figures += measurement.figures()
        result.notes |= measurement.named_notes()
    if not any(measurement.problem for measurement in measured.values()):
        sampled = any(measurement.samples for measurement in measured.values())
        result.status = Status.passed if sampled else Status.skipped
    if result.status is not Status.skipped:
        result.seconds = time.perf_counter() - began
    return result


def _describe(measured: Measurement, on_cuda: bool) -> str:
    if measured.problem:
        return f"no figure: {measured.problem}"
    if measured.missing:
        return f"not measured: {measured.missing}"
    eager = on_cuda and not measured.captured
    return f"{measured.headline} (eager)" if eager else measured.headline


def _on_driven_worlds(
    run: Run, backend: Backend, device: str, result: GateResult
) -> dict[str, Measurement]:
    """Measurements *physics* and *episode*, on the same worlds."""
    lack = lacks_episode(run.cfg)
    no_phase = "it starts as a phase begins, and a policy has none"
    lacks = {"physics": lack if run.stage.phases else no_phase, "episode": lack}
    chosen = [name for name in lacks if name in run.cfg.gate.throughput.measurements]
    measured = {name: Measurement(name=name, missing=lacks[name]) for name in chosen}
    names = [name for name in chosen if not lacks[name]]
    if not names:
        return measured
    gc.collect()  # environments hold on to their worlds in cycles, and a GPU has not room for all
    began = time.perf_counter()
    try:
        sim = run.stage.simulation(run.cfg.nworld, backend, device)
    except Exception as error:
        problem = log_error(error)
        return measured | {name: Measurement(name=name, problem=problem) for name in names}
    result.figures.append(Figure("build_and_compile", time.perf_counter() - began, "s"))
    result.notes["backend"] = sim.description
    if sim.sizes is not None:
        result.notes["sizes"] = str(sim.sizes)
    step_seconds = 0.0
    if "physics" in names:
        carry = run.artifacts.carry_start
        measured["physics"] = physics = _guarded("physics", measure_physics, run.stage, sim, carry)
        if physics.samples:
            step_ms = physics.median("ms_per_batched_step")
            step_seconds = 1e-3 * step_ms * run.cfg.timing.decimation
    if "episode" in names:
        timed_episode = run.artifacts.timed_episode
        measure = partial(measure_episode, step_seconds=step_seconds)
        measured["episode"] = _guarded("episode", measure, run.stage, sim, timed_episode)
    sim.close()
    return measured


def _on_environment(
    name: str, run: Run, backend: Backend, device: str, result: GateResult
) -> Measurement:
    """Measurement *env_step* or *cameras*, on an environment with room for random actions."""
    cfg = decided_every_step(run.cfg)
    if name == "env_step":
        cfg = without_images(cfg)
    elif backend is Backend.native:
        try:
            require_offscreen(run.stage.model)
        except MjstackError as error:
            return Measurement(name=name, missing=str(error).rstrip("."))
    gc.collect()
    began = time.perf_counter()
    worlds = build_env(
        cfg,
        model=run.stage.model,
        backend=backend,
        device=device,
        sizes=run.stage.measured.get("env"),
    )
    build_seconds = time.perf_counter() - began
    with closing(worlds) as env:
        result.notes.setdefault("backend", env.sim.description)
        measured = measure_env_step(env, name, run.stage.progress.advance)
        measured.facts.append(Figure("build_and_compile", build_seconds, "s"))
        if env.sim.sizes is not None:
            measured.notes["sizes"] = str(env.sim.sizes)
        return measured


def _guarded(name: str, measure: Callable[..., Measurement], *args: object) -> Measurement:
    """A measurement, or the error that broke it as its problem."""
    try:
        return measure(*args)
    except Exception as error:
        return Measurement(name=name, problem=log_error(error).rstrip("."))
