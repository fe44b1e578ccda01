"""A file of starts: a CSV with a header and one row per world, read and checked cell by cell."""

import csv
import math
import reprlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjstack.errors import ParameterError, suggest


@dataclass(frozen=True, slots=True)
class StartsTable:
    """The content of a file.

    Attributes:
        path: The file, as it was named.
        columns: Values by column name, each ``(worlds,)``, float64, with world w in row w.
        lines: The line of each world in the file, ``(worlds,)``.
    """

    path: str
    columns: dict[str, np.ndarray]
    lines: np.ndarray

    def misfit(
        self, world: int, columns: Sequence[str], expected: str, fix: str = "Correct it"
    ) -> ParameterError:
        """The error that some cells of a world's line cannot be used."""
        return _wrong(self.path, expected, fix, line=int(self.lines[world]), columns=columns)

    def require_range(self, column: str, low: float, high: float, fix: str = "Correct it") -> None:
        """Refuse a value outside a range, if the file has the column.

        Raises:
            ParameterError: There is one; names its line.
        """
        values = self.columns.get(column, np.empty(0))
        slack = 1e-6 * max(abs(low), abs(high))  # float32 does not hold the ends exactly
        outside = np.flatnonzero((values < low - slack) | (values > high + slack))
        if outside.size:
            world = int(outside[0])
            expected = f"{low:.6g} to {high:.6g}, it is {values[world]:.6g}"
            raise self.misfit(world, [column], expected, fix)


def read_starts_table(path: str, required: Sequence[str], optional: Sequence[str]) -> StartsTable:
    """Read a file.

    Args:
        path: The file.
        required: Names of columns that every file has, beside ``world``.
        optional: Names of columns that a file may have.

    Raises:
        ParameterError: The file cannot be read, or a column, a cell or a world is wrong.
    """
    required = ["world", *required]
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            header = [name.strip() for name in next(reader, [])]
            rows = [(reader.line_num, cells) for cells in reader if "".join(cells).strip()]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        expected = "a CSV file with a header and one row per world; it cannot be read"
        reason = getattr(error, "strerror", None) or error
        raise _wrong(path, f"{expected} ({reason})", "Name a file: starts=worlds.csv") from error

    known = [*required, *optional]
    for name in header:
        if name not in known or header.count(name) > 1:
            expected = f"columns separated by commas, each once; {reprlib.repr(name)} is wrong"
            raise _wrong(path, expected, suggest(name, known).rstrip("."), line=1)
    lacking = [name for name in required if name not in header]
    if lacking:
        expected = f"columns {', '.join(required)}; {', '.join(lacking)} missing"
        raise _wrong(path, expected, "Add the missing columns", line=1)

    values = np.empty((len(rows), len(header)))
    for row, (line, cells) in enumerate(rows):
        if len(cells) != len(header):
            expected = f"{len(header)} cells as in the header, it has {len(cells)}"
            raise _wrong(path, expected, "Correct it; the decimal mark is a point", line=line)
        for column, cell in enumerate(cells):
            value = _number(cell)
            if not math.isfinite(value):
                expected = f"a finite number, {reprlib.repr(cell)} is none"
                raise _wrong(path, expected, "Correct it", line=line, columns=[header[column]])
            values[row, column] = value

    table = dict(zip(header, values.T, strict=True))
    worlds = table.pop("world")
    missing = set(range(max(1, len(rows)))).difference(worlds)
    if missing:
        expected = f"worlds numbered from 0, a row each; {min(missing)} is missing"
        raise _wrong(path, expected, "Number the rows anew", columns=["world"])
    order = np.argsort(worlds)
    lines = np.array([line for line, _ in rows])
    return StartsTable(path, {name: column[order] for name, column in table.items()}, lines[order])


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _wrong(
    path: str, expected: str, fix: str, *, line: int | None = None, columns: Sequence[str] = ()
) -> ParameterError:
    where = path if line is None else f"{path}, line {line}"
    if columns:
        where += f", column{'s' if len(columns) > 1 else ''} {', '.join(columns)}"
    return ParameterError("path", where, expected, fix)
