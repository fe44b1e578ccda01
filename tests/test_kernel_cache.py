"""The folder of compiled kernels, and what Warp writes while it starts."""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest
from environments import Patch

from mjstack.sim import warp_setup
from mjstack.sim.warp_setup import wp

CACHE = "WARP_CACHE_PATH"
CAPTURED: Any = {"capture_output": True, "text": True, "timeout": 120}


IMPORT = "from mjstack.sim.warp_setup import wp; print(wp.config.kernel_cache_dir)"


@pytest.mark.parametrize(
    "variables",
    [
        {"HOME": "/dev/null"},
        {"HOME": "/proc"},
        {"HOME": "/dev/null", "XDG_CACHE_HOME": "/proc/1/none"},
        {"WARP_CACHE_PATH": "/dev/null/cache"},
    ],
    ids=str,
)
def test_a_kernel_cache_that_cannot_be_written_is_a_temporary_folder(
    variables: dict[str, str], tmp_path: Path
) -> None:
    """In its place; what is wrong is one line, with the variable that mends it."""
    env = {k: v for k, v in os.environ.items() if k not in ("XDG_CACHE_HOME", CACHE)} | variables
    command = [sys.executable, "-c", IMPORT]
    done = subprocess.run(command, env=env | {"TMPDIR": str(tmp_path)}, **CAPTURED)
    assert done.stdout.startswith(f"{tmp_path}/mjstack-kernels-")
    assert not list(tmp_path.iterdir())  # it ends with the process
    (line,) = done.stderr.splitlines()
    assert re.match(
        r"kernel cache /\S+: cannot be written \(.+\), so that .* Set WARP_CACHE_", line
    )


def test_a_kernel_cache_without_a_home(monkeypatch: Patch, tmp_path: Path) -> None:
    """Of a user without an entry: no folder is called ``~``."""

    def expand(path: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "expanduser", expand)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    for name in (CACHE, "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, "")
    monkeypatch.chdir(tmp_path)
    folder, problem = warp_setup._kernel_cache()
    assert [path.name for path in tmp_path.iterdir()] == [Path(folder).name]
    assert problem.startswith(
        "kernel cache ~/.cache/warp: cannot be written (Could not determine home"
    )


def test_kernels_of_a_cache_that_is_read_alone(monkeypatch: Patch, tmp_path: Path) -> None:
    """They are used: an image of a container may have them."""
    kernel = tmp_path / "image" / wp.config.version / "wp_module" / "module.o"
    kernel.parent.mkdir(parents=True)
    kernel.write_bytes(b"compiled")
    monkeypatch.setenv(CACHE, str(tmp_path / "image"))

    def denied(dir: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(tempfile, "TemporaryFile", denied)
    folder, problem = warp_setup._kernel_cache()
    copy = Path(folder, *kernel.parts[-3:])
    assert copy.read_bytes() == b"compiled"
    (copy.parent / "more.o").write_bytes(b"new")
    assert [path.name for path in kernel.parent.iterdir()] == ["module.o"]
    assert os.environ[CACHE] == folder  # for processes that this one starts
    assert "Permission denied" in problem


def test_no_folder_for_kernels_is_one_line(tmp_path: Path) -> None:
    """Not even a temporary one; in a process of its own, which has not loaded Warp."""
    script = (
        "import sys, tempfile\n"
        "def none(*args, **kwargs): raise FileNotFoundError(2, 'No usable temporary directory')\n"
        "tempfile.mkdtemp = none\n"
        "import mjstack.sim.warp_setup"
    )
    env = os.environ | {CACHE: "/dev/null/cache"}
    done = subprocess.run([sys.executable, "-c", script], env=env, **CAPTURED)
    assert done.stderr.splitlines()[-1].endswith(
        "kernel cache /dev/null/cache: cannot be written (Not a directory), and there is no"
        " temporary folder. Set WARP_CACHE_PATH to a folder of yours."
    )


@pytest.mark.skipif(warp_setup._has_driver(), reason="a CUDA driver is here")
def test_warp_has_no_line_about_a_driver_that_is_not_there() -> None:
    """What else it writes while it starts stays."""
    script = (
        "import os, warp\n"
        "start = warp.init\n"
        "warp.init = lambda: (start(), os.write(2, b'Warp CUDA error: another\\n'))\n"
        "import mjstack.sim.warp_setup\n"
        "os.write(2, b'after\\n')"
    )
    done = subprocess.run([sys.executable, "-c", script], **CAPTURED)
    assert done.stderr == "Warp CUDA error: another\nafter\n"
