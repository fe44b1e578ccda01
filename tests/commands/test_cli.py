"""The command line: exit statuses, what it writes, and that it writes nothing for bad input."""

import json
import logging
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path

import pytest
from environments import Capture, GetStage, Patch, at_double_speed, has_gl

import mjstack
from mjstack import cli
from mjstack.cli import run
from mjstack.config import load_config
from mjstack.config.session import CONFIG_FOLDER
from mjstack.errors import MjstackError
from mjstack.jobs import CheckedJob

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "run.py"
PROVENANCE = {"versions", "device", "driver", "cpu_count", "git_commit"}
PROVENANCE |= {"config_sha256", "model_sha256"}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: Patch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def everything(folder: Path) -> list[Path]:
    return list(folder.rglob("*"))


def the_report(folder: Path) -> dict:
    (path,) = folder.rglob("report.json")
    return json.loads(path.read_text())


def in_a_process(folder: Path, *command: str | Path) -> subprocess.CompletedProcess:
    """Python on a command."""
    return subprocess.run(
        [sys.executable, *command], cwd=folder, capture_output=True, text=True, timeout=120
    )


def test_torchrun_is_for_one_job(folder: Path, monkeypatch: Patch, capsys: Capture) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert run(["-m", "job=train", "seed=1,2", "sim=native"]) == 2
    assert "torchrun: expected" in capsys.readouterr().err
    assert not everything(folder)


# Refusals of the composition itself are in test_config.py.
BAD = r"""
sim=mjwarp sim.device=cuda:77
-m 'nworld =3'
-x nworld=3
hydra.run.dir=afile/below
hydra.nothing=1
hydra/job_logging=none
hydra.output_subdir=/proc/x
'+hydra.callbacks.x={_target_: nope.nope}' gates=[baseline]
-m nworld=1,0
video=true gates=[batch]
'hydra.run.dir=${foo}'
robot.grasp_sites=[x,y]
~reset.cubes.params.xy
reset.cubes.func=mjstack.mdp.reset.JiterObjects
action.arm.params.mode=sideways
reset=randomized reset.cubes.params.xy=[0.0,0.001] reset.cubes.params.gap=0.5
-m robot=glob(*)
-m nworld=range(4,1)
-m experiment=scaling sim=native nworld=1,2 view=web
-m experiment=scaling sim=native nworld=1,2 hydra.launcher.minutes=0
-m experiment=scaling sim=native nworld=1,2 hydra.launcher.retry=perhaps
-m experiment=scaling sim=native nworld=1,2 hydra.sweep.dir=afile/below
-m experiment=scaling sim=mjwarp sim.device=cuda:77 nworld=1,2
""".strip().splitlines()
FLAGS = ["--cfg nope", "-c", "--package", "--info x", "--version=1", "-m --cfg job", "-cn foo"]


ALONE = "devices=2: expected null with -m. Leave it out: with hydra/launcher=gpus each job has one"
LINES = [
    ("+foo=1", "configuration key 'foo' does not exist. Did you mean 'robot'? Available: action"),
    ("hydra.mode=MULTIRUN", "hydra.mode=MULTIRUN: expected RUN without -m. Replace it by -m."),
    ("-m hydra.sweeper.params={seed:1}", "hydra.sweeper: expected Hydra's own. Give the values"),
    ("-m seed=1,2 hydra/sweeper=optuna", "hydra.sweeper: expected Hydra's own."),
    ("-m nworld=interval(1,2)", "hydra.mode=MULTIRUN: expected a list of values."),
    ("-sc install=bash", "flag '-sc' does not exist."),
    ("devices=2 job=play sim=native", "torchrun, devices: expected"),
    ("job.name=collect nworld=2", "job.name=collect: expected the one of a job's file"),
    ("-m sim=native seed=0,1 devices=2", ALONE),
    ("--gate.batch.seeds=[1]", "flag '--gate.batch.seeds=[1]' does not exist. "),
    ("--seed nworld=2", "Keys are set without dashes: nworld=64."),
]


