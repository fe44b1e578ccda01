"""Cameras: images as observations on both backends, when they are drawn, and what cannot be."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from compositions import load_config, make_env, refusal
from environments import CUDA, Patch, at_double_speed, has_gl, no_host_reads, on_cuda, zeros
from gymnasium.utils.env_checker import check_env

from mjstack.adapters.gymnasium import GymnasiumEnv, GymnasiumVectorEnv
from mjstack.adapters.rsl_rl import RslRlVecEnv
from mjstack.config.schema import Backend
from mjstack.distributed import Ranks
from mjstack.envs import Env, build_env, driven_config
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Stage
from mjstack.errors import ArgumentError, ConfigError, FolderError
from mjstack.gates import images as gate_images
from mjstack.gates.capacity import run_capacity
from mjstack.gates.images import agree, compare_images
from mjstack.gates.parity import run_parity
from mjstack.gates.throughput import run_throughput
from mjstack.jobs import gates
from mjstack.jobs.runner import check_job
from mjstack.report.record import GateResult, Status
from mjstack.scene import build_model
from mjstack.sim import StateRenderer
from mjstack.sim import cameras as sim_cameras

GL = pytest.mark.skipif(not has_gl(), reason="MuJoCo does not draw offscreen here")
NATIVE = pytest.param("native", marks=GL)
MJWARP_CUDA = pytest.param("mjwarp-cuda", marks=CUDA)
ALL = ("rgb", "depth", "segmentation")
Make = Callable[..., Env]


def small(*names: str, outputs: tuple[str, ...] = ("rgb",), size: int = 32) -> list[str]:
    """Overrides that turn on cameras with small images."""
    return [
        f"cameras=[{','.join(names)}]",
        *(f"scene.cameras.{name}.size=[{size},{size}]" for name in names),
        *(f"scene.cameras.{name}.outputs=[{','.join(outputs)}]" for name in names),
    ]


@pytest.fixture
def make() -> Iterator[Make]:
    made: list[Env] = []

    def build(backend: str, *overrides: str, nworld: int = 2) -> Env:
        engine = "native" if backend == "native" else "mjwarp"
        device = "cuda:0" if backend == "mjwarp-cuda" else "cpu"
        made.append(make_env([f"sim={engine}", *overrides], nworld=nworld, device=device))
        return made[-1]

    yield build
    for env in made:
        env.close()


def drawn_anew(env: Env, camera: str) -> list[bool]:
    """Whether each world's image is not all sevens."""
    return [bool((image != 7).any()) for image in env.images[f"images.{camera}"]]


# Images


@GL
@pytest.mark.parametrize("mjwarp", ["mjwarp", MJWARP_CUDA])
def test_images_of_both_backends(make: Make, mjwarp: str) -> None:
    oblong = "scene.cameras.wrist.size=[28,36]"
    overrides = ["looks=randomized", "reset=randomized"]
    overrides += [*small("front", "wrist", outputs=ALL), oblong]
    sizes = {"front": (32, 32), "wrist": (28, 36)}
    found = {}
    for backend in ("native", mjwarp):
        env = make(backend, *overrides)
        first, _ = env.reset(seed=3)
        pairs = product(("images", "depth", "segmentation"), ("front", "wrist"))
        assert set(env.images) == {".".join(pair) for pair in pairs}
        obs, *_, extras = env.step(zeros(env))
        assert set(first) == set(obs) == {"policy", "privileged", *env.images}
        assert set(extras["final_obs"]) == {"policy", "privileged"}
        found[backend] = {name: image.cpu() for name, image in env.images.items()}
        labels = env.cameras.labels
    for camera in ("front", "wrist"):
        a, b = (
            [images[f"{prefix}.{camera}"] for prefix in ("images", "depth", "segmentation")]
            for images in found.values()
        )
        kinds = [((3,), torch.uint8), ((1,), torch.float32), ((), torch.int32)]
        for image, other, (channels, dtype) in zip(a, b, kinds, strict=True):
            assert image.shape == other.shape == (2, *sizes[camera], *channels)
            assert image.dtype == other.dtype == dtype
        same = a[2] == b[2]
        assert same.float().mean() > 0.99
        assert (a[0].float() - b[0].float())[same].abs().mean() < 5.0
        assert (a[1] - b[1])[same].abs().median() < 1e-4
        assert not torch.equal(a[0][0], a[0][1])  # worlds differ
        seen = {labels[number] for number in a[2].unique().tolist() if number >= 0}
        assert {"red", "blue", "table"} <= seen if camera == "front" else {"table"} <= seen
        for number in a[2].unique().tolist():
            union = ((a[2] == number) | (b[2] == number)).sum()
            assert union < 60 or ((a[2] == number) & (b[2] == number)).sum() > 0.9 * union
    # The red cube is red, in rgb order.
    image = found["native"]["images.front"]
    red = image[found["native"]["segmentation.front"] == labels.index("red")].float().mean(0)
    assert (red[0] > 2.0 * red[1:]).all()


