"""MkDocs hooks: the reference of the configuration, generated from its fields in each build;
and the pictures of the examples, which lie outside of the folder of the pages.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjstack.config import load_config
from mjstack.config.fields import field_docs
from mjstack.config.help import Key, list_groups, list_keys
from mjstack.config.schema import JOB_SCHEMAS, Config

if TYPE_CHECKING:  # the reference is made where MkDocs is not, too
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.nav import Navigation

MARKER = "<!-- reference -->"


def on_config(config: MkDocsConfig, **_: Any) -> MkDocsConfig:
    """Take the addresses of repository and site from pyproject.toml, which may have none."""
    text = (Path(config.docs_dir).parent / "pyproject.toml").read_text(encoding="utf-8")
    urls = tomllib.loads(text)["project"].get("urls", {})
    config.repo_url = urls.get("Repository")
    config.site_url = urls.get("Documentation", "")
    return config


def on_nav(nav: Navigation, config: MkDocsConfig, **_: Any) -> Navigation:
    """Write llms.txt: a line for each page, with its first sentence."""
    lines = [f"# {config.site_name}", "", f"> {config.site_description}", ""]
    for page in nav.pages:
        text = Path(page.file.abs_src_path or "").read_text(encoding="utf-8")
        first = re.search(r"(?m)^(?![#!<:]|\s*$|```).+(?:\n.+)*", text)
        words = " ".join(first[0].split()).partition(". ")[0].rstrip(".") if first else ""
        address = (config.site_url or "") + page.url
        lines.append(f"- [{page.title or page.file.name}]({address}): {words}".rstrip(": "))
    site = Path(config.site_dir)
    site.mkdir(parents=True, exist_ok=True)
    (site / "llms.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return nav


def on_files(files: Files, config: MkDocsConfig, **_: Any) -> Files:
    """Add the examples' pictures."""
    from mkdocs.structure.files import File

    for picture in sorted(Path(config.docs_dir).parent.glob("examples/*/*.png")):
        files.append(File(picture.name, str(picture.parent), config.site_dir, False))
    return files


def on_page_markdown(markdown: str, config: MkDocsConfig, **_: Any) -> str:
    """Put the reference in place of its marker, and have pictures of examples beside the pages.

    Pages of docs/history are in the repository alone: without its address, a link keeps its words.
    """
    target = rf"[\1]({config.repo_url}/blob/main/docs/\2)" if config.repo_url else r"\1"
    markdown = re.sub(r"\[([^]]+)\]\((history/[^)]+)\)", target, markdown)
    markdown = re.sub(r"\.\./examples/\w+/(\w+\.png)", r"\1", markdown)
    return markdown.replace(MARKER, reference_markdown()) if MARKER in markdown else markdown


def reference_markdown() -> str:
    """Every key of the default configuration and of the jobs as Markdown tables, by group."""
    cfg = load_config()
    words = field_docs(Config)
    groups = list_groups()
    sections: dict[str, list[Key]] = {}
    for key in list_keys(cfg, named=False):
        sections.setdefault(key.name.partition(".")[0] if "." in key.name else "", []).append(key)
    sections["job"] = []
    for name in JOB_SCHEMAS:
        own = list_keys(load_config([f"job={name}"]).job, "job", named=False)
        sections["job"] += [k for k in own if k.name not in ("job.name", "job.func")]
    text = []
    for section, keys in sections.items():
        choices = f" Choices: {', '.join(groups[section][0])}." if section in groups else ""
        text += [f"## {section or 'Top level'}", "", words.get(section, "") + choices, ""]
        text += ["| key | default | accepts | meaning |", "| --- | --- | --- | --- |"]
        for k in keys:
            cells = (f"`{k.name}`", f"`{k.value}`" if k.value else "", k.accepts, k.meaning)
            text.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
        text.append("")
    return "\n".join(text)