LINES += [(flags, "mjstack: ") for flags in FLAGS]
LINES += [("nworld=2 -m gates=[nope]", "gate 'nope'"), ("--cfg job -p gate.nope", "gate.nope")]
LINES += [(args, "") for args in BAD]
CASES = [pytest.param(*row, id=row[0], marks=[pytest.mark.full] * (row[0] in BAD)) for row in LINES]


@pytest.mark.parametrize(("args", "words"), CASES)
def test_bad_input_exits_2_in_one_line_and_writes_nothing(
    args: str, words: str, folder: Path, capsys: Capture
) -> None:
    (folder / "afile").write_text("")
    assert run(shlex.split(args)) == 2
    out, err = capsys.readouterr()
    assert re.fullmatch("mjstack: .+\n", err)
    assert words in err
    assert "Traceback" not in out + err
    assert everything(folder) == [folder / "afile"]


UNEXPECTED = (
    ValueError("one\ntwo"),
    MemoryError("5 GiB"),
    RecursionError("deep"),
    SystemExit(0),
    MjstackError("a wrong value"),
)


@pytest.mark.parametrize("error", UNEXPECTED, ids=repr)
def test_any_error_of_the_check_is_a_line(
    error: BaseException, folder: Path, capsys: Capture, monkeypatch: Patch
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(cli, "_dispatch", fail)
    assert run([]) == 2
    said = capsys.readouterr().err
    assert re.fullmatch("mjstack: .+\n", said)
    monkeypatch.setenv("MJSTACK_DEBUG", "1")
    assert run([]) == 2
    debugged = capsys.readouterr().err
    assert debugged.startswith("Traceback")
    assert debugged.endswith(said)
    assert everything(folder) == []


@pytest.mark.parametrize(
    "error",
    [UNEXPECTED[0], *(pytest.param(e, marks=pytest.mark.full) for e in UNEXPECTED[1:4])],
    ids=repr,
)
def test_any_error_of_the_run_is_a_line(
    error: BaseException,
    folder: Path,
    capsys: Capture,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: Patch,
    get_stage: GetStage,
) -> None:
    def work(*_: object) -> None:
        raise error

    # Hydra's of an earlier test writes to a stream that is closed.
    monkeypatch.setattr(logging.getLogger(), "handlers", [caplog.handler])
    job = CheckedJob(stage=get_stage("so101"), title="[/]", work=work)
    assert job.run(folder, ["[/]"]).exit_code == 1
    assert re.fullmatch("mjstack: .+\n", capsys.readouterr().err)
    assert "Traceback" in caplog.text
    assert the_report(folder)["status"] == "fail"


def test_bad_input_in_a_process_of_its_own(folder: Path) -> None:
    done = in_a_process(folder, SCRIPT, "robot=so100")
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch("mjstack: .+\n", done.stderr)
    assert everything(folder) == []


STARTING = """
import importlib.abc, os, signal, sys

class Impatient(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, signal.{before})
sys.meta_path.insert(0, Impatient())
from mjstack.__main__ import main
main()
"""


def starting(folder: Path, module: str, before: str, *args: str) -> subprocess.CompletedProcess:
    """A command line on which somebody presses Ctrl-C as a module is loaded."""
    return in_a_process(folder, "-c", STARTING.format(module=module, before=before), *args)


@pytest.mark.full
@pytest.mark.parametrize("module", ["mjstack.errors", "ctypes.util", "torch"])
def test_ctrl_c_while_modules_load_is_a_line(module: str, folder: Path) -> None:
    done = starting(folder, module, "default_int_handler", "gates=[baseline]")
    assert (done.returncode, done.stdout, done.stderr) == (
        130,
        "",
        "mjstack: interrupted before anything ran\n",
    )
    assert everything(folder) == []


@pytest.mark.full
def test_ctrl_c_stays_ignored_where_it_was(folder: Path) -> None:
    done = starting(folder, "hydra", "SIG_IGN", "nworld=many")
    assert done.returncode == 2, done.stderr


@pytest.mark.full
def test_what_is_misspelt_does_not_wait_for_torch(folder: Path) -> None:
    program = """
import sys
from mjstack.__main__ import main

for args in (["robo=so101"], ["nworld=many"], ["--nworld=3"], ["--version"], ["--help"]):
    sys.argv = ["mjstack", *args]
    try:
        main()
    except SystemExit as stop:
        print(stop.code, {"torch", "warp"} & set(sys.modules), file=sys.stderr)
"""
    done = in_a_process(folder, "-c", program)
    said = [line for line in done.stderr.splitlines() if not line.startswith("mjstack: ")]
    assert said == ["2 set()"] * 3 + ["0 set()"] * 2


def test_packages_are_there_after_a_plain_import() -> None:
    find = mjstack.__getattr__  # what Python asks for a name that nothing has imported yet
    assert find("scene").build_model.__name__ == "build_model"
    assert find("load_config").__module__ == "mjstack.config.load"
    with pytest.raises(AttributeError, match="module 'mjstack' has no attribute 'no_such'"):
        find("no_such")


@pytest.mark.full
def test_help_says_what_there_is_to_choose(
    folder: Path, capsys: Capture, monkeypatch: Patch
) -> None:
    monkeypatch.setenv("COLUMNS", "79")
    assert run(["robot=rebot", "--help"]) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 79
    said = " ".join(out.split())
    for path in CONFIG_FOLDER.glob("*/*.yaml"):
        assert re.search(rf" {path.parent.name} [^:]*: .*\b{path.stem}\b", said), path
    keys = {name for name, value in asdict(load_config()).items() if not isinstance(value, dict)}
    for name in keys - {"unused_terms"}:  # which is not to be set
        assert re.search(rf"^  {name} ", out, re.MULTILINE), name
    assert "robot the arm: so101, rebot" in said  # the default first
    assert "(256)" in said
    assert "--cfg job" in said
    assert "schema" not in said
    assert len(out.splitlines()) < 110
    assert everything(folder) == []


def test_version(folder: Path, capsys: Capture) -> None:
    assert run(["--version"]) == 0
    assert capsys.readouterr().out == f"mjstack {mjstack.__version__}\n"
    assert everything(folder) == []


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (["robot=rebot", "--cfg", "job"], "name: rebot\n"),
        (["job=collect", "job.episodes=7", "--cfg", "job", "-p", "job"], "episodes: 7\n"),
    ],
)
def test_cfg_prints_and_writes_nothing(
    args: list[str], line: str, folder: Path, capsys: Capture
) -> None:
    assert run(args) == 0
    assert line in capsys.readouterr().out
    assert everything(folder) == []