def test_without_cameras_nothing_is_drawn_or_kept() -> None:
    off = load_config()
    on = load_config(["cameras=[front,wrist]"])
    model = build_model(off)
    assert [model.camera(number).name for number in range(model.ncam)] == ["wrist_cam"]  # its own
    assert model.nlight == 0
    assert model.ngeom < build_model(on).ngeom
    assert off.scene.cameras == {}


@pytest.mark.parametrize("backend", ["native", pytest.param("mjwarp", marks=pytest.mark.full)])
def test_physics_is_the_same_to_the_bit(make: Make, backend: str) -> None:
    ends = []
    for more in ([], small("wrist", size=4)):
        env = make(backend, "reset=randomized", *more)
        sim = env.sim
        env.reset_manager.reset(torch.ones(2, dtype=torch.bool))
        generator = torch.Generator().manual_seed(0)
        for _ in range(5):
            noise = torch.rand(sim.ctrl.shape, generator=generator, dtype=sim.ctrl.dtype)
            sim.ctrl.add_(0.2 * noise - 0.1)
            sim.step(10)
        ends.append((sim.qpos.clone(), sim.qvel.clone(), sim.contact_count.clone()))
    for a, b in zip(*ends, strict=True):
        assert torch.equal(a, b)
    assert ends[0][2].any()


def test_a_driven_episode_has_the_same_scene_and_draws_nothing() -> None:
    cfg = load_config(["sim=native", "cameras=front", "looks=randomized"])
    env = build_env(driven_config(cfg), nworld=1)
    obs, _ = env.reset()
    assert (obs, env.images, env.cameras) == ({}, {}, None)
    assert env.sim.model.camera("front").id >= 0
    assert env.sim.model.ngeom == build_model(cfg).ngeom
    env.close()


# When they are drawn


@pytest.mark.parametrize("backend", [NATIVE, pytest.param("mjwarp", marks=pytest.mark.full)])
def test_a_slow_camera_is_drawn_every_few_steps_and_at_resets(make: Make, backend: str) -> None:
    chosen = ["termination.time_out.params.steps=7", "scene.cameras.front.rate=10.0"]
    chosen += ["scene.cameras.top.terminal=true", *small("front", "top", size=8)]
    env = make(backend, *chosen)
    env.reset(seed=0)
    env.episode_step[1] = 4  # worlds are at different steps
    drawn = []
    ends = []
    for _ in range(8):
        for image in env.images.values():
            image.fill_(7)
        obs, _, _, truncated, extras = env.step(zeros(env))
        assert obs["images.front"] is env.images["images.front"]
        assert all(drawn_anew(env, "top"))
        drawn.append(drawn_anew(env, "front"))
        final = extras["final_obs"]
        assert set(final) == {"policy", "privileged", "images.top"}
        ends.append([bool(image.any()) for image in final["images.top"]])
        assert [*truncated] == [env.episode_step[world] == 0 for world in (0, 1)]
    # World 0: steps 5 and 0 (reset in the 7th); world 1: 5, 0, and 5 again.
    assert [step for step, (one, _) in enumerate(drawn, 1) if one] == [5, 7]
    assert [step for step, (_, two) in enumerate(drawn, 1) if two] == [1, 3, 8]
    assert [any(row) for row in ends] == [False, False, *[True] * 6]
    assert [row[0] for row in ends] == [False] * 6 + [True] * 2


