"""What the guides in docs/ show in Python runs, offline and without a GPU."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"
GUIDES = ["tutorial.md", *(name for name in ("terms.md", "datasets.md") if (DOCS / name).exists())]


def python_lines(markdown: str) -> str:
    """The ```python blocks, everything else blank: a traceback's line number is the guide's."""
    lines: list[str] = []
    fence = ""
    for line in markdown.splitlines():
        opens = line.startswith("```")
        lines.append(line if fence == "```python" and not opens else "")
        if opens:
            fence = "" if fence else line.rstrip()
    assert not fence, "a block is not closed"
    return "\n".join(lines) + "\n"


def test_lines_keep_their_numbers() -> None:
    text = "A\n\n```python\nx = 1\n```\n\n```console\n$ ls\n```\n\n```python\ny = x\n```\n"
    assert python_lines(text).split("\n")[:-1] == [
        "",
        "",
        "",
        "x = 1",
        "",
        "",
        "",
        "",
        "",
        "",
        "",
        "y = x",
        "",
    ]


@pytest.mark.parametrize("name", GUIDES)
def test_python_blocks_run(name: str, tmp_path: Path) -> None:
    """In a process and a file of their own: Warp reads the source of kernels, so they cannot come
    from a string.
    """
    program = python_lines((DOCS / name).read_text(encoding="utf-8"))
    assert program.strip(), f"{name} has no ```python block"
    script = tmp_path / f"{Path(name).stem}_blocks.py"
    script.write_text(program, encoding="utf-8")
    env = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"}
    run = subprocess.run(
        [sys.executable, str(script)],
        cwd=tmp_path,
        env=env,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert run.returncode == 0, f"line numbers are those of docs/{name}\n{run.stdout}\n{run.stderr}"
