"""Curves over a number, of the jobs of a sweep or of a training."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]
"""A job of a sweep, by name: its keys, its ``status``, and its metrics."""

_COLORS = ("#2a7d2e", "#2457c7", "#cc2a24", "#8a5a00", "#6a3d9a", "#555555")
_STYLES = ("-o", "--s", ":^", "-.v")
_TICKS = 12  # of the axis of numbers, at most; more have Matplotlib's


@dataclass(frozen=True, kw_only=True)
class Plot:
    """Content of a picture.

    Attributes:
        title: Above the panels.
        over: Key of the rows, a number, that is drawn from left to right.
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
        metrics = [metric for curves in self.panels.values() for metric in curves.values()]
        return any(not math.isnan(_value(row, metric)) for row in rows for metric in metrics)

    def groups(self, rows: Sequence[Row]) -> Iterator[tuple[str, list[Row]]]:
        """The rows of each line by its name, in the order of what they are drawn over."""
        names = [", ".join(str(row.get(key, "")) for key in self.lines) for row in rows]
        for name in dict.fromkeys(names):
            group = [row for row, label in zip(rows, names, strict=True) if label == name]
            yield name, sorted(group, key=lambda row: row[self.over])


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


def save_curves(path: Path, plot: Plot, rows: Sequence[Row]) -> None:
    """Draw a panel for each label of a plot. A job that did not pass interrupts its curves, and a
    cross marks it. Ranges and intervals of metrics are bands.
    """
    from matplotlib.figure import Figure  # takes a while to load

    ticks = sorted({row[plot.over] for row in rows})
    labelled = len(ticks) <= _TICKS
    wide = labelled and ticks[0] > 0 and ticks[-1] / ticks[0] > 8
    size = (6.0 * len(plot.panels), 4.8)
    picture = Figure(size, layout="constrained")
    (panels,) = picture.subplots(1, len(plot.panels), squeeze=False)
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
        if all(metric.startswith("success_rate") for metric in curves.values()):
            axes.set_ylim(top=1.0)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(title=", ".join(plot.lines), frameon=False, fontsize=8)
    picture.suptitle(plot.title, wrap=True)
    picture.savefig(path, dpi=100)
