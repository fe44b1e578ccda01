"""The adapters: Gymnasium's checker and conventions, and what rsl_rl's runners rely on."""

import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from compositions import make_env
from doc_blocks import ROOT
from environments import Patch, few
from gymnasium.spaces import Box
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import ClipAction, DictInfoToList, RecordEpisodeStatistics

import mjstack
from mjstack.adapters.gymnasium import GymnasiumEnv, GymnasiumVectorEnv, register_env
from mjstack.adapters.rsl_rl import RslRlVecEnv
from mjstack.errors import ArgumentError, MjstackError, UnknownName

FRAMES = 5  # of an episode: short, so that several end in a test
SUCCESS = ("task.check.distance=10.0",)  # wherever the grasp point is
Make = Callable[..., mjstack.Env]


@pytest.fixture
def make() -> Iterator[Make]:
    made: list[mjstack.Env] = []

    def build(*overrides: str, nworld: int = 3, seed: int = 0) -> mjstack.Env:
        base = ["task=reach", "sim=native", f"task.episode_steps={FRAMES}"]
        made.append(make_env([*base, *overrides], nworld=nworld, seed=seed))
        return made[-1]

    yield build
    for env in made:
        env.close()


def zeros(env: Any) -> np.ndarray:
    return np.zeros(env.action_space.shape, dtype=np.float32)


# Gymnasium, many worlds


def test_vector_spaces(make: Make) -> None:
    inner = make()
    env = GymnasiumVectorEnv(inner)
    policy = inner.observation_manager.group_dims["policy"]
    actions = inner.action_manager.action_dim
    assert env.num_envs == 3
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert env.single_observation_space == Box(-np.inf, np.inf, (policy,), np.float32)
    assert env.single_action_space == Box(-1.0, 1.0, (actions,), np.float32)
    assert env.observation_space.shape == (3, policy)
    obs, infos = env.reset(seed=1)
    assert infos == {}
    assert obs in env.observation_space
    obs, reward, terminated, truncated, infos = env.step(env.action_space.sample())
    assert obs in env.observation_space
    assert (reward.shape, reward.dtype) == ((3,), np.float32)
    assert (terminated.shape, terminated.dtype, truncated.dtype) == ((3,), np.bool_, np.bool_)
    assert not infos["success"].any()
    assert infos["_success"].all()
    assert "final_obs" not in infos


@pytest.mark.full
def test_vector_env_in_absolute_joint_commands_has_the_joints_bounds(make: Make) -> None:
    inner = make("action=joint_absolute")
    space = GymnasiumVectorEnv(inner).single_action_space
    assert isinstance(space, Box)
    limits = inner.index.ctrl_range.astype(np.float32)
    assert space.high[4] == np.float32(inner.sim.model.joint("wrist_roll").range[1])
    np.testing.assert_array_equal(np.stack((space.low, space.high), 1), limits)


@pytest.mark.full
def test_vector_groups(make: Make) -> None:
    inner = make()
    env = GymnasiumVectorEnv(inner, group=None)
    obs, _ = env.reset(seed=0)
    assert isinstance(obs, dict)
    assert set(obs) == {"policy", "privileged"}
    assert obs in env.observation_space
    privileged, _ = GymnasiumVectorEnv(inner, group="privileged").reset(seed=0)
    np.testing.assert_array_equal(privileged, obs["privileged"])
    with pytest.raises(UnknownName, match=r"group 'polcy' does not exist\. Did you mean 'policy'"):
        GymnasiumVectorEnv(inner, group="polcy")


@pytest.mark.full
def test_vector_seeding(make: Make) -> None:
    env = GymnasiumVectorEnv(make())
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (2 * FRAMES, *env.action_space.shape)).astype(np.float32)

    def rollout(seed: int) -> np.ndarray:
        return np.stack([env.reset(seed=seed)[0], *(env.step(action)[0] for action in actions)])

    first = rollout(7)
    other = rollout(8)
    assert np.array_equal(first, rollout(7))
    assert not np.isclose(first[0], other[0]).all(1).any()
    assert env.np_random_seed == 7


