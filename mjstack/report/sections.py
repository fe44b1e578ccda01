"""A report as sections of paragraphs, lists, tables and pictures, which every format shows, and of
plots as SVG: histograms, and maps of the table.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from mjstack.report.figure import Figure
from mjstack.report.page import Map, Page, Worlds
from mjstack.report.record import GateResult, Report
from mjstack.report.table import Marked, Table
from mjstack.report.text import format_percent, format_value

_POINTS = 3000  # starts in a map: a page of more is slow
_NAMES = 12  # episodes of a rule
_SPREAD = ("median", "min", "max")
_BINS = 30
_WIDTH, _HEIGHT = 240, 90  # of a histogram
_TALL = 320  # of a map


@dataclass(frozen=True, kw_only=True)
class Plots:
    """Figures under a heading.

    Attributes:
        title: The heading.
        text: How to read them.
        figures: Elements of an HTML page; other formats leave them out.
    """

    title: str
    text: str
    figures: Sequence[str]


Part = str | list[str] | Path | Plots | Table
"""A paragraph, lines of a list, a picture, plots or a table."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """A heading and what is below it.

    Attributes:
        title: The heading's text.
        parts: In order.
        status: How it ended; empty where nothing did.
        level: Of the heading, 1 for the whole document's.
    """

    title: str
    parts: Sequence[Part]
    status: str = ""
    level: int = 2

    @property
    def heading(self) -> str:
        """Title and status."""
        return f"{self.title}: {self.status}" if self.status else self.title

    @property
    def content(self) -> list[Part]:
        """The parts that are not empty."""
        return [part for part in self.parts if part]


def make_sections(report: Report, page: Page) -> list[Section]:
    """The whole run: summary, pictures, then every gate, and the provenance."""
    facts = report.provenance
    text = f"Play it in 3-D: {page.episode} (coloured tables: failed worlds, by rule)"
    head: list[Part] = [
        ", ".join(str(facts[name]) for name in ("date", "device") if name in facts),
        page.command,
        summarize(report.gates),
        Marked(text, link=page.episode) if page.episode else "",
        page.notes,
        *(report.folder / name for name in report.pictures),
    ]
    sections = [Section(title=page.title, status=report.status, parts=head, level=1)]
    for gate in report.gates:
        parts = list(_parts(gate, page.worlds))
        sections.append(Section(title=gate.name, status=gate.status, parts=parts))
    rows = [[key, format_value(value)] for key, value in facts.items()]
    provenance = Table(header=["fact", "value"], rows=rows)
    return [*sections, Section(title="Provenance", parts=[provenance])]


def summarize(gates: Sequence[GateResult]) -> Table:
    """A row per gate: its status, wall time, and result in a line."""
    rows: list[list[str]] = [
        [
            Marked(gate.name, link=f"#{gate.name}"),
            Marked(gate.status, grade=gate.status),
            f"{gate.seconds:.1f}",
            gate.reason or "ok",
        ]
        for gate in gates
    ]
    return Table(header=["gate", "status", "seconds", "result"], rows=rows)


def _parts(gate: GateResult, worlds: Mapping[str, Worlds]) -> Iterator[Part]:
    """Result, episodes, tables with every number once, remarks."""
    yield gate.reason
    if gate.name in worlds and len(worlds[gate.name].names):
        yield from _episode_parts(worlds[gate.name])
    yield from gate.tables
    yield from _figure_tables(gate.figures)
    if gate.notes:
        rows = [[name.replace("_", " "), text] for name, text in gate.notes.items()]
        yield Table(title="Notes", header=["note", ""], rows=rows)
    yield gate.details


def _figure_tables(figures: Sequence[Figure]) -> Iterator[Table]:
    """Every figure once: groups with the same columns as a table with a row each, others in a row
    of their own beside what is required; then requirements alone.
    """
    groups: dict[str, list[Figure]] = {}
    for figure in figures:
        if figure.value is not None:
            groups.setdefault(figure.row, []).append(figure)
    rows_by_columns: dict[tuple[str, ...], list[str]] = {}
    for row, members in groups.items():
        rows_by_columns.setdefault(tuple(figure.title for figure in members), []).append(row)
    rows = []
    for columns, names in rows_by_columns.items():
        if len(names) > 1 or columns == _SPREAD:
            body = [[name, *map(_cell, groups[name])] for name in names]
            yield Table(title="Figures", header=["", *columns], rows=body)
            continue
        for figure in groups[names[0]]:
            measured = Marked(figure.text(figure.value), grade=_grade(figure))
            rows.append([figure.label, measured, figure.allowed])
    if rows:
        yield Table(title="Values", header=["", "measured", "required"], rows=rows)
    if rows := [[f.label, f.text(f.high)] for f in figures if f.value is None]:
        yield Table(title="Thresholds", header=["", "required"], rows=rows)


def _cell(figure: Figure) -> str:
    """A figure with its limit, if it has one, and how near it is."""
    limit = "".join(f" / {format_value(limit)}" for limit in figure.limits)
    text = format_value(figure.value) + limit if limit else figure.text(figure.value)
    return Marked(text, grade=_grade(figure))


def _grade(figure: Figure) -> str:
    """Good, near or bad by its limits; empty without any."""
    if not figure.limits:
        return ""
    if not figure.holds(figure.value):
        return "bad"
    near = math.isinf(figure.low) and not figure.holds(2.0 * figure.value)
    return "near" if near else "good"


def _episode_parts(worlds: Worlds) -> Iterator[Part]:
    """Rate, failures by rule, histograms of what was measured, and maps of the starts."""
    count = len(worlds.names)
    failed = np.array([bool(broken) for broken in worlds.broken])
    outcomes: dict[str, list[str]] = {"success": []}
    for name, rules in zip(worlds.names, worlds.broken, strict=True):
        for outcome in rules or ["success"]:
            outcomes.setdefault(outcome, []).append(name)
    rows = []
    for outcome, names in sorted(outcomes.items(), key=lambda item: -len(item[1])):
        share = len(names) / count
        grade = "bad" if outcome in worlds.rules else "good"
        listed = ", ".join(names[:_NAMES]) + (", ..." if len(names) > _NAMES else "")
        bar = Marked(format_percent(share), grade=grade, share=share)
        rows.append([outcome, worlds.rules.get(outcome, ""), f"{len(names):,}", bar, listed])
    header = ["outcome", "meaning", "episodes", "share", "which"]
    yield Table(title="Outcomes", header=header, rows=rows)
    histograms = [histogram(figure, values, failed) for figure, values in worlds.values]
    if any(histograms):
        text = "Number of episodes; failed ones in red on top, thresholds dashed."
        yield Plots(title="Over the worlds", text=text, figures=histograms)
    if worlds.maps:
        text = (
            "Where the objects started that the check judges, and where moved bodies and drawn"
            " places were, seen from above, the arm's base at the triangle; failed episodes as red"
            " crosses."
        )
        if worlds.unjudged:
            text += f" The check does not judge {', '.join(worlds.unjudged)}."
        on_map = np.sort(np.argsort(~failed, kind="stable")[:_POINTS]).tolist()
        if count > _POINTS:
            text += f" {_POINTS:,} of {count:,} are drawn, failed ones first."
        if ways := max(len(plan.ways) for plan in worlds.maps):
            text += f" Lines are the objects' ways in {ways} of the episodes."
        figures = [table_map(plan, worlds.names, worlds.broken, on_map) for plan in worlds.maps]
        yield Plots(title="Over the table", text=text, figures=figures)


def histogram(figure: Figure, values: np.ndarray, failed: np.ndarray) -> str:
    """The distribution of a figure's values, with its limits; empty where all are the same."""
    finite = np.isfinite(values)
    numbers = values[finite].astype(float)
    span = np.ptp(numbers) if len(numbers) else 0.0
    if not span > 1e-9 * np.abs(numbers).max(initial=1e-12):
        return ""
    # A threshold far away would squeeze the bars into one.
    near = [x for x in figure.limits if numbers.min() - span <= x <= numbers.max() + span]
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
        ends = " to ".join(figure.text(float(edge)) for edge in edges[k : k + 2])
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
        tip = _tip(f"threshold {figure.text(float(limit))}")
        marks.append(f"<line class=limit x1={x:.1f} x2={x:.1f} y1=0 y2={_HEIGHT}>{tip}</line>")
    marks.append(f"<line class=axis x1=0 x2={_WIDTH} y1={_HEIGHT} y2={_HEIGHT} />")
    for x, anchor, end in ((0, "start", low), (_WIDTH, "end", high)):
        text = escape(figure.text(end))
        marks.append(f"<text x={x} y={_HEIGHT + 13} text-anchor={anchor}>{text}</text>")
    lacking = int((~finite).sum())
    caption = f"{figure.label}{f', {lacking:,} not finite' if lacking else ''}"
    return _figure(caption, _WIDTH, _HEIGHT + 16, marks)


def table_map(
    plan: Map, names: Sequence[str], broken: Sequence[Sequence[str]], rows: Sequence[int]
) -> str:
    """A figure of the table from above: x up, y to the left, as seen from behind the arm."""
    (x0, y0), (hx, hy) = plan.table[0][:2], plan.table[1][:2]
    scale = _TALL / (x0 + hx - (min(plan.base[0], x0 - hx) - 0.02))

    def place(points: np.ndarray) -> list[list[float]]:
        """Where positions are in the figure; those that are not finite are left out."""
        xy = points[np.isfinite(points).all(1)]
        return (scale * (np.array([y0 + hy, x0 + hx]) - xy[:, ::-1])).tolist()

    wide = 2.0 * scale * hy
    ((x, y),) = place(np.array([plan.base]))
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
    for name, at in plan.marks.items():
        for x, y in place(np.array([at])):
            marks.append(f"<path class=axis d='M{x - 4:.1f} {y:.1f}h8m-4 -4v8' />")
            marks.append(f"<text x={x + 6:.1f} y={y + 4:.1f}>{escape(name)}</text>")
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
