"""Commands in processes of their own, and in ranks."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from environments import one_second_episode

import mjstack

SHORT = ["sim=native", "gates=[batch]", *one_second_episode()]
PLAIN = [*SHORT, "web.episode=false"]
SCRIPT = Path(mjstack.__file__).parents[1] / "scripts" / "run.py"


def start(ranks: int, args: Sequence[str], folder: Path, **env: str) -> subprocess.Popen[str]:
    """A command in ranks of this machine; its output goes to one pipe."""
    launcher = ["-m", "torch.distributed.run", f"--nproc-per-node={ranks}", "-m"]
    command = [*(launcher if ranks else ["-m"]), "mjstack", *args]
    return start_python(command, folder, **env)


def start_python(args: Sequence[str], folder: Path, **env: str) -> subprocess.Popen[str]:
    """Python with arguments; it finds this mjstack, and its output goes to one pipe."""
    root = str(Path(mjstack.__file__).parents[1])
    return subprocess.Popen(
        [sys.executable, *args],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": root, "OMP_NUM_THREADS": "1"} | env,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def play(ranks: int, args: Sequence[str], folder: Path, status: int | None = 0, **env: str) -> str:
    """The output of such a command when it has ended."""
    process = start(ranks, args, folder, **env)
    text, _ = process.communicate(timeout=400)
    assert status is None or process.returncode == status, text
    return text


def rank_process(parent: int, rank: int) -> int:
    """The process of a rank that a command has started, as soon as there is one."""
    until = time.monotonic() + 60.0
    while time.monotonic() < until:
        for path in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError, IndexError):
                above = int((path / "stat").read_text().rpartition(")")[2].split()[1])
                environment = (path / "environ").read_bytes().split(b"\0")
                if above == parent and f"RANK={rank}".encode() in environment:
                    return int(path.name)
        time.sleep(0.05)
    raise AssertionError(f"rank {rank} has not started")
