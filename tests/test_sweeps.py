"""Sweeps whose jobs run in processes: a queue over GPUs or cores, and Slurm."""

from __future__ import annotations

import importlib.util
import json
import os
from pathlib import Path
from typing import Any

import pytest
from environments import one_second_episode
from one_node_slurm import interrupt_a_sweep, why_not
from test_ranks import SHORT, report_of, start

from mjstack.errors import ConfigError, FolderError
from mjstack.jobs import sweep as module
from mjstack.jobs.sweep import LOG, SWEEP, SweepJob, run_jobs, shared_sweep
from mjstack.report.record import GateResult, Report, Status
from mjstack.report.write import read_report, write_report

STUB = """\
import json, os, sys
from pathlib import Path

args = dict(arg.split("=", 1) for arg in sys.argv[1:])
folder = Path((args.get("hydra.run.dir") or args["resume"]).strip("'"))
if os.environ.get("SILENT"):
    sys.exit(3)
print("mjstack: what it says", args.get("resume"), os.environ.get("CUDA_VISIBLE_DEVICES"))
if args["seed"] == "9":
    os.kill(os.getpid(), 9)
status = "fail" if args["seed"] == "2" else "pass"
gate = {"name": "batch", "status": status, "reason": "so"}
report = {"status": status, "resumes": "gates", "gates": [gate]}
(folder / "report.json").write_text(json.dumps(report))
"""


@pytest.fixture
def stub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Jobs whose process writes a report at once."""
    import sys

    (tmp_path / "stub.py").write_text(STUB)
    monkeypatch.setattr(
        module, "own_command", lambda args: [sys.executable, str(tmp_path / "stub.py"), *args]
    )
    return tmp_path / "sweep"


def jobs(folder: Path, *seeds: int) -> list[SweepJob]:
    return [SweepJob(n, folder / str(n), (f"seed={seed}",)) for n, seed in enumerate(seeds)]


def test_a_queue(stub: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Reports in the order of the jobs; a killed one says so, and it alone runs again."""
    some = jobs(stub, 1, 2, 9, 4)
    reports = run_jobs(stub, some)
    assert [report.status for report in reports] == ["pass", "fail", "fail", "pass"]
    assert max(report.exit_code for report in reports) == 1
    (gate,) = reports[2].gates
    assert "killed by signal 9: mjstack: what it says" in gate.reason
    assert (stub / "0" / LOG).read_text().startswith("mjstack: what it says None")
    capsys.readouterr()
    assert [report.status for report in run_jobs(stub, some)] == ["pass", "fail", "fail", "pass"]
    out = capsys.readouterr().out
    assert out.count("done before") == 3
    assert "job 2 on cores" in out
    other = jobs(stub, 1, 3)
    refusal = "has another sweep, whose job 1 is seed=2"
    with pytest.raises(FolderError, match=refusal):
        run_jobs(stub, other)
    with pytest.raises(FolderError, match=refusal), shared_sweep(stub, other):
        pass


