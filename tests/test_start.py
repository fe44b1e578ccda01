"""Warp starts without a word where there is no CUDA, and nothing else is kept from the user."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from mjstack.sim.start import NO_DRIVER, call_without_line


def speak(*lines: bytes) -> None:
    """As native code does, past Python's stderr."""
    for line in lines:
        os.write(2, line + b"\n")


@pytest.mark.parametrize("module", ["mjstack.sim.engine", "mjstack.kinematics.ik_kernels"])
def test_warp_starts_without_a_word(module: str) -> None:
    code = f"import {module}, warp as wp; wp.init(); print(len(wp.get_devices()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0
    assert int(done.stdout) >= 1
    assert done.stderr == ""


def test_only_that_line_is_left_out(capfd: pytest.CaptureFixture[str]) -> None:
    call_without_line(lambda: speak(b"Warp CUDA error 100", NO_DRIVER, NO_DRIVER + b" Indeed."), NO_DRIVER)
    speak(b"later")
    assert capfd.readouterr().err == f"Warp CUDA error 100\n{NO_DRIVER.decode()} Indeed.\nlater\n"


def test_what_was_said_before_an_error_is_not_lost(capfd: pytest.CaptureFixture[str]) -> None:
    def fail() -> None:
        speak(NO_DRIVER, b"why")
        raise RuntimeError("no Warp")

    with pytest.raises(RuntimeError, match="no Warp"):
        call_without_line(fail, NO_DRIVER)
    assert capfd.readouterr().err == "why\n"


def test_a_closed_stderr_is_no_obstacle() -> None:
    code = "import os; os.close(2); import mjstack.sim.engine, warp as wp; print(len(wp.get_devices()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0
    assert int(done.stdout) >= 1
