"""The solver study as a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields

from mjstack.report.markdown import format_value
from mjstack.report.table import Table, to_document


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
        values: Extremes of what the task's check measured, by name with unit.
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
    values: dict[str, float] = field(default_factory=dict)


COLUMNS = tuple(f.name for f in fields(StudyRow) if f.name != "values")


def to_markdown(
    rows: Sequence[StudyRow], title: str, notes: Sequence[str], picture: str = ""
) -> str:
    """The columns that a reader compares."""
    return to_document(title, [Table.of("", _SHOWN, rows)], notes, picture)


def _ratio(row: StudyRow) -> str:
    if row.ratio is None:
        return ""
    return f"{row.ratio:.2f} ({row.ratio_min:.2f} to {row.ratio_max:.2f})"


_SHOWN: dict[str, Callable[[StudyRow], str]] = {
    "variant": lambda row: row.variant,
    "changes": lambda row: row.changes,
    "ms per step": lambda row: format_value(row.ms_per_batched_step),
    "ratio to base": _ratio,
    "succeeded": lambda row: "" if row.succeeded is None else f"{row.succeeded} of {row.worlds}",
    "iteration limit": lambda row: format_value(row.iteration_limit_worlds),
    "line-search limit": lambda row: format_value(row.line_search_limit_worlds),
    "notes": lambda row: "; ".join(text for text in (row.broken_rules, row.reason) if text),
}
