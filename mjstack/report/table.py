"""Tables of text cells, as Markdown and on a terminal."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import rich.table
from rich.markup import escape

_NUMBER = re.compile(
    r"[-+(]?(\d|nan|inf)|-?$"
)  # begins as a number does, or says that none is known
Row = TypeVar("Row")


@dataclass(kw_only=True, slots=True)
class Table:
    """A table for people, all text.

    Attributes:
        title: Its heading.
        header: Names of the columns.
        rows: Cells, as many as there are columns.
    """

    title: str
    header: list[str]
    rows: list[list[str]]

    @classmethod
    def of(
        cls, title: str, columns: Mapping[str, Callable[[Row], str]], rows: Iterable[Row]
    ) -> "Table":
        """Make a table from records.

        Args:
            title: Its heading.
            columns: By name of the column, how a record is shown in it.
            rows: The records.
        """
        cells = [[show(row) for show in columns.values()] for row in rows]
        return cls(title=title, header=list(columns), rows=cells)

    def numeric(self) -> list[bool]:
        """Whether all cells of a column are numbers, for each column."""
        columns = zip(*self.rows, strict=True) if self.rows else [()] * len(self.header)
        return [all(_NUMBER.match(cell) for cell in column) for column in columns]

    def to_markdown(self) -> list[str]:
        """Lines of a Markdown table without its title; numbers are right-aligned."""
        rule = ["---:" if numeric else "---" for numeric in self.numeric()]
        rows = ([_escape(cell) for cell in row] for row in (self.header, rule, *self.rows))
        return [f"| {' | '.join(cells)} |" for cells in rows]

    def to_console(self, colors: Mapping[str, str] | None = None) -> rich.table.Table:
        """The table for a terminal.

        Args:
            colors: Colours of whole cells, by their text.
        """
        known = colors or {}
        table = rich.table.Table(title=escape(self.title) or None)
        for name, numeric in zip(self.header, self.numeric(), strict=True):
            table.add_column(name, justify="right" if numeric else "left", overflow="fold")
        for row in self.rows:
            table.add_row(
                *(f"[{known[c]}]{escape(c)}[/]" if c in known else escape(c) for c in row)
            )
        return table


def to_document(
    title: str, tables: Sequence[Table], notes: Sequence[str] = (), picture: str = ""
) -> str:
    """A Markdown file: title, tables, picture, and notes as a list.

    Args:
        title: The file's heading.
        tables: With a heading each, except those without a title.
        notes: A line each.
        picture: File name; empty for none.
    """
    lines = [f"# {title}"]
    for table in tables:
        lines += ["", f"## {table.title}"] if table.title else []
        lines += ["", *table.to_markdown()]
    if picture:
        lines += ["", f"![{picture}]({picture})"]
    if notes:
        lines += ["", *(f"- {note}" for note in notes)]
    return "\n".join(lines) + "\n"


def _escape(cell: str) -> str:
    """Text as a cell of a Markdown table."""
    return cell.replace("|", "\\|").replace("\n", " ")
