"""The LeRobot adapter. LeRobot needs Python 3.12 and versions of its own: `make test-lerobot` makes
an environment with it and runs these; elsewhere they are skipped.
"""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from environments import configure
from policies import make_policy

pytest.importorskip("lerobot", reason="LeRobot is not installed")

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs import preprocess_observation
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.robots import make_robot_from_config

from mjstack.adapters.lerobot import LerobotVectorEnv, MjstackEnv, MjstackFollower
from mjstack.adapters.lerobot.robot import MjstackCameraConfig, MjstackFollowerConfig
from mjstack.cli import run
from mjstack.drivers.closed_loop import make_expert
from mjstack.drivers.policy import PolicyDriver
from mjstack.episodes.stage import Stage
from mjstack.errors import ArgumentError, ConfigError, FolderError
from mjstack.jobs.export import export_policy
from mjstack.policy import Vision, load_policy, save_policy
from mjstack.policy.lerobot import load_lerobot

NATIVE = ["sim=native", "reset=jitter"]


def make_worlds(
    count: int, *overrides: str, **options: object
) -> tuple[LerobotVectorEnv, MjstackEnv]:
    cfg = MjstackEnv(overrides=[*NATIVE, *overrides], **options)  # type: ignore[arg-type]
    return cfg.create_envs(count)["mjstack"][0], cfg  # type: ignore[return-value]


@pytest.fixture(scope="module")
def four() -> Iterator[LerobotVectorEnv]:
    worlds, _ = make_worlds(4)
    yield worlds
    worlds.close()


def test_a_number_is_a_start_wherever_it_stands(four: LerobotVectorEnv) -> None:
    four.reset(seed=[1000, 7, 1000, 1003])
    first = four.inner.sim.qpos.clone()
    assert torch.equal(first[0], first[2])
    assert len(np.unique(first.numpy(), axis=0)) == 3
    four.reset(seed=range(1000, 1004))
    assert torch.equal(four.inner.sim.qpos[[0, 3]], first[[0, 3]])
    four.reset()
    assert len(np.unique(torch.cat((first, four.inner.sim.qpos)).numpy(), axis=0)) == 7
    for seed in (1000, np.int64(1000), np.arange(1000, 1004)):  # of the first world, or of each
        four.reset(seed=seed)
        assert torch.equal(four.inner.sim.qpos[[0, 3]], first[[0, 3]])
    for seed in (-1, True, [0, 1, 2, -3]):
        with pytest.raises(ArgumentError, match=r"seed: found .*an integer from 0"):
            four.reset(seed=seed)
    with pytest.raises(ArgumentError, match=r"seed: found 1 numbers, expected one for each of 4"):
        four.reset(seed=[1])


def test_success_counts_in_the_last_step_alone_and_then_worlds_stand(
    four: LerobotVectorEnv,
) -> None:
    """Three experts and an arm that stays where it is, by the task's own check."""
    seen, _ = four.reset(seed=range(4))
    start = seen["agent_pos"][3].copy()
    expert = make_expert(four.inner)
    steps = four.call("_max_episode_steps")[0]
    assert steps == 360
    ended = []
    for _ in range(steps):
        targets = four.words.units.from_si(expert.command().numpy())
        targets[3] = start
        seen, reward, terminated, truncated, infos = four.step(targets)
        ended.append((truncated.any(), infos["is_success"].any(), reward.any()))
        assert not terminated.any()
    assert not any(map(any, ended[:-1]))
    assert truncated.all()
    assert infos["is_success"].tolist() == [True, True, True, False]
    assert reward.tolist() == [1.0, 1.0, 1.0, 0.0]
    state = four.inner.sim.qpos.clone()
    again, reward, _, truncated, infos = four.step(targets)
    assert torch.equal(four.inner.sim.qpos, state)
    assert np.array_equal(again["agent_pos"], seen["agent_pos"])
    assert truncated.all()
    assert not reward.any()
    assert not infos["is_success"].any()


