"""The report as text for people."""

from __future__ import annotations

from mjstack.report.record import GateResult, Report, Status, Value


def to_markdown(report: Report) -> str:
    """Summary table, pictures, then every gate with thresholds and metrics."""
    lines = [f"# mjstack run: {report.status.value}", ""]
    lines += ["| gate | status | seconds | what it says |", "| --- | --- | ---: | --- |"]
    lines += [f"| {g.name} | {g.status.value} | {g.seconds:.1f} | {escape_cell(g.reason)} |" for g in report.gates]
    for picture in report.pictures:
        lines += ["", f"![{picture}]({picture})"]
    for gate in report.gates:
        lines += ["", f"## {gate.name}: {gate.status.value}", ""]
        if gate.reason:
            lines += [gate.reason, ""]
        lines += _table("metric", gate.metrics) + _table("threshold", gate.thresholds)
        lines += [f"- {line}" for line in gate.details]
    lines += ["", "## Provenance", "", "| what | value |", "| --- | --- |"]
    for key, value in report.provenance.items():
        text = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else format_value(value)
        lines.append(f"| {key} | {text} |")
    skipped = [gate for gate in report.gates if gate.status is Status.skipped]
    if skipped:
        lines += ["", "Skipped:", ""] + [f"- {gate.name}: {gate.reason}" for gate in skipped]
    return "\n".join(lines) + "\n"


def format_value(value: Value) -> str:
    """A number with as many digits as a reader needs."""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:.4g}"
    return "" if value is None else str(value)


def escape_cell(text: str) -> str:
    """Text as a cell of a Markdown table."""
    return text.replace("|", "\\|").replace("\n", " ")


def headline(gate: GateResult) -> str:
    """One line about a gate, for the terminal."""
    return gate.reason or "ok"


def _table(title: str, values: dict[str, Value]) -> list[str]:
    if not values:
        return []
    rows = [f"| {name} | {escape_cell(format_value(value))} |" for name, value in values.items()]
    return [f"| {title} | value |", "| --- | ---: |", *rows, ""]
