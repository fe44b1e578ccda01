"""Policies that see images: what they learn from, what they see, and what is refused."""

import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from compositions import load_config, make_env
from environments import SHORT_REACH, Capture, at_double_speed, on_cuda
from policies import interrupted, report, same

from mjstack.cli import run
from mjstack.config.schema import CloneJobCfg, VisionCfg
from mjstack.drivers.policy import PolicyDriver
from mjstack.episodes.stage import Stage
from mjstack.errors import FolderError
from mjstack.policy import load_policy
from mjstack.train.clone_learner import CloneLearner
from mjstack.train.clone_network import vision_of
from mjstack.train.images import Augmentation, ImagePool
from mjstack.train.rounds import make_round

CAMERAS = [
    "cameras=[front,wrist]",
    "scene.cameras.front.size=[16,24]",
    "scene.cameras.wrist.size=[16,16]",
]
SMALL = ["task=reach", "sim=mjwarp", "sim.device=cpu", "nworld=4", *CAMERAS, *SHORT_REACH]
TRAIN = ["job=train", "experiment=pixels", *SMALL, "web.episode=false", "gate.success.rate=0.0"]
TINY = [
    *TRAIN,
    *("job.rounds=2", "job.vision.channels=[4,8]", "job.vision.features=8", "job.vision.shift=1"),
    *("job.vision.pool=100", "job.episodes=4", "job.hidden=[16]", "job.batches=6"),
    *("job.batch_size=16", "job.save_every=6"),
]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny training."""
    folder = tmp_path_factory.mktemp("pixels") / "training"
    assert run([*TINY, f"job.folder={folder}"]) == 0
    return folder


@pytest.mark.full
def test_a_policy_sees_images_and_joints(trained: Path) -> None:
    policy = load_policy(trained / "last")
    assert list(policy.widths) == ["joint_pos"]
    vision = policy.network.vision
    assert vision.sizes == {"front": (16, 24), "wrist": (16, 16)}
    facts = json.loads((trained / "last/policy.json").read_text())
    assert facts["observation"]["images"] == {"front": [16, 24], "wrist": [16, 16]}
    assert facts["network"]["channels"] == [4, 8]
    assert [gate["status"] for gate in report(trained).values()] == ["pass", "pass"]
    # Either image changes the answer
    seen = torch.zeros(1, 6)
    black = [torch.zeros(1, *size, 3) for size in vision.sizes.values()]
    answer = policy.network(seen, black)
    for number in range(2):
        lit = [image + 200.0 * (number == k) for k, image in enumerate(black)]
        assert not torch.allclose(policy.network(seen, lit), answer)


@pytest.mark.full
def test_the_driver_sees_what_the_environment_draws(trained: Path) -> None:
    """Each world's images when it asks, also after a reset of its own."""
    policy = load_policy(trained / "last")
    env = make_env([*SMALL, "action=joint_absolute", "observation=pixels", "~termination.success"])
    env.reset(seed=5)
    driver = PolicyDriver(env, policy)
    network = policy.network.double()
    expected = torch.zeros(4, 5, 6)
    images = env.images
    for step in range(13):
        if step == 7:
            env.reset(mask=torch.tensor([False, True, False, False]))
        slot = env.episode_step % 5
        shown = [images[f"images.{name}"].double() for name in ("front", "wrist")]
        exact = env.index.on(env.device, env.sim.qpos.dtype).qpos.read(env.sim.qpos)
        home = torch.tensor(env.cfg.robot.home)
        answer = network((exact - home).double(), shown)[:, :5].float()
        expected = torch.where((slot == 0)[:, None, None], answer, expected)
        command = driver.command()
        assert torch.allclose(command, expected[torch.arange(4), slot], atol=1e-5), step
        env.step(command)
    env.close()


@pytest.mark.full
def test_other_cameras_are_refused(trained: Path, capsys: Capture) -> None:
    base = [
        *SMALL[:4],
        *SHORT_REACH,
        "controller=policy",
        f"policy={trained}/last",
        "gates=[batch]",
    ]
    for cameras, says in (
        (["cameras=[]"], "with scene.cameras.front.pose.mount=table, and here it is missing"),
        ([], "was trained with scene.cameras.front.size=[16, 24], and here it is ["),
        ([*CAMERAS, "scene.cameras.wrist.size=[32,32]"], "wrist.size=[16, 16], and here it is"),
        ([*CAMERAS, "scene.cameras.front.fovy=50"], "front.fovy=45.0, and here it is 50.0"),
    ):
        assert run([*base, *cameras]) == 2
        err = capsys.readouterr().err.strip()
        assert says in err
        assert len(err.splitlines()) == 1
    # More than it sees
    env = make_env([*SMALL, "action=joint_absolute", "cameras=[front,wrist,top]"])
    env.reset(seed=0)
    PolicyDriver(env, load_policy(trained / "last"))
    without = replace(env.cfg, scene=replace(env.cfg.scene, cameras={}))
    with pytest.raises(FolderError, match="here it is missing"):
        load_policy(trained / "last").check_fit(without)
    env.close()


