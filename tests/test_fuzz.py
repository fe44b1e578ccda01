"""Seeded command lines, and damaged folders of policies, runs and datasets.

The check of each passes, or ends in one line and exit status 2. Then nothing is written. Nothing
in the home folder changes, and no process is left. A tenth of the command lines that pass
are run to the end.

The cases run in forked children of a process of their own, whose modules are loaded already:
``python tests/test_fuzz.py commands 17 200-220`` runs these cases and prints what they say.
"""

import copy
import gc
import hashlib
import importlib
import os
import pkgutil
import random
import re
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import mjstack.cli  # before mujoco, which decides at its import how it draws

# isort: split
import pytest
import torch
from fuzz_cases import CHOSEN, QUICK, Make, command_lines, damaged_folders, is_short
from fuzz_datasets import damaged_datasets

from mjstack.config.load import compose
from mjstack.config.session import hydra_session

# `make fuzz` tries 1,000, 500 and 200
COUNTS = {"commands": 30, "folders": 40, "datasets": 10}
CASES = {
    "commands": command_lines,
    "folders": damaged_folders,
    "datasets": damaged_datasets,
}
UNTOUCHED = ("policy", "run")  # what is only read
PASSED = 77  # exit status of a child whose check has passed
ENDS = {PASSED: "passed", 0: "shown, or run", 2: "one line"}
SECONDS = 20  # of processor time that a check may take; the slowest of them takes three
MEGABYTES = 1024  # of memory that a check may take beside the modules
AT_ONCE = 3  # the process that forks works too


@pytest.mark.full
def test_a_check_passes_or_says_one_line() -> None:
    """All kinds in one process: loading all modules takes it as long as thirty cases."""
    done = subprocess.run([sys.executable, __file__], capture_output=True, text=True, timeout=1500)
    print(done.stdout[-20_000:])
    assert done.returncode == 0, done.stdout[-20_000:] + done.stderr[-3000:]
    for kind, count in COUNTS.items():
        assert f"{kind}: {count} cases" in done.stdout


class Outcome(NamedTuple):
    """How a child ended."""

    status: int
    out: str
    err: str
    changed: list[str]
    left: bool
    megabytes: float

    def problem(self, *, ran: bool = False) -> str:
        """Why that is not one of the answers that are allowed; empty if it is."""
        if "Traceback" in self.out + self.err:
            return "a traceback"
        if self.left:
            return "a process is left"
        if self.megabytes > MEGABYTES and not ran:
            return f"{self.megabytes:.0f} MB"
        goes_on = self.status in (0, 1, PASSED)
        allowed = re.compile(rf"cwd/(?!({'|'.join(UNTOUCHED)})(/|$))")
        if wrote := [name for name in self.changed if not (goes_on and allowed.match(name))]:
            return f"wrote {', '.join(wrote[:3])}"
        if self.status == 2:
            lines = [line for line in self.err.splitlines() if line.strip()]
            # Warp's own, in a process that loads it where there is no CUDA
            lines = [line for line in lines if not line.startswith("Warp CUDA warning")]
            if len(lines) != 1 or not lines[0].startswith("mjstack: "):
                return f"{len(lines)} lines on stderr"
            if len(lines[0]) > 300:
                return f"a line of {len(lines[0])} letters"
            if re.search(r"[\x00-\x08\x0b-\x1f\x7f]", lines[0]):
                return "control characters"
            return "" if not self.out.strip() else "exit 2 with output"
        if self.status in ((0, 1) if ran else (0, PASSED)):
            return ""
        return "too slow" if self.status < 0 else f"exit status {self.status}"

    def lines(self) -> str:
        """The first lines of what it said."""
        text = (self.err.strip() or self.out.strip()).splitlines()
        return " / ".join([*text[:1], *text[-1:]])[:300]


@dataclass
class Child:
    """A forked case."""

    case: int
    ran: bool
    args: list[str]
    home: Path
    before: dict[str, str]
    pid: int = 0
    began: float = field(default_factory=time.monotonic)


# The process that forks


def main(kind: str = "", *numbers: str) -> int:
    """Run all cases of each kind, those of one kind, or some of them."""
    _preload()
    spans = [[int(end) for end in number.split("-")] for number in numbers]
    cases = [case for span in spans for case in range(span[0], span[-1] + 1)]
    return max([judge_cases(name, cases) for name in ([kind] if kind else COUNTS)])


