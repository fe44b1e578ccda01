"""The table and the picture of a sweep, and the experiment on throughput that is one."""

import contextlib
import csv
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import pytest
from compositions import load_config
from environments import Capture, Patch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjstack.cli import run
from mjstack.config.schema import Backend
from mjstack.errors import MjstackError
from mjstack.jobs import check_job, sweep, sweep_table
from mjstack.jobs.sweep import LOG, SweepJob, add_jobs
from mjstack.jobs.sweep_table import sweep_rows, write_summary
from mjstack.report.curves import Plot, Row, save_curves
from mjstack.report.figure import figures
from mjstack.report.record import GateResult, Report, Status
from mjstack.report.write import write_report

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "run.py"
RATE = "physics.world_steps_per_s.median"
TINY = [
    *("-m", "experiment=scaling", "sim=native", "gate.throughput.repetitions=1"),
    *("gate.throughput.steps=2", "gate.throughput.env_steps=1", "gate.throughput.start_worlds=1"),
]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: Patch) -> Path:
    """The folder of the experiment, below an empty one in which the test runs."""
    monkeypatch.chdir(tmp_path)
    return tmp_path / "outputs" / "sweeps" / "scaling-so101-stack"


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "summary.csv").open() as file:
        return list(csv.DictReader(file))


class InThisProcess:
    """Stands in for `Child`: the command line runs in this process, which has imported everything.
    The test of Ctrl-C starts real processes.
    """

    seconds = 1.0

    def __init__(self, args: Sequence[str], log: IO[bytes], **_: object) -> None:
        *overrides, target = args
        place = Path(target.removeprefix("hydra.run.dir=").strip("'"))
        with open(log.fileno(), "w", closefd=False) as text, contextlib.redirect_stdout(text):
            try:
                self.code = check_job(load_config(overrides), overrides).run(place).exit_code
            except MjstackError as error:
                print(f"mjstack: {error}")
                self.code = error.exit_code

    def poll(self) -> int:
        return self.code


def stamps(folder: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in folder.glob("*/report.json")}


@pytest.mark.full
@pytest.mark.long
def test_throughput_goes_on_and_leaves_table_and_plot(
    folder: Path, capsys: Capture, monkeypatch: Patch
) -> None:
    """One of the jobs has more worlds than there is memory for: a gap, and the next one starts."""
    monkeypatch.setattr(sweep, "Child", InThisProcess)
    assert run([*TINY, "nworld=1,2000000000"]) == 1
    before = stamps(folder)
    assert set(before) == {"0"}
    capsys.readouterr()
    assert run([*TINY, "nworld=1,2000000000,2"]) == 1
    assert stamps(folder).items() >= before.items()
    assert "job 0: pass, done before" in capsys.readouterr().out
    rows = table(folder)
    assert [row["status"] for row in rows] == ["pass", "out of memory", "pass"]
    assert [row["nworld"] for row in rows] == ["1", "2000000000", "2"]
    for row in rows[::2]:
        for rate, ms in (
            (RATE, "physics.ms_per_batched_step"),
            ("env_step.env_steps_per_s.median", "env_step.ms_per_env_step"),
        ):
            rate_found = 1e3 * int(row["nworld"]) / float(row[f"{ms}.median"])
            assert float(row[rate]) == pytest.approx(rate_found)
        assert not {"episode.seconds.median", "succeeded"} & set(row)  # they play no episode
    text = (folder / "summary.md").read_text()
    assert "| 2000000000 | - |" in text
    assert "![summary.png](summary.png)" in text
    assert (folder / "summary.png").stat().st_size > 10_000
    assert [path.name for path in Path().iterdir()] == ["outputs"]
    # Other jobs of the same numbers are not mixed with these.
    assert run([*TINY, "nworld=4,8"]) == 2
    assert "has another sweep, whose job 0 is nworld=1" in capsys.readouterr().err


def listed(folder: Path, *overrides: str) -> list[SweepJob]:
    jobs = [SweepJob(n, folder / str(n), (text,)) for n, text in enumerate(overrides)]
    add_jobs(folder, jobs)
    return jobs


