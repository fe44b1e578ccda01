"""Numbers for readers: digits and percentages."""

import math
from collections.abc import Mapping


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
