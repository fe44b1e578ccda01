"""Pictures of jobs or of a training: curves over a number, or bars over anything else."""

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
_STYLES = ("-o", "--s", ":^", "-.v")
_TICKS = 12  # of the axis of numbers, at most; more have Matplotlib's
_RED = "#cc2a24"


@dataclass(frozen=True, kw_only=True)
class Plot:
    """Content of a sweep's picture.

    Attributes:
        title: Above the panels.
        over: Key of the rows that is drawn from left to right, or from top to bottom.
        lines: Further keys in which the jobs differ: each combination of their values is a line.
        panels: Curves of each panel by its label: a metric by the curve's label, which may be
            empty.
        log: Whether curves have a logarithmic scale.
    """

    title: str
    over: str
    lines: Sequence[str]
    panels: Mapping[str, Mapping[str, str]]
    log: bool = False

    def shows(self, rows: Sequence[Row]) -> bool:
        """Whether some job has one of the metrics."""
        return any(
            not math.isnan(_value(row, metric))
            for row in rows
            for curves in self.panels.values()
            for metric in curves.values()
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

    A job that did not pass interrupts its curves, and a cross marks it. Ranges and intervals of
    metrics are bands or whiskers.
    """
    (_draw_curves if plot.is_numeric(rows) else _draw_bars)(path, plot, rows)


def _value(row: Row, metric: str) -> float:
    """A metric of a job; NaN where it was not measured, or is void."""
    value = row.get(metric)
    void = _failed(row) and not metric.startswith("succe")
    return math.nan if void or not isinstance(value, int | float) else value


def _interval(rows: Sequence[Row], metric: str) -> tuple[np.ndarray, ...]:
    """A metric of jobs, and the ends of its range or its 95 % interval, each ``(n,)``; NaN for no
    number.
    """
    stem = metric.removesuffix(".median")
    ends = (".min", ".max") if stem != metric else ("_low95", "_high95")
    names = (metric, *(stem + end for end in ends))
    return tuple(np.array([_value(row, name) for row in rows]) for name in names)


def _failed(row: Row) -> bool:
    return row.get("status", "pass") != "pass"


def _is_rate(curves: Mapping[str, str]) -> bool:
    """Whether a panel shows rates of success alone, which end at 1."""
    return all(metric.startswith("success_rate") for metric in curves.values())


def _draw_curves(path: Path, plot: Plot, rows: Sequence[Row]) -> None:
    ticks = sorted({row[plot.over] for row in rows})
    labelled = len(ticks) <= _TICKS
    wide = labelled and ticks[0] > 0 and ticks[-1] / ticks[0] > 8
    size = (6.0 * len(plot.panels), 4.8)
    with figure(path, plot.title, len(plot.panels), figsize=size, squeeze=False) as (_, (panels,)):
        for axes, (label, curves) in zip(panels, plot.panels.items(), strict=True):
            values = [_value(row, metric) for row in rows for metric in curves.values()]
            heights = [value for value in values if not math.isnan(value)]
            for number, (name, group) in enumerate(plot.groups(rows)):
                color = _COLORS[number % len(_COLORS)]
                x = [row[plot.over] for row in group]
                for (curve, metric), style in zip(curves.items(), itertools.cycle(_STYLES)):
                    y, low, high = _interval(group, metric)
                    text = ", ".join(filter(None, (name, curve))) or label
                    if not np.isnan(y).all():
                        axes.plot(x, y, style, label=text, markersize=4, color=color)
                        axes.fill_between(x, low, high, alpha=0.2, color=color)
                failed = [row[plot.over] for row in group if _failed(row)]
                marks = [0.02 + 0.04 * number] * len(failed)
                axes.plot(failed, marks, "x", color=color, transform=axes.get_xaxis_transform())
            axes.set(xlabel=plot.over, ylabel=label)
            if wide:
                axes.set_xscale("log", base=2)
            if plot.log or (wide and min(heights, default=0.0) > 0.0):
                axes.set_yscale("log")
            if labelled:
                axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks], rotation=45)
            axes.grid(alpha=0.3)
            if _is_rate(curves):
                axes.set_ylim(top=1.0)
            if axes.get_legend_handles_labels()[0]:
                axes.legend(title=", ".join(plot.lines), frameon=False, fontsize=8)


def _draw_bars(path: Path, plot: Plot, rows: Sequence[Row]) -> None:
    """A bar for each job, with whiskers where it has a range; red where worlds failed."""
    rows = [row for row in rows if plot.shows([row])]
    keys = dict.fromkeys((plot.over, *plot.lines))
    names = [", ".join(str(row.get(key, "")) for key in keys) for row in rows]
    marked = [_failed(row) or row.get("succeeded", 0) < row.get("worlds", 0) for row in rows]
    colors = [_RED if failed else _COLORS[1] for failed in marked]
    places = np.arange(len(rows))
    size = (5.5 * len(plot.panels), 1.5 + 0.3 * len(rows))
    options: dict[str, Any] = {"figsize": size, "sharey": True, "squeeze": False}
    with figure(path, plot.title, len(plot.panels), **options) as (_, (panels,)):
        for axes, (label, curves) in zip(panels, plot.panels.items(), strict=True):
            metric = next(iter(curves.values()))
            middle, low, high = _interval(rows, metric)
            whiskers = np.array((middle - low, high - middle))
            style = {} if np.isnan(whiskers).all() else {"xerr": np.nan_to_num(whiskers)}
            axes.barh(places, middle, color=colors, ecolor="0.4", capsize=2, **style)
            if _is_rate(curves):
                axes.set_xlim(right=1.0)
            axes.set(xlabel=label)
            axes.grid(alpha=0.3, axis="x")
        panels[0].set(ylabel=", ".join(keys))
        panels[0].set_yticks(places, names)
        panels[0].invert_yaxis()
