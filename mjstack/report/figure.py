"""Figures of a result: a value with its unit, its limits, and the group in which it is shown."""

import math
from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

from mjstack.report.text import format_value


@dataclass(frozen=True, slots=True)
class Figure:
    """A quantity.

    Attributes:
        name: Its name, without unit.
        value: What was measured; None for a requirement alone, whose number is ``high``.
        unit: Such as ``m/s``; empty for none.
        group: To what it belongs, from the outside in, such as ``final.red``.
        column: Which of several numbers of the quantity it is, such as ``median``; empty for one.
        low: The least value that is allowed.
        high: The largest one.
        limit: Key of its limit in report.json; None for its own, empty where another figure has it.
    """

    name: str
    value: Any = None
    unit: str = ""
    group: str = ""
    _: KW_ONLY
    column: str = ""
    low: float = -math.inf
    high: float = math.inf
    limit: str | None = None

    @property
    def key(self) -> str:
        """Its name with unit in report.json: ``final.red.position_m``."""
        return ".".join(filter(None, (self.group, self.name + suffix(self.unit), self.column)))

    @property
    def row(self) -> str:
        """The row of a table to which it belongs, in words."""
        group = self.group.replace(".", ", ")
        name = self.name if self.column else ""
        return ": ".join(filter(None, (group, name))).replace("_", " ")

    @property
    def label(self) -> str:
        """Its name in words: ``final, red: position``."""
        return f"{self.row}: {self.title}" if self.row else self.title

    @property
    def title(self) -> str:
        """Its name within its row, in words."""
        return (self.column or self.name).replace("_", " ")

    @property
    def limits(self) -> list[float]:
        """The least and the largest value that is allowed, as far as there are some."""
        return [limit for limit in (self.low, self.high) if not math.isinf(limit)]

    @property
    def allowed(self) -> str:
        """Its limits in words; empty for none."""
        words = " to ".join(map(self.text, self.limits))
        side = "at least " if math.isinf(self.high) else "at most " if math.isinf(self.low) else ""
        return side + words if words else ""

    def thresholds(self) -> Iterator[tuple[str, float]]:
        """Key and number of its limits in report.json."""
        if self.limit == "":
            return
        for limit in self.limits:
            name = f"{self.name}_min" if limit == self.low else self.name
            yield self.limit or replace(self, name=name).key, limit

    def holds(self, values: Any) -> Any:
        """Whether values, a number or an array, are within its limits."""
        return (self.low <= values) & (values <= self.high)

    def text(self, value: object) -> str:
        """A value of it with the unit."""
        number = self.unit and isinstance(value, float | int) and not isinstance(value, bool)
        return format_value(value) + (f" {self.unit}" if number else "")


def suffix(unit: str) -> str:
    """The end of a name in report.json that tells its unit: ``_m_per_s``."""
    words = unit.lower().replace("/", "_per_")
    return f"_{words.removeprefix('_')}" if words else ""


def figures(group: str = "", /, **values: float) -> list[Figure]:
    """Figures of numbers by their names."""
    return [Figure(name, value, group=group) for name, value in values.items()]
