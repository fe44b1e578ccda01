"""Terms: how they are found, built, checked, called and shown."""

import inspect
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from mjstack.config.fields import Range, check_fields
from mjstack.config.functions import resolve_func
from mjstack.config.schema import TermCfg
from mjstack.errors import ConfigError, MjstackError, ParameterError, TermError, first_line, suggest
from mjstack.managers.state import once
from mjstack.managers.view import EnvView
from mjstack.math import describe_tensor

_WORDS = {float: "a number", int: "an integer", bool: "true or false", str: "a name"}
_WORDS |= {type(None): "null"}


def check_params(
    label: str, func: Callable[..., Any], params: dict[str, Any], leading: int
) -> None:
    """Hold the parameters against a signature whose first ``leading`` arguments the manager gives.

    Raises:
        TermError: A parameter is unknown or missing.
    """
    signature = inspect.signature(func)
    try:
        positional = signature.bind_partial(*[None] * leading).arguments
    except TypeError as error:
        form = "(env, mask, *, ...)" if leading == 2 else "(env, *, ...)"
        problem = f"{getattr(func, '__name__', func)} does not take what its manager gives"
        raise TermError(label, f"{problem}, expected {form}") from error
    options = {name: p for name, p in signature.parameters.items() if name not in positional}
    if any(p.kind is p.VAR_KEYWORD for p in options.values()):
        return
    if unknown := [name for name in params if name not in options]:
        problem = f"parameter '{unknown[0]}' does not exist. {suggest(unknown[0], options)}"
        keys = " ".join(f"~{label}.params.{name}" for name in unknown)
        raise TermError(label, f"{problem} If it was another function's, add {keys}")
    for name, option in options.items():
        if option.default is option.empty and name not in params:
            raise TermError(label, f"parameter '{name}' is missing: set {label}.params.{name}")
    try:
        called = func.__init__ if inspect.isclass(func) else func
        hints = get_type_hints(called, include_extras=True)
    except (NameError, TypeError):  # a user's annotations may name what cannot be resolved here
        return
    for name, value in params.items():
        if expected := _mismatch(value, hints.get(name, Any)):
            raise ConfigError(f"{label}.params.{name}", value, expected)


def _mismatch(value: Any, hint: Any) -> str:
    """The words for an annotation that a value from YAML does not fit; empty where it fits or
    cannot be judged.
    """
    inner = get_args(hint)
    if get_origin(hint) is Annotated and isinstance(inner[1], Range):
        words = inner[1].describe(_WORDS.get(inner[0], "a value"))
        return "" if not _mismatch(value, inner[0]) and inner[1].holds(value) else words
    if get_origin(hint) is Literal:
        return "" if value in inner else f"one of {', '.join(map(str, inner))}"
    if get_origin(hint) in (Union, UnionType):
        problems = [_mismatch(value, option) for option in inner]
        return "" if "" in problems else " or ".join(problems)
    if get_origin(hint) in (list, Sequence):
        if not isinstance(value, list | tuple):
            return "a list"
        wrong = max((_mismatch(part, inner[0]) for part in value), default="")
        return f"a list, each of it {wrong}" if wrong else ""
    if hint not in _WORDS:
        return ""
    fits = isinstance(value, (int, float) if hint is float else hint)
    return "" if fits and (hint is bool or not isinstance(value, bool)) else _WORDS[hint]


@contextmanager
def blamed(label: str) -> Iterator[None]:
    """Raise what a term raises under its dotted configuration key.

    Raises:
        ConfigError: One of its parameters has a value that it cannot use.
        TermError: It raised another error.
    """
    try:
        yield
    except ParameterError as error:
        error.move(f"{label}.params.{error.key}")
        raise
    except ConfigError:  # names its key itself
        raise
    except MjstackError as error:
        raise TermError(label, str(error)) from error
    except Exception as error:
        raise TermError(label, f"raised {type(error).__name__}: {first_line(error)}") from error


# Dotted configuration key of the term that was called last: the one to name if a capture fails
current_term = SimpleNamespace(label="")


class Term:
    """A term ready to be called: a function with its parameters, or an instance of a class built
    with them.
    """

    def __init__(
        self,
        label: str,
        cfg: TermCfg,
        env: EnvView,
        *,
        masked: bool = False,
        base: type | None = None,
    ) -> None:
        """Find the function or class, which may have to be a subclass of ``base``, and check its
        parameters. A ``masked`` term takes a mask after the environment, as reset terms do.

        Raises:
            ConfigError: One of its parameters has a value that it cannot use.
            TermError: The name or a parameter is wrong, or the class raised an error.
        """
        self.label = label  # dotted configuration key, for errors
        check_fields(label, cfg)
        func = resolve_func(label, cfg.func, base=base)
        self.params = dict(cfg.params)
        is_class = inspect.isclass(func)
        check_params(label, func, self.params, 1 if is_class or not masked else 2)
        self.model_fields: Sequence[str] = getattr(func, "model_fields", ())  # that it writes
        self.reads_state = getattr(func, "reads", None) == ("state", func)
        self.call: Any = partial(func, **self.params)
        if is_class:
            with blamed(label):
                self.call = self.call(env)
            if hasattr(func, "label"):
                self.call.label = label
        self.has_memory = hasattr(self.call, "reset")  # from step to step
        # Two groups may need the same function of the state.
        self._key = self if is_class else (func, repr(sorted(self.params.items())))

    def __call__(self, *args: Any) -> Any:
        """Call the term with the environment, and a mask if it takes one; once in a pass."""
        current_term.label = self.label
        return once((self._key, *args), self.call, *args)

    def reset(self, mask: Tensor) -> None:
        """Let a term with a memory forget the masked worlds."""
        if self.has_memory:
            self.call.reset(mask)


def first_value(
    term: Term, env: EnvView, *, dims: tuple[int, ...] = (1,), boolean: bool = False
) -> Tensor:
    """Call a value term for the first time and check what it returns: numbers, or truth values if
    ``boolean``, of one of the numbers of dimensions ``dims``.

    Raises:
        TermError: It raised an error, or returned no tensor, or one of a wrong shape,
            dtype or device.
    """
    with blamed(term.label):
        value = term(env)
    shape = f"({env.nworld},)" if dims == (1,) else f"({env.nworld},) or ({env.nworld}, d)"
    kind = "bool" if boolean else "floating point"
    if (
        not isinstance(value, Tensor)
        or value.dim() not in dims
        or len(value) != env.nworld
        or not (value.dtype is torch.bool if boolean else value.is_floating_point())
        or value.device != env.device
    ):
        expected = f"expected a {kind} tensor of shape {shape} on {env.device}"
        raise TermError(term.label, f"returned {describe_tensor(value)}, {expected}")
    return value


def render_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A manager's terms as text; the last cell of a row has the parameters by name."""
    table = Table(*columns, "parameters", title=title, title_justify="left")
    for *cells, params in rows:
        settings = ", ".join(f"{name}={value}" for name, value in params.items())
        table.add_row(*map(str, cells), settings)
    out = io.StringIO()
    Console(file=out, width=120, color_system=None, markup=False).print(table)
    return out.getvalue().rstrip()
