"""``mjstack doctor``: one page on a machine."""

import os
import re
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import torch
from compositions import load_config
from environments import Capture, Patch, Refused

import mjstack
import mjstack.jobs.doctor as doctor
from mjstack.cli import run
from mjstack.errors import MjstackError
from mjstack.sim import resolve_sizes, warp_setup
from mjstack.sim.warp_setup import wp

CACHE = "WARP_CACHE_PATH"
CAPTURED: Any = {"capture_output": True, "text": True, "timeout": 120}


def test_a_page_on_this_machine(capsys: Capture, monkeypatch: Patch, refused: Refused) -> None:
    """What fails here says what to do; the page goes on below it."""

    def fails(model: object) -> None:
        raise MjstackError("offscreen rendering fails", "Set MUJOCO_GL=egl or osmesa")

    monkeypatch.setattr(doctor, "require_offscreen", fails)
    monkeypatch.setitem(doctor._EXTRAS, "odd", "no-such-package")
    assert run(["doctor", "robot=rebot", "nworld=3", "sim=native"]) == 0
    text = capsys.readouterr().out
    lines = dict(re.findall(r"(?m)^(\S[\w ]*?)  +(.+)$", text))
    assert lines["mjstack"].startswith(f"{mjstack.__version__}, commit ")
    for package in ("mujoco", "mujoco-warp", "warp-lang", "mink"):
        assert f"{package} {metadata.version(package)}" in lines["packages"]
    assert "odd: no-such-package is not installed" in lines["extras"]
    assert f"{os.cpu_count()} cores" in lines["processor"]
    assert torch.__version__ in lines["torch"]
    assert lines["OpenGL"].endswith("rendering fails. Set MUJOCO_GL=egl or osmesa.")
    sizes = resolve_sizes(load_config(["robot=rebot"]))
    assert "rebot, task stack, 3 worlds: " in lines["buffers"]
    assert lines["backend"] == "native on cpu"
    assert f"batch.nconmax={sizes.nconmax}" in lines["buffers"]
    assert "'robt' does not exist. Did you mean 'robot'?" in refused("doctor", "robt=so101")


@pytest.mark.skipif(torch.cuda.is_available(), reason="a CUDA device is here")
def test_no_gpu_has_a_reason(capsys: Capture) -> None:
    assert run(["doctor", "sim.device=cuda:0"]) == 0
    text = capsys.readouterr().out
    assert re.search(r"(?m)^GPU +none that torch can use \(driver: ", text)
    assert re.search(r"(?m)^backend +none: .*cuda:0", text)


IMPORT = "from mjstack.sim.warp_setup import wp; print(wp.config.kernel_cache_dir)"
UNWRITABLE = r"kernel cache /\S+: cannot be written \(.+\), so that .* Set WARP_CACHE_"


@pytest.mark.parametrize(
    "variables",
    [
        {"HOME": "/proc"},
        {"HOME": "/dev/null", "XDG_CACHE_HOME": "/proc/1/none"},
        {"WARP_CACHE_PATH": "/dev/null/cache"},
    ],
    ids=str,
)
def test_a_kernel_cache_that_cannot_be_written_is_a_temporary_folder(
    variables: dict[str, str], tmp_path: Path, monkeypatch: Patch
) -> None:
    """In its place; what is wrong is one line, with the variable that mends it."""
    for name, value in ({"XDG_CACHE_HOME": "", CACHE: ""} | variables).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder, problem = warp_setup._kernel_cache()
    assert folder.startswith(f"{tmp_path}/mjstack-kernels-")
    assert re.match(UNWRITABLE, problem)


@pytest.mark.full
def test_a_temporary_kernel_cache_ends_with_its_process(tmp_path: Path) -> None:
    env = {k: v for k, v in os.environ.items() if k not in ("XDG_CACHE_HOME", CACHE)}
    env |= {"HOME": "/dev/null", "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", IMPORT], env=env, **CAPTURED)
    assert done.stdout.startswith(f"{tmp_path}/mjstack-kernels-")
    assert not list(tmp_path.iterdir())
    (line,) = done.stderr.splitlines()
    assert re.match(UNWRITABLE, line)


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


@pytest.mark.full
def test_the_page_ends_where_no_folder_can_be_written(tmp_path: Path) -> None:
    """Not even a temporary one; in a process of its own, which has not loaded Warp."""
    script = (
        "import sys, tempfile\n"
        "def none(*args, **kwargs): raise FileNotFoundError(2, 'No usable temporary directory')\n"
        "tempfile.mkdtemp = none\n"
        "from mjstack.cli import run\n"
        "sys.exit(run(['doctor', 'nworld=3']))"
    )
    env = os.environ | {CACHE: "/dev/null/cache"}
    done = subprocess.run([sys.executable, "-c", script], env=env, **CAPTURED)
    assert done.returncode == 0, done.stderr
    lines = dict(re.findall(r"(?m)^(\S[\w ]*?)  +(.+)$", done.stdout))
    assert lines["kernel cache"] == (
        "none: kernel cache /dev/null/cache: cannot be written (Not a directory), and there is no"
        " temporary folder. Set WARP_CACHE_PATH to a folder of yours."
    )
    assert lines["OpenGL"]
    assert lines["buffers"].startswith("none: kernel cache /dev/null/cache: ")
    assert list(lines)[-1] == "backend"


@pytest.mark.full
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
