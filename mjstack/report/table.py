"""Tables of text cells, and their writer for a terminal."""

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Self

import rich.console
import rich.table
from rich.markup import escape
from rich.text import Text
from typing_extensions import override

from mjstack.report.text import format_value

_CONTROL = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff]"
)


class Console(rich.console.Console):
    """A terminal that gets no control characters from texts: a text may be a stranger's."""

    def on_broken_pipe(self) -> None:
        """Go on without an output: a reader that has gone is no failure of a run."""
        os.dup2(os.open(os.devnull, os.O_WRONLY), self.file.fileno())

    @override
    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(_CONTROL.sub("", text), **options)


class Marked(str):
    """A text, and what a page makes of it.

    Attributes:
        grade: Colours it: ``good``, ``near``, ``bad`` or a status.
        share: Draws a bar that is filled to this share; None for none.
        link: Leads to this address; empty for none.
    """

    grade: str = ""
    share: float | None = None
    link: str = ""

    def __new__(cls, text: str, **attributes: str | float) -> Self:
        """Make a text."""
        marked = super().__new__(cls, text)
        vars(marked).update(attributes)
        return marked


@dataclass(kw_only=True, slots=True)
class Table:
    """A table for people, all text.

    Attributes:
        header: Names of the columns.
        rows: Cells, as many as there are columns; a `Marked` one is more than its text.
        title: Its heading; empty for none.
    """

    header: list[str]
    rows: list[list[str]]
    title: str = ""

    @classmethod
    def of(
        cls, columns: Mapping[str, str], rows: Iterable[Mapping[str, object]], title: str = ""
    ) -> Self:
        """Make a table from records, by the key of each column; "-" where one has none."""
        cells = [[format_value(row.get(key, "-")) for key in columns.values()] for row in rows]
        return cls(header=list(columns), rows=cells, title=title)

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
