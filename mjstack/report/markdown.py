"""Sections as Markdown."""

from collections.abc import Sequence
from pathlib import Path

from mjstack.report.sections import Part, Plots, Section
from mjstack.report.table import Table


def to_markdown(sections: Sequence[Section]) -> str:
    """A Markdown file; plots are left out."""
    blocks = []
    for section in sections:
        blocks.append(f"{'#' * section.level} {section.heading}")
        for part in section.content:
            blocks += _blocks(part, section.level + 1)
    return "\n\n".join(blocks) + "\n"


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