@pytest.mark.full
@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"observation": {"images": {"front": [16, 16]}}}, "images of front are not those of conf"),
        (
            {"observation": {"images": {"front": [10**9, 16]}}},
            "images of front are not those of config",
        ),
        ({"network": {"channels": []}}, "IndexError"),
        ({"network": {"features": 9}}, "loading state_dict"),
    ],
    ids=["size", "too large", "no layers", "another network"],
)
def test_a_strangers_policy_is_refused(
    trained: Path, tmp_path: Path, change: dict[str, dict], says: str
) -> None:
    for path in (trained / "last").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    facts = json.loads((tmp_path / "policy.json").read_text())
    for block, values in change.items():
        facts[block] |= values
    (tmp_path / "policy.json").write_text(json.dumps(facts))
    with pytest.raises(FolderError, match="cannot be read") as caught:
        load_policy(tmp_path)
    assert says in str(caught.value)


# Training data


def test_the_pool_keeps_an_even_share_in_any_order() -> None:
    """All steps while they fit; then the same ones, whatever came at once."""

    def images(steps: torch.Tensor) -> torch.Tensor:
        return (steps % 251).to(torch.uint8)[:, None, None, None].expand(-1, 2, 3, 3)

    def filled(pool: ImagePool, parts: Sequence[int]) -> ImagePool:
        first = 0
        for count in parts:

            def read(steps: torch.Tensor, first: int = first) -> dict[str, torch.Tensor]:
                return {"front": images(first + steps)}

            pool.add(torch.arange(0, count, 5), count, read)
            first += count
        rows = pool.rows()
        assert (pool.steps[rows].diff() > 0).all()
        assert torch.equal(pool.images["front"][rows], images(pool.steps[rows]))
        return pool

    sizes = {"front": (2, 3)}
    whole = filled(ImagePool(sizes, 700, "cpu"), [1000, 2000])
    assert torch.equal(whole.steps[whole.rows()], torch.arange(0, 3000, 5))
    share = filled(ImagePool(sizes, 100, "cpu"), [1000, 2000])
    other = filled(ImagePool(sizes, 100, "cpu"), [500, 500, 1500, 500])
    kept = share.steps[share.rows()]
    assert torch.equal(other.steps[other.rows()], kept)
    assert (torch.histc(kept.float(), 10, 0, 3000) - 10).abs().max() <= 2


@pytest.mark.full
@pytest.mark.parametrize("backend", ["mjwarp", "native"])
def test_images_of_a_round_come_again(backend: str, tmp_path: Path) -> None:
    """A round that is read has the images that were rendered when it was played: those at which the
    policy is queried and whose chunk the expert drove.
    """
    args = [*TINY, f"sim={backend}", "looks=randomized", "job.episodes=6"]
    stage = Stage(load_config(args))
    job: CloneJobCfg = stage.cfg.job
    sizes = vision_of(stage.cfg, job).sizes
    pools = [ImagePool(sizes, 1000, "cpu") for _ in range(2)]
    played, read = (make_round(stage, tmp_path, None, 0, pool) for pool in pools)
    assert played.qpos is not None
    assert read.qpos is not None
    assert torch.equal(read.qpos, played.qpos)
    steps = torch.arange(0, 6 * 70, job.execute)
    assert torch.equal(read.usable(job), steps)
    assert torch.equal(pools[1].steps[pools[1].rows()], steps)
    for camera in sizes:
        first, second = (pool.images[camera][pool.rows()] for pool in pools)
        assert torch.equal(first, second)
        assert first.flatten(1).float().std(1).min() > 5.0


@pytest.mark.full
def test_it_learns_to_tell_where_objects_are(tmp_path: Path) -> None:
    """What it estimates is recorded in every step, and no part of what the policy sees."""
    stage = Stage(load_config([*TINY, "job.rounds=0", "job.batches=300", "job.learning_rate=0.01"]))
    pool = ImagePool(vision_of(stage.cfg, stage.cfg.job).sizes, 1000, "cpu")
    played = make_round(stage, tmp_path, None, 0, pool)
    truth = played.estimated
    assert truth is not None
    assert truth.shape == (4 * 70, 2 * (3 + 3 + 2))  # offset, position, heading of two cubes
    assert list(played.widths) == ["joint_pos"]
    with closing(CloneLearner(stage, played, tmp_path, pool)) as learner:
        rows = pool.rows()
        images = [part[rows].float() for part in pool.images.values()]

        @torch.no_grad()
        def error() -> float:
            features = learner._network.encode(images)
            estimate, scaled = learner._estimator(features, truth[pool.steps[rows]])
            return float((estimate - scaled).abs().mean())

        before = error()
        learner.learn()
        assert error() < 0.5 * before


