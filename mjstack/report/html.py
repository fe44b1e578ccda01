"""Sections as one HTML page that needs no server, no script and no other file."""

import base64
import re
from collections.abc import Sequence
from html import escape
from itertools import groupby
from mimetypes import guess_type
from pathlib import Path

from mjstack.report.sections import Part, Plots, Section
from mjstack.report.table import Marked, Table

_ROWS = 40  # of a table that is not folded
_DIGITS = r"([-+]?[\d,.]+(e[-+]?\d+)?( [^\d\s]{1,4})?|[-+]?(nan|inf))"
_NUMBER = re.compile(rf"{_DIGITS}( / {_DIGITS})?|-")

# "Passed" and "failed" have a colour and a word each: no meaning hangs on the colour alone.
_STYLE = Path(__file__).with_name("page.css").read_text(encoding="utf-8")


def to_html(sections: Sequence[Section]) -> str:
    """The page. Tables that follow each other stand side by side, and so do pictures."""
    title = escape(sections[0].heading)
    body = "\n".join(map(_section, sections))
    return (
        f"<!doctype html>\n<html lang=en><head><meta charset=utf-8><title>{title}</title>"
        "<meta name=viewport content='width=device-width,initial-scale=1'>"
        "<link rel=icon href='data:,'>"
        f"<style>{_STYLE}</style></head>\n<body>\n{body}\n</body></html>\n"
    )


def _section(section: Section) -> str:
    """A heading and its parts."""
    title = escape(section.title)
    status = f" <b class={section.status}>{section.status}</b>" if section.status else ""
    blocks = [f"<h{section.level} id='{title}'>{title}{status}</h{section.level}>"]
    for css, parts in groupby(section.content, _row):
        text = "".join(map(_part, parts))
        blocks.append(f"<div class={css}>{text}</div>" if css else text)
    return "\n".join(blocks)


def _row(part: Part) -> str:
    """The class of a row that parts of a kind share; empty for a part that stands alone."""
    return "side" if isinstance(part, Table) else "pictures" if isinstance(part, Path) else ""


def _part(part: Part) -> str:
    match part:
        case str():
            return f"<p>{_text(part)}</p>"
        case Path():
            return _picture(part)
        case Table():
            return _table(part)
        case Plots():
            return (
                f"<h3>{escape(part.title)}</h3><p class=dim>{escape(part.text)}</p>"
                f"<div class=plots>{''.join(part.figures)}</div>"
            )
    return f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in part)}</ul>"


def _table(table: Table) -> str:
    """A table below its title; a long one is shown on request."""
    header = "".join(f"<th>{escape(name)}" for name in table.header)
    body = "".join(f"<tr>{''.join(map(_cell, row))}" for row in table.rows)
    text = f"<table><tr>{header}{body}</table>"
    title = escape(table.title)
    if len(table.rows) > _ROWS:
        return f"<details class=scroll><summary>{title or 'Table'}</summary>{text}</details>"
    return f"<div class=scroll>{f'<h3>{title}</h3>' if title else ''}{text}</div>"


def _cell(text: str) -> str:
    """A cell; a number stands to the right."""
    number = "n " if _NUMBER.fullmatch(text) else ""
    grade = text.grade if isinstance(text, Marked) else ""
    tip = f" title='{grade}'" if grade else ""
    return f"<td class='{number}{grade}'{tip}>{_text(text)}"


def _text(text: str) -> str:
    """A text with its bar and its link."""
    content = escape(text)
    if not isinstance(text, Marked):
        return content
    if text.share is not None:
        style = f"--w:{100.0 * text.share:.1f}%;--c:var(--{text.grade})"
        content = f"<i class=rate style='{style}'></i> {content}"
    return f"<a href='{escape(text.link)}'>{content}</a>" if text.link else content


def _picture(path: Path) -> str:
    """A picture with its bytes in the page; empty where it cannot be read."""
    try:
        content = base64.b64encode(path.read_bytes()).decode()
    except OSError:
        return ""
    kind, _ = guess_type(path)
    name = escape(path.name)
    return (
        f"<figure><img alt='{name}' src='data:{kind};base64,{content}'>"
        f"<figcaption>{name}</figcaption></figure>"
    )
