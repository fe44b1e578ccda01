"""The scaling job: a process per number of worlds, resumed, with gaps where one fails."""

from __future__ import annotations

import contextlib
import csv
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TextIO

import pytest
from compositions import load_config, put
from environments import one_second_episode
from matplotlib.axes import Axes

from mjstack import process
from mjstack.cli import run
from mjstack.config.check import validate
from mjstack.config.schema import Backend
from mjstack.errors import ConfigError, MjstackError
from mjstack.jobs import check_job, scaling, scaling_run
from mjstack.jobs.scaling import (
    RATE,
    SHOWN,
    crossover,
    describe_crossover,
    run_overrides,
    save_scaling_curves,
    scaling_folder,
)
from mjstack.jobs.scaling_run import NOT_RUN, PASS, RESULT, Row, new_row, read_report, read_run
from mjstack.report.table import Table

SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "run.py"
TINY = [
    "job=scaling",
    "job.repetitions=1",
    "job.native_steps=2",
    "job.native_env_steps=1",
    "gate.throughput.start_worlds=1",
]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def home(folder: Path) -> Path:
    (path,) = (folder / "outputs" / "scaling").iterdir()
    return path


def table(folder: Path) -> dict[tuple[str, int], dict[str, str]]:
    with (home(folder) / "scaling.csv").open() as file:
        return {(row["backend"], int(row["nworld"])): row for row in csv.DictReader(file)}


class OwnProcess:
    """Stands in for `subprocess.Popen`: the command line runs in this process, which has imported
    everything. The test of Ctrl-C starts real processes.
    """

    def __init__(self, command: list[str], *, stdout: TextIO, **_: object) -> None:
        assert command[1:3] == ["-P", "-c"]
        *overrides, target = command[4:]
        folder = Path(target.removeprefix("hydra.run.dir=").strip("'"))
        with contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stdout):
            try:
                self.code = check_job(load_config(overrides), overrides).run(folder).exit_code
            except MjstackError as error:
                print(f"mjstack: {error}")
                self.code = error.exit_code

    def poll(self) -> int:
        return self.code

    def kill(self) -> None:
        """It has ended."""

    wait = kill


def run_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = SimpleNamespace(**{**vars(subprocess), "Popen": OwnProcess})
    monkeypatch.setattr(scaling_run, "subprocess", fake)


def stamps(folder: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in home(folder).rglob("run.json")}


