"""Jobs and gates in several ranks, on one machine and as two nodes: each leaves what one rank
leaves.
"""

import json
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from dataset_checker import images_of
from environments import SHORT_REACH, at_double_speed, one_second_episode, report_of
from processes import PLAIN, SCRIPT, play, start_python

from mjstack.cli import run
from mjstack.datasets import read_dataset
from mjstack.policy import load_policy

CAMERA = ["cameras=front", "scene.cameras.front.size=[32,32]", "sim=mjwarp", "sim.device=cpu"]

pytestmark = pytest.mark.full


@pytest.mark.long
def test_two_nodes(tmp_path: Path) -> None:
    """Two agents of torchrun, as on two machines with one disk: one report, and neither agent waits
    for the other after it, though the gate has failed.
    """
    args = [*PLAIN, "nworld=3", f"hydra.run.dir={tmp_path}/run"]
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    nodes = []
    for node in (0, 1):
        (tmp_path / str(node)).mkdir()
        where = [f"--node-rank={node}", "--master-addr=127.0.0.1", f"--master-port={port}"]
        agent = ["-m", "torch.distributed.run", "--nnodes=2", "--nproc-per-node=1", *where]
        nodes.append(start_python([*agent, str(SCRIPT), *args], tmp_path / str(node)))
    began = time.monotonic()
    texts = [node.communicate(timeout=500)[0] for node in nodes]
    assert time.monotonic() - began < 200.0, texts  # an agent waits 300 s for one that fails
    assert nodes[0].returncode == 1, texts
    assert texts[0].count("status: ") == 1
    assert "status: " not in texts[1]
    assert not list((tmp_path / "1").iterdir())
    report = report_of(tmp_path / "run")
    assert report["status"] == "fail"
    (gate,) = report["gates"]
    assert gate["metrics"]["episodes"] == 3
    assert len(report["provenance"]["ranks"]) == 2


def test_each_rank_sizes_its_own_worlds(tmp_path: Path) -> None:
    capacity = ["sim=mjwarp", "sim.device=cpu", "gates=[capacity]", "gate.capacity.random_steps=20"]
    args = [*capacity, "nworld=3", *one_second_episode(), f"hydra.run.dir={tmp_path}/capacity"]
    play(2, args, tmp_path, None)
    (gate,) = report_of(tmp_path / "capacity")["gates"]
    assert gate["notes"]["ranks"] == "each of 2 ranks its own worlds; figures are rank 0's"
    assert any(line.startswith("rank 1: ") for line in gate["details"])


@pytest.mark.long
def test_two_ranks_beside_one(tmp_path: Path) -> None:
    """scripts/bench_many.py: figures of throughput are sums over the ranks."""
    short = ["repetitions=2", "steps=2", "env_steps=2", "episodes=1"]
    small = ["sim=native", *at_double_speed(), *(f"gate.throughput.{key}" for key in short)]
    bench = [str(SCRIPT.parent / "bench_many.py"), "--gpus=2", "--worlds=2", "--rounds=1"]
    command = [sys.executable, *bench, f"--folder={tmp_path}/many", "--", *small]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in (tmp_path / "many/many.jsonl").read_text().splitlines()]
    assert [(row["gpus"], row["episodes"], row["status"]) for row in rows] == [(2, 4, 0), (1, 2, 0)]
    for row in rows:
        assert min(row[name] for name in ("physics", "episode", "batch", "env.step")) > 0.0
    table = (tmp_path / "many/many.md").read_text()
    for name in ("physics", "episode", "batch", "env.step"):
        assert f"| weak | 2 | {name} | 2 |" in table
    assert (tmp_path / "many/many.png").exists()


@pytest.mark.parametrize("what", ["weak", "sweep"])
def test_a_mistyped_override_ends_a_comparison(what: str, tmp_path: Path) -> None:
    """In one line, before the runs that would say the same; no rate of runs that did nothing."""
    command = [
        sys.executable,
        str(SCRIPT.parent / "bench_many.py"),
        f"--what={what}",
        "robot=so110",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=tmp_path)
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2
    assert "so110" in line
    assert not done.stdout
    assert not [*tmp_path.iterdir()]


@pytest.mark.long
def test_ranks_collect_images(tmp_path: Path) -> None:
    """Videos of both ranks: each frame is that of the world as one rank draws it."""
    args = ["job=collect", *CAMERA, "nworld=3", "job.keep_failures=true", "job.episodes=3"]
    args += one_second_episode()
    assert run([*args, f"job.folder={tmp_path}/1"]) == 0
    play(2, [*args, f"job.folder={tmp_path}/2"], tmp_path)
    alone, shared = (read_dataset(tmp_path / name / "dataset") for name in "12")
    for key in ("world", "length"):
        assert [row[key] for row in shared.episodes] == [row[key] for row in alone.episodes]
    np.testing.assert_array_equal(shared.frames("action"), alone.frames("action"))
    key = "observation.images.front"
    for episode in range(3):
        first, second = (
            images_of(stored, key, episode).astype(float) for stored in (alone, shared)
        )
        assert first.shape == second.shape
        assert abs(first - second).mean() < 1.0  # the encoder sees other neighbours
        assert second.std() > 10.0


@pytest.mark.long
def test_ranks_learn_from_pixels(tmp_path: Path) -> None:
    """Each draws images of its own episodes; both have one policy, which the first one writes."""
    vision = ["channels=[4,8]", "features=8", "pool=40", "shift=1", "cameras=[front]"]
    sizes = ["rounds=1", "episodes=4", "hidden=[16]", "batches=4", "batch_size=16"]
    args = [
        "job=train",
        "experiment=pixels",
        *CAMERA,
        "task=reach",
        "nworld=4",
        "web.episode=false",
    ]
    args += SHORT_REACH
    args += [f"job.vision.{key}" for key in vision] + [f"job.{key}" for key in sizes]
    args += ["job.save_every=2", "gate.success.rate=0.0", f"job.folder={tmp_path}/out"]
    text = play(2, args, tmp_path)
    assert text.count("status: pass") == 1
    train, success = report_of(tmp_path / "out")["gates"]
    assert train["metrics"]["episodes_played"] == 4
    assert success["metrics"]["episodes"] == 4
    assert load_policy(tmp_path / "out/last").network.vision.sizes == {"front": (32, 32)}
