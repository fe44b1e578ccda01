"""The LeRobot adapter. LeRobot needs Python 3.12 and versions of its own: `make test-lerobot` makes
an environment with it and runs these; elsewhere they are skipped.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from environments import configure
from policies import make_policy

pytest.importorskip("lerobot", reason="LeRobot is not installed")

from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class

from mjstack.adapters.lerobot import LerobotVectorEnv, MjstackEnv
from mjstack.drivers.closed_loop import make_expert
from mjstack.drivers.policy import PolicyDriver
from mjstack.episodes.stage import Stage
from mjstack.errors import ArgumentError, ConfigError
from mjstack.jobs.export import export_policy
from mjstack.policy import Vision, load_policy, save_policy

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
    four.reset(seed=1000)
    assert torch.equal(four.inner.sim.qpos[[0, 3]], first[[0, 3]])
    four.reset()
    assert len(np.unique(torch.cat((first, four.inner.sim.qpos)).numpy(), axis=0)) == 7
    with pytest.raises(ArgumentError, match="seed: found 3 numbers, expected a number for each of"):
        four.reset(seed=[1, 2, 3])


def test_success_counts_in_the_last_step_alone_and_then_worlds_stand(
    four: LerobotVectorEnv,
) -> None:
    """Three experts and an arm that stays where it is, by the task's own check."""
    seen, _ = four.reset(seed=0)
    start = seen["agent_pos"][3].copy()
    expert = make_expert(four.inner)
    steps = four.call("_max_episode_steps")[0]
    assert steps == 360
    ended = []
    for _ in range(steps):
        targets = four._units.from_si(expert.command().numpy())
        targets[3] = start
        seen, reward, terminated, truncated, infos = four.step(targets)
        ended.append(
            (truncated.any(), infos["is_success"].any(), reward.any(), "final_info" in infos)
        )
        assert not terminated.any()
    assert not any(map(any, ended[:-1]))
    assert truncated.all()
    assert infos["final_info"]["is_success"].tolist() == [True, True, True, False]
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
    seen, _ = worlds.reset(seed=0)
    assert worlds.observation_space.contains(seen)
    assert seen["pixels"]["front"].shape == (2, 32, 48, 3)
    assert cfg.features_map.keys() == cfg.features.keys()
    assert cfg.features["observation.images.front"].shape == (32, 48, 3)
    home = np.array(worlds.inner.cfg.robot.home)
    np.testing.assert_allclose(worlds._units.to_si(seen["agent_pos"][0]), home, atol=1e-6)
    assert worlds.call("task_description") == ("Put the red cube onto the blue cube.",) * 2
    pictures = worlds.call("render")[:1]
    assert np.array_equal(pictures[0], seen["pixels"]["front"][0])
    with pytest.raises(AttributeError):
        worlds.call("reset_everything")
    worlds.close()


def test_pictures_are_drawn_of_the_worlds_that_are_asked_for(four: LerobotVectorEnv) -> None:
    four.reset(seed=0)
    pictures = four.call("render")
    assert len(pictures) == 4
    assert four._renderer is None
    some = pictures[1:3]
    assert [picture.shape for picture in some] == [(240, 240, 3)] * 2
    assert not np.array_equal(*some)
    assert np.array_equal(pictures[2], some[1])


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
    seen, _ = four.reset(seed=0)
    with pytest.raises(ArgumentError, match=r"rad, expected degrees, near .* where the arm stands"):
        four.step(four._units.to_si(seen["agent_pos"]))
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
    exported = get_policy_class(config.type).from_pretrained(tmp_path, config=config, strict=True)

    worlds, _ = make_worlds(
        3, f"observation={sees}", cameras=["front"], observation_height=32, observation_width=48
    )
    seen, _ = worlds.reset(seed=5)
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
        given = worlds._units.to_si(actions)
        np.testing.assert_allclose(given, expected, rtol=0, atol=1e-6 if not images else 2e-6)
        seen, *_ = worlds.step(actions)
    worlds.close()
    with pytest.raises(ArgumentError, match=r"observation\..*: found 5 numbers, expected"):
        exported.predict_action_chunk({name: value[:, :5] for name, value in batch.items()})
