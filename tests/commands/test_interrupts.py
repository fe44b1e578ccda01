"""Ctrl-C and SIGTERM at random moments: of a command, in forked children of a process of their own
as in test_fuzz.py, and of a script that steps an environment.

How 250 runs end is printed by
``PYTHONPATH=tests/helpers python tests/commands/test_interrupts.py gates 250``.
"""

import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections import Counter
from pathlib import Path

from forked import fork, preload

# isort: split
import pyarrow.parquet as pq
import pytest
import torch
from compositions import make_env
from environments import one_second_episode

from mjstack.interrupt import EXIT_CODE

NO_WORK = "mjstack: interrupted before anything ran\n"
WORK = "interrupted; the finished gates are in the report\n"
PROPER = {"before it ran", "while it ran", "after its last step", "ended by itself"}
COMMANDS = {
    "gates": ["gates=[baseline,batch]", "gate.batch.seeds=3"],
    "collect": ["job=collect", "job.folder=demos", "job.episodes=5", "job.keep_failures=true"],
}
SECONDS = 2.0  # of processor time, in which an interrupted command ends


@pytest.mark.full
def test_a_command_that_is_interrupted() -> None:
    """Four times of each kind, once in every quarter of it."""
    command = [sys.executable, __file__, "all", "4"]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-3000:]
    for kind in COMMANDS:
        assert f"{kind}: 4 runs" in done.stdout


@pytest.mark.full
def test_a_script_that_is_interrupted() -> None:
    """KeyboardInterrupt reaches it and no other error does, and the environment goes on."""
    assert interrupt_steps(100) == {"KeyboardInterrupt": 100}


def interrupt_steps(count: int) -> Counter[str]:
    """Interrupt a loop of `Env.step` at random moments; how each time ended."""
    moments = random.Random(0)
    ended: Counter[str] = Counter()
    env = make_env(["sim=native"], nworld=8)
    env.reset(seed=0)
    action = torch.zeros((env.nworld, env.action_manager.action_dim))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        for number in range(count):
            # To the process, as a terminal does. To the timer's own thread it could stay unnoticed.
            ask = (os.getpid(), signal.SIGINT)
            timer = threading.Timer(moments.uniform(0.001, 0.02), os.kill, ask)
            try:
                timer.start()
                until = time.monotonic() + 20.0
                while time.monotonic() < until:
                    env.step(action)
                ended["none"] += 1
            except BaseException as error:
                ended[type(error).__name__] += 1
            timer.join()
            if number % 2:
                env.reset(seed=0)
            observed, *_ = env.step(action)
            assert all(group.isfinite().all() for group in observed.values())
    finally:
        signal.signal(signal.SIGINT, before)
    env.close()
    return ended


# The process that forks


def main(kind: str, count: str) -> int:
    """Interrupt commands of a kind, or of all, and print how each ended."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # it may be ignored where tests run
    preload()
    warnings.simplefilter("ignore")  # of a machine that cannot draw
    return max([interrupt_kind(name, int(count)) for name in COMMANDS if kind in (name, "all")])


def interrupt_kind(kind: str, count: int) -> int:
    """Interrupt a command at a random moment of each of as many equal parts of it; 1 if it ends
    too late or in no proper way.
    """
    moments = random.Random(kind)
    ended: Counter[str] = Counter()
    slowest = 0.0
    with tempfile.TemporaryDirectory() as fixture:
        whole = min(interrupt_command(kind, Path(fixture), None)[1] for _ in range(2))
        for number in range(count):
            delay = moments.uniform(number, number + 1) / count * 0.95 * whole
            how, seconds = interrupt_command(kind, Path(fixture), delay)
            print(f"after {delay:.2f} s: {how}, {seconds:.2f} s later", flush=True)
            slowest = max(slowest, seconds)
            ended[how] += 1
    print(f"{kind}: {count} runs of {whole:.1f} s: {dict(ended)}, slowest {slowest:.2f} s")
    return int(slowest > SECONDS or not ended.keys() <= PROPER)


def interrupt_command(kind: str, fixture: Path, delay: float | None) -> tuple[str, float]:
    """How a command ended that was interrupted after some seconds of processor time, or was not,
    and the processor time from then on.
    """
    args = [*COMMANDS[kind], "nworld=2", "sim=native", *one_second_episode()]
    child = fork(lambda folder: args, fixture, run=True)
    before = 0.0
    if delay is not None:
        while (before := used_by(child.pid)) < delay:
            time.sleep(0.01)
        os.kill(child.pid, random.Random(delay).choice([signal.SIGINT, signal.SIGTERM]))
    _, status, usage = os.wait4(child.pid, 0)
    seconds = usage.ru_utime + usage.ru_stime - before
    try:
        # An interrupt that is lost is one that the command goes on after.
        if before == math.inf or (status in (0, 256) and seconds < 0.3):
            return "ended by itself", 0.0
        return describe_end(child.home, os.waitstatus_to_exitcode(status)), seconds
    finally:
        shutil.rmtree(child.home)


def used_by(pid: int) -> float:
    """Processor time of a process so far [s]: others may use this machine too."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return math.inf if fields[0] == "Z" else sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


def describe_end(home: Path, status: int) -> str:
    """Which of the proper ends of an interrupted command it was, or what is wrong."""
    out, err = ((home / name).read_text() for name in ("out", "err"))
    err = "".join(line for line in err.splitlines(True) if not line.startswith("Warp CUDA"))
    files = [path for path in (home / "cwd").rglob("*") if path.is_file()]
    for path in files:
        if path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".parquet":
            pq.read_table(path)
    reports = [json.loads(path.read_text()) for path in files if path.name == "report.json"]
    if (status, out, err, files) == (EXIT_CODE, "", NO_WORK, []):
        return "before it ran"
    if (status, err, len(reports)) == (EXIT_CODE, "", 1):
        stopped = reports[0]["status"] == "interrupted"
        if out.count(WORK) == stopped:
            return "while it ran" if stopped else "after its last step"
    return f"exit status {status}, {len(reports)} reports: {out[-300:]}{err[-300:]}"


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