def report(job: SweepJob, status: Status, reason: str = "", **metrics: float) -> Report:
    job.folder.mkdir(parents=True, exist_ok=True)
    gate = GateResult(name="batch", status=status, reason=reason, figures=figures(**metrics))
    facts = {"git_commit": "abc"}
    made = Report(folder=job.folder, overrides=list(job.overrides), provenance=facts)  # type: ignore[arg-type]
    made.gates = [gate]
    made.conclude()
    return made


@pytest.mark.parametrize(
    ("reason", "log", "status"),
    [
        ("RuntimeError: Failed to allocate 99 bytes on device 'cuda:0'", "", "out of memory"),
        ("internal error, OutOfMemoryError: CUDA out of memory.", "", "out of memory"),
        ("RuntimeError: bad", "Warp CUDA error 2: out of memory (in f)", "out of memory"),
        ("3 of 8 worlds failed", "", "fail"),
        ("exit status 2: mjstack: nworld=0: expected", "", "fail"),
        ("killed by signal 9", "", "out of memory"),
        ("killed by signal 11", "", "fail"),
    ],
)
def test_how_a_job_ended(tmp_path: Path, reason: str, log: str, status: str) -> None:
    (job,) = listed(tmp_path, "seed=1")
    write_report(report(job, Status.failed, reason))
    (job.folder / LOG).write_text(log)
    (row,) = sweep_rows(tmp_path, {})
    assert (row["status"], row["git_commit"], row["seed"]) == (status, "abc", 1)
    assert row["reason"] == f"batch: {reason}"


@pytest.mark.parametrize("text", [None, "", "{", "[" * 100_000, "[]", '{"status": "pass"}'])
def test_a_job_whose_report_cannot_be_read_has_not_run(tmp_path: Path, text: str | None) -> None:
    (job,) = listed(tmp_path, "nworld=4")
    if text is not None:
        job.folder.mkdir()
        (job.folder / "report.json").write_text(text)
    (row,) = sweep_rows(tmp_path, {})
    assert (row["job"], row["nworld"], row["status"]) == (0, 4, "not run")


def test_the_table_of_a_plain_sweep(tmp_path: Path) -> None:
    """What differs, the gates' results, and what tells most; names have no curves."""
    jobs = listed(tmp_path, "robot=so101", "robot=rebot", "robot=third")
    ended = [
        report(jobs[0], Status.passed, "all", succeeded=2.0),
        report(jobs[1], Status.failed, "a | b", succeeded=1.0),
    ]
    shown, problem = write_summary(tmp_path, dict(enumerate(ended)), draw=True)
    assert problem == ""
    assert shown.header == ["job", "robot", "batch", "succeeded", "status"]
    assert shown.rows[1] == ["1", "rebot", "fail: a | b", "1", "fail"]
    assert shown.rows[2] == ["2", "third", "-", "-", "not run"]
    assert "| 1 | rebot | fail: a \\| b | 1 | fail |" in (tmp_path / "summary.md").read_text()
    assert not (tmp_path / "summary.png").exists()


def test_a_result_has_its_details_in_the_files_alone(tmp_path: Path) -> None:
    jobs = listed(tmp_path, "seed=1", "seed=2")
    reason = "7 of 8 episodes succeeded (87.5 %), 97 % wanted; 1 of 8 episodes (4) failed"
    ended = {job.number: report(job, Status.failed, reason, succeeded=7.0) for job in jobs}
    table_shown, _ = write_summary(tmp_path, ended)
    assert table_shown.rows[0][2] == "fail: 7 of 8 episodes succeeded"
    assert f"| fail: {reason} |" in (tmp_path / "summary.md").read_text()
    assert table(tmp_path)[0]["batch"] == f"fail: {reason}"


def test_a_picture_names_its_keys_and_a_rate_ends_at_one(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    rows: list[Row] = [
        {
            "nworld": n,
            "robot": f"arm{n}",
            "gap": gap,
            "status": "pass",
            "success_rate": 1.0,
            RATE: 9,
        }
        for n in (1, 2)
        for gap in (0.01, 0.02)
    ]
    panels = {"rate": {"": "success_rate"}, "speed": {"": RATE}}
    figures: list[Any] = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: figures.append(self))
    plot = Plot(title="T", over="nworld", lines=["gap"], panels=panels)
    save_curves(tmp_path / "p.png", plot, rows)
    rate, speed = figures[0].axes
    assert rate.get_legend().get_title().get_text() == "gap"
    assert rate.get_ylim()[1] == 1.0
    assert speed.get_ylim()[1] > 9
    assert plot.shows(rows)
    assert not replace(plot, panels={"": {"": "missing"}}).shows(rows)


