"""trainer=ppo: small trainings on native MuJoCo and how they go on; worlds that start in an
expert's states.
"""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from environments import (
    SHORT_REACH,
    Patch,
    Refused,
    at_double_speed,
    configure,
    mask_of,
    on_cuda,
    on_new_sim,
)
from policies import assert_drives, curve, interrupted, report, run_as_torchrun, same
from rsl_rl.algorithms import PPO

from mjstack.cli import run
from mjstack.envs import Env
from mjstack.errors import MjstackError
from mjstack.policy import load_policy
from mjstack.train.ppo import PpoLearner

TINY = (
    *("job=train", "trainer=ppo", "sim=native", "nworld=4", "job.iterations=4"),
    *("job.save_every=2", "job.hidden=[16]", "job.horizon=4", "job.epochs=2"),
    *("job.minibatches=2", "gate.success.rate=0.0", "web.episode=false"),
)
REACH = (*TINY, "task=reach", "termination.time_out.params.steps=30", *SHORT_REACH)


def test_a_training_leaves_policies_a_curve_and_a_judgement(tmp_path: Path) -> None:
    out = tmp_path / "training"
    assert run([*REACH, f"job.folder={out}"]) == 0
    gates = report(out)
    assert gates["train"]["metrics"]["iterations"] == 4
    assert gates["success"]["metrics"]["episodes"] == 4
    rows = curve(out)
    assert rows["iteration"].tolist() == [2.0, 4.0]
    assert rows["decisions"].tolist() == [32.0, 64.0]
    assert np.isfinite(rows["return_"]).all()  # ends are spread out, so that some end early
    assert ((rows["success"] >= 0.0) & (rows["success"] <= 1.0)).all()
    assert (rows["reach"] > 0.0).all()
    best = int(rows["return_"].argmax())  # there is no success yet
    assert load_policy(out / "best").training["iteration"] == rows["iteration"][best]
    for name in ("train.png", "train.csv", "best/policy.json", "last/policy.json"):
        assert (out / name).stat().st_size > 0, name

    policy = load_policy(out / "last")
    assert policy.training["iteration"] == 4
    assert policy.action == configure("task=reach").action
    assert (policy.network.chunk, policy.execute) == (1, 5)
    assert policy.widths["headings"] == 4
    assert_drives(out / "last", tmp_path / "gates", "task=reach")


@pytest.mark.full
@pytest.mark.parametrize(("wanted", "bound"), [(1e-9, 1e-5), (1e9, 1e-2)], ids=["fall", "rise"])
def test_the_learning_rate_adapts_before_every_step(
    wanted: float, bound: float, tmp_path: Path
) -> None:
    """Sixteen of them are enough to get from the start to a bound."""
    out = tmp_path / "out"
    keys = [f"job.desired_kl={wanted}", "job.learning_rate=0.0002"]
    assert run([*REACH, *keys, f"job.folder={out}"]) == 0
    rows = curve(out)
    assert rows["learning_rate"][-1] == pytest.approx(bound)


@pytest.mark.full
def test_a_task_may_have_one_observation_group(tmp_path: Path) -> None:
    """The critic sees whatever groups there are."""
    out = tmp_path / "out"
    assert run([*REACH, "~observation.privileged", "job.iterations=1", f"job.folder={out}"]) == 0
    assert load_policy(out / "last").training["iteration"] == 1


def test_networks_that_are_not_finite_end_the_training(tmp_path: Path, monkeypatch: Patch) -> None:
    """In the iteration in which they become so; the folder keeps the policy before it."""
    update = PPO.update
    calls = []

    def diverge(self: PPO) -> dict[str, float]:
        calls.append(update(self))
        if len(calls) == 3:
            next(self.critic.parameters()).data[0] = torch.inf
        return calls[-1]

    monkeypatch.setattr(PPO, "update", diverge)
    out = tmp_path / "out"
    assert run([*REACH, f"job.folder={out}"]) == 1
    assert "not finite after iteration 3" in report(out)["train"]["reason"]
    for name in ("last", "best"):  # its weights are read only if they are finite
        assert load_policy(out / name).training["iteration"] == 2
    assert not list(out.rglob("*.pt"))


