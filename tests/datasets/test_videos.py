"""Datasets with images: what is decoded is what was drawn, and nothing is half-written."""

import json
import os
import shutil
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from compositions import load_config, refusal
from dataset_checker import add, contents, images_of, listed
from environments import SHORT_REACH, Patch, has_gl

from mjstack.cli import run
from mjstack.datasets import read_dataset
from mjstack.datasets import video as video_module
from mjstack.datasets.lerobot import QUANTILES
from mjstack.datasets.part import PartWriter
from mjstack.datasets.reader import uncommitted
from mjstack.datasets.spec import DatasetSpec, EpisodeData, Feature, Video
from mjstack.datasets.writer import DatasetWriter
from mjstack.drivers.closed_loop import make_expert
from mjstack.envs import build_env
from mjstack.episodes.rollout import reset_worlds
from mjstack.errors import FolderError
from mjstack.jobs import check_job

GL = pytest.mark.skipif(not has_gl(), reason="MuJoCo does not draw offscreen here")
SIZES = {"observation.images.front": (32, 48), "observation.images.wrist": (16, 16)}
SPEC = DatasetSpec(
    robot_type="so101",
    fps=50,
    task="t",
    features={"action": Feature(dtype="float32", names=("jaw",), units=("rad",))},
    videos={name: Video(height=h, width=w) for name, (h, w) in SIZES.items()},
    config_sha256="c" * 64,
)


def episode(world: int) -> EpisodeData:
    """Smooth images that change from frame to frame; 7 to 131 frames."""
    frames = 131 if world == 2 else 7 + world
    images = {}
    for name, size in SIZES.items():
        t, y, x = np.indices((frames, *size))
        rgb = (60 + 20 * world + 2 * x, 200 - 3 * y, 90 + t % 60)
        images[name] = np.stack(rgb, axis=-1).astype(np.uint8)
    arrays = {"action": np.arange(frames, dtype=np.float32)}
    row = {"success": True, "seed": 7, "world": world}
    return EpisodeData(arrays=arrays, images=images, row=row)


def write(folder: Path, worlds: range, *, spec: DatasetSpec = SPEC, batch: int = 3) -> None:
    with DatasetWriter(folder, spec) as writer:
        for first in range(worlds.start, worlds.stop, batch):
            add(writer, *map(episode, range(first, min(first + batch, worlds.stop))))


def image_names(folder: Path) -> list[str]:
    return [name for name in contents(folder) if name.startswith("videos/")]


@pytest.mark.parametrize("codec", ["h264", pytest.param("av1", marks=pytest.mark.full)])
def test_decoded_images_are_those_that_were_added(tmp_path: Path, codec: str) -> None:
    videos = {name: replace(video, codec=codec) for name, video in SPEC.videos.items()}
    write(tmp_path, range(5), spec=replace(SPEC, videos=videos))
    stored = read_dataset(tmp_path)
    info = stored.info["features"]["observation.images.front"]
    assert (info["dtype"], info["shape"]) == ("video", [32, 48, 3])
    assert info["info"]["video.codec"] == codec
    assert image_names(tmp_path) == [
        f"videos/{name}/chunk-000/file-00{shard}.mp4" for name in SIZES for shard in (0, 1)
    ]
    for number in reversed(range(5)):
        for name in SIZES:
            expected = episode(number).images[name].astype(int)
            decoded = images_of(stored, name, number)
            assert decoded.shape == expected.shape
            assert np.abs(decoded - expected).mean(axis=(1, 2, 3)).max() < 3.0
    assert len(stored.frames("action")) == stored.info["total_frames"] == 167


def assert_quantiles(total: dict[str, Any], name: str, worlds: int, atol: float = 1e-9) -> None:
    """Those of stats.json are of the sampled frames of all episodes."""
    chosen = []
    for world in range(worlds):
        images = episode(world).images[name]
        count = min(len(images), 100)
        chosen.append(images[np.round(np.linspace(0, len(images) - 1, count)).astype(int)])
    values = np.concatenate(chosen).reshape(-1, 3) / 255.0
    for kind, quantile in QUANTILES.items():
        expected = np.quantile(values, quantile, axis=0)
        assert np.allclose(np.ravel(total[name][kind]), expected, atol=atol), kind