def test_vector_autoreset_in_the_same_step(make: Make) -> None:
    """Against an identical environment without the adapter, over two episodes with unequal ends."""
    inner = make()
    env = GymnasiumVectorEnv(make())
    raw, _ = inner.reset(seed=3)
    obs, _ = env.reset(seed=3)
    np.testing.assert_array_equal(obs, raw["policy"].numpy())
    rng = np.random.default_rng(0)
    for step in range(1, 2 * FRAMES + 1):
        action = rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
        if step == 2:  # world 1 starts over, and from here on ends two steps after the others
            mask = np.array([False, True, False])
            raw, _ = inner.reset(mask=torch.from_numpy(mask))
            before, (obs, _) = obs, env.reset(options={"reset_mask": mask})
            np.testing.assert_array_equal(obs, raw["policy"].numpy())
            np.testing.assert_array_equal(obs[[0, 2]], before[[0, 2]])
            assert not np.isclose(obs[1], before[1]).all()
        raw, raw_reward, _, raw_truncated, extras = inner.step(torch.from_numpy(action))
        obs, reward, terminated, truncated, infos = env.step(action)
        np.testing.assert_array_equal(obs, raw["policy"].numpy())
        np.testing.assert_array_equal(reward, raw_reward.numpy())
        np.testing.assert_array_equal(truncated, raw_truncated.numpy())
        late = (step - 1) % FRAMES == 0
        on_time = step % FRAMES == 0
        np.testing.assert_array_equal(truncated, [on_time, late and step > 1, on_time])
        assert not terminated.any()
        assert ("final_obs" in infos) == truncated.any()
        if not truncated.any():
            continue
        assert list(infos["_final_obs"]) == list(infos["_final_info"]) == list(truncated)
        for world in range(3):
            if truncated[world]:
                np.testing.assert_array_equal(
                    infos["final_obs"][world], extras["final_obs"]["policy"][world].numpy()
                )
                assert not np.isclose(infos["final_obs"][world], obs[world]).all()
            else:
                assert infos["final_obs"][world] is None
        assert list(infos["final_info"]["_success"]) == list(truncated)


@pytest.mark.full
def test_vector_success_ends_an_episode(make: Make) -> None:
    env = GymnasiumVectorEnv(make(*SUCCESS, "task.success.params.steps=2"))
    env.reset(seed=0)
    assert not env.step(zeros(env))[2].any()
    _, _, terminated, truncated, infos = env.step(zeros(env))
    assert terminated.all()
    assert not truncated.any()
    assert infos["success"].all()
    assert infos["final_info"]["success"].all()


@pytest.mark.full
def test_vector_wrappers_of_gymnasium_work(make: Make) -> None:
    env = DictInfoToList(ClipAction(RecordEpisodeStatistics(GymnasiumVectorEnv(make()))))
    env.reset(seed=0)
    for _ in range(FRAMES):
        _, _, _, truncated, infos = env.step(zeros(env))
    assert truncated.all()
    assert [info["episode"]["l"] for info in infos] == [FRAMES] * 3
    env.close()
    env.close()


WRONG = [
    ({"action": np.zeros((3, 2))}, r"action: found shape \(3, 2\), expected an array of numbers"),
    ({"action": np.zeros(6)}, r"action: found shape \(6,\), expected"),
    ({"action": "up"}, r"action: found str, expected"),
    ({"action": np.full((3, 6), np.nan)}, r"found \[nan.* in world 0, expected finite numbers"),
    ({"seed": -1}, "seed: found -1"),
    ({"seed": [1, 2, 3]}, "seed: found"),
    ({"options": {"mask": None}}, "reset option 'mask' does not exist"),
    (
        {"options": {"reset_mask": np.ones(4, dtype=bool)}},
        r"found a torch.bool tensor of shape \(4,\) on cpu, expected a torch.bool",
    ),
    ({"options": {"reset_mask": np.ones(3)}}, r"found a torch.float64 tensor of shape"),
    ({"options": {"reset_mask": np.ones(3, dtype=bool)}, "seed": 1}, "no mask beside it"),
]


@pytest.mark.full
@pytest.mark.parametrize(("arguments", "message"), WRONG)
def test_vector_wrong_actions_and_resets(
    make: Make, arguments: dict[str, Any], message: str
) -> None:
    env = GymnasiumVectorEnv(make())
    with pytest.raises(ArgumentError, match="reset"):
        env.step(zeros(env))
    env.reset()
    with pytest.raises(MjstackError, match=message):
        env.step(arguments["action"]) if "action" in arguments else env.reset(**arguments)


WRONG_SEEDS = (True, np.True_, torch.tensor(True), 3.0, "3", [3], np.array([3, 4]), -1, 1 << 32)


