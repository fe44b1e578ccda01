"""Sweeps whose jobs run in processes: a queue over GPUs."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from environments import Capture, Patch
from test_run_folder import contents

from mjstack import process
from mjstack.errors import ConfigError, FolderError
from mjstack.jobs.sweep import LOG, SWEEP, Queueing, SweepJob, add_jobs, run_jobs
from mjstack.report.record import GateResult, Report, Status
from mjstack.report.write import read_report, write_report

STUB = """\
import json, os, signal, sys, time
from pathlib import Path

args = dict(arg.split("=", 1) for arg in sys.argv[1:])
folder = Path(args["hydra.run.dir"].strip("'"))
if os.environ.get("SILENT"):
    sys.exit(3)
print("mjstack: what it says", os.environ.get("CUDA_VISIBLE_DEVICES"))
if args["seed"] == "7":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored behind nohup
    time.sleep(90)
if args["seed"] == "9":
    os.kill(os.getpid(), 9)
status = "fail" if args["seed"] == "2" else "pass"
gate = {"name": "batch", "status": status, "reason": "so"}
report = {"status": status, "resumes": "", "gates": [gate]}
(folder / "report.json").write_text(json.dumps(report))
"""


@pytest.fixture
def stub(tmp_path: Path, monkeypatch: Patch) -> Path:
    """Jobs whose process writes a report at once."""
    (tmp_path / "stub.py").write_text(STUB)
    monkeypatch.setattr(
        process, "own_command", lambda args: [sys.executable, str(tmp_path / "stub.py"), *args]
    )
    return tmp_path / "sweep"


def play(
    folder: Path,
    sweep: list[SweepJob],
    queueing: Queueing | None = None,
    finish: Callable[[dict[int, Report]], None] = lambda reports: None,
) -> list[Report]:
    return run_jobs(folder, sweep, queueing or Queueing(), finish)


def jobs(folder: Path, *seeds: int) -> list[SweepJob]:
    return [SweepJob(n, folder / str(n), (f"seed={seed}",)) for n, seed in enumerate(seeds)]


def test_a_queue(stub: Path, capsys: Capture) -> None:
    """Reports in the order of the jobs; a killed one says so, and it alone runs again."""
    sweep = jobs(stub, 1, 2, 9, 4)
    reports = play(stub, sweep)
    assert [report.status for report in reports] == ["pass", "fail", "fail", "pass"]
    assert max(report.exit_code for report in reports) == 1
    (gate,) = reports[2].gates
    assert "killed by signal 9: mjstack: what it says" in gate.reason
    assert (stub / "0" / LOG).read_text().startswith("mjstack: what it says None")
    capsys.readouterr()
    assert [report.status for report in play(stub, sweep)] == ["pass", "fail", "fail", "pass"]
    out = capsys.readouterr().out
    assert out.count("done before") == 3
    assert "job 2: seed=9" in out
    other = jobs(stub, 1, 3)
    refusal = "has another sweep, whose job 1 is seed=2"
    with pytest.raises(FolderError, match=refusal):
        play(stub, other)


def test_the_reason_is_not_an_earlier_processs(stub: Path, monkeypatch: Patch) -> None:
    sweep = jobs(stub, 9)
    play(stub, sweep)
    monkeypatch.setenv("SILENT", "1")
    ((gate,),) = [report.gates for report in play(stub, sweep)]
    assert gate.reason == f"exit status 3 ({stub / '0' / LOG})"


def test_a_job_that_takes_too_long_has_failed(stub: Path) -> None:
    """And stops no other; what was reported so far is told as each job ends."""
    counts: list[int] = []
    reports = play(
        stub, jobs(stub, 7, 1), Queueing(minutes=0.02), lambda some: counts.append(len(some))
    )
    assert [report.status for report in reports] == ["fail", "pass"]
    assert "not done after" in reports[0].gates[0].reason
    assert "(hydra.launcher.minutes)" in reports[0].gates[0].reason
    assert counts == [1, 2]


@pytest.mark.full
def test_a_process_ends_with_its_command() -> None:
    """Also where a second Ctrl-C ends that at once. The process holds stderr while it lives."""
    start = f"{process._START} import time; print(1, flush=True); time.sleep(90)"
    program = f"""
