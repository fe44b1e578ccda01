"""Lines that tell how far a job is where there is no terminal."""

import io

import pytest
from environments import Patch
from rich.console import Console

from mjstack.jobs import progress
from mjstack.jobs.progress import ProgressBar


class Clock:
    """Seconds that pass when a test says so."""

    now = 100.0

    def monotonic(self) -> float:
        """As ``time.monotonic``."""
        return self.now


@pytest.fixture
def clock(monkeypatch: Patch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    return clock


def test_a_unit_that_begins_in_the_middle_has_its_own_rate(clock: Clock) -> None:
    """A training that goes on at batch 700 has not made these 700 now, and its first report, late
    after what came before, knows no rate yet.
    """
    out = io.StringIO()
    bar = ProgressBar(Console(file=out, width=200))
    bar.start("train")
    clock.now += 20.0
    bar.advance("batches", 700, 1500)
    assert out.getvalue() == ""
    clock.now += 10.0
    bar.advance("batches", 720, 1500)
    assert out.getvalue() == "train: batches 720/1500, 2.0/s, 390 s left\n"
    clock.now += 90.0
    bar.advance("batches", 750, 1500)
    assert out.getvalue().endswith("\ntrain: batches 750/1500, 0.5/s, 1500 s left\n")


def test_a_unit_that_starts_over_is_timed_anew(clock: Clock) -> None:
    out = io.StringIO()
    bar = ProgressBar(Console(file=out, width=200))
    bar.start("batch")
    bar.advance("steps", 0, 600)
    clock.now += 10.0
    bar.advance("steps", 600, 600)
    bar.advance("steps", 100, 600)
    clock.now += 20.0
    bar.advance("steps", 200, 600)
    assert out.getvalue() == "batch: steps 200/600, 5.0/s, 80 s left\n"
