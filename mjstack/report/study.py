"""The solver study as a table and as a picture."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.report.figure import figure
from mjstack.report.markdown import format_value
from mjstack.report.table import Table

Row = dict[str, Any]
"""One variant of the solver; a value that was not measured is missing.

``variant``, ``changes``, ``status`` (pass: it was measured; skip: it changes nothing), ``reason``;
then, of the whole episode, ``worlds``, ``succeeded``, ``broken_rules``, ``peak_rows`` (most
constraint rows of a world), the check's summaries, and ``iteration_limit_worlds`` and
``line_search_limit_worlds`` (worlds whose solver stopped at its limit in some step); then, object
in hand, ``ms_per_batched_step`` (median of the repetitions, with ``ms_min`` and ``ms_max``),
``base_ms`` (of the configured solver beside them) and ``ratio`` (of neighbouring repetitions:
median, ``ratio_min``, ``ratio_max``).
"""


def study_table(rows: Sequence[Row]) -> Table:
    """The columns that a reader compares."""
    return Table.of("", _SHOWN, rows)


def save_study(path: Path, rows: Sequence[Row], title: str) -> None:
    """Draw a bar per variant: its time over that of the base, and the worlds that succeeded.

    Args:
        path: The picture.
        rows: The variants that were measured, at least one.
        title: What is shown.
    """
    nworld = rows[0]["worlds"]
    places = np.arange(len(rows))
    succeeded = [row["succeeded"] for row in rows]
    colors = ["#2457c7" if count == nworld else "#cc2a24" for count in succeeded]
    middle, low, high = (
        np.array([row[key] for row in rows]) for key in ("ratio", "ratio_min", "ratio_max")
    )
    size = (11, 1.5 + 0.3 * len(rows))
    with figure(path, title, 2, figsize=size, sharey=True) as (_, (time, worlds)):
        whiskers = (middle - low, high - middle)
        time.barh(places, middle, xerr=whiskers, color=colors, ecolor="0.4", capsize=2)
        time.axvline(1.0, color="0.3", linewidth=1.0)
        time.set(xlabel="time per step over that of base (whiskers: all repetitions)")
        time.set_yticks(places, [row["variant"] for row in rows])
        time.invert_yaxis()
        worlds.barh(places, succeeded, color=colors)
        worlds.set(xlabel=f"succeeded of {nworld} worlds (red: not all)", xlim=(0, nworld))
        for axes in (time, worlds):
            axes.grid(alpha=0.3, axis="x")


def _value(name: str, form: str = "{0}") -> Callable[[Row], str]:
    """How a value is shown; nothing where it was not measured."""
    return lambda row: form.format(format_value(row[name]), **row) if name in row else ""


_SHOWN: dict[str, Callable[[Row], str]] = {
    "variant": _value("variant"),
    "changes": _value("changes"),
    "ms per step": _value("ms_per_batched_step"),
    "ratio to base": _value("ratio", "{ratio:.2f} ({ratio_min:.2f} to {ratio_max:.2f})"),
    "succeeded": _value("succeeded", "{succeeded} of {worlds}"),
    "iteration limit": _value("iteration_limit_worlds"),
    "line-search limit": _value("line_search_limit_worlds"),
    "notes": lambda row: "; ".join(filter(None, (row.get("broken_rules"), row["reason"]))),
}
