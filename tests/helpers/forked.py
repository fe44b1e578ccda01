"""Commands in forked children of a process that has loaded all modules, which spares each child
some seconds.
"""

import gc
import hashlib
import importlib
import os
import pkgutil
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mjstack.cli  # before mujoco, which decides at its import how it draws

# isort: split
import torch

from mjstack.config.load import compose
from mjstack.config.session import hydra_session

PASSED = 77  # exit status of a child whose check has passed
SECONDS = 20  # of processor time that a check may take; the slowest of them takes three
USERS = (".bashrc", "policy/policy.json", "run/report.json")


@dataclass
class Child:
    """A command in the folder ``cwd`` of a home of its own."""

    args: list[str]
    home: Path
    before: dict[str, str]
    pid: int = 0
    began: float = field(default_factory=time.monotonic)


def preload(choices: Sequence[Sequence[str]] = ()) -> None:
    """Load what a command loads, and keep the YAML that some choices of groups read."""
    import compositions  # noqa: F401  # which reads a YAML text once
    import matplotlib

    matplotlib.use("Agg")
    torch.set_num_threads(1)  # a forked child waits for ever for OpenMP's threads of its parent
    for module in pkgutil.walk_packages(mjstack.__path__, "mjstack.", onerror=lambda name: None):
        if not re.search(r"__main__|adapters|bench", module.name):
            importlib.import_module(module.name)
    with hydra_session():
        for choice in [[], *choices]:
            compose(choice)
    gc.collect()
    gc.freeze()


def fork(make: Callable[[Path], list[str]], folder: Path, *, run: bool) -> Child:
    """Start a command, or its check alone; ``make`` fills its working folder and returns its
    arguments.
    """
    home = Path(tempfile.mkdtemp(dir=folder))
    (home / "cwd").mkdir()
    for name in USERS:
        (home / "user" / name).parent.mkdir(parents=True, exist_ok=True)
        (home / "user" / name).write_text("the user's")
    child = Child(make(home / "cwd"), home, content(home))
    child.pid = os.fork()
    if not child.pid:
        _become(child, run)
    return child


def _become(child: Child, run: bool) -> None:
    status = 1
    try:
        os.setsid()
        gc.disable()  # a child lives for a second
        os.chdir(child.home / "cwd")
        for number, name in ((0, os.devnull), (1, child.home / "out"), (2, child.home / "err")):
            os.dup2(os.open(name, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
        resource.setrlimit(resource.RLIMIT_CPU, (3 * SECONDS if run else SECONDS,) * 2)
        resource.setrlimit(resource.RLIMIT_AS, (2**34, 2**34))
        caches = Path.home()  # of matplotlib and Warp
        os.environ |= {
            f"XDG_{name.upper()}_HOME": f"{caches}/.{name}" for name in ("cache", "config")
        }
        os.environ["HOME"] = str(child.home / "user")
        if not run:
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
        _exit(status)


def _pass(*_: object, **__: object) -> None:
    """The check has passed, and Hydra would make the folder now."""
    _exit(PASSED)


def _exit(status: int) -> None:
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status)


def is_alive(child: Child) -> bool:
    """Whether a process of its session is left."""
    try:
        os.killpg(child.pid, 0)
    except ProcessLookupError:
        return False
    return True


def kill(child: Child) -> None:
    """End all processes of its session."""
    os.killpg(child.pid, signal.SIGKILL)


def content(folder: Path) -> dict[str, str]:
    """Every path below a folder, with the hash of a file and the target of a link."""

    def digest(path: Path) -> str:
        if path.is_symlink():
            return os.readlink(path)
        return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""

    return {str(path.relative_to(folder)): digest(path) for path in folder.rglob("*")}
