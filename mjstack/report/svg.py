"""Plots of a page as SVG: histograms, and maps of the table."""

import itertools
from collections.abc import Sequence
from html import escape

import numpy as np

from mjstack.report.page import Map
from mjstack.report.text import label, with_unit

_BINS = 30
_WIDTH, _HEIGHT = 240, 90  # of a histogram
_TALL = 320  # of a map


def histogram(name: str, values: np.ndarray, failed: np.ndarray, limits: Sequence[float]) -> str:
    """A figure of the distribution of a value; empty where all are the same."""
    finite = np.isfinite(values)
    numbers = values[finite].astype(float)
    span = np.ptp(numbers) if len(numbers) else 0.0
    if not span > 1e-9 * np.abs(numbers).max(initial=1e-12):
        return ""
    # A threshold far away would squeeze the bars into one.
    near = [x for x in limits if numbers.min() - span <= x <= numbers.max() + span]
    low = float(min([numbers.min(), *near]))
    high = float(max([numbers.max(), *near]))
    edges = np.linspace(low, high, _BINS + 1)
    losses = np.histogram(numbers[failed[finite]], edges)[0].tolist()
    totals = np.histogram(numbers, edges)[0].tolist()
    step = _WIDTH / _BINS
    unit = _HEIGHT / max(totals)
    marks = []
    for k, (lost, total) in enumerate(zip(losses, totals, strict=True)):
        if not total:
            continue
        ends = " to ".join(with_unit(name, float(edge)) for edge in edges[k : k + 2])
        tip = f"{ends}: {total:,}" + (f", {lost:,} failed" if lost else "")
        marks.append(f"<g>{_tip(tip)}")
        for css, top, count in (("g", total - lost, total - lost), ("b", total, lost)):
            if count:
                size = f"width={step - 1:.1f} height={max(1.0, unit * count):.1f}"
                at = f"x={step * k:.1f} y={_HEIGHT - unit * top:.1f}"
                marks.append(f"<rect class={css} {at} {size} />")
        marks.append("</g>")
    for limit in near:
        x = _WIDTH * (limit - low) / (high - low)
        tip = _tip(f"threshold {with_unit(name, float(limit))}")
        marks.append(f"<line class=limit x1={x:.1f} x2={x:.1f} y1=0 y2={_HEIGHT}>{tip}</line>")
    marks.append(f"<line class=axis x1=0 x2={_WIDTH} y1={_HEIGHT} y2={_HEIGHT} />")
    for x, anchor, end in ((0, "start", low), (_WIDTH, "end", high)):
        text = escape(with_unit(name, end))
        marks.append(f"<text x={x} y={_HEIGHT + 13} text-anchor={anchor}>{text}</text>")
    lacking = int((~finite).sum())
    caption = f"{label(name)}{f', {lacking:,} not finite' if lacking else ''}"
    return _figure(caption, _WIDTH, _HEIGHT + 16, marks)


def table_map(
    plan: Map, names: Sequence[str], broken: Sequence[Sequence[str]], rows: Sequence[int]
) -> str:
    """A figure of the table from above: x up, y to the left, as seen from behind the arm."""
    (x0, y0), (hx, hy) = plan.table[0][:2], plan.table[1][:2]
    scale = _TALL / (x0 + hx - (min(0.0, x0 - hx) - 0.02))

    def place(points: np.ndarray) -> list[list[float]]:
        """Where positions are in the figure; those that are not finite are left out."""
        xy = points[np.isfinite(points).all(1)]
        return (scale * (np.array([y0 + hy, x0 + hx]) - xy[:, ::-1])).tolist()

    wide = 2.0 * scale * hy
    ((x, y),) = place(np.zeros((1, 2)))
    marks = [
        f"<rect fill=none class=axis x=0 y=0 width={wide:.1f} height={2.0 * scale * hx:.1f} />",
        f"<path class=axis fill='var(--fg)' d='M{x:.1f} {y - 8:.1f}l6 10h-12z' />",
    ]
    for text, failed, way in sorted(plan.ways, key=lambda way: way[1]):
        points = (f"{x:.0f} {y:.0f}" for x, y in place(way))
        line = "L".join(point for point, _ in itertools.groupby(points))  # at rest it costs nothing
        css = "'w x'" if failed else "w"
        if line:
            marks.append(f"<path class={css} d='M{line}'>{_tip(text)}</path>")
    for row in sorted(rows, key=lambda row: bool(broken[row])):  # failed ones on top
        rules = " ".join(broken[row])
        tip = _tip(f"{names[row]}: broke {rules}" if rules else names[row])
        for x, y in place(plan.xy[row : row + 1, :2]):
            if rules:
                corner = f"{x - 4:.1f} {y - 4:.1f}"
                marks.append(f"<path class=x d='M{corner}l8 8m0-8l-8 8'>{tip}</path>")
            else:
                marks.append(f"<circle class=o cx={x:.1f} cy={y:.1f} r=3>{tip}</circle>")
    return _figure(plan.title, round(wide), _TALL + 6, marks)


def _figure(caption: str, width: int, height: int, marks: Sequence[str]) -> str:
    title = escape(caption)
    return (
        f"<figure><figcaption>{title}</figcaption><svg width={width} height={height} role=img"
        f" aria-label='{title}'>{''.join(marks)}</svg></figure>"
    )


def _tip(text: str) -> str:
    return f"<title>{escape(text)}</title>"
