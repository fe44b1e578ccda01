"""Configuration fields: unit and range beside the default, words in the docstring under the field.

One function checks them all, so a dataclass says what it accepts and nothing else has to.

Example:
    >>> @dataclass(kw_only=True, slots=True)
    ... class TimingCfg:
    ...     physics_dt: float = spec(unit="s", gt=0.0)
    ...     '''Duration of one physics step.'''
"""

import ast
import inspect
import math
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields, is_dataclass
from enum import EnumMeta
from functools import cache
from itertools import pairwise
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from omegaconf import MISSING

from mjstack.errors import ConfigError

MOST_WORLDS = (1 << 31) - 1  # Warp counts them with 32 bits
MOST_SEEDS = 1 << 32  # seeds are 32-bit
MOST_COUNT = 1_000_000  # steps or episodes, one after the other
# Results that depend on a key, see `select`, and a sentence for ``--help KEY``
CHANGES = {
    "episodes": "",  # all that is played, recorded or learned
    "training": "It changes no dataset.",
    "gates": "It changes episodes of gates alone.",
    "report": "It changes no episode.",
    "nothing": "It changes no result.",
    "policy": "A policy fits the value of its training alone.",
    "images": "",  # states drawn by a camera
}
FITS = ("episodes", "policy")
_SPEC = "mjstack"  # key of a field's metadata
_NOUNS = {int: "an integer", float: "a number", bool: "true or false", str: "text"}
_PLURALS = {int: "integers", float: "numbers", str: "names"}
_hints = cache(get_type_hints)


@dataclass(frozen=True, kw_only=True)
class Range:
    """Values that a field accepts. Of a list or a mapping, limits hold for every item.

    Attributes:
        unit: Such as ``m``, ``rad`` or ``steps``; empty for a count or a name.
        gt: Values are greater than this.
        ge: Values are at least this.
        le: Values are at most this.
        length: Number of items of a list.
        vectors: Whether a mapping, of type ``dict[str, Any]``, holds lists of numbers. With their
            type OmegaConf would refuse whole ones.
        choices: The only values.
        finite: Whether infinity is refused; NaN always is.
        changes: Some of `CHANGES`, which depend on the value; empty: as of the field that holds it.
    """

    unit: str = ""
    gt: float | None = None
    ge: float | None = None
    le: float | None = None
    length: int | None = None
    vectors: bool = False
    choices: tuple[object, ...] = ()
    finite: bool = True
    changes: tuple[str, ...] = ()

    def holds(self, value: object) -> bool:
        """Whether a single value, no list, is accepted."""
        if self.choices and value not in self.choices:
            return False
        if isinstance(value, bool) or not isinstance(value, int | float):
            return True
        return (
            (math.isfinite(value) or (math.isinf(value) and not self.finite))
            and (self.gt is None or value > self.gt)
            and (self.ge is None or value >= self.ge)
            and (self.le is None or value <= self.le)
        )

    def describe(self, noun: str) -> str:
        """The noun for a value, with these limits in words."""
        most = "" if self.le is None else f"{self.le:.10g}"
        if self.gt is not None:
            noun += f" above {self.gt:.10g}" + f" and at most {most}" * bool(most)
        elif self.ge is not None:
            noun += f" from {self.ge:.10g} to {most}" if most else f" of at least {self.ge:.10g}"
        return noun + (f" [{self.unit}]" if self.unit else "")


# Annotations of a term's parameters, which its manager checks. A stranger's policy or run may set
# one, so that each integer has an upper end.
Positive = Annotated[float, Range(gt=0.0)]
NotNegative = Annotated[float, Range(ge=0.0)]
Fraction = Annotated[float, Range(ge=0.0, le=1.0)]
Count = Annotated[int, Range(ge=1, le=MOST_COUNT)]
Repeats = Annotated[int, Range(ge=1, le=1000)]  # of a computation that nothing interrupts


def spec(default: Any = MISSING, **limits: Any) -> Any:
    """Declare a configuration field with the attributes of its `Range`. Its default is its value
    where the YAML has none, of a list or mapping a copy, of a class a new one; without one, the
    YAML must have it.
    """
    metadata = {_SPEC: Range(**limits)}
    if isinstance(default, type):
        return field(default_factory=default, metadata=metadata)
    if isinstance(default, list | dict):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


def field_range(item: Field) -> Range:
    """The range of a dataclass's field; of one without `spec`, that numbers are finite."""
    return item.metadata.get(_SPEC, Range())


def find_field(owner: type, key: str) -> tuple[type, Field] | None:
    """The dataclass and the field of a dotted key below a dataclass or one that derives from it;
    None if there is none.
    """
    name, _, rest = key.partition(".")
    item = next((item for item in fields(owner) if item.name == name), None)
    if item is None:
        derived: list[type] = owner.__subclasses__()
        return next(filter(None, (find_field(child, key) for child in derived)), None)
    kind, holders = _kind(_hints(owner)[name])
    if not (isinstance(kind, type) and is_dataclass(kind)):
        return owner, item
    nested_key = rest.partition(".")[2] if holders else rest  # several are by name
    return find_field(kind, nested_key) if nested_key else (owner, item)