@pytest.mark.full
@pytest.mark.parametrize("backend", [NATIVE, "mjwarp", MJWARP_CUDA])
def test_a_masked_reset_draws_its_worlds_alone(make: Make, backend: str) -> None:
    env = make(backend, *small("front", "wrist", outputs=ALL, size=8), nworld=3)
    env.reset(seed=0)
    whole = {name: image.clone() for name, image in env.images.items()}
    for image in env.images.values():
        image.fill_(7)
    env.reset(seed=None, mask=torch.tensor([False, True, False], device=env.device))
    for name, image in env.images.items():
        assert (image[::2] == 7).all(), name
        assert not (image[1] == 7).all(), name
    env.reset(seed=0)
    for name, image in env.images.items():
        assert torch.equal(image, whole[name]), name


@pytest.mark.full
def test_a_policy_that_decides_seldom_gets_an_image_per_decision(make: Make) -> None:
    slow = ["timing.policy_decimation=2", "scene.cameras.wrist.rate=10.0"]
    env = make("mjwarp", *slow, *small("front", "wrist", size=8))
    env.reset(seed=0)
    drawn = []
    for _ in range(5):
        for image in env.images.values():
            image.fill_(7)
        env.step(zeros(env))
        drawn.append([drawn_anew(env, name)[0] for name in ("front", "wrist")])
    # Every 5 steps, so after 5 (seen at 6) and 10 steps.
    assert drawn == [[True, False], [True, False], [True, True], [True, False], [True, True]]


@on_cuda
def test_replayed_steps_draw_what_eager_steps_draw(make: Make) -> None:
    ends = []
    chosen = ["termination.time_out.params.steps=4", "scene.cameras.wrist.rate=25.0"]
    chosen += small("front", "wrist", outputs=ALL)
    for graph in ("off", "require"):
        env = make("mjwarp-cuda", f"graph={graph}", *chosen, nworld=64)
        env.reset(seed=0)
        for _ in range(9):
            env.step(zeros(env))
        ends.append({name: image.clone() for name, image in env.images.items()})
        assert env.graph.captured == (graph == "require")
    for name, image in ends[0].items():
        # No run on CUDA repeats another bit for bit: a depth is metres, the rest are integers.
        off = (image.float() - ends[1][name].float()).abs()
        assert (off <= 1e-4).float().mean() > 0.99, name


@on_cuda
def test_a_step_with_images_reads_nothing_from_the_device(make: Make) -> None:
    """Torch raises at every host read, also in steps that reset worlds."""
    chosen = ["looks=randomized", "reset=randomized", "termination.time_out.params.steps=5"]
    chosen += ["scene.cameras.front.terminal=true", "scene.cameras.wrist.rate=10.0"]
    env = make("mjwarp-cuda", *chosen, *small("front", "wrist", outputs=ALL), nworld=16)
    env.reset(seed=0)
    env.step(zeros(env))
    with no_host_reads():
        for _ in range(11):
            env.step(zeros(env))
    assert (env.episode >= 2).all()
    env.faults.raise_first()


# Looks

LOOKS = ("cam_fovy", "cam_pos", "cam_quat", "geom_rgba", "light_diffuse", "light_dir", "light_pos")


def looks_of(env: Env) -> dict[str, torch.Tensor]:
    assert set(LOOKS) <= env.sim.fields.keys()
    return {name: env.sim.fields[name].cpu().clone() for name in LOOKS}


@pytest.mark.parametrize("backend", ["native", pytest.param("mjwarp", marks=pytest.mark.full)])
def test_looks_follow_seed_world_and_episode(make: Make, backend: str) -> None:
    config = ["looks=randomized", "reset=randomized", *small("front", "top", size=2)]
    mask = torch.tensor([True, False, True])
    env = make(backend, *config, nworld=3)
    ends = []
    for _ in range(2):
        env.reset_manager.reset(~mask | mask)
        first = looks_of(env)
        env.episode += mask
        env.reset_manager.reset(mask)
        second = looks_of(env)
        env.episode.fill_(-1)
        ends.append((first, second))
    for name in LOOKS:
        first, second = (end[name] for end in ends[0])
        nominal = torch.from_numpy(getattr(env.sim.model, name)).to(first)
        assert torch.equal(first, ends[1][0][name]), name
        assert torch.equal(second, ends[1][1][name]), name
        assert torch.equal(first[1], second[1]), name
        for one, other in ((first[0], first[1]), (first[0], second[0]), (first[0], nominal)):
            assert not torch.allclose(one, other, atol=1e-4), name
    # World 0 of one world, with another camera, looks the same.
    one = make(backend, *config[:2], *small("front", size=2), nworld=1)
    one.episode.fill_(-1)
    one.reset_manager.reset(torch.ones(1, dtype=torch.bool))
    alone = looks_of(one)
    front = one.sim.model.camera("front").id
    for name in LOOKS:
        whole = ends[0][0][name][0]
        if name.startswith("cam"):
            assert torch.equal(alone[name][0, front], whole[env.sim.model.camera("front").id])
        else:
            assert torch.equal(alone[name][0], whole), name


