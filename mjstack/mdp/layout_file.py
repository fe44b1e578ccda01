"""A file of layouts: a CSV with a header and one row per world, read and checked cell by cell."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjstack.errors import ParameterError, suggest

_FORM = "a CSV file with a header and one row per world, as mjstack.mdp.layout.write_layout leaves it"


@dataclass(frozen=True, slots=True)
class Columns:
    """Names of a layout file's columns for one robot.

    Attributes:
        required: Every file has them.
        optional: Each may be there or not.
    """

    required: Sequence[str]
    optional: Sequence[str]


def column_names(objects: Sequence[str], joints: Sequence[str], friction: Sequence[str]) -> Columns:
    """The columns, in the order in which they are written.

    Args:
        objects: Names of the cubes, such as ``red_cube``.
        joints: Names of the robot's joints.
        friction: Whose friction may be given: the cubes, and ``grip`` where the jaws have their own.
    """
    cubes = [short(name) for name in objects]
    places = [f"{cube}_{part}" for cube in cubes for part in ("x_m", "y_m", "yaw_rad")]
    optional = [f"joint_{name}" for name in joints] + [f"{cube}_mass_kg" for cube in cubes]
    optional += [f"{short(name)}_friction" for name in friction] + [f"gain_{name}" for name in joints]
    return Columns(["world", *places], optional)


def short(name: str) -> str:
    """``red`` for ``red_cube``."""
    return name.removesuffix("_cube")


def read_layout_file(path: str, columns: Columns) -> dict[str, np.ndarray]:
    """Reads a file.

    Args:
        path: The file.
        columns: What it may have.

    Returns:
        A column per name, each ``(rows,)``, float64, with world w in row w.

    Raises:
        ParameterError: The file cannot be read, or a column, a cell or a world is wrong.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise _wrong(
            path, f"{_FORM}; it cannot be read ({error.strerror})", "Name an existing file: layout=worlds.csv"
        ) from error
    except UnicodeDecodeError as error:
        raise _wrong(path, f"{_FORM}; it is no text", "Save it as UTF-8") from error
    lines = csv.reader(io.StringIO(text, newline=""))
    try:
        header = [name.strip() for name in next(lines, [])]
        _check_header(path, header, columns)
        numbers, rows = [], []
        for cells in lines:
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) != len(header):
                raise _wrong(path, f"{len(header)} cells in line {lines.line_num}, it has {len(cells)}", "Correct the line")
            numbers.append(lines.line_num)
            rows.append([_number(path, lines.line_num, name, cell) for name, cell in zip(header, cells, strict=True)])
    except csv.Error as error:
        raise _wrong(path, f"{_FORM}; line {lines.line_num} is no CSV ({error})", "Correct the line") from error
    if not rows:
        raise _wrong(path, "at least one world below the header", "Add rows")
    table = dict(zip(header, np.array(rows).T, strict=True))
    order = _order(path, table.pop("world"), numbers)
    return {name: column[order] for name, column in table.items()}


def _check_header(path: str, header: list[str], columns: Columns) -> None:
    known = [*columns.required, *columns.optional]
    for name in header:
        if name not in known:
            raise _wrong(path, f"no column '{name}'", suggest(name, known).rstrip("."))
        if header.count(name) > 1:
            raise _wrong(path, f"column '{name}' once, it is there {header.count(name)} times", "Remove the others")
    lacking = [name for name in columns.required if name not in header]
    if lacking:
        raise _wrong(path, f"columns {', '.join(columns.required)}; {', '.join(lacking)} is missing", "Add it")


def _number(path: str, line: int, name: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise _wrong(path, f"a finite number in column {name}, line {line} has '{cell.strip()}'", "Correct it")
    return value


def _order(path: str, worlds: np.ndarray, lines: list[int]) -> np.ndarray:
    """Row of each world."""
    seen: dict[int, int] = {}
    for world, line in zip(worlds, lines, strict=True):
        if world != int(world) or world < 0:
            raise _wrong(path, f"an integer of at least 0 in column world, line {line} has {world:g}", "Correct it")
        if int(world) in seen:
            raise _wrong(path, f"each world once, {int(world)} is in lines {seen[int(world)]} and {line}", "Remove one")
        seen[int(world)] = line
    missing = next((world for world in range(len(seen)) if world not in seen), None)
    if missing is not None:
        raise _wrong(
            path, f"worlds 0 to {len(seen) - 1} in its {len(seen)} rows; world {missing} is missing", "Number them anew"
        )
    return np.argsort(worlds)


def _wrong(path: str, expected: str, fix: str) -> ParameterError:
    return ParameterError("path", path, expected, fix)