@pytest.mark.full
def test_runs_resume_and_leave_table_and_plot(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run_in_this_process(monkeypatch)
    # More worlds than there is memory for; the run after it starts all the same.
    assert run([*TINY, "sim=native", "job.nworlds=[1,2000000000]"]) == 1
    first = table(folder)
    before = stamps(folder)
    assert set(first) == {("native", 1), ("native", 2000000000)}
    assert "job.retry=true" in capsys.readouterr().out

    args = [*TINY, "sim=native", "job.nworlds=[1,2000000000,2]"]
    assert run([*args, "nworld=7"]) == 1
    out = capsys.readouterr().out
    after = stamps(folder)
    both = table(folder)
    assert {name: after[name] for name in before} == before
    assert set(after) - set(before) == {"native-2"}
    assert out.count("(done before)") == 4  # in the line of each result, and in the table
    assert "nworld=7 is not used" in out
    assert both["native", 1].items() >= first["native", 1].items()
    assert set(both) == {("native", 1), ("native", 2), ("native", 2000000000)}
    too_many = both.pop(("native", 2000000000))
    assert (too_many["status"], too_many[RATE]) == ("out of memory", "")
    for (_, nworld), row in both.items():
        assert row["status"] == "pass"
        for rate, ms in (
            (RATE, "physics.ms_per_batched_step"),
            ("env_step.env_steps_per_s.median", "env_step.ms_per_env_step"),
        ):
            assert float(row[rate]) == pytest.approx(1e3 * nworld / float(row[f"{ms}.median"]))
        assert not {"episode.bare_ratio.median", "succeeded"} & set(row)  # they play no episode
    for name in (
        "scaling.csv",
        "scaling.md",
        "scaling.png",
        "report.json",
        "report.md",
        "report.html",
        "run.log",
        ".hydra/config.yaml",
    ):
        assert (home(folder) / name).stat().st_size > 0, name
    report = json.loads((home(folder) / "report.json").read_text())
    assert report["status"] == "fail"
    assert {gate["name"]: gate["status"] for gate in report["gates"]} == {
        "native-1": "pass",
        "native-2": "pass",
        "native-2000000000": "fail",
    }
    assert [path.name for path in folder.iterdir()] == ["outputs"]

    # What failed runs again if asked.
    before = after
    assert run([*args, "job.retry=true"]) == 1
    after = stamps(folder)
    again = {name for name in after if after[name] > before[name]}
    assert again == {"native-2000000000"}


@pytest.mark.full
def test_failing_run_is_a_gap(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_in_this_process(monkeypatch)
    args = [
        *TINY,
        *one_second_episode(),
        "sim.device=cpu",
        "job.nworlds=[1]",
        "job.backends=[mjwarp]",
        "batch.njmax=40",
    ]
    args += ["gate.throughput.steps=2", "gate.throughput.env_steps=1"]
    assert run(args) == 1
    rows = table(folder)
    assert rows["mjwarp", 1]["status"] == "fail"
    assert "buffer overflow" in rows["mjwarp", 1]["reason"]
    assert rows["mjwarp", 1]["succeeded"] == "0"
    assert not any(
        rows["mjwarp", 1].get(f"{name}.median")
        for name in (
            "physics.world_steps_per_s",
            "env_step.env_steps_per_s",
            "episode.seconds",
        )
    )
    report = json.loads((home(folder) / "report.json").read_text())
    assert report["status"] == "fail"
    assert (home(folder) / "scaling.png").stat().st_size > 0


@pytest.mark.parametrize(
    ("code", "reason", "output", "status", "says"),
    [
        (
            1,
            "RuntimeError: Failed to allocate 99 bytes on device 'cuda:0'",
            "",
            "out of memory",
            "99 bytes",
        ),
        (
            1,
            "internal error, OutOfMemoryError: CUDA out of memory.",
            "",
            "out of memory",
            "CUDA out of memory",
        ),
        (
            1,
            "internal error, RuntimeError: bad",
            "Warp CUDA error 2: out of memory (in function x)",
            "out of memory",
            "bad",
        ),
        (1, "3 of 8 worlds failed", "", "fail", "batch: 3 of 8 worlds failed"),
        (2, "", "mjstack: nworld=0: expected", "fail", "nworld=0"),
        (-9, "", "", "out of memory", "killed by signal 9"),
        (-11, "", "", "fail", "killed by signal 11"),
    ],
)
def test_how_a_run_ended(
    tmp_path: Path, code: int, reason: str, output: str, status: str, says: str
) -> None:
    gates = (
        [{"name": "batch", "status": "fail", "reason": reason, "metrics": {}, "notes": {}}]
        if reason
        else []
    )
    (tmp_path / "report.json").write_text(
        json.dumps({"gates": gates, "provenance": {"git_commit": "abc"}})
    )
    (tmp_path / "output.log").write_text(output)
    row = read_report(tmp_path, 8, "mjwarp", code)
    assert (row["status"], row["git_commit"]) == (status, "abc")
    assert says in row["reason"]
    assert RATE not in row


def test_run_without_a_report_says_its_last_line(tmp_path: Path) -> None:
    (tmp_path / "output.log").write_text("something\nImportError: no such thing\n")
    row = read_report(tmp_path, 8, "native", 1)
    assert (row["status"], row["reason"]) == ("fail", "ImportError: no such thing")


def as_written(**changes: object) -> str:
    """A run's file with some values changed."""
    return json.dumps(new_row(4, "native", status=PASS, world_steps_per_s=1.0) | changes)


@pytest.mark.parametrize(
    "text",
    [
        *(None, "", "{", "[" * 100_000, "[]", '{"nworld": 1}', '{"other": 1}'),
        *(as_written(nworld=999), as_written(backend="mjwarp"), as_written(reason=3)),
        *(as_written(status=None), as_written(world_steps_per_s="fast")),
    ],
)
def test_unreadable_run_counts_as_not_run(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "run.json").write_text(text)
    row = read_run(tmp_path, 4, "native")
    assert (row["nworld"], row["backend"], row["status"]) == (4, "native", NOT_RUN)
    (tmp_path / "run.json").write_text(as_written())
    assert read_run(tmp_path, 4, "native") == json.loads(as_written())


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, str]]:
    """Runs that take 40 s each, on a simulated clock."""
    ran: list[tuple[int, str]] = []
    clock = [0.0]

    def simulate(
        _: Path, row: Row, __: list[str], *, run_seconds: float, job_seconds: float
    ) -> Row:
        nworld = row["nworld"]
        backend = row["backend"]
        clock[0] += min(40.0, job_seconds)
        if job_seconds < 40.0:
            return new_row(nworld, backend, reason="stopped")
        ran.append((nworld, backend))
        return new_row(
            nworld=nworld,
            backend=backend,
            status=PASS,
            seconds=40.0,
            **{RATE.replace("median", end): 1.0 * nworld for end in ("median", "min", "max")},
        )

    monkeypatch.setattr(scaling, "run_process", simulate)
    monkeypatch.setattr(scaling.time, "monotonic", lambda: clock[0])
    return ran


