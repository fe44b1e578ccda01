"""Runs the chosen gates in their order and keeps the report current."""

import logging
import time
from collections.abc import Callable

from mjstack.config.complete import typed
from mjstack.config.functions import resolve_func
from mjstack.config.schema import Config
from mjstack.episodes.context import RunContext, lacks_episode
from mjstack.errors import MjstackError, describe_error
from mjstack.interrupt import check_interrupt
from mjstack.report.record import GateResult, Status

log = logging.getLogger(__name__)

Gate = Callable[[RunContext], list[GateResult]]


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


def run_guarded(context: RunContext, name: str, run: Gate) -> None:
    """Run one gate, or other work that judges like one, and record its results. If it raises it has
    failed, with the error as its reason.
    """
    context.begin(name)
    began = time.perf_counter()
    try:
        lack = lacks_episode(context.cfg) if getattr(run, "needs_episode", False) else ""
        skipped = [GateResult(name=name, status=Status.skipped, reason=lack)]
        results = skipped if lack else run(context)
    except (Exception, SystemExit) as error:
        results = [GateResult(name=name, status=Status.failed, reason=log_error(error))]
    seconds = time.perf_counter() - began
    for result in results:
        if result.status is not Status.skipped and not result.seconds:
            result.seconds = seconds
        context.artifacts.results[result.name] = result
        context.record(result)


def log_error(error: BaseException) -> str:
    """An error in one line. The traceback of an unexpected one goes to run.log.

    Raises:
        KeyboardInterrupt: The command was interrupted, which may have caused the error.
    """
    check_interrupt()
    if not isinstance(error, MjstackError):
        log.error("unexpected error", exc_info=error)
    return describe_error(error, "run.log has the traceback")