@pytest.mark.parametrize("adapter", [GymnasiumVectorEnv, GymnasiumEnv])
def test_seeds_are_those_that_the_environment_takes(make: Make, adapter: Any) -> None:
    env = adapter(make(nworld=1))
    expected, _ = env.inner.reset(seed=3)
    for seed in (3, np.int64(3), np.array(3), torch.tensor(3)):
        obs, _ = env.reset(seed=seed)
        np.testing.assert_array_equal(obs, expected["policy"].numpy().reshape(obs.shape))
        assert env.np_random_seed == 3
    env.reset(seed=5)
    before = env.inner.sim.qpos.clone()
    for wrong in WRONG_SEEDS:
        for reset in (env.reset, env.inner.reset):
            with pytest.raises(ArgumentError, match=r"seed: found .*an integer from 0 to 42949672"):
                reset(seed=wrong)
    assert torch.equal(env.inner.sim.qpos, before)
    assert env.inner.seed == env.np_random_seed == 5


# Gymnasium, one world


@pytest.mark.parametrize("group", ["policy", None])
def test_single_env_passes_gymnasiums_checker(group: str | None) -> None:
    def build(**_: Any) -> GymnasiumEnv:
        return GymnasiumEnv(make_env(["task=reach", "sim=native"], nworld=1), group=group)

    # A registered environment is checked more thoroughly: for determinism, and by making it again.
    gymnasium.register("mjstack-test/Reach-v0", entry_point=build)
    try:
        env = gymnasium.make("mjstack-test/Reach-v0").unwrapped
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            as_it_should_be = r".*space (minimum|maximum) value is -?infinity"
            warnings.filterwarnings("ignore", message=as_it_should_be)
            check_env(env)
        env.close()
    finally:
        del gymnasium.registry["mjstack-test/Reach-v0"]


@pytest.mark.full
def test_single_env_is_the_one_world(make: Make) -> None:
    """The done step returns the final observation, and ``reset`` the start of the episode that
    follows.
    """
    inner = make(nworld=1)
    env = GymnasiumEnv(make(nworld=1))
    raw, _ = inner.reset(seed=5)
    first, _ = env.reset(seed=5)
    assert first in env.observation_space
    np.testing.assert_array_equal(first, raw["policy"][0].numpy())
    for episode in range(2):
        for step in range(1, FRAMES + 1):
            raw, raw_reward, _, _, extras = inner.step(torch.full((1, 6), 0.1))
            obs, reward, terminated, truncated, info = env.step(np.full(6, 0.1, dtype=np.float32))
            np.testing.assert_array_equal(obs, extras["final_obs"]["policy"][0].numpy())
            assert (reward, terminated, truncated) == (float(raw_reward), False, step == FRAMES)
            assert info == {"success": False}
        with pytest.raises(ArgumentError, match="after the end of an episode"):
            env.step(zeros(env))
        obs, _ = env.reset()
        np.testing.assert_array_equal(obs, raw["policy"][0].numpy())
        assert int(env.inner.episode) == episode + 1
    obs, _ = env.reset()  # in the middle of an episode: the next one
    assert int(env.inner.episode) == 3
    for _ in range(FRAMES):
        env.step(zeros(env))
    np.testing.assert_array_equal(env.reset(seed=5)[0], first)  # not the next episode


@pytest.mark.full
def test_single_env_wrong_use(make: Make) -> None:
    with pytest.raises(ArgumentError, match=r"3 worlds, expected one\. Build it with nworld=1"):
        GymnasiumEnv(make())
    env = GymnasiumEnv(make(nworld=1))
    with pytest.raises(UnknownName, match="reset option 'reset_mask' does not exist"):
        env.reset(options={"reset_mask": np.ones(1, dtype=bool)})
    env.reset()
    with pytest.raises(ArgumentError, match=r"shape \(1, 6\), expected .* of shape \(6,\)"):
        env.step(np.zeros((1, 6)))


# rsl_rl


def test_rsl_rl_shapes(make: Make) -> None:
    inner = make()
    env = RslRlVecEnv(inner)
    dims = inner.observation_manager.group_dims
    assert (env.num_envs, env.num_actions, env.max_episode_length) == (3, 6, FRAMES)
    assert env.cfg is inner.cfg
    obs = env.get_observations()
    assert obs.batch_size == torch.Size([3])
    assert {name: tuple(value.shape) for name, value in obs.items()} == {
        name: (3, dim) for name, dim in dims.items()
    }
    stepped, rewards, dones, extras = env.step(torch.zeros(3, 6))
    assert {value.dtype for value in stepped.values()} == {torch.float32}
    assert (rewards.shape, rewards.dtype) == ((3,), torch.float32)
    assert (dones.shape, dones.dtype) == ((3,), torch.int64)
    assert set(extras) == {"time_outs"}
    current = env.get_observations()
    for name, value in current.items():
        assert torch.equal(value, stepped[name])
        assert not torch.equal(value, obs[name])


