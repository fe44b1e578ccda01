"""Gate *throughput*: how fast physics, the validated episode and ``env.step`` are. Void where the
task or physics failed.
"""

from __future__ import annotations

import gc
import logging
import os
import sys
import time
from collections.abc import Callable

import torch

from mjstack.bench.power import EnergyMeter
from mjstack.bench.sections import (
    Section,
    TimeBudget,
    measure_env_steps,
    measure_episode,
    measure_physics,
)
from mjstack.config.schema import Backend
from mjstack.envs import build_env
from mjstack.episodes.context import GateContext
from mjstack.errors import MjstackError
from mjstack.report.record import GateResult, Status
from mjstack.sim import BatchSizes

log = logging.getLogger(__name__)

CUDA = "throughput_cuda"


def run_throughput(context: GateContext) -> list[GateResult]:
    """Measures the CPU-side backend as ``throughput`` and MJWarp on CUDA as ``throughput_cuda``.

    On a machine without CUDA the second is a skip; with CUDA the first is native MuJoCo on all
    cores, as the baseline.
    """
    backend, device = context.backend
    if device.startswith("cuda"):
        if context.cfg.gate.throughput.native_baseline:
            native = _measure(context, "throughput", Backend.native, "cpu")
        else:
            native = GateResult(
                name="throughput",
                status=Status.skipped,
                reason="gate.throughput.native_baseline=false",
            )
        return [native, _measure(context, CUDA, Backend.mjwarp, device)]
    reason = "no CUDA device was used: " + (
        "this machine has none"
        if not torch.cuda.is_available()
        else f"sim={backend.value} sim.device={device}"
    )
    return [
        _measure(context, "throughput", backend, device),
        GateResult(name=CUDA, status=Status.skipped, reason=reason),
    ]


def _measure(context: GateContext, name: str, backend: Backend, device: str) -> GateResult:
    """All sections on one backend. One that breaks, out of memory say, leaves the others their
    figures.
    """
    cfg = context.cfg
    t = context.cfg.gate.throughput
    batch = context.results.get("batch")
    if batch is not None and batch.status is Status.failed:
        reason = (
            "no figure: the batch gate failed, and a figure counts only where the task was verified"
        )
        return GateResult(name=name, status=Status.failed, reason=reason)
    began = time.perf_counter()
    on_cuda = device.startswith("cuda")
    watch = TimeBudget(t.max_seconds if on_cuda else t.cpu_max_seconds, t.repetitions)
    meter = EnergyMeter(device)
    facts: dict[str, float] = {"worlds": cfg.nworld, "cpu_count": os.cpu_count() or 1}
    notes: dict[str, str] = {}
    sections: list[Section] = []
    if {"physics", "episode"} & set(t.measurements):
        sections += _on_scripted_worlds(context, backend, device, watch, meter, facts, notes)
    if "env_step" in t.measurements:
        sections.append(
            _guarded(
                "env_step",
                lambda: _on_environment(context, backend, device, watch, meter, facts, notes),
            )
        )
    if not on_cuda:
        facts |= _peak_memory()
        notes["gpu_power_and_memory"] = "not measured: no GPU"

    episode = next((section for section in sections if section.name == "episode"), None)
    if episode is not None and episode.rejected:
        for section in sections:
            section.problem = (
                section.problem
                or "the episode failed, and a figure counts only where the task was verified"
            )
    verified = batch is not None and batch.status is Status.passed
    verified |= episode is not None and bool(episode.figures) and not episode.problem
    parts = []
    for section in sections:
        facts |= section.metrics()
        notes |= section.named_notes()
        text = section.headline
        if section.problem:
            text = f"no figure: {section.problem}"
        elif section.missing:
            text = f"not measured: {section.missing}"
        elif on_cuda and not section.facts["captured"]:
            text += " (eager)"
        parts.append(f"{section.name}: {text}")
    reason = "; ".join(parts)
    if not verified:
        reason += " (the task was not verified in this run: add batch to gates)"
    failed = any(section.problem for section in sections)
    measured = any(section.figures and not section.problem for section in sections)
    if not failed and not measured:
        return GateResult(
            name=name, status=Status.skipped, reason=reason, metrics=facts, notes=notes
        )
    return GateResult(
        name=name,
        status=Status.failed if failed else Status.passed,
        reason=reason,
        seconds=time.perf_counter() - began,
        thresholds={"repetitions": t.repetitions, "max_seconds_per_section": watch.seconds},
        metrics=facts,
        notes=notes,
    )


def _on_scripted_worlds(
    context: GateContext,
    backend: Backend,
    device: str,
    watch: TimeBudget,
    meter: EnergyMeter,
    facts: dict[str, float],
    notes: dict[str, str],
) -> list[Section]:
    """Sections *physics* and *episode*, on the same worlds."""
    cfg = context.cfg
    wanted = context.cfg.gate.throughput.measurements
    gc.collect()  # environments hold on to their worlds in cycles, and a GPU has not room for all
    began = time.perf_counter()
    try:
        sim = context.simulation(cfg.nworld, backend, device)
    except Exception as error:
        return [
            Section(name=name, problem=_explain(name, error))
            for name in ("physics", "episode")
            if name in wanted
        ]
    facts["build_and_compile_s"] = time.perf_counter() - began
    notes["backend"] = sim.description
    sizes: BatchSizes | None = getattr(sim, "sizes", None)
    if sizes is not None:
        facts |= {
            "nconmax": sizes.nconmax,
            "naconmax": sizes.contact_pool(cfg.nworld),
            "njmax": sizes.njmax,
        }
        notes["sizes_from"] = sizes.source
    sections: list[Section] = []
    step_seconds: float | None = None
    if "physics" in wanted:
        sections.append(_guarded("physics", lambda: measure_physics(context, sim, watch, meter)))
        step_seconds = sections[0].step_seconds
    if "episode" in wanted:
        sections.append(
            _guarded("episode", lambda: measure_episode(context, sim, watch, meter, step_seconds))
        )
    sim.close()
    return sections


def _on_environment(
    context: GateContext,
    backend: Backend,
    device: str,
    watch: TimeBudget,
    meter: EnergyMeter,
    facts: dict[str, float],
    notes: dict[str, str],
) -> Section:
    """Section *env_step*, on an environment with room for random actions."""
    cfg = context.cfg
    gc.collect()
    began = time.perf_counter()
    env = build_env(
        cfg, model=context.model, backend=backend, device=device, sizes=context.env_sizes
    )
    notes.setdefault("backend", env.sim.description)
    build_seconds = time.perf_counter() - began
    try:
        section = measure_env_steps(context, env, watch, meter)
    finally:
        env.close()
    section.facts["build_and_compile_s"] = build_seconds
    return section


def _guarded(name: str, measure: Callable[[], Section]) -> Section:
    """A section, or the error that broke it as its problem."""
    try:
        return measure()
    except Exception as error:
        return Section(name=name, problem=_explain(name, error))


def _explain(name: str, error: Exception) -> str:
    """One line about an error; run.log gets the traceback of one that is nobody's input."""
    if isinstance(error, MjstackError):
        return str(error).rstrip(".")
    log.error("%s broke", name, exc_info=error)
    return (
        f"{type(error).__name__}: {(str(error) or 'no message').splitlines()[0]} (run.log has the"
        " traceback)"
    )


def _peak_memory() -> dict[str, float]:
    """The most memory that this process has held so far."""
    try:
        import resource
    except ImportError:  # not on Windows
        return {}
    unit = 1 if sys.platform == "darwin" else 1024
    return {"process_peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20}