def test_a_picture_that_fails_takes_no_table_back(tmp_path: Path, monkeypatch: Patch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("no fonts")

    jobs = listed(tmp_path, "seed=1", "seed=2")
    monkeypatch.setattr(sweep_table, "save_curves", fail)
    ended = {job.number: report(job, Status.passed, succeeded=1.0) for job in jobs}
    _, problem = write_summary(tmp_path, ended, draw=True)
    assert problem == "summary.png was not written: no fonts"
    assert len(table(tmp_path)) == 2


def alive(marker: str) -> list[str]:
    """Processes whose environment has a marker."""
    numbers = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):
            if marker.encode() in path.read_bytes() and (path.parent / "cmdline").read_bytes():
                numbers.append(path.parent.name)
    return numbers


@pytest.mark.full
@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="no /proc here")
def test_ctrl_c_leaves_a_table_and_no_process(folder: Path) -> None:
    here = Path.cwd()
    marker = f"MJSTACK_TEST={here}"
    process = subprocess.Popen(
        [sys.executable, SCRIPT, *TINY, "nworld=64,1", "gate.throughput.steps=20000"],
        cwd=here,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"MJSTACK_TEST": str(here)},
        start_new_session=True,  # so that a failing test can end the run too
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        until = time.monotonic() + 120
        while not (folder / "0" / "report.json").exists():
            assert process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.1)
        assert len(alive(marker)) == 2
        os.kill(process.pid, signal.SIGINT)  # this process alone: a terminal would tell its child
        out, err = process.communicate(timeout=120)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 130
    assert "Traceback" not in err
    assert "summary: " in out
    assert [row["status"] for row in table(folder)] == ["interrupted", "not run"]
    assert alive(marker) == []


def test_jobs_of_the_experiment() -> None:
    native = load_config(["experiment=scaling", "robot=rebot", "sim=native", "nworld=4096"])
    assert (native.sim.backend, native.sim.device) == (Backend.native, "cpu")
    assert (native.gates, native.gate.throughput.steps) == (["throughput"], 60)
    assert native.gate.throughput.repetitions == 1
    mjwarp = load_config(["experiment=scaling", "sim=mjwarp", "nworld=2048", "sim.device=cpu"])
    assert (mjwarp.job.name, mjwarp.gates) == ("gates", ["batch", "throughput"])
    assert (mjwarp.sim.backend, mjwarp.sim.device) == (Backend.mjwarp, "cpu")
    assert mjwarp.gate.throughput.repetitions == 5
    assert not mjwarp.gate.throughput.native_baseline


PLOT = Plot(
    title="T", over="nworld", lines=["sim"], panels={"rate": {"": RATE}, "none": {"": "missing"}}
)


def rates(values: dict[str, dict[int, float]]) -> list[Row]:
    return [
        {"nworld": nworld, "sim": engine, "status": "pass", RATE: rate}
        for engine, by_worlds in values.items()
        for nworld, rate in by_worlds.items()
    ]


def test_a_job_that_failed_is_a_gap_even_with_figures(tmp_path: Path, monkeypatch: Patch) -> None:
    """Of three jobs the middle one measured physics and then failed."""
    rows = rates({"mjwarp": {1: 1.0, 10: 99.0, 100: 100.0}, "native": {1: 10.0, 10: 10, 100: 10}})
    rows[1]["status"] = "fail"
    drawn: list[tuple[str, list[float]]] = []
    plot = Axes.plot

    def spy(self: Axes, x: Any, y: Any, *args: Any, **kwargs: Any) -> Any:
        drawn.append((str(kwargs.get("label", "x")), [float(value) for value in y]))
        return plot(self, x, y, *args, **kwargs)

    monkeypatch.setattr(Axes, "plot", spy)
    save_curves(tmp_path / "p.png", PLOT, rows)
    (curve,) = [y for label, y in drawn if label == "mjwarp"]
    assert [math.isnan(value) for value in curve] == [False, True, False]
    assert [len(y) for label, y in drawn if label == "x"] == [1, 0, 1, 0]