def test_baseline_leaves_a_whole_report(folder: Path) -> None:
    assert run(["gates=[baseline]"]) == 0
    report = the_report(folder)
    assert report["schema"] == 3
    assert report["status"] == "pass"
    assert set(report["provenance"]) >= PROVENANCE
    assert len(report["provenance"]["model_sha256"]) == 64
    (gate,) = report["gates"]
    assert set(gate) >= {"name", "status", "reason", "seconds", "thresholds", "metrics", "notes"}
    assert (gate["name"], gate["status"]) == ("baseline", "pass")
    assert 0 <= gate["metrics"]["xy_err_m"] <= gate["thresholds"]["xy_err_m"]
    assert 0.035 <= gate["metrics"]["dz_m"] <= 0.055
    assert all(isinstance(v, float | int) for v in gate["metrics"].values())
    (job,) = {path.parent for path in folder.rglob("report.json")}
    assert job.relative_to(folder).parts[0] == "outputs"
    names = "report.md report.html run.log .hydra/config.yaml .hydra/overrides.yaml"
    for name in [*names.split(), *(["scene.png"] if has_gl() else [])]:
        assert (job / name).stat().st_size > 0, name
    assert [path.name for path in folder.iterdir()] == ["outputs"]


@pytest.mark.full
def test_sweep_reports_each_job_and_exits_with_its_worst(folder: Path) -> None:
    small = ["web.episode=false", "sim=native", *at_double_speed()]
    assert run(["-m", "task.check.xy_err=0.015,1e-6", "gates=[baseline]", *small]) == 1
    paths = sorted(folder.rglob("report.json"))
    assert [path.parent.name for path in paths] == ["0", "1"]
    passed, failed = (json.loads(path.read_text()) for path in paths)
    assert (passed["status"], failed["status"]) == ("pass", "fail")
    assert failed["gates"][0]["status"] == "fail"
    assert "not stacked" in failed["gates"][0]["reason"]
    (summary,) = folder.rglob("summary.md")
    rows = [line for line in summary.read_text().splitlines() if line.startswith("| ")]
    assert rows[0].startswith("| job | task.check.xy_err | baseline | ")
    assert rows[2].startswith("| 0 | 0.015 | pass: ")
    assert rows[3].startswith("| 1 | 1e-06 | fail: ")


