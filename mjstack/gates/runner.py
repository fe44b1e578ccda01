"""Runs the chosen gates in their order and keeps the report current."""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Callable

from mjstack.episodes.context import RunContext, lacks_episode
from mjstack.errors import MjstackError, is_out_of_memory
from mjstack.gates.baseline import run_baseline
from mjstack.gates.batch import run_batch
from mjstack.gates.capacity import run_capacity
from mjstack.gates.parity import run_parity
from mjstack.gates.success import run_success
from mjstack.gates.throughput import run_throughput
from mjstack.report.record import GateResult, Status

log = logging.getLogger(__name__)

Gate = Callable[[RunContext], list[GateResult]]

GATES: dict[str, Gate] = {
    "baseline": run_baseline,
    "parity": run_parity,
    "capacity": run_capacity,
    "batch": run_batch,
    "throughput": run_throughput,
    "success": run_success,
}


def run_gates(
    context: RunContext,
    on_start: Callable[[str], None] = lambda _: None,
    on_result: Callable[[GateResult], None] = lambda _: None,
) -> list[GateResult]:
    """Runs the gates that the configuration names, each once, in the order of `GATES`.

    Args:
        context: What they need. Its ``results`` fill up.
        on_start: Told before a gate starts.
        on_result: Told after each result, before the next gate starts.

    Returns:
        All results. A gate that raises has failed, with the error as its reason; the others still
        run.
    """
    out: list[GateResult] = []
    for name, run in GATES.items():
        if name in context.cfg.gates:
            on_start(name)
            out += run_guarded(context, name, run, on_result)
    return out


def run_guarded(
    context: RunContext,
    name: str,
    run: Gate,
    on_result: Callable[[GateResult], None] = lambda _: None,
) -> list[GateResult]:
    """Runs one gate, or whatever judges like one. If it raises it has failed, with the error as its
    reason.
    """
    began = time.perf_counter()
    try:
        lack = lacks_episode(context.cfg) if getattr(run, "needs_episode", False) else ""
        skipped = [GateResult(name=name, status=Status.skipped, reason=lack)]
        results = skipped if lack else run(context)
    except MjstackError as error:
        results = [GateResult(name=name, status=Status.failed, reason=str(error))]
    except Exception as error:
        log.error("gate %s broke:\n%s", name, traceback.format_exc())
        first = (str(error).splitlines() or [""])[0].rstrip(".")
        reason = f"internal error, {type(error).__name__}: {first} (run.log has the traceback)"
        if is_out_of_memory(f"{type(error).__name__}: {error}"):
            smaller = "Run fewer worlds, or with smaller buffers (batch.nconmax, batch.njmax)"
            reason = f"out of memory ({first or type(error).__name__}). {smaller}"
        results = [GateResult(name=name, status=Status.failed, reason=reason)]
    seconds = time.perf_counter() - began
    for result in results:
        if result.status is not Status.skipped and not result.seconds:
            result.seconds = seconds
        context.artifacts.results[result.name] = result
        log.info("gate %s: %s %s", result.name, result.status.value, result.reason)
        on_result(result)
    return results
