"""Configuration fields: unit and range beside the default, words in the docstring under the field.

One function checks them all, so a dataclass says what it accepts and nothing else has to.

Example:
    >>> @dataclass(kw_only=True, slots=True)
    ... class TimingCfg:
    ...     physics_dt: float = spec(unit="s", gt=0.0)
    ...     '''Duration of one physics step.'''
"""

from __future__ import annotations

import ast
import inspect
import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields, is_dataclass
from enum import EnumMeta
from functools import cache
from itertools import pairwise
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from omegaconf import MISSING

from mjstack.errors import ConfigError

MOST_WORLDS = (1 << 31) - 1  # Warp counts them with 32 bits
MOST_SEEDS = 1 << 32  # seeds are 32-bit
_SPEC = "mjstack"  # key of a field's metadata


@dataclass(frozen=True, kw_only=True, slots=True)
class Range:
    """Values that a field accepts. Of a list or a mapping, limits hold for every item.

    Attributes:
        unit: Such as ``m``, ``rad`` or ``steps``; empty for a count or a name.
        gt: Values are greater than this.
        ge: Values are at least this.
        lt: Values are less than this.
        le: Values are at most this.
        length: Number of items of a list.
        choices: The only values.
        finite: Whether infinity is refused; NaN always is.
    """

    unit: str = ""
    gt: float | None = None
    ge: float | None = None
    lt: float | None = None
    le: float | None = None
    length: int | None = None
    choices: tuple[object, ...] = ()
    finite: bool = True

    def holds(self, value: object) -> bool:
        """Whether a single value, no list, is accepted."""
        if self.choices and value not in self.choices:
            return False
        if isinstance(value, bool) or not isinstance(value, int | float):
            return True
        return not (
            math.isnan(value)
            or (self.finite and math.isinf(value))
            or (self.gt is not None and not value > self.gt)
            or (self.ge is not None and not value >= self.ge)
            or (self.lt is not None and not value < self.lt)
            or (self.le is not None and not value <= self.le)
        )


def spec(
    default: Any = MISSING,
    *,
    factory: Callable[[], Any] | None = None,
    unit: str = "",
    gt: float | None = None,
    ge: float | None = None,
    lt: float | None = None,
    le: float | None = None,
    length: int | None = None,
    choices: Sequence[object] = (),
    finite: bool = True,
) -> Any:
    """Declare a configuration field with its unit and range; see `Range`.

    Args:
        default: Its value where the YAML has none; without one, the YAML must have it.
        factory: Makes the default, where that is a list or a mapping.
        unit: Unit of its numbers.
        gt: Values are greater than this.
        ge: Values are at least this.
        lt: Values are less than this.
        le: Values are at most this.
        length: Number of items of a list.
        choices: The only values.
        finite: Whether infinity is refused.
    """
    limits = Range(
        unit=unit,
        gt=gt,
        ge=ge,
        lt=lt,
        le=le,
        length=length,
        choices=tuple(choices),
        finite=finite,
    )
    if factory is not None:
        return field(default_factory=factory, metadata={_SPEC: limits})
    return field(default=default, metadata={_SPEC: limits})


def field_range(item: Field) -> Range:
    """The range of a dataclass's field; of one without `spec`, that numbers are finite."""
    return item.metadata.get(_SPEC, Range())


def check_fields(key: str, value: object) -> None:
    """Hold every number, list and choice below a key against its field's range.

    Args:
        key: Dotted configuration key of the value, empty for the whole configuration.
        value: A dataclass. Dataclasses in its fields, lists and mappings are checked too.

    Raises:
        ConfigError: The first value that its field does not accept.
    """
    if not is_dataclass(value) or isinstance(value, type):
        return
    for item in fields(value):
        path = f"{key}.{item.name}" if key else item.name
        _check(path, getattr(value, item.name), type(value), item)


def _check(path: str, value: object, owner: type, item: Field) -> None:
    """Hold a field's value, or what a list or mapping in it holds, against the field's range."""
    limits = field_range(item)
    if is_dataclass(value):
        check_fields(path, value)
    elif isinstance(value, Mapping):
        for name, part in value.items():
            _check(f"{path}.{name}", part, owner, item)
    elif isinstance(value, list | tuple):
        wrong_length = limits.length is not None and len(value) != limits.length
        if wrong_length or not all(isinstance(part, list) or limits.holds(part) for part in value):
            raise ConfigError(path, value, accepted(owner, item))
    elif value is not None and not limits.holds(value):
        raise ConfigError(path, value, accepted(owner, item))


def accepted(owner: type, item: Field) -> str:
    """Values that a field accepts, in words: ``a number above 0 [s]``."""
    hint = _hints(owner)[item.name]
    null = " or null" if NoneType in get_args(hint) else ""
    return _accepted(field_range(item), hint) + null


def _accepted(limits: Range, hint: Any) -> str:
    hint, several, mapping = _kind(hint)
    if limits.choices or isinstance(hint, EnumMeta):
        choices = limits.choices or hint.__members__
        return f"{'some' if several else 'one'} of {', '.join(map(str, choices))}"
    if hint is bool:
        return "true or false"
    noun = {int: "integer", float: "number", str: "name"}.get(hint, "value")
    if several:
        of = "keys and " if mapping else "a list of "
        noun = f"{of}{'' if limits.length is None else f'{limits.length} '}{noun}s"
    elif noun == "name":
        noun = "text"
    else:
        noun = f"{'an' if noun == 'integer' else 'a'} {noun}"
    bounds = [
        f"{word} {bound:.10g}"
        for word, bound in (("above", limits.gt), ("below", limits.lt))
        if bound is not None
    ]
    if limits.ge is not None and limits.le is not None:
        bounds.append(f"from {limits.ge:.10g} to {limits.le:.10g}")
    elif limits.ge is not None:
        bounds.append(f"of at least {limits.ge:.10g}")
    elif limits.le is not None:
        bounds.append(f"of at most {limits.le:.10g}")
    if hint is float and not bounds and limits.finite and limits.length is None:
        noun = noun.replace("number", "finite number")
    unit = f" [{limits.unit}]" if limits.unit else ""
    return " ".join([noun, " and ".join(bounds)]).rstrip() + unit


def field_docs(owner: type) -> dict[str, str]:
    """The docstring under each field of a dataclass and of those it derives from, by name."""
    docs: dict[str, str] = {}
    for cls in reversed(owner.__mro__):
        if is_dataclass(cls):
            docs |= _own_docs(cls)
    return docs


@cache
def _own_docs(cls: type) -> dict[str, str]:
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    body = tree.body if isinstance(tree, ast.ClassDef) else []
    docs = {}
    for node, after in pairwise(body):
        if (
            isinstance(node, ast.AnnAssign)
            and isinstance(node.target, ast.Name)
            and isinstance(after, ast.Expr)
            and isinstance(after.value, ast.Constant)
        ):
            docs[node.target.id] = " ".join(str(after.value.value).split())
    return docs


@cache
def _hints(owner: type) -> dict[str, Any]:
    return get_type_hints(owner)


def _kind(hint: Any) -> tuple[Any, bool, bool]:
    """The type of a field's single values, whether it holds several, and whether by name."""
    several = False
    mapping = False
    while get_args(hint):
        if get_origin(hint) in (Union, UnionType):
            hint = next(kind for kind in get_args(hint) if kind is not NoneType)
        else:
            mapping = mapping or get_origin(hint) is dict
            several = True
            hint = get_args(hint)[-1]
    return hint, several, mapping
