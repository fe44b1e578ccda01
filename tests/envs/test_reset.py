"""Resets: worlds by seed, world and episode alone, masks, and terms that cannot reset."""

import mujoco
import pytest
import torch
from env_cases import N, fails, native, randomized, scenes
from environments import (
    COUNTS,
    POSES,
    STATE,
    actions,
    assert_rows,
    assert_same_run,
    assert_traces,
    mask_of,
    on_new_sim,
    on_shared_sim,
    play,
    returned,
    state_of,
    zeros,
)

import mjstack
from mjstack.config.schema import Backend, Config, TermCfg
from mjstack.envs import Env, build_env
from mjstack.errors import ArgumentError, TermError
from mjstack.sim import make_simulation


@scenes
def test_a_masked_reset_touches_nobody_else(backend: str, task: str, robot: str) -> None:
    cfg = randomized(task, robot)
    env = on_shared_sim(backend, N, cfg)
    moves = actions(env, 12)
    env.reset(seed=3)
    undisturbed = play(env, moves)

    env.reset(seed=3)
    before_reset = play(env, moves[:6])
    assert_traces(before_reset, undisturbed[:6], slice(None), slice(None), backend)
    others = [0, 2]
    chosen = [1, 3]
    env.sim.sensordata.fill_(1.0)  # as if they had touched something
    before = state_of(env)
    start = returned(env.reset(mask=mask_of(env, *chosen)))
    after = state_of(env)
    for name in before:
        assert torch.equal(after[name][others], before[name][others]), name
    for name, value in start.items():
        assert torch.equal(value[others], before_reset[-1][name][others]), name
    assert after["episode"].tolist() == [0, 1, 0, 1]
    assert after["episode_step"].tolist() == [6, 0, 6, 0]
    assert before["action"][chosen].any()
    cleared = ("action", "previous_action", "sensordata", "qvel", "episode_sums", "success")
    for name in (*cleared, *COUNTS[:1], *COUNTS[2:]):
        assert not after[name][chosen].any(), name
    later = play(env, moves[6:])
    assert_traces(later, undisturbed[6:], others, others, backend)

    fresh = on_new_sim(backend, N, cfg)
    fresh.reset(seed=3)
    fresh_start = returned(fresh.reset())
    assert fresh.episode.tolist() == [1] * N
    assert_rows(start, fresh_start, chosen, chosen, backend, "reset")
    new = state_of(fresh)
    for name in [n for n in after if n in (*STATE, *POSES) or n.startswith("fields.")]:
        assert_same_run(after[name][chosen], new[name][chosen], backend)
    assert_traces(later, play(fresh, moves[6:]), chosen, chosen, backend)


@pytest.mark.full
def test_starts_depend_on_seed_world_and_episode_alone(robot: str) -> None:
    """On how many worlds there are, which of them reset with it, and the backend they do not. The
    configuration's seed is the one of a reset without.
    """
    cfg = randomized("reach", robot)
    cfg.seed = 5
    names = ("qpos", "qvel", "ctrl", "site_xpos")

    def starts(env: Env) -> dict[str, torch.Tensor]:
        state = state_of(env, names).items()
        return {k: v.double().cpu() for k, v in state if k in names or k.startswith("fields.")}

    runs = {}
    for backend, nworld in (("native", N), ("native", 2), ("mjwarp", N)):
        env = on_shared_sim(backend, nworld, cfg)
        env.reset(seed=5 if backend == "mjwarp" else None)
        if nworld == N:
            env.reset(mask=mask_of(env, 1, 3))
            env.step(actions(env, 1)[0])
            env.reset(mask=mask_of(env, 0, 1))
            assert env.episode.tolist() == [1, 2, 0, 1]
        else:
            env.reset()
            env.step(actions(env, 1)[0])
            env.reset(mask=mask_of(env, 0))
            env.reset(mask=mask_of(env, 1))
            assert env.episode.tolist() == [2, 2]
        runs[backend, nworld] = starts(env)
    four, two, warp = runs.values()
    for name in four:
        assert torch.equal(four[name][1], two[name][1]), name
        # float32 holds seven digits: gains up to a thousand, metres and radians of order one.
        torch.testing.assert_close(warp[name][[0, 1]], four[name][[0, 1]], rtol=1e-6, atol=2e-6)
    assert not torch.equal(four["qpos"][0], two["qpos"][0])  # another episode
    env.reset(seed=5)
    before = starts(env)["qpos"]
    env.reset(seed=6)
    assert not env.episode.any()
    assert (starts(env)["qpos"] != before).any(1).all()


