"""A policy on its way: a small training whose disk fills, and an export that a program drives."""

from __future__ import annotations

import json
import resource
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch
from compositions import load_config
from test_export import EXAMPLE, drivers_targets
from test_train import REACH, weights

import mjstack.policy.checkpoint as checkpoint
from mjstack.cli import run
from mjstack.errors import MjstackError
from mjstack.jobs.train import check_train
from mjstack.policy import load_policy


@pytest.mark.full
def test_a_full_disk_leaves_the_policies_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """After the first policies nothing larger than a kilobyte can be written. The same command goes
    on when there is room again.
    """
    out = tmp_path / "training"
    real = checkpoint.write_atomic
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill_up(path: Path, content: str | bytes) -> None:
        real(path, content)
        if path.suffix == ".safetensors" and path.parent == out:  # the state comes last
            resource.setrlimit(resource.RLIMIT_FSIZE, (1024, hard))

    monkeypatch.setattr(checkpoint, "write_atomic", fill_up)
    try:
        assert run([*REACH, f"job.folder={out}"]) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"mjstack: {out} cannot be written: File too large.")
    kept = weights(out / "last")
    assert load_policy(out / "last").training["batch"] == 10
    hidden = [path for path in out.rglob(".*") if path.name != ".hydra"]
    assert not hidden
    assert len(list((out / "last").iterdir())) == 2

    monkeypatch.undo()
    assert run([*REACH, f"job.folder={out}"]) == 0
    assert load_policy(out / "last").training["batch"] == 30
    assert any(not torch.equal(value, kept[name]) for name, value in weights(out / "last").items())


@pytest.mark.full
def test_a_trained_policy_drives_native_mujoco_from_its_export(tmp_path: Path) -> None:
    out = tmp_path / "training"
    policy = out / "last"
    given = ["task=reach", "sim=native"]
    assert run([*REACH, f"job.folder={out}"]) == 0
    folder = tmp_path / "onnx"
    export = ["job=export", *given, f"policy={policy}", f"hydra.run.dir={folder}"]
    assert run(export) == 0
    play = runpy.run_path(str(EXAMPLE))["play"]
    # Four answers: such a short training leaves a policy that soon amplifies what float32 rounds.
    wanted = drivers_targets(policy, load_config([*given, "nworld=1"]), 32)
    np.testing.assert_allclose(play(str(folder), 32), wanted, rtol=0.0, atol=1e-4)
    (gate,) = json.loads((folder / "report.json").read_text())["gates"]
    assert gate["status"] == "pass"


def test_a_task_without_an_expert_has_no_clone() -> None:
    cfg = load_config(["job=train", "task=reach", "sim=native"])
    cfg.controller.phases = {}
    with pytest.raises(MjstackError, match=r"task=reach: expected a task with phases.*has no phas"):
        check_train(cfg)
