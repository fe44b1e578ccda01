"""A file of starts: a CSV with a header and one row per world, read and checked cell by cell."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjstack.errors import ParameterError, suggest

_FORM = "a CSV file with a header and one row per world"
_LONGEST = 40  # characters of a cell in a message


@dataclass(frozen=True, slots=True)
class Columns:
    """Names of a starts file's columns for one robot.

    Attributes:
        required: Every file has them.
        optional: Each may be there or not.
    """

    required: Sequence[str]
    optional: Sequence[str]


def column_names(
    objects: Sequence[str], joints: Sequence[str], friction: Sequence[str], places: Sequence[str]
) -> Columns:
    """The columns, in the order in which they are written.

    Args:
        objects: Names of the free objects, such as ``red``.
        joints: Names of the robot's joints.
        friction: Whose friction may be given: the objects, and ``grip`` where the jaws have their
            own.
        places: Names of the places that are drawn per episode.
    """
    required = [f"{name}_{part}" for name in objects for part in ("x_m", "y_m", "yaw_rad")]
    optional = [f"joint_{name}" for name in joints] + [f"{name}_mass_kg" for name in objects]
    optional += [f"{name}_friction" for name in friction] + [f"gain_{name}" for name in joints]
    optional += [f"{name}_{axis}_m" for name in places for axis in "xy"]
    return Columns(["world", *required], optional)


@dataclass(frozen=True, slots=True)
class StartsTable:
    """What a file holds.

    Attributes:
        path: The file, as it was named.
        columns: Values by column name, each ``(worlds,)``, float64, with world w in row w.
        lines: The line of each world in the file, ``(worlds,)``.
    """

    path: str
    columns: dict[str, np.ndarray]
    lines: np.ndarray

    def misfit(self, world: int, columns: Sequence[str], expected: str, fix: str) -> ParameterError:
        """The error that some cells of a world's line cannot be used."""
        return _wrong(self.path, expected, fix, line=int(self.lines[world]), columns=columns)


def read_starts_table(path: str, columns: Columns) -> StartsTable:
    """Reads a file.

    Args:
        path: The file.
        columns: What it may have.

    Raises:
        ParameterError: The file cannot be read, or a column, a cell or a world is wrong.
    """
    lines = csv.reader(io.StringIO(_read(path, columns), newline=""))
    try:
        header = [name.strip() for name in next(lines, [])]
        _check_header(path, header, columns)
        numbers = []
        rows = []
        end = lines.line_num
        for cells in lines:
            line = end + 1
            end = lines.line_num  # a cell in quotes may go over several lines
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) != len(header):
                expected = (
                    f"{len(header)} cells separated by commas, as in the header; it has"
                    f" {len(cells)}"
                )
                raise _wrong(
                    path, expected, "Correct the line; the decimal mark is a point", line=line
                )
            numbers.append(line)
            rows.append(
                [_number(path, line, name, cell) for name, cell in zip(header, cells, strict=True)]
            )
    except csv.Error as error:
        raise _wrong(
            path,
            f"comma-separated values, it is none ({error})",
            "Correct the line",
            line=lines.line_num,
        ) from error
    if not rows:
        raise _wrong(path, "at least one world below the header", "Add rows")
    table = dict(zip(header, np.array(rows).T, strict=True))
    order = _order(path, table.pop("world"), numbers)
    return StartsTable(
        path, {name: column[order] for name, column in table.items()}, np.array(numbers)[order]
    )


def _read(path: str, columns: Columns) -> str:
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise _wrong(
            path,
            f"an existing file, there is none in {Path(path).absolute().parent}",
            "Correct the name",
        ) from error
    except OSError as error:
        raise _wrong(
            path, f"{_FORM}; it cannot be read ({error.strerror})", "Name a file: starts=worlds.csv"
        ) from error
    except UnicodeDecodeError as error:
        raise _wrong(path, f"{_FORM}; it is no text", "Save it as CSV in UTF-8") from error
    if not text.strip():
        raise _wrong(
            path,
            f"{_FORM}; it is empty",
            f"Write the header {','.join(columns.required)} and a row for each world",
        )
    return text


def _check_header(path: str, header: list[str], columns: Columns) -> None:
    known = [*columns.required, *columns.optional]
    for mark, name in ((";", "semicolons"), ("\t", "tabs")):
        if any(mark in cell for cell in header):
            fix = "Save it with commas between cells, and with points as decimal marks"
            raise _wrong(
                path, f"a header with commas between the columns, it has {name}", fix, line=1
            )
    if all(_is_number(cell) for cell in header):
        raise _wrong(
            path,
            "a header, there are numbers",
            f"Put {','.join(columns.required)} above them",
            line=1,
        )
    for number, name in enumerate(header, start=1):
        if not name:
            raise _wrong(
                path,
                f"a name in every cell of the header, cell {number} is empty",
                "Remove that column",
                line=1,
            )
        if name not in known:
            raise _wrong(
                path, f"no column '{_shown(name)}'", suggest(name, known).rstrip("."), line=1
            )
        if header.count(name) > 1:
            raise _wrong(
                path,
                f"column {name} once, it is there {header.count(name)} times",
                "Remove the others",
                line=1,
            )
    lacking = [name for name in columns.required if name not in header]
    if lacking:
        expected = (
            f"columns {', '.join(columns.required)}; {', '.join(lacking)}"
            f" {'is' if len(lacking) == 1 else 'are'} missing"
        )
        raise _wrong(path, expected, "Add it" if len(lacking) == 1 else "Add them", line=1)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell  # which Python allows between digits


def _number(path: str, line: int, name: str, cell: str) -> float:
    value = float(cell) if _is_number(cell) else math.nan
    if not math.isfinite(value):
        found = f"'{_shown(cell)}' is none" if cell.strip() else "the cell is empty"
        raise _wrong(path, f"a finite number, {found}", "Correct it", line=line, columns=[name])
    return value


def _order(path: str, worlds: np.ndarray, lines: list[int]) -> np.ndarray:
    """Row of each world."""
    seen: dict[int, int] = {}
    for world, line in zip(worlds, lines, strict=True):
        if world != int(world) or world < 0:
            raise _wrong(
                path,
                f"an integer of at least 0, it is {world:g}",
                "Correct it",
                line=line,
                columns=["world"],
            )
        if int(world) in seen:
            expected = f"each world once, {int(world)} is in line {seen[int(world)]} already"
            raise _wrong(path, expected, "Remove one of them", line=line, columns=["world"])
        seen[int(world)] = line
    missing = next((world for world in range(len(seen)) if world not in seen), None)
    if missing is not None:
        expected = (
            f"worlds 0 to {len(seen) - 1} in its {len(seen)} rows; world {missing} is missing"
        )
        raise _wrong(path, expected, "Number them anew", columns=["world"])
    return np.argsort(worlds)


def _shown(text: str) -> str:
    """On one line, and not long, whatever is in a cell."""
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def _wrong(
    path: str, expected: str, fix: str, *, line: int | None = None, columns: Sequence[str] = ()
) -> ParameterError:
    where = path if line is None else f"{path}, line {line}"
    if columns:
        where += f", column{'s' if len(columns) > 1 else ''} {', '.join(columns)}"
    return ParameterError("path", where, expected, fix)
