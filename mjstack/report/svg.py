"""Plots of a page as SVG: histograms, and maps of the table."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from mjstack.report.write import label, with_unit

_BINS = 30


@dataclass(kw_only=True, slots=True)
class Map:
    """Where an object stood at the starts and went, seen from above.

    Attributes:
        title: The object.
        xy: Positions [m], shape ``(n, 2)``.
        table: Centre and half size of the table in x and y [m].
        ways: Its ways in some episodes: a label, whether that failed, and positions [m], shape
            ``(frames, 2)``.
    """

    title: str
    xy: np.ndarray
    table: tuple[Sequence[float], Sequence[float]]
    ways: Sequence[tuple[str, bool, np.ndarray]] = ()


def histogram(name: str, values: np.ndarray, bad: np.ndarray, limits: Sequence[float]) -> str:
    """A figure of the distribution of a value; empty where all are the same."""
    finite = np.isfinite(values)
    some = values[finite].astype(float)
    if len(some) < 2 or not np.ptp(some) > 1e-9 * max(1e-12, float(np.abs(some).max())):
        return ""
    # A threshold far away would squeeze the bars into one.
    span = np.ptp(some)
    near = [x for x in limits if some.min() - span <= x <= some.max() + span]
    low = min([some.min(), *near])
    high = max([some.max(), *near])
    edges = np.linspace(low, high, _BINS + 1)
    failed = np.histogram(some[bad[finite]], edges)[0]
    every = np.histogram(some, edges)[0]
    width, height = 240, 90
    step = width / _BINS
    unit = height / every.max()
    bars = []
    for k, (lost, total) in enumerate(zip(failed.tolist(), every.tolist(), strict=True)):
        if not total:
            continue
        ends = " to ".join(with_unit(name, float(edge)) for edge in edges[k : k + 2])
        tip = f"{ends}: {total:,}" + (f", {lost:,} failed" if lost else "")
        won = unit * (total - lost)
        bars.append(f"<g><title>{escape(tip)}</title>")
        for css, y, tall in (("g", height - won, won), ("b", height - unit * total, unit * lost)):
            if tall:
                bars.append(_rect(css, step * k, y, step - 1, max(1.0, tall)))
        bars.append("</g>")
    lines = "".join(
        f"<line class=limit x1={x:.1f} x2={x:.1f} y1=0 y2={height}>"
        f"<title>threshold {escape(with_unit(name, float(at)))}</title></line>"
        for at in near
        for x in [width * (at - low) / (high - low)]
    )
    gone = int((~finite).sum())
    caption = f"{label(name)}{f', {gone:,} not finite' if gone else ''}"
    return (
        f"<figure><figcaption>{escape(caption)}</figcaption>"
        f"<svg width={width} height={height + 16} role=img aria-label='{escape(caption)}'>"
        f"{''.join(bars)}{lines}<line class=axis x1=0 x2={width} y1={height} y2={height} />"
        f"<text x=0 y={height + 13}>{escape(with_unit(name, float(low)))}</text>"
        f"<text x={width} y={height + 13} text-anchor=end>{escape(with_unit(name, float(high)))}"
        "</text></svg></figure>"
    )


def table_map(
    one: Map, names: Sequence[str], broken: Sequence[Sequence[str]], shown: Sequence[int]
) -> str:
    """A figure of the table from above: x up, y to the left, as one who stands behind the arm
    sees it.
    """
    (x0, y0), (hx, hy) = one.table[0][:2], one.table[1][:2]
    low = min(0.0, x0 - hx) - 0.02
    scale = 320 / (x0 + hx - low)

    def place(x: float, y: float) -> tuple[float, float]:
        return scale * (y0 + hy - y), scale * (x0 + hx - x)

    marks = []
    for text, failed, way in sorted(one.ways, key=lambda way: way[1]):
        good = way[np.isfinite(way).all(1)].tolist()
        if not good:
            continue
        points = ("{:.0f} {:.0f}".format(*place(x, y)) for x, y in good)
        line = "L".join(point for point, _ in itertools.groupby(points))  # at rest it costs nothing
        css = "'w x'" if failed else "w"
        marks.append(f"<path class={css} d='M{line}'><title>{escape(text)}</title></path>")
    for row in sorted(shown, key=lambda row: bool(broken[row])):  # failed ones on top
        x, y = place(*map(float, one.xy[row, :2]))
        if not (math.isfinite(x) and math.isfinite(y)):
            continue
        rules = " ".join(broken[row])
        tip = escape(f"{names[row]}{f': {rules}' if rules else ''}")
        if broken[row]:
            at = f"{x - 4:.1f} {y - 4:.1f}"
            marks.append(f"<path class=x d='M{at}l8 8m0-8l-8 8'><title>{tip}</title></path>")
        else:
            at = f"cx={x:.1f} cy={y:.1f}"
            marks.append(f"<circle class=o {at} r=3><title>{tip}</title></circle>")
    bx, by = place(0.0, 0.0)
    wide = 2.0 * scale * hy
    tall = 2.0 * scale * hx
    title = escape(one.title)
    return (
        f"<figure><figcaption>{title}</figcaption>"
        f"<svg width={wide:.0f} height=326 role=img aria-label='{title}'>"
        f"<rect fill=none class=axis x=0 y=0 width={wide:.1f} height={tall:.1f} />"
        f"<path class=axis fill='var(--fg)' d='M{bx:.1f} {by - 8:.1f}l6 10h-12z' />"
        f"{''.join(marks)}</svg></figure>"
    )


def _rect(css: str, x: float, y: float, width: float, height: float) -> str:
    return f"<rect class={css} x={x:.1f} y={y:.1f} width={width:.1f} height={height:.1f} />"
