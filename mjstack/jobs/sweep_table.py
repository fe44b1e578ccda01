"""The table and the picture of a sweep, made from what its jobs have left in their folders."""

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from mjstack.config.explain import parse
from mjstack.errors import is_out_of_memory
from mjstack.files import to_csv, write_atomic
from mjstack.jobs.sweep import LOG, list_jobs
from mjstack.report.curves import Plot, Row, save_curves
from mjstack.report.formats import to_markdown
from mjstack.report.record import Report, Status
from mjstack.report.sections import Part, Section
from mjstack.report.table import Table
from mjstack.report.write import safely_write

_HEADLINES = ("succeeded", "success_rate", "world_steps_per_s")
_RATE = "_per_s.median"
_TAIL = 4096  # characters of a log, in which the system or Warp says that memory ran out
_PANELS = 3
_NOT_RUN = "not run"


def update_summary(folder: Path, reports: Mapping[int, Report]) -> None:
    """Write the tables after a job, lest the command be killed. A full disk ends no job."""
    with suppress(OSError):
        write_summary(folder, reports)


def write_summary(
    folder: Path, reports: Mapping[int, Report], *, draw: bool = False
) -> tuple[Table, str]:
    """Write summary.csv and summary.md into the folder of a sweep, and summary.png if it is drawn
    anew. ``reports`` are those of jobs that have ended, by their numbers; of other jobs in the
    folder's list they are read.

    Returns:
        The table, its results without details, and why there is no picture; empty if there is one,
        or none is to be drawn.

    Raises:
        OSError: A file cannot be written.
    """
    rows = sweep_rows(folder, reports)
    swept = _swept(rows)
    title = f"sweep of {len(rows)} job{'s' if len(rows) > 1 else ''}"
    table = Table.of(_columns(rows, swept), rows)
    numbers = [key for key in swept if all(type(row.get(key)) in (int, float) for row in rows)]
    plot = Plot(
        title=title,
        over=next(iter(numbers), ""),
        lines=[key for key in swept if key not in numbers[:1]],
        panels={name: {"": name} for name in _headlines(rows)[:_PANELS]},
    )
    picture = folder / "summary.png"
    problem = ""
    if draw and plot.over and plot.shows(rows):
        problem = safely_write(picture, save_curves, plot, rows, stops=False)
    notes = []
    for key, name in (("backend", "hardware"), ("git_commit", "commit")):
        values = sorted({str(row[key]) for row in rows if row.get(key)})
        notes += [f"{name}: {value}" for value in values]
    write_atomic(folder / "summary.csv", to_csv(rows))
    blocks: list[Part] = [table, *([picture] if picture.exists() else []), notes]
    write_atomic(folder / "summary.md", to_markdown([Section(title=title, parts=blocks, level=1)]))
    rows_shown = [[_first_words(cell) for cell in row] for row in table.rows]
    return replace(table, title=title, rows=rows_shown), problem


def sweep_rows(folder: Path, reports: Mapping[int, Report]) -> list[Row]:
    """A row for each job of a sweep.

    ``job``, each key of its command line, ``status`` (pass, fail, out of memory, interrupted or not
    run), ``reason``, ``seconds`` of its gates, ``git_commit``, and of its gates each result in
    words, every metric and every note by name.
    """
    rows = []
    for job in list_jobs(folder):
        report = reports.get(job.number) or job.report()
        row: Row = {"job": job.number} | _values(job.overrides)
        if report is None:
            rows.append(row | {"status": _NOT_RUN, "reason": ""})
            continue
        failed = [gate for gate in report.gates if gate.status is Status.failed]
        reason = "; ".join(f"{gate.name}: {gate.reason}" for gate in failed)
        lost = report.status is Status.failed and _lost_memory(report.folder, reason)
        row |= {"status": "out of memory" if lost else str(report.status), "reason": reason}
        row["seconds"] = sum(gate.seconds for gate in report.gates)
        row["git_commit"] = report.provenance.get("git_commit", "")
        for gate in report.gates:
            row |= {gate.name: f"{gate.status}: {gate.reason}"}
            row |= gate.notes | gate.metrics if gate.status is not Status.skipped else {}
        rows.append(row)
    return rows


def _values(overrides: Iterable[str]) -> Row:
    """The values that overrides set, by key; lists and mappings as text."""
    values: Row = {}
    for override in map(parse, overrides):
        if not override.is_delete():
            value: Any = override.value()
            number = isinstance(value, int | float)
            values[override.key_or_group] = value if number else override.get_value_element_as_str()
    return values


def _lost_memory(folder: Path, reason: str) -> bool:
    """Whether a job failed as memory ran out. The system kills (9) where it does."""
    log = folder / LOG
    text = log.read_text(errors="replace")[-_TAIL:] if log.exists() else ""
    return "killed by signal 9" in reason or is_out_of_memory(f"{reason} {text}")


def _swept(rows: Sequence[Row]) -> list[str]:
    """The keys of the command line in which jobs differ."""
    keys = dict.fromkeys(key for row in rows for key in list(row)[1 : list(row).index("status")])
    return [key for key in keys if len({str(row.get(key)) for row in rows}) > 1]


def _columns(rows: Sequence[Row], swept: Sequence[str]) -> dict[str, str]:
    """The columns of the table by their titles: what differs, and the gates' results."""
    result_keys = [key for row in rows for key, value in row.items() if _is_result(value)]
    return {name: name for name in ("job", *swept, *result_keys, *_headlines(rows), "status")}


def _is_result(value: object) -> bool:
    """Whether a value is a gate's result in words."""
    return isinstance(value, str) and value.split(": ")[0] in {*Status} and ": " in value


def _first_words(cell: str) -> str:
    """A gate's result up to its first detail; any other cell as it is."""
    return re.split(r" \(|[;,] ", cell)[0] if _is_result(cell) else cell


def _headlines(rows: Sequence[Row]) -> list[str]:
    """The metrics that tell most, among those that are there."""
    names = dict.fromkeys(name for row in rows for name in row)
    return [name for name in names if name in _HEADLINES or name.endswith(_RATE)]
