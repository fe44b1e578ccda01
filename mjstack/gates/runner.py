"""Runs the chosen gates in their order and keeps the report current."""

import logging
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from mjstack.config.complete import typed
from mjstack.config.functions import resolve_func
from mjstack.config.schema import Config
from mjstack.distributed import Ranks, current_ranks
from mjstack.episodes.earlier_run import archive_starts
from mjstack.episodes.rollout import lacks_episode
from mjstack.episodes.run import Run
from mjstack.errors import MjstackError, RankError, describe_error
from mjstack.interrupt import check_interrupt
from mjstack.report.record import GateResult, Status

log = logging.getLogger(__name__)

Gate = Callable[[Run], list[GateResult]]


def find_gates(cfg: Config) -> dict[str, Gate]:
    """Functions of the gates that run, by name and in their order.

    A gate of the search path may carry a subclass of `GateFuncCfg` as its attribute ``config``: its
    parameters, ``cfg.gate[name]``, become one of these.

    Raises:
        MjstackError: A function cannot be found, or does not take its parameters.
    """
    gates = {}
    for name, path in cfg.gate.functions().items():
        if name not in cfg.gates:
            continue
        func = resolve_func(f"gate.{name}", path, first="run")
        kind = getattr(func, "config", None)
        if kind is not None and isinstance(cfg.gate[name], dict):
            cfg.gate.added[name] = typed(f"gate.{name}", cfg.gate[name], kind)
        gates[name] = func
    return gates


def run_gates(run: Run, folder: Path) -> None:
    """Run the configured gates in their order. Each result goes to the run's ``record`` before
    the next gate begins. The folder keeps copies of starts files.
    """
    stage = run.stage
    cfg = stage.cfg
    if stage.ranks.writes:  # of several ranks, the first makes the copies
        cfg = archive_starts(cfg, folder)
    run = replace(run, stage=stage.with_config(cfg, measured=stage.measured))
    for name, gate in find_gates(run.cfg).items():
        run_guarded(run, name, gate)


def run_guarded(run: Run, name: str, gate: Gate, spread: str = "") -> None:
    """Run one gate, or other work that judges like one, and record its results. If it raises it has
    failed, with the error as its reason. ``spread`` is how ranks share its work, as the marks of
    gates say; by default as it is marked.

    Raises:
        Exception: It failed in a rank whose part the others need, or a rank has gone: the run is
            over.
    """
    began = time.perf_counter()
    ranks = run.stage.ranks
    spread = spread or getattr(gate, "spread", "")
    fatal: BaseException | None = None
    try:
        run.gate = name
        run.begin(name)  # which may load what the gate plays on
        lack = lacks_episode(run.cfg) if getattr(gate, "needs_episode", False) else ""
        if lack:
            results = [GateResult(name=name, status=Status.skipped, reason=lack)]
        elif ranks.size == 1 or spread == "worlds":
            results = gate(run)
        elif spread == "ranks":
            results = _in_each_rank(run, gate)
        else:
            results = ranks.from_first(lambda: _with_note(gate(run), "rank 0 alone"))
    except (Exception, SystemExit, KeyboardInterrupt) as error:
        cause = ranks.cause(error)
        if isinstance(cause, KeyboardInterrupt):
            raise
        results = [GateResult(name=name, status=Status.failed, reason=log_error(cause))]
        gone = isinstance(cause, RankError) and cause.gone
        fatal = cause if gone or (ranks.size > 1 and spread == "worlds") else None
    seconds = time.perf_counter() - began
    for result in results:
        if result.status is not Status.skipped and not result.seconds:
            result.seconds = seconds
        run.artifacts.results[result.name] = result
        run.record(result)
    if fatal is not None:
        raise fatal


def _in_each_rank(run: Run, gate: Gate) -> list[GateResult]:
    """Run a gate in every rank on its own worlds. It has failed if it has failed in any."""
    stage = run.stage
    ranks = stage.ranks
    gate_cfg = run.cfg.gate
    # Ranks that made different numbers of repetitions would not be timed at the same time
    throughput = replace(gate_cfg.throughput, precision=0.0)
    gates = replace(gate_cfg, throughput=throughput)
    share = replace(run.cfg, nworld=len(stage.worlds), gate=gates)
    single = replace(run, stage=stage.with_config(share, ranks=Ranks(), measured=stage.measured))
    return join_ranks(ranks.in_all(lambda: gate(single)))


def join_ranks(results_of: list[list[GateResult]]) -> list[GateResult]:
    """The results of rank 0, with sums of all ranks' rates and the slowest of each."""
    size = len(results_of)
    note = f"each of {size} ranks its own worlds; figures are rank 0's"
    results = _with_note(results_of[0], note)
    for result, *later in zip(*results_of, strict=True):
        for rank, rank_result in enumerate(later, 1):
            result.details.append(f"rank {rank}: {rank_result.status}, {rank_result.reason}")
            if rank_result.status is Status.failed and result.status is not Status.failed:
                result.status = Status.failed
                result.reason = f"rank {rank}: {rank_result.reason}"
        rates = {}
        for figure in [f for f in result.figures if f.unit == "/s" and f.column == "median"]:
            if all(figure.key in rank_result.metrics for rank_result in later):
                values = [rank_result.metrics[figure.key] for rank_result in (result, *later)]
                group = f"all_ranks.{figure.group}"
                result.figures.append(replace(figure, value=sum(values), group=group))
                unit = f"{figure.name.replace('_', '-')}/s"
                slowest = f"rank {values.index(min(values))}, the slowest, {min(values):,.0f}"
                rates[figure.group] = f"{figure.group} {sum(values):,.0f} {unit} ({slowest})"
        if rates and result.status is not Status.failed:
            result.reason = f"{size} ranks: {'; '.join(rates.values())}; rank 0: {result.reason}"
    return results


def _with_note(results: list[GateResult], text: str) -> list[GateResult]:
    """Results that name the ranks they are of."""
    for result in results:
        result.notes["ranks"] = text
    return results


def log_error(error: BaseException) -> str:
    """An error in one line. The traceback of an unexpected one goes to run.log, or where this rank
    writes none to stderr.

    Raises:
        KeyboardInterrupt: The command was interrupted, which may have caused the error.
    """
    check_interrupt()
    log_name = "run.log"
    if not isinstance(error, MjstackError):
        if current_ranks().writes:
            log.error("unexpected error", exc_info=error)
        else:
            log_name = "stderr"
            traceback.print_exception(error)
    return describe_error(error, f"{log_name} has the traceback")
