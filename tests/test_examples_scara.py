"""The example robot does the stacking task, driven through the command line from its own folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mjstack.cli import run

SCARA = Path(__file__).parents[1] / "examples" / "scara"


@pytest.fixture
def command(tmp_path: Path) -> list[str]:
    return [
        f"--config-dir={SCARA}/conf",
        "robot=scara",
        "nworld=4",
        "sim=native",
        f"hydra.run.dir={tmp_path / 'out'}",
    ]


def test_it_stacks_from_nominal_and_from_random_starts(command: list[str], tmp_path: Path) -> None:
    assert run([*command, "gates=[baseline,batch,success]", "gate.batch.failed_worlds=0"]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [gate["status"] for gate in report["gates"]] == ["pass"] * 3
    assert report["gates"][2]["metrics"]["succeeded"] == 4


def test_its_profile_is_short() -> None:
    assert len((SCARA / "conf" / "robot" / "scara.yaml").read_text().splitlines()) <= 40
    assert (SCARA / "scara.png").stat().st_size < 150_000
