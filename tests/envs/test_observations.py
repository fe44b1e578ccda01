"""Observations: written anew, at the end of an episode and after it, with history and noise."""

import math

import numpy as np
import pytest
import torch
from env_cases import fails, randomized, scenes, split, without_ends
from environments import (
    actions,
    assert_rows,
    assert_same_run,
    assert_traces,
    configure,
    mask_of,
    on_new_sim,
    on_shared_sim,
    play,
    returned,
)

import mjstack
from mjstack.config.schema import Config, ObservationGroupCfg, ObservationTermCfg
from mjstack.envs import Env, build_env
from mjstack.errors import MjstackError, TermError


@pytest.mark.full
@scenes
def test_outputs_filled_with_nan_change_nothing(backend: str, task: str, robot: str) -> None:
    cfg = randomized(task, robot, steps=4)
    env = on_shared_sim(backend, 3, cfg)
    sim = env.sim
    moves = actions(env, 10)
    model = sim.model
    # Geoms of the world are placed once, when the data is made.
    moving = np.flatnonzero(model.body_weldid[model.geom_bodyid] != 0)

    def poison(_: int = 0) -> None:
        sim.geom_xpos[:, torch.from_numpy(moving).to(env.device)] = math.nan
        rewards = env.reward_manager
        ends = env.termination_manager
        for view in (
            *(sim.xpos[:, 1:], sim.xquat[:, 1:], sim.site_xpos, sim.sensordata, sim.qfrc_actuator),
            *(*env.observation_manager.groups.values(), rewards.reward, rewards.values),
            env.action_manager.previous_action,
        ):
            view.fill_(math.nan)
        for flags in (ends.terminated, ends.truncated, ends.values, env.success):
            flags.fill_(True)
        sim.contact_count.fill_(-1)
        sim.constraint_count.fill_(-1)

    clean_start = returned(env.reset(seed=2))
    clean = play(env, moves)
    poison()
    env.action_manager.action.fill_(math.nan)
    start = returned(env.reset(seed=2))
    dirty = play(env, moves, before=poison)
    assert_rows(start, clean_start, slice(None), slice(None), backend, "reset")
    assert_traces(dirty, clean, slice(None), slice(None), backend)
    for row in (start, *dirty):
        for name, value in row.items():
            assert torch.isfinite(value).all(), name
    assert sum(int(row["truncated"].sum()) for row in clean) == 6


@scenes
def test_terminal_observation_and_the_one_to_go_on_with(
    backend: str, task: str, robot: str
) -> None:
    env = on_shared_sim(backend, 3, without_ends(randomized(task, robot)))
    moves = actions(env, 9)
    env.reset(seed=4)
    endless = play(env, moves[:5])
    env.reset(seed=4)
    next_start = returned(env.reset())

    env = on_shared_sim(backend, 3, randomized(task, robot, steps=5))
    env.reset(seed=4)
    trace = play(env, moves[:2])
    env.reset(mask=mask_of(env, 1))  # so that world 1 is not done with the others
    trace += play(env, moves[2:])
    assert [row["truncated"].tolist() for row in trace[4:7]] == [
        [True, False, True],
        [False] * 3,
        [False, True, False],
    ]
    done = trace[4]
    for group in env.observation_manager.groups:
        obs = done[f"obs.{group}"]
        final = done[f"final.{group}"]
        assert_same_run(final[[0, 2]], endless[4][f"obs.{group}"][[0, 2]], backend)
        assert_same_run(obs[[0, 2]], next_start[f"obs.{group}"][[0, 2]], backend)
        assert torch.equal(final[1], obs[1])
        assert not torch.equal(final[0], obs[0])
        for row in trace[5:6]:
            assert torch.equal(row[f"obs.{group}"], row[f"final.{group}"])


@pytest.mark.full
def test_returned_tensors_are_the_callers(backend: str) -> None:
    env = on_shared_sim(backend, 3, randomized("stack", "so101", steps=3))
    moves = actions(env, 7)
    # The last one with resets
    kept = [returned(env.reset(seed=0)), *(returned(env.step(move)) for move in moves[:3])]
    copies = [{name: value.clone() for name, value in row.items()} for row in kept]
    play(env, moves[3:])
    env.reset(mask=mask_of(env, 0))
    env.reset(seed=9)
    for row, copied in zip(kept, copies, strict=True):
        for name, value in row.items():
            assert torch.equal(value, copied[name]), name
            value.zero_()  # nor does it matter to the environment what they do with them
    env.reset(seed=0)
    assert_rows(returned(env.step(moves[0])), copies[1], slice(None), slice(None), backend)


