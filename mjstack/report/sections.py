"""A report as sections of paragraphs, lists, tables and pictures: every format shows these."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjstack.report.page import Page, Worlds
from mjstack.report.record import GateResult, Report
from mjstack.report.svg import histogram, table_map
from mjstack.report.table import Marked, Table
from mjstack.report.text import format_percent, format_value, label, unit_ending, with_unit

_POINTS = 3000  # starts in a map: a page of more is slow
_NAMES = 12  # episodes of a rule
_SPREAD = ("median", "min", "max")


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
    episode = page.note
    if page.episode:
        text = f"Play it in 3-D: {page.episode} (red tables: failed worlds)"
        episode = Marked(text, link=page.episode)
    head: list[Part] = [
        ", ".join(str(facts[name]) for name in ("date", "device") if name in facts),
        " ".join(report.overrides),
        summarize(report.gates),
        episode,
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
        yield from _episode_parts(worlds[gate.name], gate.thresholds)
    metrics = dict(gate.metrics)
    thresholds = dict(gate.thresholds)
    yield from _take_limited(metrics, thresholds)
    yield from gate.tables
    yield from _take_matrices(metrics)
    yield from _beside_limits(metrics, thresholds, gate.beyond)
    if gate.notes:
        rows = [[label(name), format_value(value)] for name, value in gate.notes.items()]
        yield Table(title="Notes", header=["note", ""], rows=rows)
    yield gate.details


def _take_limited(metrics: dict[str, float], thresholds: dict[str, float]) -> Iterator[Table]:
    """Metrics ``STATE.GROUP.NAME`` with a threshold of this name or ``GROUP.NAME``, taken out of
    both mappings: a row per state and group, in which each stands beside its limit.
    """
    cells: dict[str, dict[str, str]] = {}
    limits = set()
    for name in list(metrics):
        state, _, quantity = name.partition(".")
        group, dot, column = quantity.rpartition(".")
        key = name if name in thresholds else quantity
        if not dot or key not in thresholds:
            continue
        limits.add(key)
        limit = float(thresholds[key])
        value = float(metrics.pop(name))
        grade = "good" if value <= 0.5 * limit else "near" if value <= limit else "bad"
        row = cells.setdefault(f"{label(state)}, {label(group)}", {})
        row[column] = Marked(f"{format_value(value)} / {format_value(limit)}", grade=grade)
    for quantity in limits:
        del thresholds[quantity]
    columns = list(dict.fromkeys(column for row in cells.values() for column in row))
    rows = [[name, *(row.get(column, "") for column in columns)] for name, row in cells.items()]
    if rows:
        yield Table(title="Found / allowed", header=["state", *columns], rows=rows)


def _take_matrices(metrics: dict[str, float]) -> Iterator[Table]:
    """Metrics ``ROW.COLUMN`` of which several rows have the same columns, or one row a median and
    its range, taken out of the mapping.
    """
    rows: dict[str, list[str]] = {}
    for name in metrics:
        row, dot, column = name.rpartition(".")
        if dot:
            rows.setdefault(row, []).append(column)
    alike: dict[tuple[str, ...], list[str]] = {}
    for row, names in rows.items():
        alike.setdefault(tuple(names), []).append(row)
    for columns, names in alike.items():
        if len(names) < 2 and columns != _SPREAD:
            continue
        body = []
        for name in names:
            cells = [
                with_unit(column if unit_ending(column) else name, metrics.pop(f"{name}.{column}"))
                for column in columns
            ]
            body.append([label(name), *cells])
        yield Table(title="Figures", header=["", *map(label, columns)], rows=body)


def _beside_limits(
    metrics: Mapping[str, float], thresholds: Mapping[str, float], beyond: Sequence[str]
) -> Iterator[Table]:
    """What was measured beside what is required, in red where a threshold broke."""
    broken = {*beyond, *(name.rpartition(".")[2] for name in beyond)}
    required = {name: with_unit(name, value) for name, value in thresholds.items()}
    rows = []
    for name, value in metrics.items():
        limits = _limits_of(name, thresholds)
        cell = " to ".join(with_unit(limit, thresholds[limit]) for limit in limits)
        measured = with_unit(name, value)
        names = {name, *(limit.removesuffix(unit_ending(limit)) for limit in limits)}
        grade = "" if broken.isdisjoint(names) else "bad"
        rows.append([label(name), Marked(measured, grade=grade), cell])
        required = {name: text for name, text in required.items() if name not in limits}
    rows += [[label(name), "", text] for name, text in required.items()]
    if rows:
        yield Table(title="Values", header=["", "measured", "required"], rows=rows)


def _limits_of(name: str, thresholds: Mapping[str, float]) -> list[str]:
    """Thresholds of a measurement: its name, or with ``_min``, ``_max`` before the unit."""
    unit = unit_ending(name)
    stem = name.removesuffix(unit)
    for base in (stem, re.sub("_(min|max)$", "", stem)):
        for ends in (("",), ("_min", "_max")):
            limits = [f"{base}{end}{unit}" for end in ends]
            if limits := [limit for limit in limits if limit in thresholds]:
                return limits
    return []


def _episode_parts(worlds: Worlds, thresholds: Mapping[str, float]) -> Iterator[Part]:
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
    histograms = [
        histogram(name, values, failed, [thresholds[end] for end in _limits_of(name, thresholds)])
        for name, values in worlds.values.items()
    ]
    if any(histograms):
        text = "Number of episodes; failed ones in red on top, thresholds dashed."
        yield Plots(title="Over the worlds", text=text, figures=histograms)
    if worlds.maps:
        text = (
            "Where the objects started, seen from above, the arm's base at the triangle; failed"
            " episodes as red crosses."
        )
        on_map = np.sort(np.argsort(~failed, kind="stable")[:_POINTS]).tolist()
        if count > _POINTS:
            text += f" {_POINTS:,} of {count:,} are drawn, failed ones first."
        if ways := len(worlds.maps[0].ways):
            text += f" Lines are the objects' ways in {ways} of the episodes."
        figures = [table_map(plan, worlds.names, worlds.broken, on_map) for plan in worlds.maps]
        yield Plots(title="Over the table", text=text, figures=figures)
