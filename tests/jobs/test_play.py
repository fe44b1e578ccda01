"""job=play: worlds with a policy or the expert, as a video."""

import sys
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest
from compositions import load_config, refusal
from environments import Patch, Refused, configure, few, gate_of, has_gl
from PIL import Image, ImageSequence
from policies import write_policy

import mjstack
import mjstack.jobs.play as play
from mjstack.cli import run
from mjstack.episodes.stage import Stage
from mjstack.errors import MjstackError
from mjstack.jobs import check_job
from mjstack.report.page import World
from mjstack.report.picture import save_video
from mjstack.scene import build_model

REACH = ("job=play", "task=reach", "task.episode_steps=60", "sim=native")


@pytest.fixture
def saved(monkeypatch: Patch) -> list[np.ndarray]:
    """States of videos, none of which is drawn."""
    videos: list[np.ndarray] = []

    def save(
        path: Path, model: mujoco.MjModel, worlds: list[World], *options: object, **named: object
    ) -> None:
        path.touch()
        videos.append(np.stack([world.qpos for world in worlds]))

    monkeypatch.setattr(play, "save_video", save)
    monkeypatch.setattr(play, "require_offscreen", lambda model: None)
    return videos


@pytest.mark.full
def test_a_policy_plays_worlds_as_a_batch_starts_them(
    saved: list[np.ndarray], tmp_path: Path
) -> None:
    policy = write_policy(tmp_path / "policy", configure("task=reach"))
    out = tmp_path / "out"
    assert (
        run(
            [
                *REACH,
                "controller=policy",
                f"policy={policy}",
                "nworld=2",
                "seed=5",
                f"hydra.run.dir={out}",
            ]
        )
        == 0
    )
    gate = gate_of(out)
    assert gate["reason"] == "0 of 2 worlds succeeded"  # a world that fails is shown all the same
    assert "world 1: failed: grasp point not above red" in gate["details"]
    assert (out / "episode.mp4").exists()
    (qpos,) = saved
    assert qpos.shape == (2, 60, 20)

    chosen = ("task=reach", "task.episode_steps=60", "reset=randomized", "sim=native", "nworld=2")
    cfg = load_config([*chosen, "seed=5", "controller=policy", f"policy={policy}"])
    stage = Stage(cfg)
    sim = stage.batch_simulation(2)
    stage.play(sim, cfg.reset)
    assert np.array_equal(qpos[:, -1], sim.qpos.numpy())


def test_a_task_without_a_check_is_shown_unjudged(saved: list[np.ndarray], tmp_path: Path) -> None:
    cfg = configure("task=reach")
    policy = write_policy(tmp_path / "policy", cfg)
    out = tmp_path / "out"
    args = [
        *REACH,
        "task.check=null",
        "task.success=null",
        "controller=policy",
        f"policy={policy}",
        "nworld=1",
    ]
    args.append(f"hydra.run.dir={out}")
    assert run(args) == 0
    assert gate_of(out)["reason"] == "not judged: the task has no check"
    assert len(saved) == 1


@pytest.mark.skipif(not has_gl(), reason="MuJoCo cannot draw offscreen here")
def test_a_video_has_worlds_side_by_side(tmp_path: Path) -> None:
    import imageio_ffmpeg

    cfg = configure()
    model = build_model(cfg, visuals=True)
    home = np.tile(model.qpos0, (3, 4, 1))
    home[1, :, Stage(cfg).index.object_qpos[0] + 2] += 0.1  # its cube is in the air
    save_video(tmp_path / "x.mp4", model, [World(label="", qpos=qpos) for qpos in home], 0.02)
    frames = imageio_ffmpeg.read_frames(str(tmp_path / "x.mp4"))
    facts = next(frames)
    assert facts["size"] == (960, 720)
    picture = np.frombuffer(next(frames), np.uint8).reshape(720, 960, 3).astype(int)
    first, second, third = picture[:360, :480], picture[:360, 480:], picture[360:, :480]
    assert first.std() > 10
    assert abs(first - third).max() < 120
    assert abs(first - second).max() > 160
    assert picture[370:, 490:].max() < 40  # the fourth is empty