def test_rsl_rl_tells_time_outs_from_other_ends(make: Make) -> None:
    env = RslRlVecEnv(make(*SUCCESS, "task.success.params.steps=3"))
    env.episode_length_buf = torch.tensor([0, FRAMES - 2, FRAMES - 3])
    ends = [env.step(torch.zeros(3, 6))[2:] for _ in range(3)]
    assert [dones.tolist() for dones, _ in ends] == [[0, 0, 0], [0, 1, 0], [1, 0, 1]]
    # In the third step world 2 is at its time limit too, but it is the success that ended it.
    time_outs = [extras["time_outs"].tolist() for _, extras in ends]
    assert time_outs == [[False] * 3, [False, True, False], [False] * 3]


@pytest.mark.full
def test_rsl_rl_episode_length_is_the_environments_own(make: Make) -> None:
    inner = make()
    env = RslRlVecEnv(inner)
    step = inner.episode_step
    spread = torch.randint_like(env.episode_length_buf, high=int(env.max_episode_length))
    env.episode_length_buf = spread
    env.episode_length_buf = torch.tensor([0, 2, FRAMES - 1])
    assert inner.episode_step is step
    assert inner.episode_step.tolist() == [0, 2, FRAMES - 1]
    _, _, dones, _ = env.step(torch.zeros(3, 6))
    assert dones.tolist() == [0, 0, 1]
    assert env.episode_length_buf.tolist() == [1, 3, 0]


@pytest.mark.full
def test_rsl_rl_log(make: Make) -> None:
    env = RslRlVecEnv(make(), log_interval=FRAMES + 1)
    logs = [env.step(torch.zeros(3, 6))[3].get("log") for _ in range(2 * FRAMES + 2)]
    assert [i for i, log in enumerate(logs) if log is not None] == [FRAMES, 2 * FRAMES + 1]
    log = logs[FRAMES]
    assert log is not None
    figures = [log[f"episode/{name}"] for name in ("episodes", "steps", "success")]
    assert figures == [3.0, FRAMES, 0.0]
    terms = sum(value for name, value in log.items() if name.startswith("episode/reward/"))
    assert log["episode/return"] == pytest.approx(terms, rel=1e-5)


@pytest.mark.full
def test_rsl_rl_actions_are_clamped_and_checked(make: Make) -> None:
    inner = make()
    env = RslRlVecEnv(inner)
    action = torch.tensor([[-3.0, -1.0, -0.5, 0.5, 1.0, 3.0]]).expand(3, -1)
    env.step(action)
    assert torch.equal(inner.action.float(), action.clamp(-1.0, 1.0))
    for wrong, found in (
        (torch.zeros(3, 1), r".* shape \(3, 1\)"),
        (np.zeros((3, 6)), "a ndarray"),
    ):
        with pytest.raises(ArgumentError, match=f"action: found {found}"):
            env.step(wrong)


@pytest.mark.full
def test_rsl_rl_steps_in_inference_mode_and_out_of_it(make: Make) -> None:
    """Runners collect in inference mode, and whoever evaluates afterwards may not."""
    env = RslRlVecEnv(make())
    with torch.inference_mode():
        for _ in range(FRAMES + 1):
            env.step(torch.zeros(3, 6))
    env.env.reset()
    for _ in range(FRAMES + 1):
        env.step(torch.zeros(3, 6))


# Imports


@pytest.mark.full
@pytest.mark.parametrize(
    ("adapter", "library"),
    [("gymnasium", "gymnasium"), ("rsl_rl", "rsl_rl"), ("rsl_rl", "tensordict")],
)
def test_missing_extra_is_one_line(adapter: str, library: str, monkeypatch: Patch) -> None:
    for name in [name for name in sys.modules if f"{name}.".startswith(f"{library}.")]:
        monkeypatch.setitem(sys.modules, name, None)  # as if it could not be found
    monkeypatch.delitem(sys.modules, f"mjstack.adapters.{adapter}")
    with pytest.raises(MjstackError) as caught:
        import_module(f"mjstack.adapters.{adapter}")
    out = str(caught.value)
    assert "\n" not in out
    assert library in out
    assert "pip install 'mjstack[train]'" in out


# Ids


