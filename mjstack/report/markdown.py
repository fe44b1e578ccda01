"""Sections as Markdown, and tables as files."""

from collections.abc import Callable, Sequence
from pathlib import Path

from mjstack.files import write_atomic
from mjstack.report.sections import Part, Plots, Section
from mjstack.report.table import Table
from mjstack.report.write import safely_write


def to_markdown(sections: Sequence[Section]) -> str:
    """A Markdown file; plots are left out."""
    blocks = []
    for section in sections:
        blocks.append(f"{'#' * section.level} {section.heading}")
        for part in section.content:
            blocks += _blocks(part, section.level + 1)
    return "\n\n".join(blocks) + "\n"


def save_tables(
    path: Path,
    title: str,
    table: Table,
    notes: Sequence[str],
    csv: str,
    draw: Callable[[Path], object] | None = None,
    *,
    stops: bool = True,
) -> str:
    """Replace a table's files, ``path`` with the endings csv, md and, where ``draw`` is given, png.
    Markdown shows a picture that is there.

    Returns:
        Why there is no picture, as of `safely_write`.

    Raises:
        OSError: A file cannot be written.
    """
    picture = path.with_suffix(".png")
    problem = safely_write(picture, draw, stops=stops) if draw is not None else ""
    write_atomic(path.with_suffix(".csv"), csv)
    parts: list[Part] = [table, *([picture] if picture.exists() else []), list(notes)]
    text = to_markdown([Section(title=title, parts=parts, level=1)])
    write_atomic(path.with_suffix(".md"), text)
    return problem


def _blocks(part: Part, level: int) -> list[str]:
    match part:
        case str():
            return [part]
        case Path():
            return [f"![{part.name}]({part.name})"]
        case Table():
            title = [f"{'#' * level} {part.title}"] if part.title else []
            rule = ["---"] * len(part.header)
            return [*title, "\n".join(map(_row, [part.header, rule, *part.rows]))]
        case Plots():
            return []
    return ["\n".join(f"- {line}" for line in part)]


def _row(cells: Sequence[str]) -> str:
    """A row of a table, each cell in one line."""
    texts = (cell.replace("|", "\\|").replace("\n", " ") for cell in cells)
    return f"| {' | '.join(texts)} |"