def test_observations_are_named_typed_and_scaled_as_lerobot_has_them() -> None:
    worlds, cfg = make_worlds(2, cameras=["front"], observation_height=32, observation_width=48)
    seen, _ = worlds.reset(seed=[0, 1])
    assert [seen[name].dtype for name in ("agent_pos", "environment_state")] == [np.float32] * 2
    assert seen["pixels"]["front"].shape == (2, 32, 48, 3)
    assert cfg.features_map.keys() == cfg.features.keys()
    assert cfg.features["observation.images.front"].shape == (32, 48, 3)
    assert cfg.features["environment_state"].shape == seen["environment_state"].shape[1:]
    home = np.array(worlds.inner.cfg.robot.home)
    np.testing.assert_allclose(worlds.words.units.to_si(seen["agent_pos"][0]), home, atol=1e-6)
    assert worlds.call("task_description") == ("Put the red cube onto the blue cube.",) * 2
    pictures = worlds.call("render")[:1]
    assert np.array_equal(pictures[0], seen["pixels"]["front"][0])
    with pytest.raises(AttributeError):
        worlds.call("reset_everything")
    worlds.close()


def test_pictures_are_drawn_of_the_worlds_that_are_asked_for(four: LerobotVectorEnv) -> None:
    four.reset(seed=range(4))
    pictures = four.call("render")
    assert four._renderer is None
    some = pictures[1:3]
    assert [picture.shape for picture in some] == [(240, 240, 3)] * 2
    assert not np.array_equal(*some)
    assert np.array_equal(pictures[:10][2], some[1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fps": 25}, r"env\.fps=25: expected one of 30, 50"),
        ({"units": "degrees"}, r"env\.units=degrees: expected one of lerobot, si"),
        ({"robot": "rebot"}, r"robot=rebot: expected a robot that LeRobot has a follower of"),
    ],
)
def test_what_cannot_be_used_is_one_line(options: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_worlds(1, **options)


def test_radians_and_other_widths_are_refused(four: LerobotVectorEnv) -> None:
    seen, _ = four.reset(seed=range(4))
    with pytest.raises(ArgumentError, match=r"rad, expected degrees, near .* where the arm stands"):
        four.step(four.words.units.to_si(seen["agent_pos"]))
    with pytest.raises(
        ArgumentError, match=r"action: found shape \(4, 7\), expected shape \(4, 6\)"
    ):
        four.step(np.zeros((4, 7), np.float32))


@pytest.mark.parametrize("sees", ["state", "pixels"])
def test_an_exported_policy_gives_the_drivers_actions(tmp_path: Path, sees: str) -> None:
    """From an environment state; and from measured joints and images, as a real arm has them."""
    images = {"front": (32, 48)} if sees == "pixels" else {}
    size = "scene.cameras.front.size=[32,48]"
    cfg = configure("timing=hz30", *NATIVE, f"observation={sees}", "cameras=front", size)
    cfg.observation["policy"] = replace(cfg.observation["policy"], noise=False)
    vision = Vision(sizes=images, channels=[4], features=8) if images else None
    save_policy(tmp_path / "policy", make_policy(cfg, execute=4, vision=vision))
    policy = load_policy(tmp_path / "policy")
    export = replace(configure("job=export", "job.format=lerobot"), policy=str(tmp_path / "policy"))
    export_policy(Stage(export), tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path)
    assert ("observation.state" in config.input_features) == bool(images)
    exported = get_policy_class(config.type).from_pretrained(tmp_path, config=config)

    worlds, _ = make_worlds(
        3, f"observation={sees}", cameras=["front"], observation_height=32, observation_width=48
    )
    seen, _ = worlds.reset(seed=[5, 6, 7])
    driver = PolicyDriver(worlds.inner, policy, worlds.inner.cfg.scene.cameras)
    exported.reset()
    for _ in range(10):
        image = torch.from_numpy(seen["pixels"]["front"]).permute(0, 3, 1, 2).float() / 255
        batch = {
            "observation.state": torch.from_numpy(seen["agent_pos"]),
            "observation.environment_state": torch.from_numpy(seen["environment_state"]),
            "observation.images.front": image,
        }
        expected = driver.command().numpy().copy()
        actions = exported.select_action(batch).numpy()
        given = worlds.words.units.to_si(actions)
        np.testing.assert_allclose(given, expected, rtol=0, atol=1e-6 if not images else 2e-6)
        seen, *_ = worlds.step(actions)
    worlds.close()
    with pytest.raises(ArgumentError, match=r"observation\..*: found 5 numbers, expected"):
        exported.predict_action_chunk({name: value[:, :5] for name, value in batch.items()})


@pytest.fixture(scope="module")
def act(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a small ACT with random weights, which sees joints, the state and an image."""
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    shapes = {
        "observation.state": (FeatureType.STATE, (6,)),
        "observation.environment_state": (FeatureType.ENV, (28,)),
        "observation.images.front": (FeatureType.VISUAL, (3, 64, 64)),
    }
    small = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1}
    config = ACTConfig(
        input_features={key: PolicyFeature(*shape) for key, shape in shapes.items()},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (6,))},
        pretrained_backbone_weights=None,
        device="cpu",
        push_to_hub=False,
        chunk_size=5,
        n_action_steps=5,
        n_vae_encoder_layers=1,
        **small,
    )
    folder = tmp_path_factory.mktemp("act")
    degrees = torch.tensor([0.0, -22.9, 27.1, 67.4, 88.0, 45.6])  # the SO-101's start
    unit = {"mean": torch.zeros(6), "std": torch.ones(6)}
    statistics = {"observation.state": unit, "action": {"mean": degrees, "std": torch.ones(6)}}
    torch.manual_seed(0)
    ACTPolicy(config).save_pretrained(folder)
    for processor in make_pre_post_processors(config, dataset_stats=statistics):
        processor.save_pretrained(folder)
    return folder


SCENE = ("timing=hz30", "observation=state", "cameras=front", "scene.cameras.front.size=[64,64]")


def drive(folder: Path, *overrides: str) -> Stage:
    args = ["sim=native", "controller=lerobot", f"policy={folder}", *overrides]
    return Stage(configure(*args))


def test_our_rollout_drives_as_lerobots_does(act: Path) -> None:
    """Its joint targets are the same numbers in both."""
    config = PreTrainedConfig.from_pretrained(act)
    policy = get_policy_class("act").from_pretrained(act, config=config)
    before, after = make_pre_post_processors(config, str(act))
    worlds, _ = make_worlds(2, cameras=["front"], observation_height=64, observation_width=64)
    seen, _ = worlds.reset(seed=[0, 1])
    stage = drive(act, *SCENE, "reset=jitter", "nworld=2")
    env = stage.start(stage.batch_simulation(2), stage.cfg.reset, worlds=[0, 1])
    driver = stage.driver(env)
    assert env.cfg.graph == "off"
    for _ in range(12):
        targets = driver.command()
        batch = preprocess_observation(seen) | {
            "task": ["Put the red cube onto the blue cube."] * 2
        }
        actions = after(policy.select_action(before(batch))).detach().numpy()
        expected = worlds.words.units.to_si(actions)
        np.testing.assert_allclose(targets.numpy(), expected, rtol=0, atol=1e-6)
        assert targets.std(0).max() > 0.0
        env.step(targets)
        seen, *_ = worlds.step(actions)
    worlds.close()
    env.close()


def test_gate_success_judges_act_with_its_interval_and_failing_rules(
    act: Path, tmp_path: Path
) -> None:
    args = ["gates=[success]", "sim=native", "nworld=3", *SCENE, "controller=lerobot"]
    short = ["task.episode_steps=60"]
    assert run([*args, *short, f"policy={act}", f"hydra.run.dir={tmp_path / 'run'}"]) == 1
    (gate,) = json.loads((tmp_path / "run" / "report.json").read_text())["gates"]
    assert gate["reason"].startswith("0 of 3 episodes succeeded (0 %, 95 % interval 0 to 56.15 %)")
    assert gate["metrics"]["distinct_starts"] == 3
    assert gate["metrics"]["reached_and_lost"] == 0
    assert any("STACKED" in line or "not stacked" in line for line in gate["details"])
    assert (tmp_path / "run" / "episode.html").is_file()
    replay = ["job=replay", f"run={tmp_path / 'run'}", "world=0", f"hydra.run.dir={tmp_path / 'b'}"]
    assert run(replay) == 2  # a run's folder may be a stranger's


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["cameras=front", "scene.cameras.front.size=[32,32]"], r"images\.front of shape"),
        (["cameras=wrist"], r"images\.front of shape \(3, 64, 64\), .* missing"),
        ([*SCENE, "observation=real"], r"_state of shape \(28,\), and here it is \(22,\)"),
    ],
)
def test_a_scene_without_what_it_sees_is_one_line(
    act: Path, overrides: list[str], message: str
) -> None:
    stage = drive(act, "nworld=1", "observation=state", *overrides)
    env = stage.start(stage.batch_simulation(1), stage.cfg.reset)
    with pytest.raises(FolderError, match=message):
        stage.driver(env)
    env.close()


def test_a_folder_that_cannot_be_loaded_is_one_line(act: Path, tmp_path: Path) -> None:
    for _ in range(2):  # without a file, and without its weights
        with pytest.raises(FolderError, match="LeRobot cannot load it"):
            load_lerobot(str(tmp_path), "cpu")
        shutil.copy(act / "config.json", tmp_path)


def test_a_follower_has_the_real_ones_words(tmp_path: Path) -> None:
    """Names, features and robot type are those of LeRobot's; calibration gives the same units."""
    from lerobot.robots.so_follower import SOFollower, SOFollowerRobotConfig

    cameras = {"front": MjstackCameraConfig(width=64, height=48, fps=30)}
    config = MjstackFollowerConfig(id="one", calibration_dir=tmp_path, seed=3, cameras=cameras)
    follower = make_robot_from_config(config)
    assert isinstance(follower, MjstackFollower)
    real = SOFollower.__dict__
    assert follower.name == real["name"]
    joints = [f"{name}.pos" for name in ("shoulder_pan", "shoulder_lift", "elbow_flex")]
    joints += ["wrist_flex.pos", "wrist_roll.pos", "gripper.pos"]
    assert list(follower.action_features) == joints
    assert follower.observation_features["front"] == (48, 64, 3)
    assert SOFollowerRobotConfig(port="").use_degrees
    follower.connect()
    seen = follower.get_observation()
    assert seen.keys() == follower.observation_features.keys()
    assert seen["front"].shape == (48, 64, 3)
    # A bus with this calibration gives these numbers, to a tick of its encoders
    index = follower._world.inner.index
    angles = follower._world.inner.sim.qpos[0, index.robot_qpos].numpy()
    middles = index.servo_range.mean(1)
    turns = (angles - middles) / (2 * np.pi)
    values = [seen[name] for name in joints]
    for part, turn, value in zip(follower.calibration.values(), turns, values, strict=True):
        span = part.range_max - part.range_min
        bus = 360 * turn if part.id < 6 else 50 + 100 * turn * 4095 / span
        assert bus == pytest.approx(value, abs=0.1)
    with pytest.raises(ArgumentError, match=r"action: found shape \(1, 5\), expected"):
        follower.send_action(dict.fromkeys(joints[:5], 0.0))
    targets = {name: seen[name] for name in joints}
    targets["shoulder_pan.pos"] += 5.0
    assert follower.send_action(targets) == pytest.approx(targets)
    for _ in range(400):  # longer than the task's episode
        follower.send_action(targets)
    assert follower.get_observation()["shoulder_pan.pos"] > seen["shoulder_pan.pos"] + 3
    follower.disconnect()
    assert not follower.is_connected
    assert not list(tmp_path.iterdir())