def test_looks_stay_in_their_ranges(make: Make) -> None:
    values = ("pos=0.3", "brightness=[0.5,0.8]", "tint=0.0")
    light = (f"reset.light.params.{value}" for value in values)
    env = make("native", "looks=randomized", *light, *small("top", size=2), nworld=200)
    model = env.sim.model
    env.reset_manager.reset(torch.ones(200, dtype=torch.bool))
    fields = {name: env.sim.fields[name].numpy() for name in LOOKS}
    factor = fields["light_diffuse"] / model.light_diffuse
    assert factor.min() == pytest.approx(0.5, abs=0.01)
    assert factor.max() == pytest.approx(0.8, abs=0.01)
    assert np.ptp(factor, axis=2).max() < 1e-6  # no tint
    moved = np.abs(fields["light_pos"] - model.light_pos)
    assert 0.28 < moved.max() <= 0.3
    # Lights stay aimed at one point on the table.
    top = env.cfg.scene.table_top
    down = (fields["light_pos"][..., 2:] - top) / -fields["light_dir"][..., 2:]
    aimed = fields["light_pos"] + down * fields["light_dir"]
    assert np.ptp(aimed, axis=0).max() < 1e-5
    assert np.abs(np.linalg.norm(fields["light_dir"], axis=-1) - 1).max() < 1e-6
    number = model.camera("top").id
    assert 0.009 < np.abs(fields["cam_pos"] - model.cam_pos)[:, number].max() <= 0.01
    dots = np.abs((fields["cam_quat"] * model.cam_quat).sum(-1))[:, number]
    angle = 2 * np.arccos(dots.clip(0, 1))
    assert 0.03 < angle.max() < 0.03 * math.sqrt(3)
    scale = (fields["cam_fovy"] / model.cam_fovy)[:, number]
    assert scale.min() == pytest.approx(0.95, abs=2e-3)
    assert scale.max() == pytest.approx(1.05, abs=2e-3)
    red = model.geom("red").id
    spread = fields["geom_rgba"][:, red] - model.geom_rgba[red]
    assert 0.07 < np.abs(spread).max() <= 0.08 + 1e-6
    assert not spread[:, 3].any()
    robot = model.geom_bodyid == model.body("base").id
    assert (fields["geom_rgba"][:, robot] == model.geom_rgba[None, robot]).all()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("cameras=[]", "reset.light: the scene has no lights, because nothing is drawn"),
        (
            "reset.table_color.params.things=[tabel]",
            "things=['tabel']: expected names of things. Did you mean 'table'?",
        ),
        ("reset.light.params.brightness=[2,1]", "=[2, 1]: expected two positive numbers"),
        ("reset.object_colors.params.spread=2", "spread=2: expected a number from 0 to 1"),
    ],
)
def test_looks_that_cannot_be_are_one_line(override: str, message: str) -> None:
    choices = ["looks=randomized", *([] if override == "cameras=[]" else ["cameras=front"])]
    call = partial(make_env, ["sim=native", *choices, override], nworld=1)
    refusal(call, override.partition(".params")[0].replace("cameras=[]", ""), message)


