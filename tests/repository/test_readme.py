"""The README: its Python runs, its links lead somewhere, and it stays short."""

import re
import sys
from pathlib import Path

from doc_blocks import ROOT, python_blocks, write_files
from environments import Capture, Patch

README = ROOT / "README.md"


def test_python_blocks_run(capsys: Capture, tmp_path: Path, monkeypatch: Patch) -> None:
    write_files(README.read_text(), tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    names: dict[str, object] = {}
    try:
        for block in python_blocks(README.read_text()):  # later ones use names of earlier ones
            exec(block, names)
    finally:
        sys.modules.pop("mine", None)  # a page has another module of this name
    assert "'policy': (64, 24)" in capsys.readouterr().out


def test_it_is_short() -> None:
    text = README.read_text()
    lines = text.splitlines()
    assert len(lines) <= 150
    assert len(text.split()) <= 900
    assert [line for line in lines if len(line) > 100] == []


def test_links_lead_to_files() -> None:
    targets = re.findall(r"\]\(([^)#]+)", README.read_text())
    assert len(targets) > 10
    assert [target for target in targets if not (README.parent / target).is_file()] == []