def test_quantiles_are_kept_up_over_calls(tmp_path: Path) -> None:
    write(tmp_path, range(3))
    write(tmp_path, range(3, 4))
    total = json.loads((tmp_path / "meta/stats.json").read_text())
    for name in SIZES:
        assert_quantiles(total, name, 4)


def test_statistics_are_per_channel_and_in_0_to_1(tmp_path: Path) -> None:
    write(tmp_path, range(3))
    rows = pq.read_table(tmp_path / "meta/episodes").to_pylist()
    total = json.loads((tmp_path / "meta/stats.json").read_text())
    for name in SIZES:
        key = f"stats/{name}"
        for world, row in enumerate(rows):
            images = episode(world).images[name]
            chosen = np.round(np.linspace(0, len(images) - 1, min(len(images), 100))).astype(int)
            values = images[chosen].reshape(-1, 3) / 255.0
            assert row[f"{key}/count"] == [len(chosen)]
            exact = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0)}
            exact |= {"std": values.std(0)}
            exact |= {k: np.quantile(values, q, axis=0) for k, q in QUANTILES.items()}
            for kind, expected in exact.items():
                value = np.array(row[f"{key}/{kind}"])
                assert value.shape == (3, 1, 1)
                atol = 1e-9 + (2.0 / 255.0 if kind.startswith("q") else 0.0)
                assert np.allclose(value.ravel(), expected, atol=atol), kind
        counts = np.array([row[f"{key}/count"][0] for row in rows])
        means = np.array([row[f"{key}/mean"] for row in rows])[..., 0, 0]
        assert total[name]["count"] == [int(counts.sum())]
        assert np.allclose(np.ravel(total[name]["mean"]), counts @ means / counts.sum())
        assert_quantiles(total, name, 3)
    assert total["action"]["count"] == [146]


def test_a_resumed_dataset_is_the_uninterrupted_one(tmp_path: Path, monkeypatch: Patch) -> None:
    def fail(*paths: Path) -> None:
        raise OSError("no more")

    write(tmp_path / "whole", range(6))
    write(tmp_path / "parts", range(3))
    with DatasetWriter(tmp_path / "parts", SPEC) as writer:
        monkeypatch.setattr(os, "replace", fail)
        with pytest.raises(FolderError):
            add(writer, episode(4))
    monkeypatch.undo()
    write(tmp_path / "parts", range(3, 6))
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")


@pytest.mark.full
def test_a_kill_leaves_what_was_committed(tmp_path: Path, monkeypatch: Patch) -> None:
    """What one would have left is copied before the second commit's first file takes its place."""
    whole = tmp_path / "whole"
    left = tmp_path / "left"
    replaced = os.replace

    def copied(*paths: Any) -> None:
        if not left.exists():
            shutil.copytree(whole, left)
        replaced(*paths)

    write(whole, range(3))
    monkeypatch.setattr(os, "replace", copied)
    write(whole, range(3, 6))
    assert uncommitted(left, 1)
    assert len(listed(left)) == 2 + 3
    assert len(read_dataset(left).episodes) == 3
    with DatasetWriter(left, SPEC):
        pass
    assert uncommitted(left, 1) == []
    assert len(image_names(left)) == 2