@pytest.mark.full
@pytest.mark.parametrize("backend", [NATIVE, "mjwarp", MJWARP_CUDA])
def test_states_are_drawn_later_as_they_were(make: Make, backend: str) -> None:
    config = ["looks=randomized", "reset=randomized", *small("front", "wrist", outputs=ALL)]
    env = make(backend, *config, nworld=3)
    env.reset(seed=2)
    env.step(zeros(env))
    engine = Backend.native if backend == "native" else Backend.mjwarp
    renderer = StateRenderer(
        env.sim.model, env.cfg, 5, backend=engine, device=str(env.device), fields=[*env.sim.fields]
    )
    for worlds in ([0, 1, 2], [2, 1]):
        fields = {name: field[worlds] for name, field in env.sim.fields.items()}
        drawn = renderer.draw(env.sim.qpos[worlds], fields)
        assert drawn.keys() == env.images.keys()
        for name, image in drawn.items():
            assert (image == env.images[name][worlds]).float().mean() > 0.999, name
    assert renderer.labels == env.cameras.labels
    with pytest.raises(ArgumentError, match="qpos: found 6 states, expected at most 5"):
        renderer.draw(env.sim.qpos.repeat(2, 1))
    renderer.close()


# Gates


def painted(offset: int, color: int) -> dict[str, np.ndarray]:
    """Two images of a 20 x 20 thing on another, at an offset and of a colour."""
    things = np.zeros((2, 64, 64), np.int32)
    things[:, 20:40, 20 + offset : 40 + offset] = 1
    colors = np.where(things[..., None] == 1, color, 50).repeat(3, -1).astype(np.uint8)
    depth = things[..., None].astype(np.float32)
    return {"images.c": colors, "depth.c": depth, "segmentation.c": things}


def test_agreement_of_images() -> None:
    labels = ["floor", "cube"]
    same = agree("c", painted(0, 200), painted(0, 200), labels, 100)
    assert (same.same, same.color, same.depth) == (1.0, 0.0, 0.0)
    assert same.iou == {"floor": 1.0, "cube": 1.0}
    moved = agree("c", painted(0, 200), painted(1, 200), labels, 100)
    assert moved.iou["cube"] == pytest.approx(19 / 21)
    assert moved.color == 0.0  # where both show the same thing
    assert moved.same == pytest.approx(1 - 40 / 4096)
    darker = agree("c", painted(0, 200), painted(0, 190), labels, 100)
    assert darker.color == pytest.approx(10 * 400 / 4096)
    small = agree("c", painted(0, 200), painted(1, 200), labels, 841)
    assert (list(small.iou), small.left_out) == (["floor"], ["cube"])
    other = painted(0, 200)
    other["segmentation.c"] = other["segmentation.c"] + 2
    assert agree("c", painted(0, 200), other, labels, 100).color == np.inf


def test_images_that_compare_too_little_fail(monkeypatch: Patch) -> None:
    """A cube wholly elsewhere, of too few pixels for an intersection over union: with nothing else
    to compare but the background, and beside a robot that agrees.
    """
    labels = ["table", "red", "gripper"]

    def images(size: int, cube: int, robot: int) -> dict[str, np.ndarray]:
        things = np.zeros((12, size, size), np.int32)
        things[:, cube : cube + 3, :3] = 1
        things[:, :robot, size - robot :] = 2
        return {
            "segmentation.front": things,
            "images.front": np.zeros((*things.shape, 3), np.uint8),
            "depth.front": np.zeros((*things.shape, 1), np.float32),
        }

    monkeypatch.setattr(gate_images, "require_offscreen", lambda model: None)
    stage = Stage(load_config(["cameras=front", "gate.parity.images=x.npz"]))
    elsewhere = Run(stage)
    for size, robot, says in (
        (8, 0, ["nothing but the background has gate.parity.image_pixels=1000 ", "is 0.7188"]),
        (64, 40, ["front: same thing is 0.9956, expected at least"]),
    ):
        mjwarp = images(size, 0, robot)
        native = images(size, size - 3, robot)
        monkeypatch.setattr(gate_images, "load_images", lambda cfg, m=mjwarp: (np.zeros(1), m))
        monkeypatch.setattr(gate_images, "_draw_states", lambda *args, n=native: (n, labels))
        result = GateResult(name="parity", status=Status.passed)
        problems = compare_images(elsewhere, result)
        assert len(problems) == len(says)
        assert all(says[k] in problem for k, problem in enumerate(problems))
        assert "image_pixels=1000 pixels: " in result.details[0]
        assert "red" in result.details[0]


