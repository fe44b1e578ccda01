"""Values that derive from the state of the worlds. In a pass, which is work that does not change
the state, each is computed once.
"""

from collections.abc import Callable
from contextvars import ContextVar, copy_context
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from mjstack.managers.view import EnvView
from mjstack.math import all_finite, not_finite
from mjstack.sim.graph import side_by_side

Result = TypeVar("Result")
Arguments = ParamSpec("Arguments")

# Of the current pass, by function and arguments; None outside
_values: ContextVar[dict[Any, Any] | None] = ContextVar("_values", default=None)


def in_one_pass(work: Callable[[], Result], known: dict[Any, Any] | None = None) -> Result:
    """The result of work in a separate pass, which starts with ``known`` values and adds to them.

    The values belong to a context, which Python leaves however the work ends: a ``finally`` clause
    that Ctrl-C cuts short would leave old values to later steps.
    """
    context = copy_context()
    context.run(_values.set, {} if known is None else known)
    return context.run(work)


def branches(device: torch.device, *works: Callable[[], Any]) -> list[Any]:
    """Results of independent works of one pass. Later ones know the values that earlier ones have
    computed, except on CUDA, where they are branches of a graph: what comes after knows them all.
    """
    if device.type != "cuda":
        return [work() for work in works]
    if (values := _values.get()) is None:
        values = {}
    known = [dict(values) for _ in works]
    results: list[Any] = [None] * len(works)

    def keep(number: int) -> None:
        results[number] = in_one_pass(works[number], known[number])

    side_by_side(device, *(partial(keep, number) for number in range(len(works))))
    for branch in known:
        values.update(branch)
    return results


def once(key: Any, compute: Callable[..., Result], /, *args: Any, **named: Any) -> Result:
    """The value of this key in the current pass, computed where it is asked for first."""
    values = _values.get()
    if values is None:
        return compute(*args, **named)
    if key not in values:
        values[key] = compute(*args, **named)
    return values[key]


def shared(compute: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Make a function compute a value once in a pass for equal arguments, such as an environment
    and a name. Nobody may write into it.
    """

    @wraps(compute)
    def value(*args: Arguments.args, **named: Arguments.kwargs) -> Result:
        return once((compute, *args, *named.items()), compute, *args, **named)

    return value


@shared
def lost_state(env: EnvView) -> Tensor:
    """Whether a state is not finite, shape ``(nworld,)``, bool; ``sim.no_worlds`` where the host
    can see that none is. Do not write into it.
    """
    sim = env.sim
    fine = all_finite(sim.qpos, sim.qvel)
    return sim.no_worlds if fine else not_finite(sim.qpos, sim.qvel)
