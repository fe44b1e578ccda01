"""Ends of episodes: by terms, by numbers that are not finite, by overflow, and their statistics."""

import math
import re
from collections.abc import Callable

import pytest
import torch
from compositions import make_env
from env_cases import fails, native, randomized
from environments import actions, configure, mask_of, on_shared_sim, zeros

from mjstack.config.schema import Backend, Config
from mjstack.envs import Env, build_env
from mjstack.errors import FaultError
from mjstack.sim import Overflow


@pytest.fixture
def ended(backend: str, robot: str) -> Env:
    """Three worlds that have just started."""
    env = on_shared_sim(backend, 3, configure("task=stack", robot=robot))
    env.reset(seed=0)
    return env


def assert_ends(env: Env, term: str, worlds: list[int]) -> None:
    """One step ends exactly these worlds, by exactly this term, and all of them go on."""
    before = env.episode.clone()
    obs, reward, terminated, truncated, extras = env.step(zeros(env))
    expected = mask_of(env, *worlds)
    columns = env.termination_manager.values.unbind(1)
    for name, column in zip(env.termination_manager.names, columns, strict=True):
        assert torch.equal(column, expected & (name == term)), name
    assert torch.equal(terminated, expected)
    assert not truncated.any()
    assert torch.equal(env.episode - before, expected.long())
    assert not env.episode_step[expected].any()
    assert torch.isfinite(reward).all()
    assert term != "non_finite" or not reward[expected].any()
    for group in (*obs.values(), *extras["final_obs"].values()):
        assert torch.isfinite(group).all()
    assert not env.step(zeros(env))[2].any()


def _below_the_table(env: Env, world: int) -> None:
    scene = env.cfg.scene
    under = scene.table_center[2] - scene.table_half[2] - 0.03
    env.sim.qpos[world, env.index.object_qpos[0] + 2] = under


def _not_a_number(env: Env, world: int) -> None:
    env.sim.qvel[world, env.index.object_qvel[0]] = math.nan


def _overflow(env: Env, world: int) -> None:
    env.sim.overflow[world] |= int(Overflow.NEFC)


@pytest.mark.parametrize(
    ("term", "world", "spoil"),
    [
        ("object_off_table", 0, _below_the_table),
        ("non_finite", 1, _not_a_number),
        ("overflow", 0, _overflow),
    ],
)
def test_end_by_what_happened(
    ended: Env, term: str, world: int, spoil: Callable[[Env, int], None]
) -> None:
    spoil(ended, world)
    assert_ends(ended, term, [world])


def test_statistics_are_those_of_the_episodes_that_ended(backend: str) -> None:
    cfg = randomized("reach", "so101", steps=4)
    env = on_shared_sim(backend, 3, cfg)
    env.read_statistics()
    env.reset(seed=0)
    moves = actions(env, 9)
    totals = torch.zeros(3)
    returns = []
    lengths = []
    for t, move in enumerate(moves):
        if t == 5:
            env.sim.qpos[0, env.index.object_qpos[0] + 1] += 1.0
        _, reward, terminated, truncated, _ = env.step(move)
        totals += reward.cpu()
        for k in (terminated | truncated).nonzero()[:, 0].tolist():
            returns.append(float(totals[k]))
            totals[k] = 0.0
            lengths.append({3: 4, 5: 2, 7: 4}[t])
    assert sorted(lengths) == [2, 4, 4, 4, 4, 4]
    read = env.read_statistics()
    assert read["episodes"] == 6
    assert read["steps"] == pytest.approx(22 / 6)
    assert read["return"] == pytest.approx(sum(returns) / 6, rel=1e-5)
    parts = [value for name, value in read.items() if name.startswith("reward/")]
    assert len(parts) == len(cfg.reward)
    assert sum(parts) == pytest.approx(read["return"], rel=1e-5)
    assert read["termination/time_out"] == pytest.approx(5 / 6)
    assert read["termination/object_off_table"] == pytest.approx(1 / 6)
    assert read["success"] == 0.0
    assert env.read_statistics() == {"episodes": 0.0}


def build(cfg: Config) -> Env:
    return on_shared_sim("native", 3, cfg)


def test_state_that_becomes_nan_is_named_without_its_termination(cfg: Config) -> None:
    cfg.termination.pop("non_finite")
    env = build(cfg)
    env.reset()
    env.sim.qvel[1, 0] = float("nan")
    words = ["state is not finite", "1 of 3 worlds (1)", "non_finite"]
    fails(FaultError, lambda: env.step(zeros(env)), *words)


def warp_env(cfg: Config, **batch: int) -> Env:
    """Two worlds that have started."""
    for name, value in batch.items():
        setattr(cfg.batch, name, value)
    env = build_env(cfg, nworld=2, backend=Backend.mjwarp, device="cpu")
    env.reset()
    return env


@pytest.mark.full
def test_constraint_rows_too_few(cfg: Config) -> None:
    """Each step of a resting start needs some 100 rows; the environment says so at the first step,
    or ends the episodes if it has the termination.
    """
    env = warp_env(cfg, njmax=40)
    _, _, terminated, _, _ = env.step(zeros(env))
    assert terminated.all()
    column = env.termination_manager.names.index("overflow")
    assert env.termination_manager.values[:, column].all()
    cfg.termination.pop("overflow")
    env = warp_env(cfg, njmax=40)
    words = ["NEFC overflow in 2 of 2 worlds (0, 1)", "Raise batch.njmax", "njmax=40"]
    message = fails(FaultError, lambda: env.step(zeros(env)), *words)
    rows = re.search(r"up to (\d+) rows", message)
    assert rows is not None
    assert int(rows[1]) > 40


@pytest.mark.full
def test_an_overflow_names_the_size_that_is_in_force() -> None:
    sizes = ["sim=mjwarp", "sim.device=cpu", "batch.nconmax=40", "reset=randomized"]
    env = make_env(sizes, nworld=2)
    env.reset(seed=0)
    env.sim.overflow.fill_(8)  # NARROWPHASE; latched as if a step had raised it
    env.faults._overflow |= 8
    env.sim.peak_pool.fill_(77)
    words = r"Raise batch\.nconmax \(nconmax=40; all worlds together needed 77"
    with pytest.raises(FaultError, match=words):
        env.faults.raise_first()


@pytest.mark.full
def test_episode_length_is_the_time_out_terms() -> None:
    assert native("termination.time_out.params.steps=50").max_episode_steps == 50
    assert native("~termination.time_out").max_episode_steps == 600