@GL
@pytest.mark.full
def test_parity_compares_images_here_and_elsewhere(tmp_path: Path) -> None:
    overrides = ["gates=[parity]", "sim=mjwarp", "sim.device=cpu"]
    overrides += [*at_double_speed(), *small("front", "top", "wrist", size=128)]
    (result,) = run_parity(Run(Stage(load_config(overrides)), folder=tmp_path))
    assert result.status is Status.passed
    assert result.metrics["images.front.iou.red"] > 0.99
    assert 0.0 < result.metrics["images.wrist.color_of_255"] < 3.0
    assert (tmp_path / "parity_images.png").stat().st_size > 10_000
    # The same file on another machine, and one that shows something else
    file = tmp_path / "parity_images.npz"
    cfg = load_config([*overrides, f"gate.parity.images={file}"])
    stage = Stage(cfg)
    elsewhere = Run(stage)
    apart = GateResult(name="parity", status=Status.passed)
    assert compare_images(elsewhere, apart) == []
    for name in ("images.front.iou.red", "images.wrist.color_of_255"):
        assert apart.metrics[name] == result.metrics[name]
    with np.load(file) as saved:
        arrays = dict(saved)
    arrays["images.top"] += 20
    arrays["segmentation.front"] = np.roll(arrays["segmentation.front"], 3, axis=2)
    np.savez(file, **arrays)
    other = GateResult(name="parity", status=Status.passed)
    problems = compare_images(elsewhere, other)
    assert any(problem.startswith("images, front, iou: red is 0.") for problem in problems)
    assert any(problem.startswith("images, top: color of 255 is") for problem in problems)
    # Files that cannot be compared are one line, before anything is written.
    there = f"gate.parity.images={file}"
    size = "scene.cameras.front.size=[64,64]"
    for args, message in (
        ([*overrides[:3], *small("front")], r"drawn with .*top.* expected none"),
        ([*overrides, size], r"scene.cameras.front.size=\[128, 128\], expected \[64, 64\]"),
    ):
        with pytest.raises(FolderError, match=message):
            check_job(load_config([*args, there]))
    file.write_bytes(b"nothing")
    with pytest.raises(FolderError, match=r"parity_images\.npz: cannot be read"):
        check_job(load_config([*overrides, there]))


@GL
@pytest.mark.full
def test_throughput_and_capacity_count_images() -> None:
    quick = ("measurements=[env_step,cameras]", "repetitions=1", "env_steps=3", "action_share=0.1")
    overrides = ["gates=[capacity,throughput]", "sim=native", "nworld=4", *at_double_speed()]
    overrides += [*(f"gate.throughput.{value}" for value in quick), "gate.capacity.random_steps=3"]
    run = Run(Stage(load_config([*overrides, *small("front", "wrist", size=16)])))
    result = run_throughput(run)[0]
    assert result.status is Status.passed
    m = result.metrics
    images_s = m["cameras.images_per_s.median"]
    images_ms = m["cameras.images_ms_per_step.median"]
    assert images_s == pytest.approx(4 * 2 * 1e3 / images_ms)  # of one repetition
    assert "env_step.images_per_s.median" not in m
    size = 4 * 2 * 16 * 16 * 3 / 1e6
    assert m["cameras.images_mb"] == pytest.approx(size)
    (capacity,) = run_capacity(run)
    assert capacity.metrics["memory.images_mb"] == pytest.approx(size)


# Adapters


@GL
@pytest.mark.full
def test_gymnasium_gets_images_and_keeps_them(make: Make) -> None:
    terminal = "scene.cameras.front.terminal=true"
    overrides = ["task.episode_steps=3", *small("front", outputs=ALL, size=8)]
    with pytest.raises(ConfigError, match=r"scene.cameras.front.terminal=false: expected true"):
        GymnasiumVectorEnv(make("native", *overrides), group=None)
    check_env(GymnasiumEnv(make("native", *overrides, terminal, nworld=1), group=None))
    env = GymnasiumVectorEnv(make("native", *overrides, terminal), group=None)
    first, _ = env.reset(seed=0)
    kept = first["images.front"].copy()
    for _ in range(3):
        assert first in env.observation_space
        obs, *_, infos = env.step(env.action_space.sample())
    assert np.array_equal(first["images.front"], kept)
    assert obs in env.observation_space
    assert infos["final_obs"][1] in env.single_observation_space
    assert infos["final_obs"][1]["images.front"].any()


