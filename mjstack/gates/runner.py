"""Runs the chosen gates in their order and keeps the report current."""

import logging
import time
from collections.abc import Callable
from dataclasses import replace

from mjstack.config.complete import typed
from mjstack.config.functions import resolve_func
from mjstack.config.schema import Config
from mjstack.distributed import Ranks
from mjstack.episodes.context import RunContext, lacks_episode
from mjstack.errors import MjstackError, RankError, describe_error
from mjstack.interrupt import check_interrupt
from mjstack.report.record import GateResult, Status

log = logging.getLogger(__name__)

Gate = Callable[[RunContext], list[GateResult]]
_ALONE = "rank 0 alone"
_RATE = "_per_s.median"


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
        func = resolve_func(f"gate.{name}", path, first="context")
        kind = getattr(func, "config", None)
        if kind is not None and isinstance(cfg.gate[name], dict):
            cfg.gate.added[name] = typed(f"gate.{name}", cfg.gate[name], kind)
        gates[name] = func
    return gates


def run_gates(context: RunContext) -> None:
    """Run the configured gates in their order. Each result goes to the context's ``record`` before
    the next gate begins.
    """
    for name, run in find_gates(context.cfg).items():
        run_guarded(context, name, run)


def run_guarded(context: RunContext, name: str, run: Gate, spread: str = "") -> None:
    """Run one gate, or other work that judges like one, and record its results. If it raises it has
    failed, with the error as its reason.

    Args:
        context: The run.
        name: The gate's name.
        run: Its function.
        spread: How ranks share its work, as the marks of gates say; by default as it is marked.

    Raises:
        Exception: It failed in a rank whose part the others need, or a rank has gone: the run is
            over.
    """
    context.begin(name)
    began = time.perf_counter()
    ranks = context.ranks
    spread = spread or getattr(run, "spread", "")
    over: BaseException | None = None
    try:
        lack = lacks_episode(context.cfg) if getattr(run, "needs_episode", False) else ""
        if lack:
            results = [GateResult(name=name, status=Status.skipped, reason=lack)]
        elif ranks.size == 1 or spread == "worlds":
            results = run(context)
        elif spread == "ranks":
            results = _in_each_rank(context, run)
        else:
            results = ranks.from_first(lambda: _note(run(context), _ALONE))
    except (Exception, SystemExit, KeyboardInterrupt) as error:
        cause = ranks.cause(error)
        if isinstance(cause, KeyboardInterrupt):
            raise
        results = [GateResult(name=name, status=Status.failed, reason=log_error(cause))]
        gone = isinstance(cause, RankError) and cause.gone
        over = cause if gone or (ranks.size > 1 and spread == "worlds") else None
        if over is not None and context.cfg.job.name == "gates" and context.folder is not None:
            results[0].reason += f" To go on after the last finished seed: resume={context.folder}"
    seconds = time.perf_counter() - began
    for result in results:
        if result.status is not Status.skipped and not result.seconds:
            result.seconds = seconds
        context.artifacts.results[result.name] = result
        context.record(result)
    if over is not None:
        raise over


def _in_each_rank(context: RunContext, run: Gate) -> list[GateResult]:
    """Run a gate in every rank on its own worlds: the results of rank 0, with the sums of all
    ranks' rates. It has failed if it has failed in any.
    """
    ranks = context.ranks
    own = replace(context, cfg=replace(context.cfg, nworld=len(context.worlds)), ranks=Ranks())
    each = ranks.in_all(lambda: run(own))
    results = _note(each[0], f"each of {ranks.size} ranks its own worlds; figures are rank 0's")
    for number, result in enumerate(results):
        others = [part[number] for part in each[1:]]
        for rank, other in enumerate(others, 1):
            result.details.append(f"rank {rank}: {other.status}, {other.reason}")
            if other.status is Status.failed and result.status is not Status.failed:
                result.status = Status.failed
                result.reason = f"rank {rank}: {other.reason}"
        for key in [key for key in result.metrics if key.endswith(_RATE)]:
            found = [part.metrics.get(key) for part in (result, *others)]
            rates = [rate for rate in found if rate is not None]
            if len(rates) == ranks.size:
                result.metrics[f"all_ranks.{key}"] = sum(rates)
    return results


def _note(results: list[GateResult], text: str) -> list[GateResult]:
    """Results that say which ranks they are of."""
    for result in results:
        result.notes["ranks"] = text
    return results


def log_error(error: BaseException) -> str:
    """An error in one line. The traceback of an unexpected one goes to run.log.

    Raises:
        KeyboardInterrupt: The command was interrupted, which may have caused the error.
    """
    check_interrupt()
    if not isinstance(error, MjstackError):
        log.error("unexpected error", exc_info=error)
    return describe_error(error, "run.log has the traceback")
