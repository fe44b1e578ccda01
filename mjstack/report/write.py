"""Write report.json and report.md, and draw pictures that may fail."""

import json
import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from mjstack.files import write_atomic
from mjstack.interrupt import check_interrupt
from mjstack.report.record import GateResult, Report, Status
from mjstack.report.table import Table, format_value, to_document

log = logging.getLogger(__name__)

SCHEMA = 2
# Units by the end of a metric's name; the first that fits counts.
_UNITS = {
    "_m_per_s": "m/s",
    "_per_s": "/s",
    "_mib": "MiB",
    "_deg": "deg",
    "_mb": "MB",
    "_rad": "rad",
    "_m": "m",
    "_s": "s",
    "_w": "W",
    "_j": "J",
    "_n": "N",
}
_SPREAD = ("median", "min", "max")


def write_report(report: Report) -> None:
    """Replace report.json and report.md, each in one step.

    Called after every result, so that nothing finished is lost.
    """
    data = {
        "schema": SCHEMA,
        "status": report.status,
        "resumes": report.resumes,
        "provenance": report.provenance,
        "gates": [asdict(gate) for gate in report.gates],
        "pictures": report.pictures,
    }
    # A gate may return NumPy scalars. JSON has no NaN: a number that is not finite becomes its
    # name.
    text = json.dumps(data, default=lambda value: value.item())
    finite = json.loads(text, parse_constant=lambda name: str(float(name)))
    text = json.dumps(finite, indent=2) + "\n"
    write_atomic(report.folder / "report.json", text)
    write_atomic(report.folder / "report.md", to_markdown(report))