@pytest.mark.full
def test_rsl_rl_gets_images_and_keeps_them(make: Make) -> None:
    env = RslRlVecEnv(make("mjwarp", *small("wrist", size=16)))
    first = env.get_observations()
    kept = first["images.wrist"].clone()
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        action = torch.rand((2, env.num_actions), generator=generator)
        after, *_ = env.step(action)
    assert torch.equal(first["images.wrist"], kept)
    assert not torch.equal(after["images.wrist"], kept)


# Bad input


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("scene.cameras.front.size=[0,64]", "2 integers from 1 to 4096 [pixels]"),
        ("scene.cameras.front.size=[64]", "2 integers from 1 to 4096 [pixels]"),
        ("scene.cameras.front.fovy=0", "a number from 1 to 170 [deg]"),
        ("scene.cameras.front.rate=30", "50 Hz over an integer"),
        ("scene.cameras.front.outputs=[]", "some of rgb, depth, segmentation, each once"),
        ("scene.cameras.front.outputs=[heat]", "some of rgb, depth, segmentation"),
        ("scene.cameras.front.pose.target=[0.55,0,0.42]", "a point away from pos"),
        ("scene.cameras.front.pose.up=[-0.57,0,-0.38]", "a direction across that"),
        ("scene.cameras.front.pose.mount=lid", "body 'lid' does not exist."),
        ("robot.wrist_camera=null", "scene.cameras.wrist.pose=null: expected a pose"),
        ("robot.wrist_camera.mount=lid", "scene.cameras.wrist.pose.mount: body 'lid'"),
        ("cameras=side", "'side' does not exist. Available: front, top, wrist"),
        ("cameras=[] gate.parity.images=x.npz", "gate.parity.images=x.npz: expected null, because"),
    ],
)
def test_a_bad_value_is_one_line(overrides: str, message: str) -> None:
    cameras = [] if overrides.startswith("cameras") else ["cameras=[front,wrist]"]
    refusal(lambda: build_model(load_config([*cameras, *overrides.split()])), message)


@pytest.mark.parametrize("backend", ["native", "mjwarp"])
def test_images_that_do_not_fit_into_memory_are_one_line(backend: str, monkeypatch: Patch) -> None:
    monkeypatch.setattr(sim_cameras, "free_memory", lambda device: 10**9)
    monkeypatch.setattr(gates, "require_offscreen", lambda model: None)
    config = [f"sim={backend}", "gates=[baseline]", "cameras=front"]
    check_job(load_config([*config, "nworld=1000"]))
    with pytest.raises(ConfigError) as caught:
        check_job(load_config([*config, "nworld=100000", "scene.cameras.front.size=[64,64]"]))
    assert str(caught.value) == (
        "scene.cameras=front 64x64: expected images that fit into the memory of cpu, where 100000"
        f" worlds need {'1.14' if backend == 'native' else '3.95'} GiB and 0.931 GiB are free."
        " Lower nworld, or the cameras' size."
    )


@pytest.mark.parametrize(
    ("device", "devices", "size", "nworld"),
    [("cuda:0", "4", 1, 5), ("cuda:2", "4", 4, 5), ("cuda:1", "null", 2, 9), ("cpu", "2", 1, 17)],
)
def test_a_gpu_needs_room_for_the_images_of_its_rank(
    device: str, devices: str, size: int, nworld: int, monkeypatch: Patch
) -> None:
    found: list[int] = []
    monkeypatch.setattr("torch.cuda.device_count", lambda: 4)
    monkeypatch.setattr("mjstack.jobs.runner.resolve_backend", lambda cfg: ("mjwarp", device))
    monkeypatch.setattr(gates, "check_image_memory", lambda *args, mjwarp: found.append(args[2]))
    cfg = load_config(["cameras=front", "nworld=17", f"devices={devices}"])
    backend = (Backend.mjwarp, device)
    stage: Any = SimpleNamespace(cfg=cfg, backend=backend, ranks=Ranks(0, size), model=None)
    gates.check_cameras(stage)
    assert found == [nworld]
