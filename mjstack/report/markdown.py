"""The report as text for people."""

from __future__ import annotations

import math
from collections.abc import Mapping

from mjstack.report.record import GateResult, Report, Status, Table


def to_markdown(report: Report) -> str:
    """Summary table, pictures, then every gate with thresholds and metrics."""
    lines = [f"# mjstack run: {report.status.value}", ""]
    lines += ["| gate | status | seconds | what it says |", "| --- | --- | ---: | --- |"]
    lines += [
        f"| {g.name} | {g.status.value} | {g.seconds:.1f} | {escape_cell(g.reason)} |"
        for g in report.gates
    ]
    for picture in report.pictures:
        lines += ["", f"![{picture}]({picture})"]
    for gate in report.gates:
        lines += ["", f"## {gate.name}: {gate.status.value}", ""]
        if gate.reason:
            lines += [gate.reason, ""]
        lines += _table("metric", gate.metrics) + _table("threshold", gate.thresholds)
        lines += _table("note", gate.notes)
        lines += [f"- {line}" for line in gate.details]
        for table in gate.tables:
            lines += ["", f"### {table.title}", "", *_rows(table)]
    lines += ["", "## Provenance", "", "| what | value |", "| --- | --- |"]
    for key, value in report.provenance.items():
        text = (
            ", ".join(f"{k} {v}" for k, v in value.items())
            if isinstance(value, dict)
            else format_value(value)
        )
        lines.append(f"| {key} | {text} |")
    skipped = [gate for gate in report.gates if gate.status is Status.skipped]
    if skipped:
        lines += ["", "Skipped:", ""] + [f"- {gate.name}: {gate.reason}" for gate in skipped]
    return "\n".join(lines) + "\n"


def format_value(value: object) -> str:
    """A number with as many digits as a reader needs."""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:.4g}"
    return "" if value is None else str(value)


def format_percent(rate: float, unit: str = " %") -> str:
    """A rate with as many digits as tell it from 0 and 1, at least two."""
    gap = min(rate, 1.0 - rate)
    digits = 2 if gap <= 0.0 else max(2, math.ceil(-math.log10(100.0 * gap)))
    text = f"{100.0 * rate:.{digits}f}"
    return text.rstrip("0").rstrip(".") + unit


def escape_cell(text: str) -> str:
    """Text as a cell of a Markdown table."""
    return text.replace("|", "\\|").replace("\n", " ")


def headline(gate: GateResult) -> str:
    """One line about a gate, for the terminal."""
    return gate.reason or "ok"


def _rows(table: Table) -> list[str]:
    """A table as Markdown: its first column is text, the others are numbers."""
    rule = ["---", *["---:"] * (len(table.header) - 1)]
    return [
        f"| {' | '.join(escape_cell(cell) for cell in row)} |"
        for row in (table.header, rule, *table.rows)
    ]


def _table(title: str, values: Mapping[str, object]) -> list[str]:
    if not values:
        return []
    rows = [f"| {name} | {escape_cell(format_value(value))} |" for name, value in values.items()]
    return [f"| {title} | value |", "| --- | ---: |", *rows, ""]