@pytest.mark.full
def test_ctrl_c_leaves_the_finished_gates_and_a_kill_would_too(folder: Path) -> None:
    """In a long native batch, after baseline has passed. A kill leaves the files as they are."""
    args = ["gates=[baseline,batch]", "nworld=400", "sim=native", "hydra.run.dir=out"]
    process = subprocess.Popen(
        [sys.executable, SCRIPT, *args],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A runner in the background may have been started with Ctrl-C ignored, and Python would
        # take that over.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    path = folder / "out" / "report.json"
    try:
        until = time.monotonic() + 120
        while not (path.exists() and json.loads(path.read_text())["gates"]):
            assert process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.1)
        time.sleep(0.3)
        assert process.poll() is None
        as_killed = json.loads(path.read_text())
        assert "interrupted" in (folder / "out" / "report.md").read_text()
        os.kill(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 130
    assert "Traceback" not in err
    for report in (as_killed, json.loads(path.read_text())):
        assert report["status"] == "interrupted"
        gates = [(gate["name"], gate["status"]) for gate in report["gates"]]
        assert gates == [("baseline", "pass")]


@pytest.mark.full
def test_a_reader_that_goes_away_fails_nothing(tmp_path: Path) -> None:
    """As in ``mjstack ... | head -1``: the run goes on without an output."""
    args = ["sim=native", "nworld=2", "gates=[baseline,batch]", f"hydra.run.dir={tmp_path}/run"]
    command = [sys.executable, "scripts/run.py", *args, *at_double_speed()]
    done = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=Path(__file__).parents[2]
    )
    assert done.stdout is not None
    done.stdout.read(1)
    done.stdout.close()
    assert done.wait() == 0, done.stderr and done.stderr.read()
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert [gate["status"] for gate in report["gates"]] == ["pass", "pass"]


@pytest.mark.full
def test_the_command_in_another_program_leaves_its_ctrl_c_alone(folder: Path) -> None:
    program = """
import os, signal, sys, threading
signal.signal(signal.SIGINT, signal.default_int_handler)  # it may be ignored where tests run
from mjstack.__main__ import main
sys.argv = ["mjstack", "nworld=many"]

def call():
    try:
        main()
    except SystemExit as stop:
        print(stop.code)

thread = threading.Thread(target=call)
thread.start()
thread.join()
call()
try:
    os.kill(os.getpid(), signal.SIGINT)
except KeyboardInterrupt:
    print("mine")
"""
    done = in_a_process(folder, "-c", program)
    assert done.stdout.split() == ["2", "2", "mine"], done.stderr