def test_the_reason_is_not_an_earlier_processs(stub: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    some = jobs(stub, 9)
    run_jobs(stub, some)
    monkeypatch.setenv("SILENT", "1")
    ((gate,),) = [report.gates for report in run_jobs(stub, some)]
    assert gate.reason == f"exit status 3 ({stub / '0' / LOG})"


def test_a_sweeper_brings_jobs_in_batches(stub: Path) -> None:
    """All of them are in one list, also where their folders are below others."""
    some = [
        SweepJob(n, stub / "so101" / str(n), (f"seed={seed}",)) for n, seed in enumerate((1, 4))
    ]
    for job in some:
        assert [report.status for report in run_jobs(stub, [job])] == ["pass"]
    with shared_sweep(stub):
        assert json.loads((stub / SWEEP).read_text())["1"] == ["so101/1", ["seed=4"]]


@pytest.mark.parametrize("count", [0, -1, "x", 1.5])
def test_a_number_of_jobs_that_cannot_be_is_refused(count: Any, stub: Path) -> None:
    with pytest.raises(ConfigError, match=f"hydra.launcher.jobs={count}: expected null, or an"):
        run_jobs(stub, jobs(stub, 1), count)
    assert not stub.exists()


def test_a_job_that_was_stopped_goes_on(stub: Path) -> None:
    """By its own folder; one that left nothing of use begins anew."""
    for name, resumes in (("0", "gates"), ("1", "")):
        (stub / name).mkdir(parents=True)
        (stub / name / "kept").touch()
        report = {"status": "interrupted", "resumes": resumes, "gates": []}
        (stub / name / "report.json").write_text(json.dumps(report))
    run_jobs(stub, jobs(stub, 1, 3))
    assert (stub / "0" / "kept").exists()
    assert str(stub / "0") in (stub / "0" / LOG).read_text()
    assert not (stub / "1" / "kept").exists()


def test_a_gpu_for_each_job(stub: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two GPUs, of which another command has one: all jobs run on the free one."""
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5,7")
    monkeypatch.setattr("tempfile.tempdir", str(stub.parent))
    with pytest.raises(ConfigError, match=r"hydra.launcher.jobs=3: expected at most 2"):
        run_jobs(stub, jobs(stub, 1), 3)
    for slot in module.find_slots(None):
        assert slot.lock is not None
        if slot.name == "GPU 5":
            held = module._lock(slot.lock)
    assert held is not None
    run_jobs(stub, jobs(stub, 1, 3))
    assert all((stub / name / LOG).read_text().endswith(" 7\n") for name in "01")
    held.close()


def test_the_locks_of_gpus_are_the_users_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    locks = tmp_path / f"mjstack-gpus-{os.getuid()}"
    locks.mkdir(mode=0o777)
    (slot,) = module.find_slots(None)
    assert slot.lock is not None
    assert slot.lock.parent == locks
    assert locks.stat().st_mode & 0o777 == 0o700
    locks.rmdir()
    (tmp_path / "elsewhere").mkdir()
    locks.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(FolderError, match=r"is another user's or no folder.*Set TMPDIR"):
        module.find_slots(None)
    own = os.getuid()
    monkeypatch.setattr("os.getuid", lambda: own + 1)
    (tmp_path / f"mjstack-gpus-{own + 1}").mkdir()
    with pytest.raises(FolderError, match="is another user's"):
        module.find_slots(None)


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    with pytest.raises(FolderError, match=r"has notes\.txt"), shared_sweep(tmp_path):
        pass


@pytest.mark.full
def test_a_sweep_in_two_terminals(tmp_path: Path) -> None:
    """Each job runs once, and both commands report all of them."""
    args = [*SHORT, "-m", "hydra/launcher=gpus", "seed=1,2,3", "nworld=2"]
    args += [f"hydra.sweep.dir={tmp_path}/sweep"]
    both = [start(0, args, tmp_path) for _ in range(2)]
    texts = [process.communicate(timeout=400)[0] for process in both]
    assert [process.returncode for process in both] == [1, 1], texts  # the episodes are too short
    for number in range(3):
        assert sum(text.count(f"job {number} on ") for text in texts) == 1
        assert report_of(tmp_path / "sweep" / str(number))["status"] == "fail"
        assert all("sweep of 3 jobs" in text for text in texts)


@pytest.mark.full
def test_slurm_queues_a_job_of_a_dead_node_again(tmp_path: Path) -> None:
    """It goes on after the seeds that it had finished."""
    if reason := why_not():
        pytest.skip(reason)
    if importlib.util.find_spec("submitit") is None:
        pytest.skip("no submitit here (pip install 'mjstack[cluster]')")
    short = ["sim=native", "gates=[batch]", "nworld=4", *one_second_episode()]
    node, sweep, status = interrupt_a_sweep(tmp_path / "here", short)
    assert status == 1, (tmp_path / "here/sweep.log").read_text()  # the episodes are too short
    reports = [report_of(sweep / str(number)) for number in range(4)]
    assert [report["gates"][0]["metrics"]["episodes"] for report in reports] == [32] * 4
    again = [report for report in reports if "earlier_calls" in report["provenance"]]
    assert again
    assert any("an earlier call has played seeds 0" in str(report) for report in again)
    assert any("PENDING" in line or "REQUEUED" in line for line in node.lines)


def test_a_report_is_read_back(tmp_path: Path) -> None:
    assert read_report(tmp_path) is None
    (tmp_path / "report.json").write_text("{}")
    assert read_report(tmp_path) is None
    gate = GateResult(name="batch", status=Status.failed, reason="so")
    written = Report(folder=tmp_path, resumes="gates", status=Status.failed, gates=[gate])
    write_report(written)
    assert read_report(tmp_path) == written