import os, subprocess, sys
run = subprocess.Popen(
    [sys.executable, "-P", "-c", {start!r}],
    stdout=subprocess.PIPE,
)
run.stdout.readline()
os._exit(130)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=60)
    assert (done.returncode, done.stderr) == (130, b"")


def test_jobs_in_several_calls_are_in_one_list(stub: Path) -> None:
    for job in jobs(stub, 1, 4):
        assert [report.status for report in play(stub, [job])] == ["pass"]
    assert json.loads((stub / SWEEP).read_text())["1"] == ["1", ["seed=4"]]


@pytest.mark.parametrize("count", [0, -1, "x", 1.5])
def test_a_number_of_jobs_that_cannot_be_is_refused(count: Any) -> None:
    with pytest.raises(ConfigError, match=f"hydra.launcher.jobs={count}: expected an integer of"):
        Queueing.from_launcher({"jobs": count})


def test_a_job_that_was_stopped_goes_on(stub: Path) -> None:
    """By its own folder; one that left nothing of use begins anew, and removes nothing."""
    add_jobs(stub, jobs(stub, 1, 3))
    for name, resumes in (("0", "collect"), ("1", "")):
        (stub / name).mkdir(parents=True)
        (stub / name / "kept").touch()
        report = {"status": "interrupted", "resumes": resumes, "gates": []}
        (stub / name / "report.json").write_text(json.dumps(report))
    play(stub, jobs(stub, 1, 3))
    assert (stub / "0" / "kept").exists()
    assert not (stub / "1" / "kept").exists()
    assert (stub / "1-earlier-1" / "kept").exists()


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize("what", ["files", "link", "empty link", "cut report", "another run"])
def test_a_job_removes_no_file_that_it_did_not_write(stub: Path, what: str, listed: bool) -> None:
    """A folder with other files, or a link in its place, is refused before any job starts."""
    sweep = jobs(stub, 1, 2)
    play(stub, sweep[: 1 + listed])
    place = stub / "1"
    report = (stub / "0" / "report.json").read_text()
    files = {"notes.txt": "mine", "data/x": "mine"}
    if what == "another run" and listed:
        pytest.skip("it is the job's")
    if what in ("cut report", "another run"):
        files["report.json"] = report if what == "another run" else report[:20]
    if what.endswith("link"):
        shutil.rmtree(place, ignore_errors=True)
        files = {} if what == "empty link" else files
        place.symlink_to("../precious")
        place = stub.parent / "precious"
    elif what == "files" and listed:
        (place / "report.json").unlink()
    for name, text in files.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_text(text)
    place.mkdir(exist_ok=True)
    before = contents(stub.parent)
    expected = "1 is a link" if what.endswith("link") else r"1 has data, expected a new or an empty"
    with pytest.raises(FolderError, match=expected):
        play(stub, jobs(stub, 1, 2, 3))
    assert contents(stub.parent) == before


def test_a_report_is_read_back(tmp_path: Path) -> None:
    assert read_report(tmp_path) is None
    (tmp_path / "report.json").write_text("{}")
    assert read_report(tmp_path) is None
    gate = GateResult(name="batch", status=Status.failed, reason="so")
    written = Report(folder=tmp_path, resumes="gates", status=Status.failed, gates=[gate])
    write_report(written)
    assert read_report(tmp_path) == written


def test_a_gpu_for_each_job(stub: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5,7")
    with pytest.raises(ConfigError, match=r"hydra.launcher.jobs=3: expected at most 2"):
        play(stub, jobs(stub, 1), Queueing(3))
    play(stub, jobs(stub, 1, 3))
    ends = {(stub / name / LOG).read_text()[-3:] for name in "01"}
    assert ends == {" 5\n", " 7\n"}
    play(stub / "one", jobs(stub / "one", 1, 3), Queueing(1))
    assert all((stub / "one" / name / LOG).read_text().endswith(" 5\n") for name in "01")