def read_report(folder: Path, overrides: Sequence[str] = ()) -> Report | None:
    """The statuses and reasons of a report that a run has left; None if there is none that can be
    read.
    """
    try:
        data = json.loads((folder / "report.json").read_text())
        gates = [
            GateResult(name=gate["name"], status=Status(gate["status"]), reason=gate["reason"])
            for gate in data["gates"]
        ]
        status = Status(data["status"])
        resumes = str(data["resumes"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return Report(
        folder=folder, overrides=list(overrides), resumes=resumes, status=status, gates=gates
    )


def safely_write(
    path: Path, write: Callable[..., object], *args: object, stops: bool = True
) -> str:
    """Write a file by a call with a path beside it and ``args``, complete or not at all; a failure
    takes no result back. It is not written if the command was asked to stop, unless ``stops`` is
    false.

    Returns:
        Empty, or one line that says why there is no such file. run.log has the traceback.
    """
    if stops:
        check_interrupt()
    begun = path.with_name(f".{path.name}")
    try:
        write(begun, *args)
        begun.replace(path)
    except (Exception, KeyboardInterrupt) as error:
        begun.unlink(missing_ok=True)
        if isinstance(error, KeyboardInterrupt):
            raise
        log.exception("%s was not written", path.name)
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        return f"{path.name} was not written: {reason}"
    return ""


def to_markdown(report: Report) -> str:
    """Summary table, pictures, then every gate with its figures, and the provenance."""
    title = f"mjstack run: {report.status}"
    parts = [to_document(title, [summarize(report.gates)], pictures=report.pictures)]
    for gate in report.gates:
        title = f"{gate.name}: {gate.status}"
        tables = [*gate.tables, *_tables(gate)]
        parts.append(to_document(title, tables, gate.details, text=gate.reason, level=2))
    rows = [[key, words(value)] for key, value in report.provenance.items()]
    facts = Table(header=["fact", "value"], rows=rows)
    return "\n".join([*parts, to_document("Provenance", [facts], level=2)])


def summarize(gates: Iterable[GateResult]) -> Table:
    """A row per gate: its status, wall time, and result in a line."""
    rows = [[gate.name, gate.status, f"{gate.seconds:.1f}", gate.reason or "ok"] for gate in gates]
    return Table(header=["gate", "status", "seconds", "result"], rows=rows)


def format_percent(rate: float, unit: str = " %") -> str:
    """A rate with as many digits as tell it from 0 and 1, at least two."""
    gap = min(rate, 1.0 - rate)
    digits = 2 if gap <= 0.0 else max(2, math.ceil(-math.log10(100.0 * gap)))
    text = f"{100.0 * rate:.{digits}f}"
    return text.rstrip("0").rstrip(".") + unit


def _tables(gate: GateResult) -> list[Table]:
    """The gate's numbers, every one once.

    Repeated figures have their median and range in a row. A metric ``STATE.GROUP.NAME`` whose
    threshold is called ``GROUP.NAME`` stands beside that limit, in a row per state. The rest has
    name and value.
    """
    metrics = dict(gate.metrics)
    thresholds = dict(gate.thresholds)
    tables = [table] if (table := take_repeated(metrics)).rows else []
    cells = {
        row: {column: " / ".join(map(format_value, pair)) for column, pair in pairs.items()}
        for row, pairs in take_limited(metrics, thresholds).items()
    }
    if cells:
        columns = list(dict.fromkeys(column for row in cells.values() for column in row))
        rows = [[name, *(row.get(c, "") for c in columns)] for name, row in cells.items()]
        tables.append(Table(title="Found / allowed", header=["state", *columns], rows=rows))
    rest: dict[str, Mapping[str, object]] = {
        "measured": metrics,
        "required": thresholds,
        "notes": gate.notes,
    }
    for name, values in rest.items():
        if values:
            rows = [[label(key), with_unit(key, value)] for key, value in values.items()]
            tables.append(Table(title=name.capitalize(), header=[name, "value"], rows=rows))
    return tables


def take_repeated(metrics: dict[str, float]) -> Table:
    """Median and range of repeated figures, taken out of the mapping."""
    groups = [name[:-7] for name in metrics if name.endswith(".median")]
    rows = []
    for name in groups:
        if all(f"{name}.{end}" in metrics for end in _SPREAD):
            spread = [metrics.pop(f"{name}.{end}") for end in _SPREAD]
            rows.append([label(name), *(with_unit(name, value) for value in spread)])
    return Table(title="Figures", header=["figure", "median", "smallest", "largest"], rows=rows)


def take_limited(
    metrics: dict[str, float], thresholds: dict[str, float]
) -> dict[str, dict[str, tuple[float, float]]]:
    """Metrics per state with their limits, taken out of both mappings: by state and group, and then
    by quantity, what was found and what is allowed.
    """
    cells: dict[str, dict[str, tuple[float, float]]] = {}
    used = set()
    for name in list(metrics):
        state, _, quantity = name.partition(".")
        limit = thresholds.get(quantity)
        if limit is None or "." not in quantity:
            continue
        used.add(quantity)
        group, _, column = quantity.rpartition(".")
        row = cells.setdefault(", ".join(label(part) for part in (state, group) if part), {})
        row[column] = float(metrics.pop(name)), float(limit)
    for quantity in used:
        del thresholds[quantity]
    return cells


def unit_ending(name: str) -> str:
    """The end of a name that tells its unit; empty where there is none."""
    return next((end for end in _UNITS if name.endswith(end)), "")


def label(name: str) -> str:
    """A metric's name in words, without its unit.

    ``final.red.position_m`` is "final, red: position".
    """
    *groups, last = name.removesuffix(unit_ending(name)).replace("_", " ").split(".")
    return f"{', '.join(groups)}: {last}" if groups else last


def with_unit(name: str, value: object) -> str:
    """A value with the unit that its name ends on."""
    end = unit_ending(name)
    number = isinstance(value, float | int) and not isinstance(value, bool)
    return f"{format_value(value)} {_UNITS[end]}" if end and number else format_value(value)


def words(value: object) -> str:
    """A value of the provenance; versions become a list."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {item}" for name, item in value.items())
    return format_value(value)
