"""Captured work: what replays is what ran, what cannot be captured is named, and what changed is
captured anew.
"""

import logging
from functools import partial

import pytest
import torch
import warp as wp
from compositions import make_env
from environments import CUDA, actions, on_cuda, returned, zeros

from mjstack.envs import Env
from mjstack.errors import MjstackError
from mjstack.managers.view import EnvView
from mjstack.rng import uniform
from mjstack.sim.draws import draw_uniform
from mjstack.sim.graph import StepGraph, side_by_side

BACKENDS = ["mjwarp", pytest.param("mjwarp-cuda", marks=CUDA)]


def make(backend: str, graph: str, nworld: int, *overrides: str) -> Env:
    device = "cuda:0" if backend == "mjwarp-cuda" else "cpu"
    return make_env(
        ["sim=mjwarp", "reset=randomized", f"graph={graph}", *overrides],
        nworld=nworld,
        device=device,
    )


def reads_the_device(env: EnvView) -> torch.Tensor:
    """A termination that a graph cannot hold."""
    return torch.full((env.nworld,), bool(env.sim.qpos[0, 0].item() > 1e9), device=env.device)


@pytest.mark.full
@pytest.mark.parametrize("backend", BACKENDS)
def test_eager_and_replayed_steps_agree_through_resets(backend: str) -> None:
    """Over many resets. On the CPU device bit for bit; on CUDA, where two runs of the same differ,
    the starts are equal.
    """
    steps = 20
    total = 300
    ends = ("success", "object_off_table", "joint_limit")
    common = ["task=reach", *(f"~termination.{name}" for name in ends)]
    common += [f"termination.time_out.params.steps={steps}"]
    nworld = 64
    if backend == "mjwarp":  # an eager substep takes 10 ms there, whatever nworld is
        nworld = 2
        total = 60
        common += ["timing.physics_dt=0.01", "timing.decimation=2"]
    eager = make(backend, "off", nworld, *common)
    replayed = make(backend, "require", nworld, *common)
    starts = []
    first, again = (env.reset(seed=3)[0] for env in (eager, replayed))
    assert all(torch.equal(first[name], again[name]) for name in first)
    spread = 0.0
    for t, action in enumerate(actions(eager, total)):
        a = returned(eager.step(action))
        b = returned(replayed.step(action))
        assert torch.equal(eager.episode, replayed.episode)
        assert torch.equal(eager.episode_step, replayed.episode_step)
        if backend == "mjwarp":
            assert all(torch.equal(a[name], b[name]) for name in a), t
            assert torch.equal(eager.sim.qpos, replayed.sim.qpos)
            continue
        if (t + 1) % steps == 0:
            assert (a["truncated"] & b["truncated"]).all()
            # The new episodes' starts come from random numbers alone.
            assert torch.equal(eager.sim.qpos, replayed.sim.qpos)
            starts.append(replayed.sim.qpos.clone())
        if t % steps < 5:  # later, contacts have drawn two runs of the same apart
            spread = max(spread, float((a["reward"] - b["reward"]).abs().quantile(0.95)))
    assert torch.isfinite(eager.sim.qpos).all()
    for env in (eager, replayed):
        assert env.read_statistics()["episodes"] == total // steps * nworld
    if backend == "mjwarp-cuda":
        assert replayed.graph.captured
        assert spread < 1e-4
        # Random numbers advance at every replay.
        assert len({tuple(start[0].tolist()) for start in starts}) == len(starts)


def test_the_kernel_draws_what_the_generator_draws(device: str) -> None:
    wp.init()  # nothing may have used it yet
    world = torch.arange(33)
    rows = {"world": world, "episode": world * 7 + 1, "step": world * 1000003 + 5}
    on_device = {name: values.to(device) for name, values in rows.items()}
    for seed, stream in ((0, 0), (4294967295, 0x9ABCDEF0)):
        key = torch.tensor([seed], device=device)
        draw = partial(draw_uniform, key=key, stream=stream, size=11)
        expect = partial(uniform, seed=seed, stream=stream, size=11)
        assert torch.equal(draw(**on_device).cpu(), expect(**rows))
        scaled = draw(**on_device | {"step": None}, low=0.7, high=1.3).cpu()
        plain = expect(**rows | {"step": torch.zeros_like(world)})
        torch.testing.assert_close(scaled, 0.7 + 0.3 * (plain + 1.0), rtol=1e-6, atol=0.0)


