"""The report file: whole or not at all, always JSON, and what its status means."""

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from environments import Patch

from mjstack.files import write_atomic
from mjstack.report import formats
from mjstack.report.figure import Figure, figures
from mjstack.report.page import Page
from mjstack.report.record import GateResult, Report, Status
from mjstack.report.sections import Section
from mjstack.report.write import safely_write


def gate(status: Status, name: str = "g", **numbers: float) -> GateResult:
    return GateResult(name=name, status=status, figures=figures(**numbers))


def write_report(report: Report) -> None:
    formats.write_formats(report, Page())


def strict_json(path: Path) -> dict:
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    return json.loads(path.read_text(), parse_constant=refuse)


@pytest.mark.parametrize("function", ["replace", "fsync"])
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_failed_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: Patch, function: str, error: BaseException
) -> None:
    path = tmp_path / "report.json"
    write_atomic(path, "old")

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(os, function, fail)
    with pytest.raises(type(error)):
        write_atomic(path, "new" * 10_000)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["report.json"]


def test_file_appears_complete(tmp_path: Path, monkeypatch: Patch) -> None:
    path = tmp_path / "report.json"
    seen = []
    replace = os.replace

    def spy(source: str, target: Path) -> None:
        seen.append((Path(source).read_text(), path.exists()))
        replace(source, target)

    monkeypatch.setattr(os, "replace", spy)
    write_atomic(path, "text")
    assert seen == [("text", False)]
    assert path.stat().st_mode & 0o777 == 0o644


def test_numbers_that_are_not_finite_stay_json(tmp_path: Path) -> None:
    bad = gate(Status.failed, a=math.nan, b=math.inf, c=-math.inf, d=0.5)
    bad.figures.append(Figure("t", high=math.nan))
    facts = {"x": math.nan, "versions": {"y": math.inf}}
    report = Report(folder=tmp_path, provenance=facts, gates=[bad])
    report.conclude()
    write_report(report)
    data = strict_json(tmp_path / "report.json")
    assert data["gates"][0]["metrics"] == {"a": "nan", "b": "inf", "c": "-inf", "d": 0.5}
    assert data["schema"] == 3
    assert data["status"] == "fail"
    assert "nan" in (tmp_path / "report.md").read_text()


def test_a_format_is_a_function_of_sections_and_takes_no_result_back(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    def broken(sections: Sequence[Section]) -> str:
        raise ValueError

    def plain(sections: Sequence[Section]) -> str:
        return "\n".join(section.heading for section in sections)

    monkeypatch.setattr(formats, "FORMATS", {"report.md": broken, "report.txt": plain})
    write_report(Report(folder=tmp_path, gates=[gate(Status.passed)]))
    assert sorted(os.listdir(tmp_path)) == ["report.json", "report.txt"]
    assert strict_json(tmp_path / "report.json")["status"] == "interrupted"  # before the end
    text = (tmp_path / "report.txt").read_text()
    assert text == "mjstack run: interrupted\ng: pass\nProvenance"


@pytest.mark.parametrize(
    ("outcomes", "expected"),
    [
        ([Status.passed], Status.passed),
        ([Status.passed, Status.skipped], Status.passed),
        ([Status.passed, Status.failed], Status.failed),
        ([Status.failed, Status.skipped], Status.failed),
        ([Status.skipped], Status.failed),
        ([], Status.failed),
    ],
)
def test_conclude(outcomes: list[Status], expected: Status) -> None:
    report = Report(folder=Path(), gates=[gate(status) for status in outcomes])
    report.conclude()
    assert report.status is expected


def test_markdown_has_every_gate_and_skip(tmp_path: Path) -> None:
    skip = GateResult(name="throughput_cuda", status=Status.skipped, reason="no CUDA device")
    gates = [gate(Status.passed, "baseline", xy=0.1), skip]
    write_report(Report(folder=tmp_path, provenance={"device": "cpu"}, gates=gates))
    text = (tmp_path / "report.md").read_text()
    assert "## baseline: pass" in text
    assert "| xy | 0.1 |" in text
    assert "\n## throughput_cuda: skip\n\nno CUDA device\n" in text


def test_table_cells_survive_a_bar_in_a_reason(tmp_path: Path) -> None:
    bad = GateResult(name="baseline", status=Status.failed, reason="a | b")
    write_report(Report(folder=tmp_path, gates=[bad]))
    lines = (tmp_path / "report.md").read_text().splitlines()
    (row,) = (line for line in lines if line.startswith("| baseline"))
    assert row.replace("\\|", "").count("|") == 5


def test_figures_and_limits_have_a_row_each(tmp_path: Path) -> None:
    """Repetitions as median and range, the rest with its unit; tables as in test_page.py."""
    rate = {"median": 12_000.0, "min": 11_500.0, "max": 12_500.0}
    measured = [
        Figure("world_steps", value, "/s", "physics", column=end) for end, value in rate.items()
    ]
    measured += [
        Figure("captured", True, group="physics"),
        *(
            Figure(field, 2e-7, group=f"lifted.{step}", high=1e-6)
            for step in ("step1", "step50")
            for field in ("qpos", "qvel")
        ),
        Figure("distance", 0.002, "m", high=0.01),
        Figure("rate", 0.95, low=0.9),
        Figure("margin", high=1.25),
        Figure("shared", 1.0, "N", "final.red", high=2.0, limit="final.shared_n"),
    ]
    result = GateResult(
        name="parity", status=Status.passed, figures=measured, notes={"backend": "native"}
    )
    assert {f"physics.world_steps_per_s.{end}" for end in rate} <= result.metrics.keys()
    assert result.metrics["final.red.shared_n"] == 1.0
    assert result.thresholds == {
        **{f"lifted.step{n}.{field}": 1e-6 for n in (1, 50) for field in ("qpos", "qvel")},
        **{"distance_m": 0.01, "rate_min": 0.9, "margin": 1.25, "final.shared_n": 2.0},
    }
    write_report(Report(folder=tmp_path, gates=[result]))
    text = (tmp_path / "report.md").read_text()
    assert "| physics: world steps | 12,000 /s | 11,500 /s | 12,500 /s |" in text
    assert "| lifted, step1 | 2e-07 / 1e-06 | 2e-07 / 1e-06 |" in text
    assert "| distance | 0.002 m | at most 0.01 m |" in text
    assert "| final, red: shared | 1 N | at most 2 N |" in text
    assert "| physics: captured | yes |" in text
    assert "| backend | native |" in text
    assert "| margin | 1.25 |" in text
    assert "step1.qpos" not in text


def test_a_failed_picture_is_a_line_and_leaves_no_part(tmp_path: Path) -> None:
    path = tmp_path / "a.png"

    def fail(target: Path, text: str) -> None:
        target.write_text(text)
        raise OSError(28, "No space left on device")

    assert safely_write(path, fail, "part") == "a.png was not written: No space left on device"
    assert not path.exists()
    assert safely_write(path, Path.write_text, "all") == ""
    assert path.read_text() == "all"


@pytest.mark.full
def test_a_gate_may_return_numpy_scalars_and_a_median_alone(tmp_path: Path) -> None:
    own = gate(Status.passed, small=np.float32(0.5), count=np.int64(3), good=np.bool_(True))
    own.figures.append(Figure("gap", 0.25, "m", column="median"))
    write_report(Report(folder=tmp_path, gates=[own]))
    (held,) = strict_json(tmp_path / "report.json")["gates"]
    assert held["metrics"] == {"small": 0.5, "count": 3, "good": True, "gap_m.median": 0.25}
    assert "| gap: median | 0.25 m |" in (tmp_path / "report.md").read_text()