def test_every_task_has_an_id_for_each_robot() -> None:
    names = [f"{task}-{arm}" for task in ("box", "reach", "stack") for arm in ("rebot", "so101")]
    ids = sorted(id for id in gymnasium.registry if id.startswith("mjstack/"))
    assert ids == [f"mjstack/{name}-v0" for name in names]


def test_an_id_names_the_module_that_registers_it() -> None:
    """mjstack alone loads no adapter, nor what takes long."""
    program = """
import sys
import mjstack
assert not {"gymnasium", "rsl_rl", "tensordict", "torch", "numpy"} & sys.modules.keys()
import gymnasium
env = gymnasium.make("mjstack.adapters.gymnasium:mjstack/reach-rebot-v0", overrides=["sim=native"])
assert env.spec.id == "mjstack/reach-rebot-v0"
assert env.unwrapped.inner.cfg.robot.name == "rebot"
obs, info = env.reset(seed=1)
assert obs in env.observation_space
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


SHORT = ["sim=native", f"task.episode_steps={FRAMES}"]
REACH_ID = "mjstack/reach-so101-v0"


def test_an_id_passes_gymnasiums_checker_and_renders() -> None:
    env = gymnasium.make(REACH_ID, overrides=SHORT, render_mode="rgb_array")
    assert env.metadata["render_fps"] == 50
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env.unwrapped)
    env.reset(seed=4)
    first = env.render()
    assert isinstance(first, np.ndarray)
    assert (first.shape, first.dtype) == ((128, 128, 3), np.uint8)
    ended = False
    images = [first]
    while not ended:
        *_, terminated, truncated, _ = env.step(np.ones_like(env.action_space.sample()))
        ended = terminated or truncated
        images.append(env.render())
    assert (images[1] != first).any()
    # The worlds stand at the next start already, which is not this episode's end.
    np.testing.assert_array_equal(images[-1], images[-2])
    env.reset()
    assert (env.render() != images[-1]).any()
    env.close()


def test_rendering_changes_no_episode() -> None:
    runs = []
    for mode in (None, "rgb_array"):
        env = gymnasium.make(REACH_ID, overrides=SHORT, render_mode=mode)
        obs, _ = env.reset(seed=2)
        action = np.full(env.action_space.shape, 0.5, np.float32)
        runs.append(np.stack([obs, *(env.step(action)[0] for _ in range(FRAMES - 1))]))
        env.close()
    np.testing.assert_array_equal(*runs)


def test_make_vec_has_worlds_of_one_environment() -> None:
    mode = "vector_entry_point"
    overrides = [*SHORT, "reset=randomized"]
    env = gymnasium.make_vec(
        REACH_ID, 3, vectorization_mode=mode, overrides=overrides, render_mode="rgb_array"
    )
    assert isinstance(env, GymnasiumVectorEnv)
    assert (env.num_envs, env.inner.nworld) == (3, 3)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert env.spec is not None
    assert env.spec.kwargs["overrides"] == overrides
    obs, _ = env.reset(seed=1)
    images = env.render()
    assert isinstance(images, tuple)
    assert len(images) == 3
    assert (images[0] != images[1]).any()
    alone = gymnasium.make(REACH_ID, overrides=overrides)
    np.testing.assert_array_equal(alone.reset(seed=1)[0], obs[0])
    alone.close()
    env.close()
    several = gymnasium.make_vec(REACH_ID, 2, vectorization_mode="sync", overrides=SHORT)
    assert several.reset(seed=1)[0].shape == (2, obs.shape[1])
    several.close()


@pytest.mark.parametrize(
    ("options", "expected"),
    few(
        [
            ({"render_mode": "ansi"}, "render_mode: found 'ansi', expected None or rgb_array"),
            ({"overrides": ["robot=ur5"]}, "'ur5' does not exist"),
            ({"group": "critic"}, "observation group 'critic' does not exist"),
        ],
        2,
    ),
)
def test_make_refuses_in_one_line(options: dict[str, Any], expected: str) -> None:
    overrides = options.pop("overrides", [])
    warnings.simplefilter("ignore")  # pytest restores it
    with pytest.raises(MjstackError, match=expected):
        gymnasium.make(REACH_ID, overrides=[*SHORT, *overrides], **options)


def test_a_task_of_ones_own_has_an_id(monkeypatch: Patch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.registry))
    register_env("mine/push-v0", ["task=push"], config_dir="examples/push/conf")
    monkeypatch.chdir("/")
    env: Any = gymnasium.make("mine/push-v0", overrides=["sim=native"])
    assert env.unwrapped.inner.cfg.task.name == "push"
    env.close()
