"""More worlds than there is memory for."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from compositions import load_config

from mjstack.cli import run
from mjstack.config import Config
from mjstack.episodes.context import RunContext
from mjstack.errors import ConfigError
from mjstack.gates.runner import run_guarded
from mjstack.jobs import memory_check as room
from mjstack.jobs.memory_check import check_room, total_memory
from mjstack.report.record import GateResult, Status
from mjstack.scene import build_model
from mjstack.sim.native import NativeSimulation, native_bytes

pytestmark = pytest.mark.full

MANY = 100_000_000


def test_native_bytes_are_some_of_those_that_are_held(so101_cfg: Config) -> None:
    model = build_model(so101_cfg)
    sim = NativeSimulation(model, 5, nthread=1)
    arrays = [sim._state, *sim._poses.values(), *sim._others.values()]
    assert native_bytes(model, 5) == sum(array.nbytes for array in arrays)


@pytest.mark.parametrize(
    "args",
    [
        ["sim=native"],
        ["sim=mjwarp"],
        ["sim=native", "job=study"],
        ["sim=native", "gates=[success]"],
    ],
    ids=" ".join,
)
def test_more_than_memory_holds_is_refused(
    args: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    gib = 64
    monkeypatch.setattr(room, "total_memory", lambda device: gib << 30)
    folder = tmp_path / "run"
    assert run([f"nworld={MANY}", *args, "sim.device=cpu", f"hydra.run.dir={folder}"]) == 2
    (line,) = [
        line for line in capsys.readouterr().err.splitlines() if line.startswith("mjstack: ")
    ]
    found = re.fullmatch(
        rf"mjstack: nworld={MANY}: expected worlds that fit into the {gib} GiB of this machine, "
        r"and these need (\d+) GiB or more\. Use fewer\.",
        line,
    )
    assert found is not None
    assert int(found[1]) > gib
    assert not folder.exists()


@pytest.mark.parametrize("sizes", ["batch=default", "batch=auto"])
def test_what_could_fit_is_not_refused(
    sizes: str, so101_cfg: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Just above and just below what is there; sizes that are to be measured count as the
    smallest.
    """
    cfg = load_config(["sim=mjwarp", "sim.device=cpu", "nworld=200000", sizes])
    model = build_model(cfg)
    monkeypatch.setattr(room, "total_memory", lambda device: 1)
    with pytest.raises(ConfigError) as caught:
        check_room(cfg, model)
    found = re.search(r"need (\d+) GiB", str(caught.value))
    assert found is not None
    needed = int(found[1])
    monkeypatch.setattr(room, "total_memory", lambda device: (needed - 1) << 30)
    with pytest.raises(ConfigError):
        check_room(cfg, model)
    monkeypatch.setattr(room, "total_memory", lambda device: (needed + 1) << 30)
    check_room(cfg, model)
    assert (needed >= 10) == (sizes == "batch=default")


def test_gates_of_one_world_are_not_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "total_memory", lambda device: 1)
    cfg = load_config([f"nworld={MANY}", "gates=[baseline,parity]", "sim=native"])
    check_room(cfg, build_model(cfg))


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("Unable to allocate 9 GiB"),
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 9 GiB"),
        RuntimeError("Failed to allocate 99 bytes on device 'cuda:0'"),
        RuntimeError(
            "[enforce fail at alloc_cpu.cpp:118] DefaultCPUAllocator: can't allocate memory: you"
            " tried to"
        ),
    ],
)
def test_memory_that_runs_out_later(error: Exception, so101_cfg: Config) -> None:
    def gate(context: RunContext) -> list[GateResult]:
        raise error

    (result,) = run_guarded(RunContext(cfg=so101_cfg), "batch", gate)
    assert result.status is Status.failed
    assert result.reason.startswith(f"out of memory ({error}). Run fewer worlds")


def test_memory_of_this_machine() -> None:
    there = total_memory("cpu")
    assert there is not None
    assert 1 << 28 < there < 1 << 50
