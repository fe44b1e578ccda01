"""Code blocks of the README and the pages in docs/.

A block with a title, such as `yaml title="lift/conf/task/lift.yaml"`, is a file. A `python` block
without one is a part of the page's program.
"""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TRAINS = "runner.learn("


def python_blocks(markdown: str) -> list[str]:
    """The blocks of the page's program."""
    return re.findall(r"(?m)^```python\n((?:.*\n)*?)```$", markdown)


def python_lines(markdown: str) -> str:
    """The program, everything else blank: a traceback's line number is the page's.

    Blocks that train are left out.
    """
    lines: list[str] = []
    begins = 0
    fence = ""
    for line in markdown.splitlines():
        opens = line.startswith("```")
        lines.append(line if fence == "```python" and not opens else "")
        if opens:
            if fence and any(TRAINS in line for line in lines[begins:]):
                lines[begins:] = [""] * (len(lines) - begins)
            begins = len(lines)
            fence = "" if fence else line.rstrip()
    assert not fence, "a block is not closed"
    return "\n".join(lines) + "\n"


def write_files(markdown: str, folder: Path) -> list[Path]:
    """Writes the titled blocks below a folder."""
    paths = []
    for name, content in re.findall(r'(?m)^```\w+ title="(.+)"\n((?:.*\n)*?)```$', markdown):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content, encoding="utf-8")
        paths.append(path)
    return paths