def test_few_images_wait_for_the_encoders(tmp_path: Path, monkeypatch: Patch) -> None:
    encode = video_module.encode
    go = threading.Event()
    begun: list[int] = []

    def slow(images: np.ndarray, *args: object) -> None:
        begun.append(len(images))
        go.wait(60.0)
        encode(images, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(video_module, "encode", slow)
    paths = {name: tmp_path / f"{name}.mp4" for name in SIZES}
    encoder = video_module.VideoEncoder(SPEC.videos, SPEC.fps, paths, 2 * 7 * 32 * 48 * 3)
    encoder.add(episode(0).images)  # does not wait
    threading.Timer(0.2, go.set).start()
    encoder.add(episode(1).images)  # there is no room for both
    assert go.is_set()
    encoder.complete()
    assert encoder.waited > 0.0
    assert all(path.exists() for path in paths.values())


def test_a_missing_video_is_one_line(tmp_path: Path) -> None:
    write(tmp_path, range(2))
    (tmp_path / image_names(tmp_path)[0]).unlink()
    with pytest.raises(FolderError, match=r"file-000.mp4: cannot be read"):
        read_dataset(tmp_path)


# job=collect

SMALL = "scene.cameras.front.size=[32,32] scene.cameras.wrist={size:[32,32],rate:10}"
COMMAND = ["job=collect", "task=reach", "sim=native", "job.folder=demos", "cameras=[front,wrist]"]
COMMAND += [*SMALL.split(), *SHORT_REACH]


@GL
def test_without_an_encoder_nothing_is_written(monkeypatch: Patch) -> None:
    def refused(*more: str, says: str) -> None:
        refusal(lambda: check_job(load_config([*COMMAND, *more])), says)

    for program in ("/bin/false", "/no/ffmpeg"):
        monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", program)
        refused(says="cannot be encoded")
    monkeypatch.delenv("IMAGEIO_FFMPEG_EXE")
    refused("scene.cameras.wrist.outputs=[depth]", says="expected rgb among them")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    refused(says="pip install 'mjstack[video]'")


def halved(images: np.ndarray) -> np.ndarray:
    """Means of 2 x 2 pixels: a video has one colour for each."""
    n, height, width, _ = images.shape
    return images.reshape(n, height // 2, 2, width // 2, 2, 3).mean(axis=(2, 4))


@GL
@pytest.mark.full
@pytest.mark.parametrize("backend", ["native", "mjwarp"])
def test_a_dataset_has_the_images_of_the_environment(
    tmp_path: Path, monkeypatch: Patch, backend: str
) -> None:
    """Five episodes in batches of three; images as an environment draws them in its steps."""
    monkeypatch.chdir(tmp_path)
    write_part = PartWriter.write
    added: dict[tuple[int, int], dict[str, np.ndarray]] = {}

    def write(self: PartWriter, episode: EpisodeData, *args: Any) -> None:
        added[episode.row["seed"], episode.row["world"]] = dict(episode.images)
        write_part(self, episode, *args)

    monkeypatch.setattr(PartWriter, "write", write)
    args = [*COMMAND, f"sim={backend}", "sim.device=cpu", "looks=randomized", "timing=hz30"]
    assert run([*args, "nworld=3", "job.episodes=5"]) == 0
    stored = read_dataset(tmp_path / "demos/dataset")
    assert stored.info["fps"] == 30
    assert [row["length"] for row in stored.episodes] == [42] * 5
    cfg = load_config([*args, "job.episodes=5"])
    env = build_env(replace(cfg, action=cfg.controller.action, termination={}), nworld=3)
    for row in stored.episodes:
        if row["world"] == 0:
            reset_worlds(env, row["seed"])
            expert = make_expert(env)
            observed: dict[str, list[torch.Tensor]] = {"front": [], "wrist": []}
            obs = env.images
            for _ in range(row["length"]):
                for name, images in observed.items():
                    images.append(obs[f"images.{name}"].clone())
                obs, *_ = env.step(expert.command())
        for name, images in observed.items():
            expected = torch.stack(images)[:, row["world"]].numpy()
            key = f"observation.images.{name}"
            rendered = added[row["seed"], row["world"]][key]
            # Poses are kept in float32
            assert (np.abs(rendered.astype(int) - expected) > 8).mean() < 1e-3
            off = halved(images_of(stored, key, row["episode_index"])) - halved(rendered)
            assert np.abs(off).mean(axis=(1, 2, 3)).max() < 6.0, name
    env.close()
    assert run([*args, "nworld=3", "job.episodes=5"]) == 0  # does nothing
    assert run([*args, "nworld=3", "job.episodes=6"]) == 0
    assert len(read_dataset(tmp_path / "demos/dataset").episodes) == 6