def select(
    config: Mapping[str, Any],
    changes: Collection[str],
    owner: type,
    inherited: Sequence[str] = ("episodes",),
) -> dict[str, Any]:
    """The keys of a dataclass in JSON's types, or of one that derives from it, that change some of
    `CHANGES`.
    """
    owner = _derived(owner, config.keys()) or owner
    selected: dict[str, Any] = {}
    for item in fields(owner):
        value = config.get(item.name)
        depends = field_range(item).changes or inherited
        kind, holders = _kind(_hints(owner)[item.name])
        if isinstance(value, dict) and isinstance(kind, type) and is_dataclass(kind):
            children = value if holders else {"": value}
            nested = {
                name: select(member, changes, kind, depends) for name, member in children.items()
            }
            if nested := {name: member for name, member in nested.items() if member}:
                selected[item.name] = nested if holders else nested[""]
        elif item.name in config and {*changes} & {*depends}:
            selected[item.name] = value
    return selected


def _derived(owner: type, names: Collection[str]) -> type | None:
    """A dataclass, or one that derives from it, whose fields have exactly these names."""
    if {item.name for item in fields(owner)} == {*names}:
        return owner
    derived: list[type] = owner.__subclasses__()
    return next(filter(None, (_derived(child, names) for child in derived)), None)


def check_fields(key: str, value: Any) -> None:
    """Hold every number, list and choice in a dataclass against its field's range, also those in
    dataclasses, lists and mappings in it. Its dotted key is empty for the whole configuration. A
    ConfigError for the first value that is not accepted, or a ``NAME_min`` above its ``NAME_max``.
    """
    for item in fields(value):
        path = f"{key}.{item.name}" if key else item.name
        _check(path, getattr(value, item.name), type(value), item)
        if item.name.endswith("_min"):
            high = item.name.removesuffix("min") + "max"
            bounds = (getattr(value, item.name), getattr(value, high, None))
            if None not in bounds and bounds[0] > bounds[1]:
                raise ConfigError(path, bounds[0], f"at most {high}={bounds[1]}")


def _check(path: str, value: object, owner: type, item: Field, *, inside: bool = False) -> None:
    """Hold a field's value, or one inside of its mapping, against the field's range."""
    limits = field_range(item)
    if is_dataclass(value):
        check_fields(path, value)
    elif isinstance(value, Mapping):
        for name, member in value.items():
            if limits.vectors:
                if not isinstance(member, list) or {*map(type, member)} - {int, float}:
                    raise ConfigError(f"{path}.{name}", member, accepted(owner, item, inside=True))
                member[:] = map(float, member)
            _check(f"{path}.{name}", member, owner, item, inside=True)
    elif isinstance(value, list | tuple):
        if limits.length not in (None, len(value)) or not all(map(limits.holds, value)):
            raise ConfigError(path, value, accepted(owner, item, inside=inside))
    elif value is not None and not limits.holds(value):
        raise ConfigError(path, value, accepted(owner, item, inside=inside))


def accepted(owner: type, item: Field, *, inside: bool = False) -> str:
    """Values that a field accepts, or one inside of its mapping, in words: ``a number above 0
    [s]``.
    """
    hint = _hints(owner)[item.name]
    limits = field_range(item)
    kind, holders = _kind(dict[str, list[float]] if limits.vectors else hint)
    holders = holders[inside:]
    if limits.choices or isinstance(kind, EnumMeta):
        choices = limits.choices or kind.__members__
        description = f"{'some' if holders else 'one'} of {', '.join(map(str, choices))}"
    elif holders or is_dataclass(kind):
        mapping = holders[:1] == [dict] or is_dataclass(kind)
        count = "" if limits.length is None else f"{limits.length} "
        description = (
            f"{'keys and' if mapping else 'a list of'} {count}{_PLURALS.get(kind, 'values')}"
        )
    elif (kind is float or inside) and limits == Range(unit=limits.unit, changes=limits.changes):
        description = "a finite number"
    else:
        description = _NOUNS.get(kind, "a value")
    null = " or null" if NoneType in get_args(hint) and not inside else ""
    return limits.describe(description) + null


@cache
def field_docs(owner: type) -> dict[str, str]:
    """The docstring under each field of a dataclass and of those it derives from, by name."""
    docs: dict[str, str] = {}
    for cls in filter(is_dataclass, reversed(owner.__mro__)):
        tree: Any = ast.parse(textwrap.dedent(inspect.getsource(cls)))
        for node, successor in pairwise(tree.body[0].body):
            if isinstance(node, ast.AnnAssign) and isinstance(successor, ast.Expr):
                docs[ast.unparse(node.target)] = " ".join(ast.literal_eval(successor.value).split())
    return docs


def _kind(hint: Any) -> tuple[Any, list[Any]]:
    """The type of a field's single values, and the types that hold them, from the outside in."""
    holders = []
    while get_args(hint):
        if get_origin(hint) in (Union, UnionType):
            hint = next(kind for kind in get_args(hint) if kind is not NoneType)
        else:
            holders.append(get_origin(hint))
            hint = get_args(hint)[-1]
    return hint, holders