@pytest.mark.full
def test_a_training_goes_on_after_ctrl_c(tmp_path: Path) -> None:
    """Weights, optimizer and figures are those of the interrupted one, so two resumed trainings are
    the same. Worlds begin new episodes, because the state of the physics is not saved: a training
    that was never interrupted is another one.
    """
    out = tmp_path / "out"
    interrupted([*REACH, f"job.folder={out}"], PpoLearner, 3)
    again = tmp_path / "again"
    shutil.copytree(out, again)
    for folder in (out, again):
        assert run([*REACH, f"job.folder={folder}"]) == 0
        rows = curve(folder)
        assert rows["iteration"].tolist() == [2.0, 4.0]
    assert same(out / "last", again / "last")

    # A larger limit goes on with it, as far as another limit lets it
    more = ["job.iterations=6", "job.max_minutes=0.000001"]
    assert run([*REACH, f"job.folder={out}", *more]) == 0
    assert load_policy(out / "last").training["iteration"] == 5
    assert not same(out / "last", again / "last")


@pytest.mark.full
@pytest.mark.long
def test_two_processes_learn_one_policy(tmp_path: Path) -> None:
    """As torchrun starts them, with Gloo on a CPU: both average gradients, the first one writes."""
    out = tmp_path / "out"
    texts = run_as_torchrun([*REACH, f"job.folder={out}"], tmp_path)
    assert "iteration 4" in texts[0]
    assert "iteration" not in texts[1]
    assert not list((tmp_path / "1").iterdir())
    rows = curve(out)
    assert rows["decisions"].tolist() == [32.0, 64.0]  # nworld is of both


def states_file(path: Path, env: Env, count: int = 3) -> Path:
    """States of the environment's worlds after some steps, each from another episode."""
    env.reset(seed=5)
    for _ in range(20):
        env.step(torch.ones((env.nworld, env.action_manager.action_dim)))
    arrays = {
        name: getattr(env.sim, name)[:count].numpy() for name in ("qpos", "qvel", "act", "ctrl")
    }
    arrays["episode"] = np.arange(count)
    arrays |= {f"field.{name}": field[:count].numpy() for name, field in env.sim.fields.items()}
    np.savez(path, **arrays)
    return path


def test_worlds_start_in_an_experts_states(tmp_path: Path) -> None:
    """By seed, world and episode, a falling share of them, with fresh counters; the others as they
    would without.
    """
    whole = on_new_sim("native", 6, configure("reset=randomized"))
    path = states_file(tmp_path / "states.npz", whole)
    bank = np.load(path)
    params = [f"reset.expert.params.{name}" for name in ("path", "share", "last_share", "episodes")]
    values = (path, 0.7, 0.2, 2)
    keys = [f"{key}={value}" for key, value in zip(params, values, strict=True)]
    envs = [on_new_sim("native", n, configure("reset=expert_states", *keys)) for n in (6, 4)]
    whole.reset(seed=9)
    for env in envs:
        env.reset(seed=9)
    shares = []
    for _ in range(4):
        starts = envs[0].sim.qpos.numpy()
        assert np.array_equal(starts[:4], envs[1].sim.qpos.numpy())
        midway = np.zeros(6, dtype=bool)
        for world, start in enumerate(starts):
            found = np.flatnonzero((bank["qpos"] == start).all(1))
            midway[world] = len(found)
            others = whole if not len(found) else None
            for name, field in envs[0].sim.fields.items():
                wanted = (
                    others.sim.fields[name][world] if others else bank[f"field.{name}"][found[0]]
                )
                assert np.array_equal(field[world].numpy(), np.asarray(wanted)), name
            if others:
                assert np.array_equal(start, whole.sim.qpos[world].numpy())
            else:
                assert np.array_equal(envs[0].sim.qvel[world].numpy(), bank["qvel"][found[0]])
                assert np.array_equal(envs[0].sim.ctrl[world].numpy(), bank["ctrl"][found[0]])
        shares.append(midway.mean())
        assert not envs[0].episode_step.any()
        for env in (whole, *envs):
            env.reset()
    assert 0.0 < shares[0] < 1.0
    assert len({tuple(row) for row in envs[0].sim.qpos.tolist()}) > 1

    # A masked reset starts its worlds alone
    before = envs[0].sim.qpos.clone()
    envs[0].reset(mask=mask_of(envs[0], 1, 4))
    moved = (envs[0].sim.qpos != before).any(1)
    assert moved.tolist() == [False, True, False, False, True, False]