def judge_cases(kind: str, cases: Sequence[int]) -> int:
    """Run cases of a kind, or as many as the test tries; 1 if one of them ends badly."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as temporary:
        fixture = Path(temporary)
        make = CASES[kind](fixture)
        gc.collect()
        gc.freeze()
        cases = cases or list(range(COUNTS[kind]))
        talks = len(cases) < 30
        counts: Counter[str] = Counter()

        def judge(numbers: Sequence[int], *, run: bool = False) -> list[int]:
            """Count how cases end, and return those that pass and are short."""
            passed = []
            for child, outcome in _fork_all(numbers, make, fixture, run=run):
                problem = outcome.problem(ran=run)
                counts["bad"] += bool(problem)
                counts[problem or ENDS.get(outcome.status, f"status {outcome.status}")] += 1
                if problem or talks:
                    line = f"{kind} {child.case}{', run' * run}: {shlex.join(child.args)}"
                    print(f"{line}\n  {problem}: {outcome.lines()}", flush=True)
                if outcome.status == PASSED and is_short(child.args):
                    passed.append(child.case)
            return passed

        passed = judge(cases)
        if kind == "commands":
            tenth = min(counts["passed"] // 10 + 1, len(passed))
            judge(passed if talks else random.Random(kind).sample(passed, tenth), run=True)
    print(
        f"{kind}: {len(cases)} cases: {dict(counts)}; {time.monotonic() - began:.0f} s", flush=True
    )
    return min(counts["bad"], 1)


def _fork_all(
    cases: Sequence[int], make: Make, fixture: Path, *, run: bool = False
) -> Iterator[tuple[Child, Outcome]]:
    """Fork a child per case, some at a time."""
    running: dict[int, Child] = {}
    waiting = iter(cases)
    while True:
        while len(running) < AT_ONCE and (case := next(waiting, None)) is not None:
            child = _fork(case, make, fixture, run)
            running[child.pid] = child
        if not running:
            return
        pid, status, used = os.wait4(-1, os.WNOHANG)
        if pid in running:
            more = (used.ru_maxrss - resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) / 1024
            yield running[pid], _outcome(running.pop(pid), os.waitstatus_to_exitcode(status), more)
        elif not pid:
            time.sleep(0.005)
            for child in running.values():
                if time.monotonic() - child.began > 20 * SECONDS:
                    os.killpg(child.pid, signal.SIGKILL)


def _fork(case: int, make: Make, fixture: Path, run: bool) -> Child:
    home = Path(tempfile.mkdtemp(dir=fixture))
    (home / "cwd").mkdir()
    for name in (".bashrc", "notes.txt", "policy/policy.json", "run/report.json"):
        (home / "user" / name).parent.mkdir(parents=True, exist_ok=True)
        (home / "user" / name).write_text("the user's")
    args = make(case, home / "cwd")
    child = Child(case, run, args, home, _content(home))
    child.pid = os.fork()
    if not child.pid:
        _be_the_command(child)
    return child


def _be_the_command(child: Child) -> None:
    """Become the command line, in a folder that is empty but for what the case put there."""
    status = 1
    try:
        os.setsid()
        gc.disable()  # a child lives for a second
        os.chdir(child.home / "cwd")
        for number, name in ((0, os.devnull), (1, child.home / "out"), (2, child.home / "err")):
            file = os.open(name, os.O_RDWR | os.O_CREAT | os.O_TRUNC)
            os.dup2(file, number)
        resource.setrlimit(resource.RLIMIT_CPU, (3 * SECONDS if child.ran else SECONDS,) * 2)
        resource.setrlimit(resource.RLIMIT_AS, (2**34, 2**34))
        caches = Path.home()  # of matplotlib and Warp
        os.environ |= {
            f"XDG_{name.upper()}_HOME": f"{caches}/.{name}" for name in ("cache", "config")
        }
        os.environ["HOME"] = str(child.home / "user")
        if not child.ran:
            from hydra._internal.hydra import Hydra

            Hydra.run = Hydra.multirun = _pass  # type: ignore[method-assign, assignment]
        sys.argv = ["mjstack", *child.args]
        from mjstack.__main__ import main as command

        command()
    except SystemExit as stop:
        status = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(status)


def _pass(*_: object, **__: object) -> None:
    """The check has passed, and Hydra would make the folder now."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(PASSED)


def _outcome(child: Child, status: int, megabytes: float) -> Outcome:
    out, err = ((child.home / name).read_text(errors="replace") for name in ("out", "err"))
    now = _content(child.home)
    changed = sorted(
        name
        for name in now | child.before
        if now.get(name) != child.before.get(name) and name not in ("out", "err")
    )
    shutil.rmtree(child.home, ignore_errors=True)
    left = True
    try:
        os.killpg(child.pid, 0)
    except ProcessLookupError:
        left = False
    return Outcome(status, out, err, changed, left, megabytes)


def _content(folder: Path) -> dict[str, str]:
    """Every path below a folder, with the hash of a file and the target of a link."""

    def digest(path: Path) -> str:
        if path.is_symlink():
            return os.readlink(path)
        return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""

    return {str(path.relative_to(folder)): digest(path) for path in folder.rglob("*")}


def _preload(chosen: Sequence[str] = CHOSEN) -> None:
    """Load what a command line loads, and keep what it and some choices read of YAML."""
    import matplotlib
    import yaml

    matplotlib.use("Agg")
    torch.set_num_threads(1)  # a forked child waits for ever for OpenMP's threads of its parent
    for module in pkgutil.walk_packages(mjstack.__path__, "mjstack.", onerror=lambda name: None):
        if not re.search(r"__main__|adapters|bench", module.name):
            importlib.import_module(module.name)
    read = yaml.load
    known: dict[str, Any] = {}

    def load(stream: Any, Loader: Any) -> Any:
        if not hasattr(stream, "seek"):
            return read(stream, Loader=Loader)
        text = stream.read()
        if text not in known:
            stream.seek(0)
            known[text] = read(stream, Loader=Loader)
        return copy.deepcopy(known[text])

    yaml.load = load
    with hydra_session():
        for choice in [[], *([choice] for choice in chosen)]:
            for more in [[], QUICK[1:2]]:
                compose(choice + more)


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