@pytest.mark.full
@pytest.mark.skipif(not has_gl(), reason="MuJoCo cannot draw offscreen here")
def test_a_camera_of_the_scene_draws_the_video(tmp_path: Path) -> None:
    """Ten pictures per second of 60 steps, each world in its own looks."""
    policy = write_policy(tmp_path / "policy", configure("task=reach"))
    out = tmp_path / "out"
    seen = ["cameras=front", "looks=randomized", "scene.cameras.front.size=[48,64]", "seed=3"]
    clip = ["job.camera=front", "job.format=gif", "job.fps=10", "job.width=128", "nworld=2"]
    args = [*REACH, *seen, *clip, "controller=policy", f"policy={policy}", "web.episode=false"]
    assert run([*args, f"hydra.run.dir={out}"]) == 0
    with Image.open(out / "episode.gif") as video:
        assert video.info["loop"] == 0
        frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(video)]
        assert 6 < len(frames) <= 12  # equal ones in a row are one
        times = [frame.info["duration"] for frame in ImageSequence.Iterator(video)]
    assert sum(times) == 1200
    first = np.asarray(frames[0], int).reshape(48, 2, 64, 3)

    env = mjstack.make_env(["task=reach", "reset=randomized", "sim=native", *seen], nworld=2)
    starts = env.reset(seed=3)[0]["images.front"].numpy().astype(int)
    env.close()
    for world in range(2):
        apart = [abs(first[:, world] - start).mean() for start in starts]
        assert apart[world] < 4.0
        assert apart[1 - world] > 2.0 * apart[world]


@pytest.mark.parametrize("ending", ["gif", "webp"])
def test_a_loop_lasts_as_long_as_the_episode(ending: str, tmp_path: Path) -> None:
    """Thirty pictures per second, which are no whole hundredths apart, scaled to the width."""
    path = tmp_path / f"x.{ending}"

    def draw(states: np.ndarray) -> Iterator[np.ndarray]:
        for (state,) in states:
            image = np.zeros((20, 40, 3), np.uint8)
            image[:, int(10 * state) :][:, :10] = (200, 40, 0)
            yield image

    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    qpos = np.tile(np.arange(4.0)[None, :, None], (4, 1, 1))
    worlds = [World(label="", qpos=states) for states in qpos]
    save_video(path, model, worlds, 1.0 / 30.0, fps=30.0, width=160, draw=draw)
    with Image.open(path) as video:
        assert video.size == (160, 80)
        assert video.n_frames == 4
        for number in range(4):
            video.seek(number)
            shown = np.asarray(video.convert("RGB"), float)
            assert video.info["duration"] == (30, 40, 30, 30)[number]
            for column in (0, 80):  # two worlds in a row
                near = shown[:, column + 20 * number :][:, 4:16].mean((0, 1))
                assert near == pytest.approx((200, 40, 0), abs=16)
            assert shown.mean((0, 1)) == pytest.approx((50, 10, 0), abs=5)


def test_without_a_writer_nothing_is_written(refused: Refused, monkeypatch: Patch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    says = "needs imageio-ffmpeg, which is not installed: run pip install 'mjstack[video]'"
    assert says in refused("job=play", "task=reach", "job.format=mp4")


BAD = [
    (["job.format=avi"], "job.format=avi: expected one of mp4, gif, webp"),
    (["job.camera=side", "cameras=front"], "job.camera=side: expected null, or one of scene.c"),
    (["job.camera=front"], "scene.cameras: there is none. Add a camera: cameras=front"),
    (["job.width=10"], "job.width=10: expected an integer from 64 to 1280 [pixels] or null"),
    (["nworld=65"], "nworld=65: expected at most 64 worlds"),
    (["policy=nowhere"], "policy=nowhere: expected null, because no policy drives"),
    (["controller=policy", "policy=nowhere"], "policy=nowhere: has no policy.json"),
    (["policy=null", "task=lonely"], "lonely"),
    (["controller=policy"], "policy=null: expected the folder of a trained policy"),
]


@pytest.mark.parametrize(("overrides", "says"), few(BAD, 2), ids=[" ".join(o) for o, _ in BAD])
def test_bad_input_is_one_line(overrides: list[str], says: str) -> None:
    args = [*REACH, *overrides]
    refusal(lambda: check_job(load_config(args), args), says)


def test_a_task_without_phases_needs_a_policy() -> None:
    cfg = load_config(list(REACH))
    cfg.controller.phases = {}
    with pytest.raises(MjstackError, match=r"task=reach: expected a task with phases.*policy=FOLD"):
        play.check_play(cfg)


def test_without_gl_nothing_is_written(refused: Refused, monkeypatch: Patch) -> None:
    def fail(*args: object) -> None:
        raise AttributeError("no GL")

    monkeypatch.setattr(mujoco, "Renderer", fail)
    line = refused("job=play", "task=reach", "sim=native")
    assert "offscreen rendering fails" in line
    assert line.endswith("Set MUJOCO_GL=egl or osmesa.")


@pytest.mark.full
def test_a_video_that_cannot_be_written_fails_the_job(
    saved: list[np.ndarray], tmp_path: Path, monkeypatch: Patch
) -> None:
    def full(*args: object, **named: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(play, "save_video", full)
    policy = write_policy(tmp_path / "policy", configure("task=reach"))
    out = tmp_path / "out"
    args = [
        *REACH,
        "controller=policy",
        f"policy={policy}",
        "nworld=1",
        "web.episode=false",
        f"hydra.run.dir={out}",
    ]
    assert run(args) == 1
    assert "episode.mp4 was not written: No space left on device" in gate_of(out)["reason"]
    assert not (out / "episode.mp4").exists()