@pytest.mark.full
def test_the_expert_plays_at_the_beginning(tmp_path: Path) -> None:
    """Its states are kept for later calls, and the policy is judged from whole starts."""
    out = tmp_path / "training"
    command = [*TINY, *at_double_speed(), "reset=expert_states", "job.expert_worlds=2"]
    assert run([*command, "job.iterations=2", f"job.folder={out}"]) == 0
    bank = np.load(out / "expert_states.npz")
    height = bank["qpos"][:, 8]  # of red
    assert len(bank["qpos"]) == len(bank["episode"]) == len(set(bank["episode"])) * 60
    assert height.max() > height.min() + 0.04

    # With actions of 0 what a world starts with in its hand stays there
    params = {"path": out / "expert_states.npz", "share": 1.0, "last_share": 1.0}
    keys = [f"reset.expert.params.{name}={value}" for name, value in params.items()]
    env = on_new_sim("native", 16, configure("reset=expert_states", "action=ee_tilt", *keys))
    env.reset(seed=0)
    view = env.state
    for step in range(50):
        env.step(torch.zeros((16, 6)))
        if step == 0:
            held = view.in_hand[:, 0].clone()
    assert 2 < held.sum() < 14
    assert view.in_hand[held, 0].all()

    written = (out / "expert_states.npz").stat().st_mtime_ns
    assert run([*command, f"job.folder={out}"]) == 0
    assert (out / "expert_states.npz").stat().st_mtime_ns == written
    assert report(out)["success"]["metrics"]["episodes"] == 4
    assert "cubes" in report(out)["success"]["notes"]["starts"]
    assert "expert" not in report(out)["success"]["notes"]["starts"]


@on_cuda
def test_a_training_on_cuda(tmp_path: Path) -> None:
    """Steps and judged rollouts are captured, in a second call too."""
    out = tmp_path / "training"
    command = [*TINY, *at_double_speed(), "sim=mjwarp", "graph=require", "nworld=32"]
    command += ["reset=expert_states", "job.expert_worlds=16"]
    assert run([*command, "job.iterations=2", f"job.folder={out}"]) == 0
    assert run([*command, f"job.folder={out}"]) == 0
    assert report(out)["train"]["metrics"]["iterations"] == 4
    assert report(out)["success"]["metrics"]["episodes"] == 32
    assert len(set(np.load(out / "expert_states.npz")["episode"])) > 8


def test_states_need_a_file_outside_of_a_training() -> None:
    with pytest.raises(
        MjstackError, match=r"path=null: expected a file of states, which job=train"
    ):
        on_new_sim("native", 1, configure("reset=expert_states"))


def test_states_of_another_scene_are_refused(tmp_path: Path) -> None:
    env = on_new_sim("native", 1, configure("reset=randomized"))
    path = states_file(tmp_path / "states.npz", env)
    arrays = dict(np.load(path))
    name = next(key for key in arrays if key.startswith("field."))
    arrays[name] = np.repeat(arrays[name], 2, axis=1)
    np.savez(path, **arrays)
    with pytest.raises(MjstackError, match=r"states of this robot and scene: \w+ of shape"):
        on_new_sim(
            "native", 1, configure("reset=expert_states", f"reset.expert.params.path={path}")
        )


def test_a_missing_extra_is_one_line(monkeypatch: Patch, refused: Refused) -> None:
    for name in list(sys.modules):
        if name.startswith(("rsl_rl", "mjstack.train.ppo", "mjstack.adapters.rsl_rl")):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rsl_rl", None)
    assert "pip install 'mjstack[train]'" in refused(*REACH, "job.folder=out")
