"""Tables of text cells, as Markdown and on a terminal."""

import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import rich.console
import rich.table
from rich.markup import escape
from rich.text import Text

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


class Console(rich.console.Console):
    """A terminal that gets no control characters from texts: a text may be a stranger's."""

    def on_broken_pipe(self) -> None:
        """Go on without an output: a reader that has gone is no failure of a run."""
        os.dup2(os.open(os.devnull, os.O_WRONLY), self.file.fileno())

    def render_str(self, text: str, **options: Any) -> Text:
        """See `rich.console.Console`."""
        return super().render_str(_CONTROL.sub("", text), **options)


@dataclass(kw_only=True, slots=True)
class Table:
    """A table for people, all text.

    Attributes:
        header: Names of the columns.
        rows: Cells, as many as there are columns.
        title: Its heading; empty for none.
    """

    header: list[str]
    rows: list[list[str]]
    title: str = ""

    @classmethod
    def of(
        cls, columns: Mapping[str, str], rows: Iterable[Mapping[str, object]], title: str = ""
    ) -> "Table":
        """Make a table from records, with the key of each column's values; "-" where a record has
        none.
        """
        cells = [[format_value(row.get(key, "-")) for key in columns.values()] for row in rows]
        return cls(header=list(columns), rows=cells, title=title)

    def to_markdown(self) -> list[str]:
        """Lines of a Markdown table without its title."""
        rule = ["---"] * len(self.header)
        rows = ([_escape(cell) for cell in row] for row in (self.header, rule, *self.rows))
        return [f"| {' | '.join(cells)} |" for cells in rows]

    def to_console(self, colors: Mapping[str, str] | None = None) -> rich.table.Table:
        """The table for a terminal, with colours of whole cells by their text."""
        known = colors or {}
        table = rich.table.Table(title=escape(self.title) or None)
        for name in self.header:
            table.add_column(name, overflow="fold")
        for row in self.rows:
            table.add_row(
                *(f"[{known[c]}]{escape(c)}[/]" if c in known else escape(c) for c in row)
            )
        return table


def format_value(value: object) -> str:
    """A number with as many digits as a reader needs; other values as they are."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:,.0f}" if 1e4 <= abs(value) < math.inf else f"{value:.4g}"
    return "" if value is None else str(value)


def to_document(
    title: str,
    tables: Sequence[Table] = (),
    notes: Sequence[str] = (),
    pictures: Sequence[str] = (),
    text: str = "",
    level: int = 1,
) -> str:
    """A Markdown file, or a section of one: heading, text, tables, pictures, notes as a list."""
    parts = [f"{'#' * level} {title}", *filter(None, [text])]
    for table in tables:
        parts += [f"{'#' * (level + 1)} {table.title}"] if table.title else []
        parts.append("\n".join(table.to_markdown()))
    parts += [f"![{picture}]({picture})" for picture in pictures]
    parts += ["\n".join(f"- {note}" for note in notes)] if notes else []
    return "\n\n".join(parts) + "\n"


def _escape(cell: str) -> str:
    """Text as a cell of a Markdown table."""
    return cell.replace("|", "\\|").replace("\n", " ")
