"""MkDocs hooks: the reference of the configuration, generated from its fields in each build;
and the pictures of the examples, which lie outside of the folder of the pages.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjstack.config import load_config
from mjstack.config.fields import field_docs
from mjstack.config.help import Key, list_groups, list_keys
from mjstack.config.schema import JOB_SCHEMAS, Config

if TYPE_CHECKING:  # the reference is made where MkDocs is not, too
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

MARKER = "<!-- reference -->"


def on_files(files: Files, config: MkDocsConfig, **_: Any) -> Files:
    """Add the examples' pictures."""
    from mkdocs.structure.files import File

    for picture in sorted(Path(config.docs_dir).parent.glob("examples/*/*.png")):
        files.append(File(picture.name, str(picture.parent), config.site_dir, False))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the reference in place of its marker, and have pictures of examples beside the pages."""
    markdown = re.sub(r"\.\./examples/\w+/(\w+\.png)", r"\1", markdown)
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
