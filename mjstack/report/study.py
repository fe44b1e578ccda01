"""The solver study as a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

from mjstack.report.markdown import escape_cell


@dataclass(kw_only=True, slots=True)
class StudyRow:
    """One variant of the solver. Figures are None where there are none.

    Attributes:
        variant: Its name.
        changes: What it changes.
        status: ``pass`` if it was measured, ``fail`` with its reason, ``skip`` if it changes
            nothing.
        reason: Why.
        ms_per_batched_step: Median time of one step of all worlds, cube in hand [ms].
        ms_min: Shortest of the repetitions [ms].
        ms_max: Longest [ms].
        base_ms: Median of the configured solver in the same run, in turns with it [ms].
        ratio: Median of the ratios of neighbouring turns.
        ratio_min: Smallest.
        ratio_max: Largest.
        worlds: Number of worlds.
        succeeded: Worlds that the check of the whole episode passed.
        broken_rules: Which rules the others broke, and how many each.
        iteration_limit_worlds: Worlds whose solver stopped at its iteration limit in some step of
            the episode.
        line_search_limit_worlds: Likewise at the limit of the line search.
        peak_rows: Most constraint rows of a world.
        xy_err_max_m: Largest distance of the stack's centres at the end [m].
    """

    variant: str
    changes: str
    status: str = "fail"
    reason: str = ""
    ms_per_batched_step: float | None = None
    ms_min: float | None = None
    ms_max: float | None = None
    base_ms: float | None = None
    ratio: float | None = None
    ratio_min: float | None = None
    ratio_max: float | None = None
    worlds: int | None = None
    succeeded: int | None = None
    broken_rules: str = ""
    iteration_limit_worlds: int | None = None
    line_search_limit_worlds: int | None = None
    peak_rows: int | None = None
    xy_err_max_m: float | None = None


COLUMNS = tuple(field.name for field in fields(StudyRow))


def to_markdown(
    rows: Sequence[StudyRow], title: str, notes: Sequence[str], picture: str = ""
) -> str:
    """The columns that a reader compares."""
    head = (
        "variant",
        "changes",
        "ms per step",
        "ratio to base",
        "succeeded",
        "iteration limit",
        "line-search limit",
        "notes",
    )
    lines = [
        f"# {title}",
        "",
        f"| {' | '.join(head)} |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | --- |",
    ]
    for row in rows:
        ratio = (
            ""
            if row.ratio is None
            else f"{row.ratio:.2f} ({row.ratio_min:.2f} to {row.ratio_max:.2f})"
        )
        cells = (
            row.variant,
            row.changes,
            "" if row.ms_per_batched_step is None else f"{row.ms_per_batched_step:.3g}",
            ratio,
            "" if row.succeeded is None else f"{row.succeeded} of {row.worlds}",
            _count(row.iteration_limit_worlds),
            _count(row.line_search_limit_worlds),
            "; ".join(text for text in (row.broken_rules, row.reason) if text),
        )
        lines.append(f"| {' | '.join(escape_cell(cell) for cell in cells)} |")
    if picture:
        lines += ["", f"![{picture}]({picture})"]
    return "\n".join([*lines, "", *(f"- {note}" for note in notes)]) + "\n"


def _count(value: int | None) -> str:
    return "" if value is None else str(value)