@pytest.mark.full
@on_cuda
@pytest.mark.parametrize("graph", ["require", "auto"])
def test_a_term_that_reads_the_device_is_named(
    graph: str, caplog: pytest.LogCaptureFixture
) -> None:
    bad = "+termination.spy={func: test_graph.reads_the_device}"
    env = make("mjwarp-cuda", graph, 8, bad)
    env.reset(seed=0)
    zero = zeros(env)
    env.step(zero)
    with caplog.at_level(logging.WARNING):
        if graph == "require":
            with pytest.raises(
                MjstackError, match=r"env\.step cannot be captured because of termination\.spy"
            ):
                env.step(zero)
        else:
            for _ in range(3):
                env.step(zero)
            assert int(env.episode_step[0]) == 4
            said = [r.message for r in caplog.records if "termination.spy" in r.message]
            assert len(said) == 1
    # The device works on.
    other = make("mjwarp-cuda", "require", 8)
    other.reset(seed=0)
    for _ in range(3):
        other.step(zero)
    assert torch.isfinite(other.sim.qpos).all()
    assert int(other.sim.step_count[0]) == 30


def test_a_graph_warms_up_captures_and_replays(device: str) -> None:
    values = wp.zeros(3, dtype=float, device=device)
    view = wp.to_torch(values)
    version = 0
    calls = 0

    def work() -> None:
        nonlocal calls
        calls += 1
        wp.launch(_add_one, dim=3, inputs=[values], device=device)

    graph = StepGraph(work, device, "require", name="adding", version=lambda: version)
    for _ in range(5):
        graph()
    wp.synchronize_device(device)
    assert view.tolist() == [5.0] * 3
    assert calls == 2  # once eagerly, once captured
    assert graph.captured
    version = 1
    assert not graph.captured
    graph()
    graph()
    graph()
    wp.synchronize_device(device)
    assert view.tolist() == [8.0] * 3
    assert calls == 4
    assert graph.capture_seconds > 0.0


def test_without_capture_the_work_just_runs() -> None:
    calls = []
    graph = StepGraph(lambda: calls.append(1), "cpu", "off", name="counting")
    for _ in range(3):
        graph()
    assert len(calls) == 3
    assert not graph.captured


@wp.kernel
def _add_one(values: wp.array[float]):
    i = wp.tid()
    values[i] = values[i] + 1.0


def test_what_failed_is_captured_anew_after_a_change() -> None:
    version = 0
    results = iter([None, RuntimeError("this cannot be captured")])

    def work() -> None:
        if error := next(results, None):
            raise error

    graph = StepGraph(work, "cpu", "auto", name="failing once", version=lambda: version)
    for _ in range(4):
        graph()
    assert not graph.captured
    version = 1
    for _ in range(3):
        graph()
    assert graph.captured


def test_what_a_step_returns_is_the_callers_own() -> None:
    """To autograd, too: each tensor is a copy."""
    env = make_env(["task=reach", "sim=native"], nworld=2)
    env.reset(seed=0)
    zero = zeros(env)
    obs, reward, terminated, *_ = env.step(zero)
    weight = torch.ones(obs["policy"].shape[1], requires_grad=True)
    loss = (obs["policy"] * weight).sum()
    reward.add_(1.0)
    terminated.fill_(True)
    loss.backward()
    assert torch.equal(weight.grad, obs["policy"].sum(0))
    kept = {name: value.clone() for name, value in obs.items()}
    again = env.step(zero + 1.0)
    assert all(torch.equal(kept[name], obs[name]) for name in obs)
    assert not again[2].any()


@on_cuda
def test_a_branch_within_a_branch_keeps_its_memory() -> None:
    """A branch reads late what its inner branch has made; meanwhile another one forks too."""
    device = torch.device("cuda:0")
    out = torch.zeros((2, 1 << 20), device=device)
    busy = torch.zeros(1 << 26, device=device)

    def branch(number: int) -> None:
        made = []
        inner = partial(torch.full_like, out[0], number + 1.0)
        side_by_side(device, lambda: None, lambda: made.append(inner()))
        if number == 1:
            for _ in range(50):
                busy.add_(1.0)
        out[number].copy_(made.pop())

    def work() -> None:
        side_by_side(device, partial(branch, 0), partial(branch, 1))

    graph = StepGraph(work, device, "require", name="branches")
    for _ in range(3):
        out.zero_()
        graph()
        assert [row.unique().tolist() for row in out] == [[1.0], [2.0]]