def test_a_group_without_numbers_is_not_estimated(tmp_path: Path) -> None:
    """Such as headings of objects that are all round: the mean of no error is not a number."""
    stage = Stage(load_config([*TINY, "job.rounds=0", "job.batches=1"]))
    pool = ImagePool(vision_of(stage.cfg, stage.cfg.job).sizes, 1000, "cpu")
    played = make_round(stage, tmp_path, None, 0, pool)
    assert played.estimated is not None
    played = replace(played, estimated=played.estimated[:, :0])
    with closing(CloneLearner(stage, played, tmp_path, pool)) as learner:
        learner.learn()
        assert learner.curve[-1]["loss"] > 0.0


def test_augmentation_shifts_and_tints() -> None:
    pool = [torch.randint(0, 256, (5, 9, 12, 3), dtype=torch.uint8) for _ in range(2)]
    rows = torch.tensor([4, 0, 0, 2])
    generator = torch.Generator().manual_seed(0)
    still = Augmentation(VisionCfg(shift=0, color=0.0), 2, 4, torch.device("cpu"))
    still.draw(generator)
    for image, images in zip(still(pool, rows), pool, strict=True):
        assert torch.equal(image, images[rows].float())

    moving = Augmentation(VisionCfg(shift=2, color=0.0), 2, 4, torch.device("cpu"))
    found: set[tuple[int, int]] = set()
    for _ in range(30):
        moving.draw(generator)
        for image, images, moves in zip(moving(pool, rows), pool, moving._moves, strict=True):
            for one, row, (y, x) in zip(image, rows.tolist(), (moves - 2).tolist(), strict=True):
                found.add((y, x))
                padded = torch.nn.functional.pad(
                    images[row].permute(2, 0, 1)[None].float(), (2, 2, 2, 2), mode="replicate"
                )[0].permute(1, 2, 0)
                assert torch.equal(one, padded[2 + y : 11 + y, 2 + x : 14 + x])
    assert found == {(y, x) for y in range(-2, 3) for x in range(-2, 3)}

    grey = [torch.full((5, 9, 12, 3), 100, dtype=torch.uint8)] * 2
    tinted = Augmentation(VisionCfg(shift=0, color=0.2), 2, 4, torch.device("cpu"))
    tinted.draw(generator)
    image = torch.cat(tinted(grey, rows))
    assert torch.equal(image, image[:, :1, :1].expand_as(image))  # alike in all of an image
    colors = image[:, 0, 0]
    assert ((colors - 100.0).abs() <= 0.2 * 100.0 + 0.2 * 127.5 + 1e-3).all()
    assert colors.std() > 3.0
    assert (colors.std(dim=1) > 0.5).all()


@pytest.mark.full
@pytest.mark.long
def test_a_training_goes_on_where_it_was_interrupted(trained: Path, tmp_path: Path) -> None:
    """In the first round, when it is over, and in the second one, from other images each."""
    command = [*TINY, f"job.folder={tmp_path}"]
    for number in (3, 6, 8):
        interrupted(command, CloneLearner, number)
    assert run(command) == 0
    assert same(tmp_path / "last", trained / "last")


@pytest.mark.full
def test_stack_learns_from_pixels_and_goes_on_bit_for_bit(tmp_path: Path) -> None:
    """Looks differ between episodes. Any rate will do."""
    sizes = [each for each in TINY if not each.startswith(("task", "controller"))]
    command = [*sizes, "looks=randomized", "job.length=0.2", *at_double_speed()]
    interrupted([*command, f"job.folder={tmp_path}/parts"], CloneLearner, 8)
    for name in ("parts", "whole"):
        assert run([*command, f"job.folder={tmp_path}/{name}"]) == 0
    assert same(tmp_path / "parts/last", tmp_path / "whole/last")


def success_rate(overrides: Sequence[str], folder: Path) -> float:
    """Of the policy that a training leaves, whatever rate its task asks for."""
    assert run([*overrides, f"job.folder={folder}"]) in (0, 1)
    return report(folder)["success"]["metrics"]["success_rate"]


@pytest.mark.long
def test_two_cores_train_reach_from_pixels(tmp_path: Path) -> None:
    """One camera of 48 x 48 pixels, from 64 unseen starts: some two minutes."""
    overrides = ["job=train", "experiment=pixels", "task=reach", "sim=mjwarp", "sim.device=cpu"]
    overrides += ["nworld=64", "cameras=front", "scene.cameras.front.size=[48,48]"]
    assert success_rate(overrides, tmp_path) >= 60 / 64


@pytest.mark.full
@on_cuda
def test_cuda_learns_and_plays_in_graphs(tmp_path: Path) -> None:
    command = [each.replace("sim.device=cpu", "sim.device=cuda:0") for each in TINY]
    assert success_rate([*command, "graph=require"], tmp_path) >= 0.0
