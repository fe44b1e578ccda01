"""A run's folder: two runs never share one, and what a full disk or a kill leaves in it does not
keep the same command from going on.
"""

import csv
import gc
import json
import os
import resource
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace

import hydra.core.utils
import pytest
from compositions import load_config
from environments import Capture, Patch

import mjstack
from mjstack import cli
from mjstack.__main__ import main
from mjstack.config.explain import own_overrides
from mjstack.errors import FolderError
from mjstack.files import claim_folder, reading
from mjstack.jobs import CheckedJob, check_job, runner
from mjstack.report.record import GateResult, Status

NOON = "outputs/2026-11-21/12-00-00"
SWEEP = "outputs/sweeps/2026-11-21/12-00-00"


def test_a_missing_file_is_said_in_plain_words(tmp_path: Path) -> None:
    path = tmp_path / "nowhere.npz"
    with pytest.raises(FolderError) as caught, reading(path, "Name another"):
        path.open()
    assert str(caught.value) == (
        f"{path}: cannot be read (No such file or directory), expected it as written. Name another."
    )


@pytest.fixture(scope="module")
def checked() -> CheckedJob:
    """A job that does nothing and passes."""

    def work(stage: object, folder: Path) -> None:
        stage.record(GateResult(name="nothing", status=Status.passed))  # type: ignore[attr-defined]

    return replace(check_job(load_config(["gates=[baseline]"])), work=work)


@pytest.fixture
def begin(checked: CheckedJob, tmp_path: Path, monkeypatch: Patch) -> Callable[..., int]:
    """Run a command line at noon with that job, or a variant of it."""
    monkeypatch.chdir(tmp_path)
    noon = SimpleNamespace(now=lambda: datetime(2026, 11, 21, 12, 0, 0))
    monkeypatch.setattr(hydra.core.utils, "datetime", noon)

    def begin(*args: str, **changes: object) -> int:
        def check(cfg: object, overrides: list[str]) -> CheckedJob:
            job = replace(checked, **changes)  # type: ignore[arg-type]
            return cli._checked.setdefault(tuple(own_overrides(overrides)), job)

        monkeypatch.setattr(cli, "_check", check)
        return cli.run(list(args))

    return begin


def in_children(
    count: int, work: Callable[[int], int | None], output: Path | None = None
) -> list[int]:
    """Exit statuses of forked processes that do the same, as nearly at once as can be."""
    # A child that freed the threads of an earlier test's worlds would wait for them: it has none.
    gc.collect()
    ready, start = os.pipe()
    pids = []
    for number in range(count):
        pid = os.fork()
        if pid == 0:
            status = 99
            try:
                os.close(start)
                os.read(ready, 1)  # until the parent closes its end
                if output is not None:
                    sys.stdout = sys.stderr = output.open("a", buffering=1)
                status = work(number) or 0
            except BaseException:
                traceback.print_exc(file=sys.__stderr__)
            finally:
                sys.stdout.flush()
                os._exit(status)
        pids.append(pid)
    os.close(ready)
    os.close(start)
    return [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in pids]


def contents(folder: Path) -> dict[str, bytes | None]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


