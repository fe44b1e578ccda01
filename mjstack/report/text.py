"""Numbers and names for readers: digits, units and percentages."""

import math
from collections.abc import Mapping

# Units by the end of a metric's name; the first that fits counts.
_UNITS = {
    "_m_per_s": "m/s",
    "_per_s": "/s",
    "_mib": "MiB",
    "_deg": "deg",
    "_mb": "MB",
    "_rad": "rad",
    "_m": "m",
    "_s": "s",
    "_w": "W",
    "_j": "J",
    "_n": "N",
}


def format_value(value: object) -> str:
    """A number with as many digits as a reader needs, a mapping as a list."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {item}" for name, item in value.items())
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:,.0f}" if 1e4 <= abs(value) < math.inf else f"{value:.4g}"
    return "" if value is None else str(value)


def format_percent(rate: float, unit: str = " %") -> str:
    """A rate with as many digits as tell it from 0 and 1, at least two."""
    gap = min(rate, 1.0 - rate)
    digits = 2 if gap <= 0.0 else max(2, math.ceil(-math.log10(100.0 * gap)))
    return f"{100.0 * rate:.{digits}f}".rstrip("0").rstrip(".") + unit


def unit_ending(name: str) -> str:
    """The end of a name that tells its unit; empty where there is none."""
    return next((end for end in _UNITS if name.endswith(end)), "")


def label(name: str) -> str:
    """A metric's name in words, without its unit.

    ``final.red.position_m`` is "final, red: position".
    """
    *groups, last = name.removesuffix(unit_ending(name)).replace("_", " ").split(".")
    return f"{', '.join(groups)}: {last}" if groups else last


def with_unit(name: str, value: object) -> str:
    """A value with the unit that its name ends on."""
    end = unit_ending(name)
    number = isinstance(value, float | int) and not isinstance(value, bool)
    return f"{format_value(value)} {_UNITS[end]}" if end and number else format_value(value)
