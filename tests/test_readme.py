"""What the README shows in Python runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

README = Path(__file__).resolve().parents[1] / "README.md"


def test_python_blocks_run(capsys: pytest.CaptureFixture[str]) -> None:
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.S)
    assert len(blocks) >= 2
    names: dict[str, object] = {}
    for block in blocks:  # one after the other: later blocks use what earlier ones defined
        exec(block, names)
    printed = capsys.readouterr().out
    assert "Seeed reBot DevArm 0.02" in printed
    assert "torch.Size([64, 22])" in printed