def put(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def test_claims_at_once(tmp_path: Path) -> None:
    def claim(_: int) -> None:
        with claim_folder(tmp_path / "a" / "run", numbered=True) as folder:
            (folder / "mine").mkdir()  # fails where there is one

    assert in_children(8, claim) == [0] * 8
    assert len(list((tmp_path / "a").iterdir())) == 8


@pytest.mark.full
def test_sweeps_of_one_hour_have_a_folder_each(begin: Callable[..., int]) -> None:
    assert begin("-m", "seed=1,2") == begin("-m", "seed=3,4") == 0
    files = {"0", "1", "multirun.yaml", "summary.csv", "summary.md", "sweep.json"}
    for folder, seeds in ((SWEEP, (1, 2)), (f"{SWEEP}-2", (3, 4))):
        assert {path.name for path in Path(folder).iterdir()} == files
        for number, seed in enumerate(seeds):
            text = Path(folder, str(number), ".hydra", "overrides.yaml").read_text()
            assert text == f"- seed={seed}\n"


def test_a_jobs_folder_in_a_sweep_is_its_number(begin: Callable[..., int], capsys: Capture) -> None:
    assert begin("-m", "seed=1,2", "hydra.sweep.subdir=same") == 2
    assert "hydra.sweep.subdir=same: expected none" in capsys.readouterr().err
    assert contents(Path()) == {}
    text = "# @package _global_\nhydra: {sweep: {subdir: same}}\n"
    put(Path(), {"conf/experiment/same.yaml": text})
    command = ["-m", "--config-dir", "conf", "experiment=same", "seed=1,2"]
    assert begin(*command) == 2
    err = capsys.readouterr().err
    assert err.startswith("mjstack: hydra.sweep.subdir=same: expected none")
    assert list(contents(Path())) == ["conf", "conf/experiment", "conf/experiment/same.yaml"]


@pytest.mark.full
def test_an_experiment_names_the_jobs_of_a_sweep_and_their_folder(
    begin: Callable[..., int], capsys: Capture
) -> None:
    """The same command goes on with it, and the command line goes before its values."""
    text = "# @package _global_\nhydra: {sweeper: {params: {seed: '1,2'}}, sweep: {dir: mine}}\n"
    put(Path(), {"conf/experiment/two.yaml": text})
    command = ["-m", "--config-dir", "conf", "experiment=two"]
    assert begin(*command) == 0
    stamp = Path("mine/1/report.json").stat().st_mtime_ns
    assert begin(*command) == 0
    assert "job 1: pass, done before" in capsys.readouterr().out
    assert Path("mine/1/report.json").stat().st_mtime_ns == stamp
    assert begin(*command, "seed=1,2,3") == 0
    assert {path.name for path in Path("mine").iterdir() if path.is_dir()} == {"0", "1", "2"}
    assert begin(*command, "seed=4") == 2
    assert "mine has another sweep, whose job 0 is seed=1" in capsys.readouterr().err


@pytest.mark.full
def test_an_interrupted_sweep_leaves_a_summary(begin: Callable[..., int]) -> None:
    def work(stage: object, folder: Path) -> None:
        if folder.name == "1":
            raise KeyboardInterrupt
        stage.record(GateResult(name="nothing", status=Status.passed))  # type: ignore[attr-defined]

    assert begin("-m", "seed=1,2,3", work=work) == 130
    rows = csv.DictReader(Path(SWEEP, "summary.csv").read_text().splitlines())
    assert [row["status"] for row in rows] == ["pass", "interrupted", "not run"]
    assert begin("-m", "seed=1,2,3") == 0  # a folder of the hour is new
    assert Path(f"{SWEEP}-2", "2", "report.json").exists()


@pytest.mark.full
@pytest.mark.parametrize("what", ["a closed output", "a signal after the last step"])
def test_a_run_that_is_done_ends_with_its_status(
    what: str, begin: Callable[..., int], monkeypatch: Patch
) -> None:
    def whole_command(_: int) -> int:
        if what == "a closed output":
            os.close(1)
            sys.stdout = None  # type: ignore[assignment]  # as Python has it
        else:
            monkeypatch.setattr(runner, "_print_summary", lambda *_: signal.raise_signal(2))
        with pytest.raises(SystemExit) as stop:
            main()
        return stop.value.code  # type: ignore[return-value]

    monkeypatch.setattr(sys, "argv", ["mjstack"])
    begin("--version")  # the job of the fixture from here on
    assert in_children(1, whole_command) == [0]
    assert json.loads(Path(NOON, "report.json").read_text())["status"] == "pass"


@pytest.mark.parametrize("link", [".hydra", ".hydra/overrides.yaml", "run.log"])
def test_a_folder_with_links_is_refused(
    link: str, begin: Callable[..., int], capsys: Capture
) -> None:
    precious = Path("precious")
    (precious if link == ".hydra" else Path("elsewhere")).mkdir()
    if link != ".hydra":
        precious.write_text("precious")
    place = Path("given") / link
    place.parent.mkdir(parents=True)
    place.symlink_to(precious.resolve())
    before = contents(Path())
    assert begin("hydra.run.dir=given") == 2
    assert f"given/{link} is a link" in capsys.readouterr().err
    assert contents(Path()) == before


RUN_DIR = "hydra.run.dir=given"
GATES = {"report.json": '{"resumes": ""}', ".hydra/config.yaml": "job: {name: gates}\n"}
COLLECT = {"report.json": '{"resumes": "collect"}', "dataset/meta/info.json": "{}"}
COLLECTING = {"resumes": "collect", "folder": Path("given")}
TRAINING = {"resumes": "train 12", "folder": Path("elsewhere")}


@pytest.mark.full
@pytest.mark.parametrize(
    ("files", "args", "changes"),
    [
        (GATES, [RUN_DIR], {}),
        (GATES, ["job=collect", "job.folder=given"], COLLECTING),
        (GATES, ["job=play", RUN_DIR], TRAINING),
        (GATES, ["-m", "seed=1,2", "hydra.sweep.dir=given"], {}),
        ({"report.json": "{", "run.log": ""}, [RUN_DIR], {}),
        (COLLECT, [RUN_DIR], {}),
        ({"report.json": '{"resumes": "train 34"}'}, ["job=play", RUN_DIR], TRAINING),
        ({"notes.txt": "mine"}, [RUN_DIR], {}),
        ({"dataset/mine.txt": "mine", "batches.json": "mine"}, ["job=collect"], COLLECTING),
    ],
)
def test_a_given_folder_of_another_run_is_refused(
    files: dict[str, str],
    args: list[str],
    changes: dict[str, object],
    begin: Callable[..., int],
    capsys: Capture,
) -> None:
    put(Path("given"), files)
    before = contents(Path())
    assert begin(*args, **changes) == 2
    err = capsys.readouterr().err
    assert err.startswith("mjstack: given has ")
    assert f"Set hydra.{'sweep' if '-m' in args else 'run'}." in err
    assert len(err.splitlines()) == 1
    assert contents(Path()) == before


HALF = {".hydra/config.yaml": "a: [", ".hydra/hydra.yaml": "", "run.log": "2026"}


@pytest.mark.full
@pytest.mark.parametrize(
    ("files", "changes"),
    [
        ({}, {}),
        (HALF, {}),
        ({".report.json.x1": "{"} | COLLECT | HALF, COLLECTING),
        ({"report.json": '{"resumes": "collect"}'} | HALF, COLLECTING),
        ({"report.json": '{"resumes": "train 12"}'} | HALF, TRAINING),
    ],
)
def test_a_job_goes_on_in_its_folder(
    files: dict[str, str], changes: dict[str, object], begin: Callable[..., int]
) -> None:
    Path("given").mkdir()
    put(Path("given"), files)
    job = str(changes.get("resumes") or "gates")
    args = [] if changes.get("folder") == Path("given") else [RUN_DIR]
    assert begin(f"job={job.split()[0]}", *args, **changes) == 0
    report = json.loads(Path("given", "report.json").read_text())
    assert (report["resumes"], report["status"]) == (changes.get("resumes", ""), "pass")
    assert "job:\n" in Path("given", ".hydra", "config.yaml").read_text()


def test_the_second_of_two_writes_nothing(begin: Callable[..., int], capsys: Capture) -> None:
    """Both have passed their checks; the first has begun and has written nothing yet."""
    with claim_folder(Path("given"), "collect"):
        assert begin("job=collect", **COLLECTING) == 2
        assert "given is open in another writer" in capsys.readouterr().err
        assert contents(Path()) == {"given": None}
        with pytest.raises(FolderError), claim_folder(Path("given")):
            pass
    assert begin("job=collect", **COLLECTING) == 0


def test_a_failed_claim_removes_what_it_made_alone(tmp_path: Path, monkeypatch: Patch) -> None:
    with pytest.raises(KeyboardInterrupt), claim_folder(tmp_path / "a" / "run"):
        raise KeyboardInterrupt
    assert contents(tmp_path) == {}
    with claim_folder(tmp_path / "run"):
        monkeypatch.setattr(Path, "exists", lambda path: False)  # not yet there at the first look
        with pytest.raises(FolderError), claim_folder(tmp_path / "run"):
            pass
        assert (tmp_path / "run").is_dir()


@pytest.mark.full
@pytest.mark.parametrize("limit", [0, 8, 40])
def test_a_full_disk_is_a_line_and_the_same_command_goes_on(
    limit: int, begin: Callable[..., int], tmp_path: Path
) -> None:
    """No file can have more than that many KiB."""
    output = tmp_path.parent / "output"
    output.unlink(missing_ok=True)

    def full(_: int) -> int:
        (reader, writer) = os.pipe()
        sys.stdout = sys.stderr = os.fdopen(writer, "w")
        resource.setrlimit(resource.RLIMIT_FSIZE, (1024 * limit, resource.RLIM_INFINITY))
        status = begin("job=collect", **COLLECTING)
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
        sys.stdout.flush()
        os.set_blocking(reader, False)
        output.write_bytes(os.read(reader, 65536))
        return status

    (status,) = in_children(1, full)
    lines = output.read_text().splitlines()
    assert "Traceback" not in " ".join(lines)
    problems = [line for line in lines if line.startswith("mjstack: ")]
    assert any("report: " in line for line in lines) == Path("given", "report.md").exists()
    assert status in ((0, 1, 2) if limit > 8 else (1, 2))
    assert len(problems) == bool(status)
    if status == 2:
        assert contents(Path()) == {}
        assert lines == problems
    assert begin("job=collect", **COLLECTING) == 0


DENIED: dict[str, tuple[Callable[[Path], object], list[str]]] = {
    "a folder": (lambda f: f.chmod(0), [RUN_DIR]),
    ".hydra": (lambda f: (f / ".hydra").chmod(0), []),
    "run.log": (lambda f: (f / "run.log").mkdir(), []),
    "the folder above": (lambda f: f.parent.chmod(0o555), ["hydra.run.dir=new"]),
}


@pytest.mark.full
@pytest.mark.parametrize("what", ["nothing", *DENIED])
def test_no_permission_is_a_line(
    what: str, begin: Callable[..., int], tmp_path: Path, monkeypatch: Patch
) -> None:
    """As another user, who owns everything there but for what a case takes away."""
    with tempfile.TemporaryDirectory() as home:  # pytest's own is its user's alone
        monkeypatch.chdir(home)
        status, lines = denied(what, begin, tmp_path / "output")
        monkeypatch.chdir(tmp_path)
    assert status == (0 if what == "nothing" else 2), lines
    if status:
        (line,) = lines
        assert line.startswith("mjstack: ")


def denied(what: str, begin: Callable[..., int], output: Path) -> tuple[int, list[str]]:
    """Exit status and lines of a command in the current folder."""
    put(Path("given"), {".hydra/config.yaml": "", "report.json": '{"resumes": "collect"}'})
    deny, args = DENIED.get(what, (lambda f: None, []))
    if os.geteuid() == 0:
        for path in (Path(), *Path().rglob("*")):
            os.chown(path, 65534, 65534)
    deny(Path("given"))

    def as_nobody(_: int) -> int:
        if os.geteuid() == 0:
            os.setgid(65534)
            os.setuid(65534)
        return begin("job=collect", *args, **COLLECTING)

    (status,) = in_children(1, as_nobody, output)
    for path in (Path(), *Path().glob("*")):
        path.chmod(0o755)
    return status, output.read_text().splitlines()


@pytest.mark.full
@pytest.mark.parametrize("report", ["given/report.json", "given/0/report.json"])
def test_a_folder_of_another_version_is_named(
    report: str, begin: Callable[..., int], error_line: Callable[[], str]
) -> None:
    for version, says in (("0.1.0", " of mjstack 0.1.0,"), (mjstack.__version__, ",")):
        facts = {"provenance": {"versions": {"mjstack": version}}}
        put(Path(), {report: json.dumps(facts)})
        assert begin("-m", "seed=0,1", "hydra.sweep.dir=given") == 2
        assert f"given has {Path(report).parts[1]}{says}" in error_line()
