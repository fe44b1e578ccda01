"""MkDocs hooks: the reference of the configuration, generated from its fields in each build."""

from __future__ import annotations

from typing import Any

from mjstack.config.help import reference_markdown

MARKER = "<!-- reference -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the reference in place of its marker."""
    return markdown.replace(MARKER, reference_markdown()) if MARKER in markdown else markdown
