"""The files of a report: report.json for machines, and a format each for people."""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

from mjstack.report.html import to_html
from mjstack.report.page import Page
from mjstack.report.record import Report
from mjstack.report.sections import Part, Plots, Section, make_sections
from mjstack.report.table import Table
from mjstack.report.write import safely_write, write_report


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


Format = Callable[[Sequence[Section]], str]
FORMATS: dict[str, Format] = {"report.md": to_markdown, "report.html": to_html}


def write_formats(report: Report, page: Page) -> None:
    """Replace report.json and the report in every format, each in one step.

    Called after every result, so that nothing finished is lost. A format that fails takes no result
    back.

    Raises:
        OSError: report.json cannot be written.
    """
    write_report(report)
    sections = cache(lambda: make_sections(report, page))

    def write(path: Path, to_text: Format) -> None:
        path.write_text(to_text(sections()), encoding="utf-8")

    for name, to_text in FORMATS.items():
        safely_write(report.folder / name, write, to_text, stops=False)
