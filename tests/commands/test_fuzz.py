"""Odd command lines, and damaged folders of policies, runs and datasets, drawn by a number.

The check of each passes, or ends in one line and exit status 2; then nothing is written. Nothing in
the home folder changes, and no process is left. A tenth of the command lines that pass are run to
the end. These cases are tried and printed by
``PYTHONPATH=tests/helpers python tests/commands/test_fuzz.py commands 17 200-220``.
"""

import json
import os
import random
import re
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from forked import PASSED, SECONDS, Child, content, fork, is_alive, kill, preload

# isort: split
import pytest
import yaml
from environments import configure, one_second_episode
from policies import write_policy

from mjstack import load_config
from mjstack.cli import run

# `make fuzz` tries 1,000, 500 and 200
COUNTS = {"commands": 30, "folders": 40, "datasets": 10}
UNTOUCHED = ("policy", "run")  # what is only read
ENDS = {PASSED: "passed", 0: "shown, or run", 2: "one line"}
MEGABYTES = 1024  # of memory that a check may take beside the modules
AT_ONCE = 3  # the process that forks works too
Make = Callable[[int, Path], list[str]]
"""Puts a case's files into its folder and returns its arguments."""


@pytest.mark.full
def test_a_check_passes_or_says_one_line() -> None:
    """All kinds in one process: loading all modules takes it as long as thirty cases."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, __file__]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=1500)
    print(done.stdout[-20_000:])
    assert done.returncode == 0, done.stdout[-20_000:] + done.stderr[-3000:]
    for kind, count in COUNTS.items():
        assert f"{kind}: {count} cases" in done.stdout


def main(kind: str = "", *numbers: str) -> int:
    """Try all cases of each kind, those of one kind, or some of them."""
    preload([[choice, *more] for choice in CHOSEN for more in ([], QUICK[1:2])])
    spans = [[int(end) for end in number.split("-")] for number in numbers]
    cases = [case for span in spans for case in range(span[0], span[-1] + 1)]
    return max([judge_cases(name, cases) for name in ([kind] if kind else COUNTS)])


def judge_cases(kind: str, cases: Sequence[int]) -> int:
    """Try cases of a kind, or as many as the test tries; 1 if one of them ends badly."""
    began = time.monotonic()
    cases = cases or range(COUNTS[kind])
    verbose = len(cases) < 30
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        make = KINDS[kind](Path(folder))

        def judge(numbers: Sequence[int], run: bool) -> list[int]:
            """Count how cases end, and return those that pass and are short."""
            passed = []
            for case, child, status, megabytes in _ended(numbers, make, Path(folder), run):
                out, err = ((child.home / n).read_text(errors="replace") for n in ("out", "err"))
                problem = find_problem(child, status, out, err, 0.0 if run else megabytes, run)
                shutil.rmtree(child.home, ignore_errors=True)
                counts["bad"] += bool(problem)
                counts[problem or ENDS.get(status, f"status {status}")] += 1
                if problem or verbose:
                    says = (err.strip() or out.strip())[:300]
                    print(f"{kind} {case}{', run' * run}: {shlex.join(child.args)}", flush=True)
                    print(f"  {problem}: {says}", flush=True)
                if status == PASSED and is_short(child.args):
                    passed.append(case)
            return passed

        passed = judge(cases, False)
        if kind == "commands":
            tenth = min(counts["passed"] // 10 + 1, len(passed))
            judge(passed if verbose else random.Random(kind).sample(passed, tenth), True)
    seconds = time.monotonic() - began
    print(f"{kind}: {len(cases)} cases: {dict(counts)}; {seconds:.0f} s", flush=True)
    return min(counts["bad"], 1)


def _ended(
    cases: Sequence[int], make: Make, folder: Path, run: bool
) -> Iterator[tuple[int, Child, int, float]]:
    """Fork a child per case, some at a time: the case, its child, exit status and memory [MB]."""
    running: dict[int, tuple[int, Child]] = {}
    waiting = iter(cases)
    while True:
        while len(running) < AT_ONCE and (case := next(waiting, None)) is not None:
            child = fork(lambda cwd, case=case: make(case, cwd), folder, run=run)  # type: ignore[misc]
            running[child.pid] = case, child
        if not running:
            return
        pid, status, used = os.wait4(-1, os.WNOHANG)
        if pid in running:
            more = used.ru_maxrss - resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            yield *running.pop(pid), os.waitstatus_to_exitcode(status), more / 1024
        elif not pid:
            time.sleep(0.005)
            for _, child in running.values():
                if time.monotonic() - child.began > 20 * SECONDS:
                    kill(child)


def find_problem(child: Child, status: int, out: str, err: str, megabytes: float, run: bool) -> str:
    """Why an end is not one of those that are allowed; empty if it is."""
    now = content(child.home)
    paths = [p for p in now | child.before if now.get(p) != child.before.get(p)]
    allowed = re.compile(rf"cwd/(?!({'|'.join(UNTOUCHED)})(/|$))")
    goes_on = status in (0, 1, PASSED)
    wrote = [p for p in paths if p not in ("out", "err") and not (goes_on and allowed.match(p))]
    # Warp's own, in a process that loads it where there is no CUDA
    lines = [s for s in err.splitlines() if s.strip() and not s.startswith("Warp CUDA warning")]
    refusal = lines[0] if status == 2 and len(lines) == 1 else "mjstack: "
    problems = {
        "a traceback": "Traceback" in out + err,
        "a process is left": is_alive(child),
        f"{megabytes:.0f} MB": megabytes > MEGABYTES,
        f"wrote {', '.join(wrote[:3])}": bool(wrote),
        f"{len(lines)} lines on stderr": status == 2 and len(lines) != 1,
        f"the line {refusal[:20]}": not refusal.startswith("mjstack: "),
        f"a line of {len(refusal)} letters": len(refusal) > 300,
        "control characters": bool(re.search(r"[\x00-\x08\x0b-\x1f\x7f]", refusal)),
        "exit 2 with output": status == 2 and bool(out.strip()),
        "too slow": status < 0,
        f"exit status {status}": status not in (2, *((0, 1) if run else (0, PASSED))),
    }
    return next((problem for problem, found in problems.items() if found), "")


# Command lines


QUICK = ["nworld=2", "sim=native", "gates=[baseline]"]
SHORT = [*QUICK[:2], *one_second_episode()]
CHOSEN = ["task=stack", "task=box", "task=reach", "job=collect", "job=replay", "job=train"]
ODD = r"""
-1 0 2 0.5 1e-30 1e308 1e999 10000000000000000000000 007 1_000 nan -inf true null None '' x [] {}
[1,2] [nan,0] [[1]] {a:{b:[1]}} {func:math.sqrt} ??? ${nope} ${oc.env:HOME} ${now:%Y} ${..name} 1,2
, = a=b [/] %s \\ ../x /proc/x /dev/null . ~ * `id` é☃ 🤖 range(3,1) choice() glob(*) int(2.5)
"""
TEXT = ["a b", "'a b'", "a\tb", "a\nb", "\x1b[31m", "\u202e", "x" * 3000, "[" * 200]
FUNCS = """
mjstack.mdp.reward.reach mjstack.mdp.reward.nope mjstack.mdp mjstack.mdp.termination.time_out
mjstack.mdp.action.JointPosition mjstack.tasks.box.BoxCheck mjstack.tasks.progress.Progress
mjstack.cli.run mjstack.cli.os.getcwd mjstack.gates.episodes.judge_episodes mjstack.envs.Env
mjstack.__main__.main builtins.print builtins.None sys.exit math.sqrt torch.zeros this antigravity.x
nope.nope nope..nope .nope mjstack..cli é.☃ '' 3 null [x]
"""
MORE = """
--help -h --cfg=job --cfg=nope --version --info=config --hydra-help --resolve -p=gate.x -m
--config-dir=nope --config-dir --config-name=x --config-path=x --run -x - --- --experimental-rerun=x
task@x=stack +robot=rebot ~model /scene=box robot:so101 timing=Stack model=[] action=../stack
job=replay,run=. job=replay,run=nope,world=-1 job=export,run=/dev/null job=train,run=x job=collect
hydra.run.dir=x hydra.run.dir=. hydra.run.dir=/proc/x hydra.run.dir=null hydra.run.dir=${nope}
hydra.sweep.subdir= hydra.job.chdir=true hydra/job_logging=nope hydra/sweeper=x hydra/launcher=nope
hydra.verbose=[x] hydra.output_subdir=null hydra.output_subdir=/proc/x hydra.mode=MULTIRUN hydra=x
hydra.searchpath=[pkg://nope] ~hydra.run +hydra.callbacks.x={_target_:nope.nope} hydra.callbacks=3
"""


def command_lines(folder: Path) -> Make:
    """Changed command lines; an experiment in the folder makes episodes of a second."""
    phases = [o.split("=") for o in one_second_episode() if o.startswith("controller")]
    short = {"phases": {key.split(".")[2]: {"seconds": float(value)} for key, value in phases}}
    (folder / "conf" / "experiment").mkdir(parents=True)
    text = yaml.dump({"controller": short, "task": {"check": {"window": 5}}})
    (folder / "conf" / "experiment" / "tiny.yaml").write_text(f"# @package _global_\n{text}")
    load_config(["experiment=tiny"], config_dir=folder / "conf")  # composed before the children
    sys.path.remove(str(folder))
    keys = {chosen: dict(_flat(asdict(configure(chosen)))) for chosen in CHOSEN}

    def make(case: int, cwd: Path) -> list[str]:
        draw = random.Random(f"command {case}")
        chosen = draw.choice(["task=stack"] * 6 + list(keys))
        args = [f"--config-dir={folder}/conf", *QUICK, "experiment=tiny"]
        if chosen != "task=stack":
            args = [*QUICK[: draw.randrange(4)], chosen]
        for _ in range(draw.choice((1, 1, 1, 1, 2, 3))):
            more, anywhere = _change(draw, args, keys[chosen])
            at = draw.randrange(len(args) + 1) if anywhere else len(args)
            args = [*args[:at], *more, *args[at:]]
        return [arg.replace("\0", "") for arg in args]

    return make


def _flat(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and their values."""
    if isinstance(node, dict) and key.count(".") < 5:
        for name, value in node.items():
            yield from _flat(value, f"{key}.{name}" if key else str(name))
    if key:
        yield key, node


def _change(draw: random.Random, args: list[str], keys: dict[str, Any]) -> tuple[list[str], bool]:
    """More arguments, and whether they may stand anywhere. A character more is put into one."""
    key, usual = draw.choice(list(keys.items()))
    kind = draw.choice(("value", "value", "key", "func", "more", "text", "text"))
    at = draw.randrange(len(key))
    if kind == "value":
        value = draw.choice([*ODD.split(), *TEXT, str(usual).replace(" ", "")])
        if isinstance(usual, int | float) and draw.random() < 0.7:
            value = str(type(usual)(usual * draw.choice((0.5, 1, 1, 2, 10, -1))))
        return [f"{draw.choice(('', '', '', '', '+', '++'))}{key}={value}"], False
    if kind == "key":
        wrong = (key[:at] + key[at + 1 :], f"{key[:at]}é{key[at:]}", f"{key}[0]", key.upper(), "")
        forms = (f"~{key}", f"~{key}=1", "{}=1", "+{}=1", "~{}", "{}")
        return [draw.choice(forms).replace("{}", draw.choice(wrong))], False
    if kind == "func":
        named = draw.choice([key for key in keys if key.endswith(".func")])
        params = draw.choice(("", ",params:{x:1}", ",weight:1", ",weight:1,params:3"))
        section = draw.choice(("reward", "termination", "reset", "observation.policy.terms"))
        func = draw.choice(FUNCS.split())
        return [draw.choice((f"{named}={func}", f"+{section}.x={{func:{func}{params}}}"))], False
    if kind == "more":
        return draw.choice(MORE.split()).split(","), True
    letters = "=+~[]{}'\",:$ \\\t\n.@/-xé3"
    if draw.random() < 0.5:
        return ["".join(draw.choices(letters, k=draw.randrange(12)))], True
    arg = args.pop(draw.randrange(len(args)))
    at = draw.randrange(len(arg) + 1)
    return [arg[:at] + draw.choice(letters) + arg[at:]], True


def is_short(args: list[str]) -> bool:
    """Whether a command line that passed its check can be run to its end."""
    long = (
        r"seconds|seeds|repetitions|steps|iterations|physics_dt|decimation|scaling|solver|timing"
        r"|video|view|minutes|launcher|range|/proc|nworld=(?![12]\b)"
    )
    return set(QUICK) <= set(args) and not re.search(long, " ".join(args))


# Damaged folders


COLLECT = [
    *("job=collect", *SHORT, "observation=state", "+observation.policy.noise=false"),
    *("job.keep_failures=true", "job.folder=set"),
]
COMMANDS = {
    "policy": ["controller=policy", "policy=policy", "gates=[batch]", *SHORT],
    "run": ["job=replay", "run=run", "world=failing"],
    "set": [*COLLECT, "job.episodes=3"],
}
TRAIN = [
    *("job=train", "trainer=clone", "job.dataset=set/dataset", *SHORT, "job.folder=trained"),
    *("job.batches=2", "job.batch_size=16", "job.hidden=[8]"),
]
TEXTS = (
    b"", b"\0", b"null", b"[]", b"{}", b"3", b"a: [", b"\xff\xfe\x00", b"PK\x03\x04", b"PAR1PAR1",
    b"[" * 100_000, b'{"a":' * 100_000, b"!!python/object:os.system {}", b"x: 1" + b":00" * 30_000,
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, -1, 3, -0.5, 1e308, float("nan"), 10**30, 2**63, "x", "é" * 1000, [], {}, [1], [[]],
    [1] * 4000, {"a": 1}, "../x", "/etc/passwd", "${oc.env:HOME}", "os.getpid", "\x1b[31mx", "[/]",
    "x" * 10**6, {f"k{n}": [] for n in range(30_000)},
)  # fmt: skip


def damaged_folders(folder: Path) -> Make:
    """Policies that gate *batch* is to play, and runs whose worlds are to be played again."""
    with chdir(folder):
        write_policy(Path("policy"), load_config(["sim=native"]))
        assert run(["gates=[batch]", *SHORT, "hydra.run.dir=run"]) == 1
    return _damaged(folder, UNTOUCHED)


def damaged_datasets(folder: Path) -> Make:
    """Datasets that *collect* is to go on with, or a clone to learn from."""
    with chdir(folder):
        assert run([*COLLECT, "job.episodes=2"]) == 0
    return _damaged(folder, ("set",))


def _damaged(folder: Path, names: Sequence[str]) -> Make:
    for picture in folder.rglob("*.png"):
        picture.unlink()

    def make(case: int, cwd: Path) -> list[str]:
        draw = random.Random(f"{names} {case}")
        name = names[case % len(names)]
        shutil.copytree(folder / name, cwd / name)
        for _ in range(draw.choice((1, 1, 1, 2))):
            read = {".json", ".yaml", ".npz", ".safetensors", ".parquet"}
            paths = [p for p in sorted((cwd / name).rglob("*")) if not p.is_symlink()]
            damage(draw, draw.choice([p for p in paths if p.suffix in read or p.is_dir()]))
        return TRAIN if name == "set" and draw.random() < 0.5 else COMMANDS[name]

    return make


def damage(draw: random.Random, path: Path) -> None:
    """Cut, replace, remove or redirect a file or a folder, or change a value in it."""
    is_text = path.suffix in (".json", ".yaml")
    values = ["value"] * 6 if is_text else ["cut"]  # tables of each reader have other values
    kind = draw.choice(("cut", "text", "text", "gone", "link", "other", *values))
    if path.is_dir() and kind in ("cut", "text"):
        kind = draw.choice(("gone", "link", "other"))
    if kind == "cut":
        content = path.read_bytes()
        path.write_bytes(content[: draw.randrange(len(content) + 1)])
    elif kind == "text":
        path.write_bytes(draw.choice(TEXTS))
    elif kind == "value":
        with suppress(Exception):  # it may be damaged already
            _change_value(draw, path)
    else:
        moved = path.with_name(f"{path.name}.moved")
        path.rename(moved)
        if kind == "link":
            path.symlink_to(draw.choice((moved.name, "/dev/null", "/dev/zero", path.name, "nope")))
        elif kind == "other":
            draw.choice((path.mkdir, lambda: os.mkfifo(path), lambda: path.write_text("x")))()


def _change_value(draw: random.Random, path: Path) -> None:
    """Another value, or none, for a key of JSON or YAML."""
    is_json = path.suffix == ".json"
    node = data = json.loads(path.read_text()) if is_json else yaml.safe_load(path.read_text())
    while True:
        name = draw.choice(list(node) if isinstance(node, dict) else range(len(node)))
        if not isinstance(node[name], dict | list) or not node[name] or draw.random() < 0.2:
            break
        node = node[name]
    if draw.random() < 0.3 and isinstance(node, dict):
        del node[name]
    else:
        node[name] = draw.choice(VALUES)
    path.write_text(json.dumps(data) if is_json else yaml.safe_dump(data))


KINDS = {"commands": command_lines, "folders": damaged_folders, "datasets": damaged_datasets}

if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