def test_no_run_starts_that_would_not_fit(
    folder: Path, simulated: list[tuple[int, str]], capsys: pytest.CaptureFixture[str]
) -> None:
    # 150 s: three runs of 40 s; 30 s are too few for the fourth, which may take 60 s.
    args = [*TINY, "sim=native", "job.nworlds=[1,2,4,8]", "job.max_minutes=2.5"]
    assert run(args) == 1
    assert [nworld for nworld, _ in simulated] == [1, 2, 4]
    out = capsys.readouterr().out
    assert (
        "incomplete: 1 of 4 runs have not run (native, 8 worlds needs more than the 30 s that are"
        " left)" in out
    )
    report = json.loads((home(folder) / "report.json").read_text())
    assert report["status"] == "fail"
    assert report["gates"][-1]["reason"].startswith("has not run (native, 8 worlds needs more")
    assert "| 8 | native | - | - |" in (home(folder) / "scaling.md").read_text()


def test_a_call_that_is_too_short_still_tries_its_first_run(
    folder: Path, simulated: list[tuple[int, str]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*TINY, "sim=native", "job.nworlds=[1,2]", "job.max_minutes=0.5"]) == 1
    assert simulated == []
    assert "incomplete: 2 of 2 runs have not run (stopped)" in capsys.readouterr().out


