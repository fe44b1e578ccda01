"""MkDocs hooks: the reference of the configuration, generated from its fields in each build."""

from __future__ import annotations

from typing import Any

from mjstack.config import load_config
from mjstack.config.fields import field_docs
from mjstack.config.help import Key, list_groups, list_keys
from mjstack.config.schema import JOB_SCHEMAS, Config

MARKER = "<!-- reference -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the reference in place of its marker."""
    return markdown.replace(MARKER, reference_markdown()) if MARKER in markdown else markdown


def reference_markdown() -> str:
    """Every key of the default configuration and of the jobs as Markdown tables, by group."""
    cfg = load_config()
    words = field_docs(Config)
    groups = {group.name: group for group in list_groups()}
    sections: dict[str, list[Key]] = {}
    for key in list_keys(cfg, named=False):
        sections.setdefault(key.name.partition(".")[0] if "." in key.name else "", []).append(key)
    sections["job"] = []
    for name in JOB_SCHEMAS:
        own = list_keys(load_config([f"job={name}"]).job, "job", named=False)
        sections["job"] += [k for k in own if k.name not in ("job.name", "job.func")]
    text = []
    for section, keys in sections.items():
        choices = f" Choices: {', '.join(groups[section].choices)}." if section in groups else ""
        text += [f"## {section or 'Top level'}", "", words.get(section, "") + choices, ""]
        text += ["| key | default | accepts | meaning |", "| --- | --- | --- | --- |"]
        for k in keys:
            cells = (f"`{k.name}`", f"`{k.value}`" if k.value else "", k.accepts, k.words)
            text.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
        text.append("")
    return "\n".join(text)
