"""The solver study as a table and as a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from mjstack.report.markdown import format_value
from mjstack.report.table import Table, to_document

matplotlib.use("Agg")
import matplotlib.pyplot as plt

Row = dict[str, Any]
"""One variant of the solver by the names of `COLUMNS`; columns without a value may be left out."""

COLUMNS = (
    "variant",
    "changes",
    "status",  # pass: it was measured; fail, with its reason; skip: it changes nothing
    "reason",
    "ms_per_batched_step",  # one step of all worlds, object in hand: median of the repetitions
    "ms_min",
    "ms_max",
    "base_ms",  # the configured solver's in the same interleaved repetitions
    "ratio",  # of a repetition to the base's beside it: median
    "ratio_min",
    "ratio_max",
    "worlds",
    "succeeded",  # worlds, in the whole episode
    "broken_rules",  # by the others, and by how many each
    "iteration_limit_worlds",  # worlds whose solver stopped at its limit in some step
    "line_search_limit_worlds",
    "peak_rows",  # most constraint rows of a world
)
"""Columns of study.csv, before those of the task's check."""


def to_markdown(rows: Sequence[Row], title: str, notes: Sequence[str], picture: str = "") -> str:
    """The columns that a reader compares."""
    return to_document(title, [Table.of("", _SHOWN, rows)], notes, picture)


def save_study(path: Path, rows: Sequence[Row], title: str) -> None:
    """Draw a bar per variant: its time over that of the base, and the worlds that succeeded.

    Args:
        path: The picture.
        rows: The variants that were measured.
        title: What is shown.
    """
    nworld = rows[0]["worlds"]
    figure, (time, worlds) = plt.subplots(
        1, 2, figsize=(11, 1.5 + 0.3 * len(rows)), layout="constrained", sharey=True
    )
    places = np.arange(len(rows))
    succeeded = [row["succeeded"] for row in rows]
    colors = ["#2457c7" if count == nworld else "#cc2a24" for count in succeeded]
    middle, low, high = (
        np.array([row[key] for row in rows]) for key in ("ratio", "ratio_min", "ratio_max")
    )
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
    figure.suptitle(title)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _ratio(row: Row) -> str:
    if "ratio" not in row:
        return ""
    return f"{row['ratio']:.2f} ({row['ratio_min']:.2f} to {row['ratio_max']:.2f})"


_SHOWN: dict[str, Callable[[Row], str]] = {
    "variant": lambda row: row["variant"],
    "changes": lambda row: row["changes"],
    "ms per step": lambda row: format_value(row.get("ms_per_batched_step")),
    "ratio to base": _ratio,
    "succeeded": lambda row: f"{row['succeeded']} of {row['worlds']}" if "worlds" in row else "",
    "iteration limit": lambda row: format_value(row.get("iteration_limit_worlds")),
    "line-search limit": lambda row: format_value(row.get("line_search_limit_worlds")),
    "notes": lambda row: "; ".join(filter(None, (row.get("broken_rules"), row["reason"]))),
}