@pytest.mark.full
def test_failed_plot_takes_nothing_back(
    folder: Path,
    simulated: list[tuple[int, str]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("no fonts")

    monkeypatch.setattr(scaling, "save_scaling_curves", fail)
    assert run([*TINY, "sim=native", "job.nworlds=[1]"]) == 0
    assert "scaling.png was not written: no fonts" in capsys.readouterr().out
    assert ("native", 1) in table(folder)


@pytest.mark.full
def test_full_disk_is_one_line(
    folder: Path,
    simulated: list[tuple[int, str]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(scaling, "write_tables", full)
    assert run([*TINY, "sim=native", "job.nworlds=[1]"]) == 1
    err = capsys.readouterr().err
    assert err.startswith("mjstack: ")
    assert "No space left on device" in err
    assert len(err.strip().splitlines()) == 1


def alive(marker: str) -> list[str]:
    """Processes whose environment has a marker."""
    found = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        try:
            if marker.encode() in path.read_bytes() and (path.parent / "cmdline").read_bytes():
                found.append(path.parent.name)
        except OSError:
            continue
    return found


@pytest.mark.full
@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="no /proc here")
def test_ctrl_c_leaves_the_finished_runs_and_no_process(folder: Path) -> None:
    args = [*TINY, "sim=native", "job.native_steps=20000"]
    done = scaling_folder(load_config(args)) / "runs" / "native-1" / RESULT
    done.parent.mkdir(parents=True)
    done.write_text(json.dumps(new_row(1, "native", status=PASS, seconds=1.0)))
    marker = f"MJSTACK_TEST={folder}"
    process = subprocess.Popen(
        [
            sys.executable,
            SCRIPT,
            *args,
            "job.nworlds=[1,64]",
        ],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"MJSTACK_TEST": str(folder)},
        start_new_session=True,  # so that a failing test can end the run too
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        until = time.monotonic() + 120
        while not list(folder.glob("outputs/scaling/*/runs/native-64/report.json")):
            assert process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.1)
        assert len(alive(marker)) == 2
        os.kill(
            process.pid, signal.SIGINT
        )  # this process alone: a terminal would tell its child too
        out, err = process.communicate(timeout=60)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 130
    assert "Traceback" not in err
    assert "interrupted; the finished gates are in the report" in out
    rows = table(folder)
    assert (rows["native", 1]["status"], rows["native", 64]["status"]) == ("pass", "not run")
    assert json.loads((home(folder) / "report.json").read_text())["status"] == "interrupted"
    assert alive(marker) == []


@pytest.mark.full
def test_a_run_ends_with_its_job() -> None:
    """Also where a second Ctrl-C ends that at once. The run holds stderr as long as it lives."""
    start = (
        process._START.rpartition(" from ")[0]
        + " import time; print(1, flush=True); time.sleep(90)"
    )
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


@pytest.mark.full
def test_folder_depends_on_what_a_run_depends_on() -> None:
    def name(*values: str, choices: Sequence[str] = ()) -> str:
        return str(scaling_folder(put(load_config(["job=scaling", *choices]), *values)))

    same = name()
    assert same.startswith("outputs/scaling/")
    unused = ("job.nworlds=[5]", "job.max_minutes=3", "job.retry=true", "nworld=3")
    assert name(*unused, choices=["sim=native", "job.backends=[native]"]) == same
    for choice in ("robot=rebot", "~reward.success"):
        assert name(choices=[choice]) != same, choice
    for value in ("job.repetitions=2", "batch.njmax=99", "seed=1", "sim.device=cpu"):
        assert name(value) != same, value


@pytest.mark.full
def test_folder_depends_on_a_layouts_content(tmp_path: Path) -> None:
    def name(path: Path) -> str:
        return str(
            scaling_folder(load_config(["job=scaling", "reset=starts_file", f"starts={path}"]))
        )

    first = tmp_path / "first.csv"
    second = tmp_path / "second.csv"
    first.write_text("world,red_x_m\n0,0.33\n")
    second.write_bytes(first.read_bytes())
    assert name(first) == name(second)
    second.write_text("world,red_x_m\n0,0.34\n")
    assert name(first) != name(second)
    with pytest.raises(ConfigError, match=r"starts=.*no\.csv.*a file that can be read"):
        name(tmp_path / "no.csv")


def test_runs_get_the_command_line() -> None:
    cfg = load_config(["job=scaling", "robot=rebot"])
    given = [
        "job=scaling",
        "robot=rebot",
        "nworld=3",
        "job.nworlds=[4]",
        "sim=native",
        "sim.device=cpu",
        "gate.throughput.steps=3",
        "+reward.x={func: f}",
    ]
    warp, native = (run_overrides(cfg, given, 4096, backend) for backend in ("mjwarp", "native"))
    assert not [override for override in warp + native if override.startswith("job")]
    assert "+reward.x={func: f}" in warp
    warp.remove("+reward.x={func: f}")
    native.remove("+reward.x={func: f}")
    gates = load_config(warp)
    assert (gates.job.name, gates.robot.name, gates.nworld) == ("gates", "rebot", 4096)
    assert (gates.sim.backend, gates.sim.device) == (Backend.mjwarp, "cpu")
    assert gates.gates == ["batch", "throughput"]
    assert gates.gate.throughput.repetitions == 1
    gates = load_config(native)
    assert (gates.sim.backend, gates.sim.device, gates.nworld) == (Backend.native, "cpu", 4096)
    assert (gates.gates, gates.gate.throughput.steps) == (["throughput"], 60)
    assert "gate.throughput.repetitions=5" in run_overrides(cfg, given, 2048, "mjwarp")


BAD = [
    ["job.nworlds=[0]"],
    ["job.nworlds=many"],
    ["job.nworld=[2]"],
    ["job.backends=[cuda]"],
    ["view=true"],
    ["task=reach", "task.check=null"],
    ["gate.throughput.measurements=[physic]"],
    ["job.backends=[mjwarp]", "sim.device=cuda:77"],
    ["hydra.run.dir=afile/below"],
]


@pytest.mark.full
@pytest.mark.parametrize("args", BAD, ids=[" ".join(args) for args in BAD])
def test_bad_input_is_one_line_and_writes_nothing(
    args: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "afile").write_text("")
    assert run(["job=scaling", *args]) == 2
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    assert err.startswith("mjstack: ")
    assert len(err.strip().splitlines()) == 1
    assert [path.name for path in folder.rglob("*")] == ["afile"]


@pytest.mark.parametrize("value", ["repetitions=0", "run_minutes=0", "max_minutes=-1"])
def test_range_of_a_number(value: str) -> None:
    with pytest.raises(ConfigError, match=rf"job\.{value}: expected"):
        validate(put(load_config(["job=scaling"]), f"job.{value}"))


def rows(rates: dict[str, dict[int, float | None]]) -> list[Row]:
    return [
        new_row(
            n,
            backend,
            status="fail" if rate is None else PASS,
            **({} if rate is None else {RATE: rate}),
        )
        for backend, some in rates.items()
        for n, rate in some.items()
    ]


@pytest.mark.parametrize(
    ("mjwarp", "native", "at"),
    [
        ({1: 1.0, 100: 100.0}, {1: 10.0, 100: 10.0}, 10.0),
        ({1: 1.0, 10: None, 100: 100.0}, {1: 10.0, 10: 10.0, 100: 10.0}, 10.0),
        ({1: 1.0, 100: 5.0}, {1: 10.0, 100: 10.0}, None),
        ({1: 20.0, 100: 50.0}, {1: 10.0, 100: 10.0}, None),
        ({1: 1.0}, {100: 10.0}, None),
        ({1: None}, {1: None}, None),
    ],
)
def test_crossover(
    mjwarp: dict[int, float | None], native: dict[int, float | None], at: float | None
) -> None:
    both = rows({"mjwarp": mjwarp, "native": native})
    found = crossover(both)
    assert found == (None if at is None else pytest.approx(at))
    assert (f"about {at:,.0f} worlds" if at else "do not show") in describe_crossover(both)


def test_failed_run_is_a_gap_even_with_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of three runs the middle one measured physics and then failed; its figure would move the
    crossover.
    """
    both = rows(
        {"mjwarp": {1: 1.0, 10: 99.0, 100: 100.0}, "native": {1: 10.0, 10: 10.0, 100: 10.0}}
    )
    both[1]["status"] = "fail"
    assert crossover(both) == pytest.approx(10.0)
    drawn: list[tuple[str, list[float]]] = []
    plot = Axes.plot

    def spy(self: Axes, x: Any, y: Any, *args: Any, **kwargs: Any) -> Any:
        drawn.append((str(kwargs.get("label", "x")), [float(value) for value in y]))
        return plot(self, x, y, *args, **kwargs)

    monkeypatch.setattr(Axes, "plot", spy)
    save_scaling_curves(tmp_path / "p.png", both, 10, "T")
    curves = [y for label, y in drawn if label == "MJWarp, physics"]
    assert [[math.isnan(value) for value in y] for y in curves] == [[False, True, False]] * 2
    assert [len(y) for label, y in drawn if label == "x"] == [1, 1, 0, 0]


def test_table_shows_gaps() -> None:
    good = new_row(
        2048,
        "mjwarp",
        status=PASS,
        **{"physics.ms_per_batched_step.median": 1.376, "episode.bare_ratio.median": 1.02},
        **{"env_step.gpu_memory_whole_gpu_mib": 7.0},
    )
    bad = new_row(4096, "mjwarp", status="out of memory", reason="a | b")
    lines = Table.of(SHOWN, [good, bad]).to_markdown()
    assert lines[2].startswith("| 2048 | mjwarp | - | 1.376 |")
    assert "| 1.02 | 7 |" in lines[2]
    assert lines[3].endswith("| out of memory | a \\| b |")