def test_history_starts_full_and_slides(backend: str) -> None:
    cfg = randomized("reach", "so101", steps=4)
    terms = cfg.observation["policy"].terms
    terms["joint_pos"].history = 3
    env = on_shared_sim(backend, 3, cfg)

    def read(obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        parts = split(env, "policy", obs)
        return parts["joint_pos"].reshape(3, 3, -1), parts["grasp_point_to_goal"].reshape(3, 2, -1)

    trace = [returned(env.reset(seed=0)), *(returned(env.step(move)) for move in actions(env, 6))]
    steps = [read(row["obs.policy"]) for row in trace]
    for t in (0, 4):  # the first step, also of the second episode
        for part in steps[t]:
            assert (part == part[:, :1]).all()
    for t in (1, 2, 3, 5, 6):
        for new, old in zip(steps[t], steps[t - 1], strict=True):
            assert torch.equal(new[:, :-1], old[:, 1:])
            assert not torch.equal(new[:, -1], old[:, -1])
    # The terminal observation slides too: it is the old episode's.
    for final, old in zip(read(trace[4]["final.policy"]), steps[3], strict=True):
        assert torch.equal(final[:, :-1], old[:, 1:])
    # A masked reset fills the history of its worlds alone.
    old = steps[-1]
    new = read(env.reset(mask=mask_of(env, 1))[0]["policy"])
    for a, b in zip(new, old, strict=True):
        assert (a[1] == a[1, :1]).all()
        assert not (b[1] == b[1, :1]).all()
        assert torch.equal(a[[0, 2]], b[[0, 2]])


def test_a_slide_has_less_noise_than_a_hinge() -> None:
    """A tenth as many metres as the others have radians."""
    env = on_new_sim("native", 64, configure("task=reach", "reset=nominal", robot="rebot"))
    obs, _ = env.reset(seed=0)
    seen, clean = (split(env, name, obs[name])["joint_pos"] for name in ("policy", "privileged"))
    width = env.cfg.observation["policy"].terms["joint_pos"].noise
    largest = (seen - clean).abs().amax(0)
    assert (largest[:6] > 0.8 * width).all()
    assert ((largest[6:] > 0.08 * width) & (largest[6:] < 0.1001 * width)).all()


def test_noise_is_keyed_and_within_its_width() -> None:
    base = randomized("reach", "so101", steps=5)
    env = on_shared_sim("native", 3, base)
    moves = actions(env, 8)

    def noises(env: Env, seed: int, worlds: list[int] | None = None) -> torch.Tensor:
        if worlds is not None:
            env.world.copy_(torch.tensor(worlds))
        env.reset(seed=seed)
        out = []
        for move in moves:
            obs = env.step(move)[0]
            pos = split(env, "policy", obs["policy"])["joint_pos"]
            clean = split(env, "privileged", obs["privileged"])
            out.append(pos - clean["joint_pos"])
        return torch.stack(out)

    noise = noises(env, 0)
    width = base.observation["policy"].terms["joint_pos"].noise
    assert (noise.abs() <= width + 1e-6).all()
    assert 0.8 * width < noise.abs().max()
    assert abs(float(noise.mean())) < 0.25 * width
    # Each step, each world and each episode has its own: step 5 is the start of episode 1, so it
    # differs from step 0's.
    flat = noise.flatten(0, 1)
    assert len({tuple(row) for row in (flat * 1e4).round().int().tolist()}) == len(flat)
    torch.testing.assert_close(noises(env, 0), noise, rtol=0, atol=0)
    assert not torch.isclose(noises(env, 1), noise, atol=1e-5, rtol=0).all(-1).any()

    # In worlds that start alike and do alike, the noise is all that differs; a world's number alone
    # decides its own.
    cfg = configure("task=reach", "reset=nominal")
    env = on_shared_sim("native", 3, cfg)
    moves = [move[:1].expand(3, -1) for move in moves]
    a = noises(env, 0)
    b = noises(env, 0, [2, 0, 7])
    torch.testing.assert_close(b[:, 0], a[:, 2], rtol=0, atol=1e-6)
    torch.testing.assert_close(b[:, 1], a[:, 0], rtol=0, atol=1e-6)

    cfg.observation["policy"].noise = False
    env = on_shared_sim("native", 3, cfg)
    assert not noises(env, 0).any()


@pytest.mark.full
def test_noise_then_clip_then_scale(backend: str) -> None:
    cfg = configure("task=stack", "reset=nominal")
    term = cfg.observation["policy"].terms["joint_vel"]
    seen = {}
    for name, term.noise, term.clip, term.scale in (
        ("plain", 0.0, None, 1.0),
        ("noisy", 0.3, None, 1.0),
        ("clipped", 0.3, [-0.5, 0.25], 1.0),
        ("all", 0.3, [-0.5, 0.25], 0.1),
    ):
        env = on_shared_sim(backend, 2, cfg)
        env.reset(seed=0)
        trace = play(env, actions(env, 6))
        rows = [split(env, "policy", row["obs.policy"])["joint_vel"] for row in trace]
        seen[name] = torch.stack(rows)
    added = (seen["noisy"] - seen["plain"]).abs()
    assert (added <= 0.3 + 1e-4).all()
    assert added.max() > 0.2
    assert_same_run(seen["clipped"], seen["noisy"].clamp(-0.5, 0.25), backend)
    assert_same_run(seen["all"], 0.1 * seen["clipped"], backend)
    assert (seen["clipped"] == 0.25).any()
    assert (seen["clipped"] == -0.5).any()


def build(cfg: Config) -> Env:
    return on_shared_sim("native", 3, cfg)


def refused(cfg: Config, *words: str, kind: type[MjstackError] = TermError) -> str:
    """No environment can be built."""
    return fails(kind, lambda: build(cfg), *words)


def test_an_empty_group(cfg: Config) -> None:
    cfg.observation["empty"] = ObservationGroupCfg(terms={})
    refused(cfg, "observation.empty", "no terms")


class Counter:
    """Counts its calls per world: a memory."""

    def __init__(self, env: Env) -> None:
        self.count = torch.zeros(env.nworld)

    def __call__(self, env: Env) -> torch.Tensor:
        self.count += 1.0
        return self.count

    def reset(self, mask: torch.Tensor) -> None:
        self.count.masked_fill_(mask, 0.0)


@pytest.mark.full
def test_an_observation_with_a_memory_is_refused() -> None:
    cfg = mjstack.load_config(["sim=native"])
    cfg.observation["policy"].terms["counter"] = ObservationTermCfg(func=f"{__name__}.Counter")
    words = r"observation\.policy\.terms\.counter: has a reset\(mask\).*use history"
    with pytest.raises(TermError, match=words):
        build_env(cfg, nworld=1)
