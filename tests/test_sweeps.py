"""Sweeps whose jobs run in processes: a queue over GPUs or cores, and Slurm."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from environments import Capture, Patch, report_of
from processes import PLAIN, start
from test_run_folder import contents

from mjstack import process
from mjstack.errors import ConfigError, FolderError
from mjstack.jobs.sweep import LOG, SWEEP, Queueing, SweepJob, add_jobs, lock_file, run_jobs
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


def jobs(folder: Path, *seeds: int) -> list[SweepJob]:
    return [SweepJob(n, folder / str(n), (f"seed={seed}",)) for n, seed in enumerate(seeds)]


def test_a_queue(stub: Path, capsys: Capture) -> None:
    """Reports in the order of the jobs; a killed one says so, and it alone runs again."""
    sweep = jobs(stub, 1, 2, 9, 4)
    reports = run_jobs(stub, sweep)
    assert [report.status for report in reports] == ["pass", "fail", "fail", "pass"]
    assert max(report.exit_code for report in reports) == 1
    (gate,) = reports[2].gates
    assert "killed by signal 9: mjstack: what it says" in gate.reason
    assert (stub / "0" / LOG).read_text().startswith("mjstack: what it says None")
    capsys.readouterr()
    assert [report.status for report in run_jobs(stub, sweep)] == ["pass", "fail", "fail", "pass"]
    out = capsys.readouterr().out
    assert out.count("done before") == 3
    assert "job 2 on cores" in out
    other = jobs(stub, 1, 3)
    refusal = "has another sweep, whose job 1 is seed=2"
    with pytest.raises(FolderError, match=refusal):
        run_jobs(stub, other)


def test_the_reason_is_not_an_earlier_processs(stub: Path, monkeypatch: Patch) -> None:
    sweep = jobs(stub, 9)
    run_jobs(stub, sweep)
    monkeypatch.setenv("SILENT", "1")
    ((gate,),) = [report.gates for report in run_jobs(stub, sweep)]
    assert gate.reason == f"exit status 3 ({stub / '0' / LOG})"


def test_failures_are_repeated_on_request(stub: Path, capsys: Capture) -> None:
    """Anew, and once in a call."""
    sweep = jobs(stub, 1, 2)
    run_jobs(stub, sweep)
    (stub / "1" / "notes.txt").write_text("mine")
    capsys.readouterr()
    assert [report.status for report in run_jobs(stub, sweep, Queueing(retry=True))][1] == "fail"
    out = capsys.readouterr().out
    assert "job 0: pass, done before" in out
    assert out.count("job 1 on cores") == 1
    assert not (stub / "1" / "notes.txt").exists()
    assert (stub / "1-earlier-1" / "notes.txt").read_text() == "mine"
    assert (stub / "1-earlier-1" / "report.json").exists()


def test_a_job_that_takes_too_long_has_failed(stub: Path) -> None:
    """And stops no other; what was reported so far is told as each job ends."""
    counts: list[int] = []
    reports = run_jobs(
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
        assert [report.status for report in run_jobs(stub, [job])] == ["pass"]
    assert json.loads((stub / SWEEP).read_text())["1"] == ["1", ["seed=4"]]


@pytest.mark.parametrize("count", [0, -1, "x", 1.5])
def test_a_number_of_jobs_that_cannot_be_is_refused(count: Any) -> None:
    with pytest.raises(ConfigError, match=f"hydra.launcher.jobs={count}: expected an integer of"):
        Queueing.of({"jobs": count})


def test_a_job_that_was_stopped_goes_on(stub: Path) -> None:
    """By its own folder; one that left nothing of use begins anew, and removes nothing."""
    add_jobs(stub, jobs(stub, 1, 3))
    for name, resumes in (("0", "collect"), ("1", "")):
        (stub / name).mkdir(parents=True)
        (stub / name / "kept").touch()
        report = {"status": "interrupted", "resumes": resumes, "gates": []}
        (stub / name / "report.json").write_text(json.dumps(report))
    run_jobs(stub, jobs(stub, 1, 3))
    assert (stub / "0" / "kept").exists()
    assert not (stub / "1" / "kept").exists()
    assert (stub / "1-earlier-1" / "kept").exists()


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize("what", ["files", "link", "empty link", "cut report", "another run"])
def test_a_job_removes_no_file_that_it_did_not_write(stub: Path, what: str, listed: bool) -> None:
    """A folder with other files, or a link in its place, is refused before any job starts."""
    sweep = jobs(stub, 1, 2)
    run_jobs(stub, sweep[: 1 + listed])
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
        run_jobs(stub, jobs(stub, 1, 2, 3))
    assert contents(stub.parent) == before


def test_a_gpu_for_each_job(stub: Path, monkeypatch: Patch) -> None:
    """Two GPUs, of which another command has one: all jobs run on the free one."""
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5,7")
    monkeypatch.setenv("HOME", str(stub.parent))
    with pytest.raises(ConfigError, match=r"hydra.launcher.jobs=3: expected at most 2"):
        run_jobs(stub, jobs(stub, 1), Queueing(3))
    for slot in Queueing().slots():
        assert slot.lock is not None
        if slot.name == "GPU 5":
            lock = lock_file(slot.lock)
    assert lock is not None
    run_jobs(stub, jobs(stub, 1, 3))
    assert all((stub / name / LOG).read_text().endswith(" 7\n") for name in "01")
    lock.close()


@pytest.mark.full
@pytest.mark.long
def test_a_sweep_in_two_terminals(tmp_path: Path) -> None:
    """Each job runs once, and both commands report all of them."""
    args = [*PLAIN, "-m", "hydra/launcher=gpus", "seed=1,2,3", "nworld=2"]
    args += [f"hydra.sweep.dir={tmp_path}/sweep"]
    commands = [start(0, args, tmp_path) for _ in range(2)]
    texts = [command.communicate(timeout=400)[0] for command in commands]
    assert [command.returncode for command in commands] == [1, 1], (
        texts
    )  # the episodes are too short
    for number in range(3):
        assert sum(text.count(f"job {number} on ") for text in texts) == 1
        assert report_of(tmp_path / "sweep" / str(number))["status"] == "fail"
        assert all("sweep of 3 jobs" in text for text in texts)


def test_a_report_is_read_back(tmp_path: Path) -> None:
    assert read_report(tmp_path) is None
    (tmp_path / "report.json").write_text("{}")
    assert read_report(tmp_path) is None
    gate = GateResult(name="batch", status=Status.failed, reason="so")
    written = Report(folder=tmp_path, resumes="gates", status=Status.failed, gates=[gate])
    write_report(written)
    assert read_report(tmp_path) == written


def test_the_locks_of_gpus_are_the_users_own(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    monkeypatch.setenv("HOME", str(tmp_path))
    (slot,) = Queueing().slots()
    assert slot.lock is not None
    assert slot.lock.is_relative_to(tmp_path / ".cache")


@pytest.mark.parametrize("home", ["/dev/null", "/proc/1", ""])
def test_locks_without_a_home_are_a_line(home: str, monkeypatch: Patch) -> None:
    """A file, a folder that takes none, and a user without one."""

    def no_home(path: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    monkeypatch.setenv("HOME", home)
    if not home:
        monkeypatch.setattr(Path, "expanduser", no_home)
    with pytest.raises(FolderError, match=r"expected a folder for the GPUs' locks. Set HOME to"):
        Queueing().slots()
