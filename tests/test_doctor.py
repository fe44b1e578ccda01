"""``mjstack doctor``: one page on a machine."""

import os
import re
from importlib import metadata

import pytest
import torch
from compositions import load_config
from environments import Capture, Patch, Refused

import mjstack
import mjstack.jobs.doctor as doctor
from mjstack.cli import run
from mjstack.errors import MjstackError
from mjstack.sim import resolve_sizes


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
