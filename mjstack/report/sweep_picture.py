"""Pictures of a sweep: curves over a number, or bars over anything else."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.report.picture import figure

Row = dict[str, Any]
"""A job of a sweep, by name: its keys, its ``status``, and its metrics."""

_COLORS = ("#2a7d2e", "#2457c7", "#cc2a24", "#8a5a00", "#6a3d9a", "#555555")
_RED = "#cc2a24"


@dataclass(frozen=True, kw_only=True)
class Plot:
    """Content of a sweep's picture.

    Attributes:
        title: Above the panels.
        over: Key of the rows that is drawn from left to right, or from top to bottom.
        lines: Further keys in which the jobs differ: each combination of their values is a line.
        panels: The metric of each panel by its label.
    """

    title: str
    over: str
    lines: Sequence[str]
    panels: Mapping[str, str]

    def shows(self, rows: Sequence[Row]) -> bool:
        """Whether some job has one of the metrics."""
        return any(
            not math.isnan(_value(row, metric)) for row in rows for metric in self.panels.values()
        )

    def groups(self, rows: Sequence[Row]) -> Iterator[tuple[str, list[Row]]]:
        """The rows of each line by its name, in the order of what they are drawn over."""
        names = [", ".join(str(row.get(key, "")) for key in self.lines) for row in rows]
        for name in dict.fromkeys(names):
            group = [row for row, label in zip(rows, names, strict=True) if label == name]
            yield name, sorted(group, key=lambda row: row[self.over])

    def is_numeric(self, rows: Sequence[Row]) -> bool:
        """Whether the jobs are drawn over a number."""
        values = [row.get(self.over) for row in rows]
        numbers = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
        return len(numbers) == len(values) and len(set(numbers)) > 1


def save_sweep(path: Path, plot: Plot, rows: Sequence[Row]) -> None:
    """Draw a panel for each metric: curves over a number, else a bar for each job.

    A job that did not pass interrupts its curves, and a cross marks it.
    """
    (_draw_curves if plot.is_numeric(rows) else _draw_bars)(path, plot, rows)


def crossover(plot: Plot, rows: Sequence[Row]) -> float | None:
    """Where one of two lines passes the other in the first panel; None if the rows do not show it.

    Interpolated between the two numbers that bracket it, straight in logarithms. Jobs that did not
    pass do not count.
    """
    groups = [group for _, group in plot.groups(rows)]
    if len(groups) != 2:
        return None
    metric = next(iter(plot.panels.values()))
    first, second = ({row[plot.over]: _value(row, metric) for row in group} for group in groups)
    points = [
        (math.log(x), math.log(first[x] / second[x]))
        for x in sorted(first.keys() & second.keys())
        if x > 0 and first[x] > 0.0 and second[x] > 0.0
    ]
    for (x0, gap0), (x1, gap1) in itertools.pairwise(points):
        if (gap0 > 0.0) != (gap1 > 0.0):
            return math.exp(x0 - (x1 - x0) * gap0 / (gap1 - gap0))
    return None


def _value(row: Row, metric: str) -> float:
    """A metric of a job; NaN where it was not measured, or is void."""
    value = row.get(metric, math.nan)
    void = row["status"] != "pass" and not metric.startswith("succe")
    return math.nan if void or not isinstance(value, int | float) else value


def _is_rate(metric: str) -> bool:
    """Whether a metric is a rate of success, which ends at 1."""
    return metric.startswith("success_rate")


def _draw_curves(path: Path, plot: Plot, rows: Sequence[Row]) -> None:
    crossing = crossover(plot, rows)
    ticks = sorted({row[plot.over] for row in rows})
    wide = ticks[0] > 0 and ticks[-1] / ticks[0] > 8
    size = (6.0 * len(plot.panels), 4.8)
    title = f"{plot.title} (x: no figure)"
    with figure(path, title, len(plot.panels), figsize=size, squeeze=False) as (_, (panels,)):
        for axes, (label, metric) in zip(panels, plot.panels.items(), strict=True):
            heights: list[float] = []
            for number, (name, group) in enumerate(plot.groups(rows)):
                color = _COLORS[number % len(_COLORS)]
                x = [row[plot.over] for row in group]
                y = [_value(row, metric) for row in group]
                if not all(map(math.isnan, y)):
                    axes.plot(x, y, "-o", label=name or label, markersize=4, color=color)
                heights += y
                failed = [row[plot.over] for row in group if row["status"] != "pass"]
                marks = [0.02 + 0.04 * number] * len(failed)
                axes.plot(failed, marks, "x", color=color, transform=axes.get_xaxis_transform())
            # Axes
            axes.set(xlabel=plot.over, ylabel=label)
            if wide:
                axes.set_xscale("log", base=2)
            if wide and min((y for y in heights if not math.isnan(y)), default=0.0) > 0.0:
                axes.set_yscale("log")
            axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks], rotation=45)
            axes.grid(alpha=0.3)
            if crossing is not None:
                text = f"crossover, {crossing:,.0f}"
                axes.axvline(crossing, color="0.4", linestyle=":", label=text)
            if _is_rate(metric):
                axes.set_ylim(top=1.0)
            if axes.get_legend_handles_labels()[0]:
                axes.legend(title=", ".join(plot.lines), frameon=False, fontsize=8)


def _draw_bars(path: Path, plot: Plot, rows: Sequence[Row]) -> None:
    """A bar for each job, with whiskers where it has a range; red where worlds failed."""
    rows = [row for row in rows if plot.shows([row])]
    keys = dict.fromkeys((plot.over, *plot.lines))
    names = [", ".join(str(row.get(key, "")) for key in keys) for row in rows]
    marked = [
        row["status"] != "pass" or row.get("succeeded", 0) < row.get("worlds", 0) for row in rows
    ]
    colors = [_RED if failed else _COLORS[1] for failed in marked]
    places = np.arange(len(rows))
    size = (5.5 * len(plot.panels), 1.5 + 0.3 * len(rows))
    options: dict[str, Any] = {"figsize": size, "sharey": True, "squeeze": False}
    with figure(path, plot.title, len(plot.panels), **options) as (_, (panels,)):
        for axes, (label, metric) in zip(panels, plot.panels.items(), strict=True):
            stem = metric.removesuffix(".median")
            joint = "." if stem != metric else "_"
            middle, low, high = (
                np.array([_value(row, name) for row in rows])
                for name in (metric, f"{stem}{joint}min", f"{stem}{joint}max")
            )
            whiskers = np.array((middle - low, high - middle))
            style = {} if np.isnan(whiskers).all() else {"xerr": np.nan_to_num(whiskers)}
            axes.barh(places, middle, color=colors, ecolor="0.4", capsize=2, **style)
            if _is_rate(metric):
                axes.set_xlim(right=1.0)
            axes.set(xlabel=label)
            axes.grid(alpha=0.3, axis="x")
        panels[0].set(ylabel=", ".join(keys))
        panels[0].set_yticks(places, names)
        panels[0].invert_yaxis()
