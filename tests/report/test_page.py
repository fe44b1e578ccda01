"""The page of a run: it needs nothing but itself, reads like tables, and trusts no text."""

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mjstack.report.figure import Figure
from mjstack.report.html import to_html
from mjstack.report.page import Map, Page, Worlds
from mjstack.report.record import GateResult, Report, Status
from mjstack.report.sections import make_sections
from mjstack.report.table import Table

VOID = {"br", "img", "link", "meta"}
IMPLIED = {"td", "th", "tr"}  # HTML ends these by itself


class Reader(HTMLParser):
    """Reads a page: addresses, tables as cells, text, and tags left open."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.in_cell = False
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.addresses += [str(v) for name, v in attrs if name in ("src", "href", "action")]
        if tag not in VOID | IMPLIED and not self.get_starttag_text().endswith("/>"):
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        self.in_cell = tag in ("td", "th") or (self.in_cell and tag not in ("tr", "table"))
        if tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)

    def handle_endtag(self, tag: str) -> None:
        if tag not in IMPLIED:
            assert self.open.pop() == tag
        self.in_cell = self.in_cell and tag not in ("td", "th", "table")

    def handle_data(self, data: str) -> None:
        if self.in_cell:
            self.tables[-1][-1][-1] += data


def batch(count: int) -> tuple[GateResult, Worlds]:
    """A gate and its episodes, of which those divisible by 5 failed."""
    rng = np.random.default_rng(0)
    broken = [["STACKED"] if world % 5 == 0 else [] for world in range(count)]
    table = ([0.3, 0.0, 0.0], [0.2, 0.3, 0.02])
    worlds = Worlds(
        names=[str(world) for world in range(count)],
        broken=broken,
        rules={"STACKED": "not stacked"},
        values=[
            (Figure("xy_err", unit="m", high=0.015), rng.uniform(0.0, 0.02, count)),
            (Figure("steps"), np.full(count, 600.0)),
            (
                Figure("lost", unit="m"),
                np.where(np.arange(count) == 1, np.nan, rng.uniform(0.0, 1.0, count)),
            ),
        ],
        maps=[Map(title="red", xy=rng.uniform(0.1, 0.2, (count, 2)), table=table)],
    )
    gate = GateResult(
        name="batch",
        status=Status.failed,
        reason="some failed",
        figures=[
            Figure("xy_err_max", 0.02, "m", high=0.015),
            Figure("dz", 0.04, "m", low=0.03, high=0.05),
            Figure("far", 1.0, "m", "final.red"),
            Figure("far", 2.0, "m", "final.blue"),
            Figure("window", unit="steps", high=50),
        ],
    )
    return gate, worlds


def page(tmp_path: Path, count: int = 64) -> str:
    gate, worlds = batch(count)
    parity = GateResult(
        name="parity",
        status=Status.passed,
        figures=[
            Figure("qpos", 2e-7, group="lifted.step1", high=1e-6),
            Figure("qvel", 4e-4, group="lifted.step1", high=1e-4),
            Figure("qpos", 8e-7, group="placed.step1", high=1e-6),
            Figure("qvel", 8e-5, group="placed.step1", high=1e-4),
        ],
    )
    Image.new("L", (1, 1)).save(tmp_path / "scene.png")
    report = Report(
        folder=tmp_path,
        overrides=["robot=so101"],
        provenance={"date": "today", "device": "cpu", "versions": {"mujoco": "4.0.0"}},
        gates=[parity, gate],
        pictures=["scene.png", "missing.png"],
    )
    shown = Page(worlds={"batch": worlds}, episode="episode.html")
    return to_html(make_sections(report, shown))


def batch_page(folder: Path, gate: GateResult, worlds: Worlds) -> str:
    report = Report(folder=folder, gates=[gate])
    return to_html(make_sections(report, Page(worlds={"batch": worlds})))


def test_the_page_asks_for_nothing_but_itself(tmp_path: Path) -> None:
    text = page(tmp_path)
    reader = Reader(text)
    assert reader.open == []
    assert not reader.tags & {"script", "iframe", "object"}
    outside = {a for a in reader.addresses if not a.startswith(("data:", "#"))}
    assert outside == {"episode.html"}  # a link, not a source
    assert not re.search(r"https?:|url\(|@import", text)
    assert text.count("data:image/png;base64,") == 1


def test_gates_are_tables(tmp_path: Path) -> None:
    tables = Reader(page(tmp_path)).tables
    (differences,) = (t for t in tables if "qpos" in t[0])
    assert differences[0] == ["", "qpos", "qvel"]
    assert differences[1] == ["lifted, step1", "2e-07 / 1e-06", "0.0004 / 0.0001"]
    assert differences[2] == ["placed, step1", "8e-07 / 1e-06", "8e-05 / 0.0001"]
    assert [["", "far"], ["final, red", "1 m"], ["final, blue", "2 m"]] in tables
    assert ["dz", "0.04 m", "0.03 m to 0.05 m"] in [row for t in tables for row in t]
    assert ["xy err max", "0.02 m", "at most 0.015 m"] in [row for t in tables for row in t]
    assert ["window", "50 steps"] in [row for t in tables for row in t]
    (outcomes,) = (t for t in tables if t[0][:1] == ["outcome"])
    assert [row[:3] for row in outcomes[1:]] == [
        ["success", "", "51"],
        ["STACKED", "not stacked", "13"],
    ]


def test_a_broken_threshold_is_red(tmp_path: Path) -> None:
    cells = re.findall(r"<td class='([^']*)'[^>]*>([\d.]+ m)", page(tmp_path))
    grades = {text: "bad" in kinds.split() for kinds, text in cells}
    assert grades["0.02 m"]  # xy err
    assert not grades["0.04 m"]  # dz


def test_histograms_count_every_world(tmp_path: Path) -> None:
    text = page(tmp_path)
    plots = re.findall(r"<figure><figcaption>(.*?)</figcaption>(.*?)</figure>", text)
    found = {}
    for name, plot in plots:
        tips = re.findall(r": (\d+)(?:, (\d+) failed)?</title>", plot)
        found[name] = (sum(int(n) for n, _ in tips), sum(int(bad or 0) for _, bad in tips))
    assert found["xy err"] == (64, 13)
    assert found["lost, 1 not finite"] == (63, 13)
    assert "steps" not in found  # all the same
    assert "threshold 0.015 m" in text


@pytest.mark.parametrize(("count", "failed"), [(10_000, 2000), (20_000, 3000)])
def test_maps_of_a_large_batch_show_failed_worlds_first(
    tmp_path: Path, count: int, failed: int
) -> None:
    text = page(tmp_path, count)
    assert text.count("<path class=x") == failed
    assert text.count("<circle class=o") == 3000 - failed
    assert f"3,000 of {count:,} are drawn, failed ones first." in text
    assert len(text) < 1e6


def test_maps_show_ways(tmp_path: Path) -> None:
    """A line per episode from the start on, one point while the object rests; what is not finite
    is left out.
    """
    gate, worlds = batch(8)
    way = np.array([[0.1, 0.1], [0.1, 0.1], [0.3, 0.1], [np.nan, np.nan], [0.1, 0.1]])
    lost = np.full((3, 2), np.nan)
    worlds.maps[0].ways = [("5: STACKED", True, way), ("1", False, way[:3]), ("2", False, lost)]
    text = batch_page(tmp_path, gate, worlds)
    assert re.findall(r"<path class='?(w[ x]*)'? d='(.*?)'><title>(.*?)<", text) == [
        ("w", "M123 246L123 123", "1"),
        ("w x", "M123 246L123 123L123 246", "5: STACKED"),
    ]
    assert " ways in 3 of the episodes." in text


def test_the_limits_of_a_value_are_dashed(tmp_path: Path) -> None:
    """One end, the other, or both."""
    gate, worlds = batch(64)
    span = np.linspace(0.5, 2.0, 64)
    ends = ({"low": 1.0}, {"high": 1.5}, {"low": 0.75, "high": 1.25}, {})
    worlds.values = [(Figure(f"value {len(end)}", unit="m", **end), span) for end in ends]
    text = batch_page(tmp_path, gate, worlds)
    limits = [
        re.findall(r"<title>threshold ([\d.]+) m<", plot)
        for plot in re.findall(r"<figure><figcaption>.*?</figure>", text)[:4]
    ]
    assert limits == [["1"], ["1.5"], ["0.75", "1.25"], []]


def test_maps_show_what_is_judged(tmp_path: Path) -> None:
    """A place that stays is marked by its name in each map; what the check does not judge, and what
    the pages do not show, is said.
    """
    gate, worlds = batch(8)
    worlds.maps[0].marks = {"goal": [0.3, 0.1]}
    worlds.unjudged = ["dummy"]
    report = Report(folder=tmp_path, gates=[gate])
    page = Page(worlds={"batch": worlds}, notes=["web.episode=false"])
    text = to_html(make_sections(report, page))
    (x, y) = re.findall(r"<text x=([\d.]+) y=([\d.]+)>goal</text>", text)[0]
    scale = 320 / 0.52  # the table's far edge at the top, 2 cm behind the base at the bottom
    assert float(x) - 6 == pytest.approx(scale * 0.2, abs=0.1)
    assert float(y) - 4 == pytest.approx(scale * 0.2, abs=0.1)
    assert "The check does not judge dummy." in text
    assert "<li>web.episode=false" in text


def test_text_is_not_markup(tmp_path: Path) -> None:
    bad = "<script>alert(1)</script>'\"&"
    gate = GateResult(
        name=bad,
        status=Status.failed,
        reason=bad,
        figures=[Figure(bad, 1.0, bad, high=2.0), Figure(f"{bad}x", high=1.0)],
        notes={bad: bad},
        details=[bad],
        tables=[Table(title=bad, header=[bad], rows=[[bad]])],
    )
    two = np.array([0.0, 1.0])
    ways = [(bad, True, np.zeros((2, 2)))]
    maps = [Map(title=bad, xy=np.zeros((2, 2)), table=([0.3, 0.0], [0.2, 0.3]), ways=ways)]
    worlds = Worlds(
        names=[bad] * 2,
        broken=[[bad], []],
        rules={bad: bad},
        values=[(Figure(bad), two)],
        maps=maps,
    )
    report = Report(folder=tmp_path, provenance={bad: bad}, gates=[gate])
    shown = Page(title=bad, command=bad, worlds={bad: worlds}, notes=[bad])
    reader = Reader(to_html(make_sections(report, shown)))
    assert "script" not in reader.tags
    assert reader.open == []


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_have_a_page(tmp_path: Path, value: float) -> None:
    gate, worlds = batch(8)
    worlds.values[0][1][:] = value
    worlds.maps[0].xy[:] = value
    gate.figures.append(Figure("qpos", value, group="lifted.step1", high=value))
    text = batch_page(tmp_path, gate, worlds)
    assert str(float(value)) in text