@scenes
def test_world_k_of_n_is_world_k_of_one(backend: str, task: str, robot: str) -> None:
    """Over random actions and two automatic resets each."""
    cfg = randomized(task, robot, steps=5)
    many = on_shared_sim(backend, N, cfg)
    many.reset(seed=1)
    many_trace = play(many, actions(many, 13))
    assert many_trace[-1]["episode"].tolist() == [2] * N
    one = on_shared_sim(backend, 1, cfg)
    for k in range(N):
        one.world.fill_(k)
        one.reset(seed=1)
        assert_traces(play(one, actions(one, 13)), many_trace, 0, k, backend)
    rows = many_trace[-1]["qpos"]
    assert len({tuple(row) for row in rows.tolist()}) == N


def test_step_before_reset(cfg: Config) -> None:
    env = on_shared_sim("native", 3, cfg)
    fails(ArgumentError, lambda: env.step(zeros(env)), "before reset()", "env.reset()")
    fails(ArgumentError, lambda: env.reset(mask=mask_of(env, 1)), "mask", "env.reset()")
    env.reset()
    env.step(zeros(env))


def test_reset_term_without_its_fields(cfg: Config) -> None:
    env = on_shared_sim("native", 3, cfg)
    bare = make_simulation(env.sim.model, cfg, 3, backend=Backend.native)
    cfg.reset["mass"] = TermCfg(func="mjstack.mdp.reset.ObjectMass", params={"scale": [0.9, 1.1]})
    fails(TermError, lambda: Env(bare, env.index, cfg), "reset.mass", "body_mass", "fields=")


@pytest.mark.full
def test_drawn_friction_is_that_of_the_contact(robot: str) -> None:
    """MuJoCo combines two geoms' coefficients, so a field alone says little."""
    env = native(
        f"robot={robot}", "reset=randomized", "reset.friction.params.sliding=[0.3,0.5]", nworld=8
    )
    env.reset(seed=0)
    model = env.sim.model
    grips = set()
    data = mujoco.MjData(model)
    table = model.geom("table").id
    for w in range(env.nworld):
        model.geom_friction[:] = env.sim.fields["geom_friction"][w].numpy()
        data.qpos[:] = env.sim.qpos[w].numpy()
        red = env.index.object_qpos[0]
        # One cube in the jaws, the other one on the table.
        grasp_point = 0.5 * env.sim.site_xpos[w, env.index.grasp_sites].sum(0)
        data.qpos[red : red + 3] = grasp_point.numpy()
        mujoco.mj_forward(model, data)
        cubes = {geoms[0]: name for name, geoms in env.index.geoms.items()}
        for contact in data.contact:
            pair = set(contact.geom.tolist())
            cube = next((g for g in pair if g in cubes), None)
            if cube is None:
                continue
            (other,) = pair - {cube}
            if other == table:
                drawn = float(env.sim.fields["geom_friction"][w, cube, 0])
                assert contact.friction[0] == pytest.approx(drawn)
            else:
                grips.add(round(float(contact.friction[0]), 6))
    assert len(grips) > 1 or robot == "rebot"  # the reBot's open fingers do not touch the cube
    assert all(0.3 <= friction <= 0.5 for friction in grips)


@pytest.mark.full
def test_two_terms_of_one_class_draw_different_numbers() -> None:
    noise = "{func: mjstack.mdp.reset.JointNoise, params: {arm: 0.01}}"
    once = native("reset=nominal", f"+reset.a={noise}")
    twice = native("reset=nominal", f"+reset.a={noise}", f"+reset.b={noise}")
    plain = native("reset=nominal")
    for env in (once, twice, plain):
        env.reset(seed=0)
    first = once.sim.ctrl - plain.sim.ctrl
    both = twice.sim.ctrl - plain.sim.ctrl
    assert not torch.allclose(both, 2.0 * first, atol=1e-6)


@pytest.mark.full
def test_a_value_function_is_no_reset_term() -> None:
    cfg = mjstack.load_config(["sim=native"])
    cfg.reset["x"] = TermCfg(func="mjstack.mdp.reward.success")
    words = r"reset\.x: success does not take .* expected \(env, mask, \*, \.\.\.\)"
    with pytest.raises(TermError, match=words):
        build_env(cfg, nworld=1)
