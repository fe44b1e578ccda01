"""job=train: small trainings on native MuJoCo, what they leave, and how they go on."""

import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from compositions import load_config
from environments import SHORT_REACH, Capture, Patch, at_double_speed, configure, on_new_sim
from policies import assert_drives, curve, interrupted, report, same, weights
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import mjstack.policy.checkpoint as checkpoint
import mjstack.train.clone as clone
from mjstack.cli import run
from mjstack.distributed import Ranks
from mjstack.envs import driven_config
from mjstack.errors import MjstackError
from mjstack.jobs.train import check_train
from mjstack.mdp.observation import headings
from mjstack.policy import load_policy
from mjstack.policy.checkpoint import read_state, write_state
from mjstack.train.clone_learner import CloneLearner, draw_seed
from mjstack.train.trainer import STATE

TINY = (
    *("job=train", "trainer=clone", "sim=native", "nworld=4"),
    "job.episodes=6",
    *("job.hidden=[32]", "job.batches=30", "job.batch_size=64", "job.save_every=10"),
    *("gate.success.rate=0.0", "web.episode=false"),
)
REACH = (*TINY, "task=reach", *SHORT_REACH)


def test_a_training_leaves_policies_a_curve_and_a_judgement(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    out = tmp_path / "training"
    assert run([*REACH, f"job.folder={out}"]) == 0
    gates = report(out)
    train = gates["train"]["metrics"]
    assert train["batches"] == 30
    assert train["episodes_played"] == 6
    assert 2 <= train["episodes"] <= 6
    success = gates["success"]["metrics"]
    assert success["episodes"] == 4
    assert 0.0 <= success["success_rate_low95"] <= success["success_rate_high95"] <= 1.0
    assert "success:" not in gates["success"]["reason"]  # job=replay takes runs of job=gates
    rows = curve(out)
    assert rows["batch"].tolist() == [10.0, 20.0, 30.0]
    assert rows["validation_loss"][-1] < rows["validation_loss"][0]
    for name in ("train.png", "train.csv", "best/policy.json", "last/policy.json"):
        assert (out / name).stat().st_size > 0, name

    # What the policy sees and says
    policy = load_policy(out / "last")
    assert policy.training["batch"] == 30
    assert policy.training["seed"] == 0
    assert list(policy.widths) == ["joint_pos", "offsets", "positions", "headings", "goals"]
    assert policy.widths["headings"] == 4
    assert (policy.network.chunk, policy.execute) == (16, 8)

    # Curves for TensorBoard
    events = EventAccumulator(str(out)).Reload()
    assert [event.step for event in events.Scalars("train/validation_loss")] == [10, 20, 30]

    # It is there already: the same command judges it anew without the expert, and it drives gates
    before = weights(out / "last")
    monkeypatch.setattr(clone, "make_round", None)
    assert run([*REACH, f"job.folder={out}"]) == 0
    assert report(out)["train"]["metrics"] == train
    assert all(torch.equal(v, before[k]) for k, v in weights(out / "last").items())
    assert_drives(out / "last", tmp_path / "gates", "task=reach", nworld=3)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a training that was not interrupted."""
    folder = tmp_path_factory.mktemp("whole") / "training"
    assert run([*REACH, f"job.folder={folder}"]) == 0
    return folder


@pytest.mark.full
def test_a_training_goes_on_where_it_was_interrupted(whole: Path, tmp_path: Path) -> None:
    """Bit for bit as one that was not."""
    parts = tmp_path / "parts"
    interrupted([*REACH, f"job.folder={parts}"], CloneLearner, 7)
    assert (parts / "training.safetensors").exists()
    assert run([*REACH, f"job.folder={parts}"]) == 0
    assert same(whole / "last", parts / "last")
    np.testing.assert_allclose(curve(whole)["loss"], curve(parts)["loss"], rtol=1e-5)


@pytest.mark.full
def test_numbers_that_are_not_finite(tmp_path: Path, capsys: Capture) -> None:
    """An episode with one is left out; a network with one is not saved, and ends the training."""
    (tmp_path / "conf").mkdir()
    (tmp_path / "faulty.py").write_text(
        "import torch\n\n\ndef missing(env):\n"
        "    value = torch.zeros((env.nworld, 2))\n"
        "    value[env.world == 1] = torch.nan\n"
        "    return value\n"
    )
    faulty = [*REACH, "job.episodes=4", "+job.observation.policy.terms.x.func=faulty.missing"]
    out = tmp_path / "left_out"
    assert run(["--config-dir", str(tmp_path / "conf"), *faulty, f"job.folder={out}"]) == 0
    assert report(out)["train"]["metrics"]["episodes"] == 3
    (path,) = (out / "last").glob("*.safetensors")
    assert all(bool(value.isfinite().all()) for value in load_file(path).values())

    out = tmp_path / "diverged"
    assert run([*REACH, "job.learning_rate=1e30", f"job.folder={out}"]) == 1
    assert "numbers are not finite after batch 10" in report(out)["train"]["reason"]
    assert not (out / "last").exists()


@pytest.mark.full
def test_a_full_disk_leaves_the_policies_before_it(
    tmp_path: Path, monkeypatch: Patch, capsys: Capture
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


def test_every_batch_of_every_process_draws_anew() -> None:
    seeds = [draw_seed(5, rank, batch) for rank in range(8) for batch in range(0, 100_000, 997)]
    assert len({seed % 2**32 for seed in seeds}) == len(seeds)


def test_a_process_may_come_when_the_first_one_has_begun(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    (tmp_path / "training.json").write_text("{}")
    cfg = load_config([*REACH, f"job.folder={tmp_path}"])
    with pytest.raises(MjstackError, match="has a training of another configuration"):
        check_train(cfg)
    monkeypatch.setattr("mjstack.distributed._current", Ranks(1, 2))
    assert check_train(cfg).folder == tmp_path


@pytest.mark.long
@pytest.mark.parametrize(
    ("overrides", "rate"),
    [(["trainer=clone", "task=reach"], 0.99), (["reset=jitter"], 62 / 64)],
    ids=["clone-reach", "dagger-stack"],
)
def test_two_cores_train(overrides: list[str], rate: float, tmp_path: Path) -> None:
    """In two minutes of both, four of processor time, as other work may share the machine."""
    began = time.process_time()
    out = tmp_path / "training"
    command = ["job=train", "sim=native", "nworld=64", *overrides, "gate.success.rate=0.5"]
    assert run([*command, f"job.folder={out}"]) == 0
    assert report(out)["success"]["metrics"]["success_rate"] >= rate
    assert time.process_time() - began < 240.0


@pytest.mark.full
def test_a_clone_of_stack_drives_the_batch(tmp_path: Path) -> None:
    """From few episodes at double speed, which take seconds: no success is asked for. It sees what
    a real arm has, with its past, decides ten times a second, and its commands are late.
    """
    fast = [*at_double_speed(), "reset=jitter", "timing.command_delay=5"]
    seen = ["observation@job.observation=real", "+job.observation.policy.terms.joint_pos.history=2"]
    out = tmp_path / "training"
    assert run([*TINY, *fast, *seen, "job.execute=5", f"job.folder={out}"]) == 0
    assert report(out)["train"]["metrics"]["episodes"] >= 4
    policy = load_policy(out / "last")
    assert policy.widths["joint_pos"] == 12
    assert policy.execute == 5
    assert_drives(out / "last", tmp_path / "gates", *fast)


def test_headings_are_those_of_a_quarter_turn() -> None:
    env = on_new_sim("native", 8, driven_config(configure("reset=randomized")))
    env.reset(seed=0)
    found = headings(env)
    for column, address in enumerate(env.index.object_qpos):
        w, _, _, z = env.sim.qpos[:, address + 3 : address + 7].unbind(1)
        yaw = 2.0 * torch.atan2(z, w)
        torch.testing.assert_close(found[:, 2 * column], torch.cos(4.0 * yaw))
        torch.testing.assert_close(found[:, 2 * column + 1], torch.sin(4.0 * yaw))


@pytest.mark.full
def test_a_folder_belongs_to_one_training(whole: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(whole, tmp_path / "out"))
    with pytest.raises(MjstackError, match=r"another configuration: job\.chunk="):
        check_train(load_config([*REACH, f"job.folder={out}", "job.chunk=4"]))
    state, facts = read_state(out / STATE)
    write_state(out / STATE, state, facts | {"done": -5})
    assert run([*REACH, f"job.folder={out}"]) == 1
    assert "done is -5. Remove it to train anew" in report(out)["train"]["reason"]
    facts["made_with"]["device"] = "cuda"
    write_state(out / STATE, state, facts)
    assert run([*REACH, f"job.folder={out}"]) == 1
    assert "Set job.folder to another folder" in report(out)["train"]["reason"]


def test_a_task_without_an_expert_has_no_clone() -> None:
    cfg = load_config(["job=train", "trainer=clone", "task=reach", "sim=native"])
    cfg.controller.phases = {}
    with pytest.raises(MjstackError, match=r"task=reach: expected a task with phases.*has no phas"):
        check_train(cfg)


@pytest.mark.full
@pytest.mark.long
def test_a_training_that_is_killed_goes_on_where_it_saved(tmp_path: Path) -> None:
    """SIGKILL after the first save: the same command ends bit for bit as a whole one."""
    # With more batches than can follow before the kill
    train = [*REACH, "job.batches=400", "job.save_every=50"]
    state = tmp_path / "killed" / STATE
    process = subprocess.Popen(
        [sys.executable, "-m", "mjstack", *train, f"job.folder={state.parent}"],
        env=os.environ | {"OMP_NUM_THREADS": "1"},  # other work may share the machine
        stdout=subprocess.DEVNULL,
    )
    until = time.monotonic() + 300.0
    while not state.exists():
        assert process.poll() is None
        assert time.monotonic() < until
        time.sleep(0.005)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert 0 < read_state(state)[1]["done"] < 400
    ends = []
    for name in ("killed", "whole"):
        folder = tmp_path / name
        assert run([*train, f"job.folder={folder}"]) == 0
        tensors, facts = read_state(folder / STATE)
        ends.append(tensors | weights(folder / "last") | weights(folder / "best"))
        assert facts["done"] == 400
    killed, whole = ends
    assert killed.keys() == whole.keys()
    assert all(torch.equal(value, whole[name]) for name, value in killed.items() if name != "sum")
