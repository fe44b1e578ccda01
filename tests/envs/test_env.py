"""A step as a whole: without autograd, after refused arguments, interrupts and threads."""

import signal
import threading
import time
from collections.abc import Callable

import pytest
import torch
from compositions import load_config
from env_cases import fails, native
from environments import (
    GetStage,
    Patch,
    actions,
    assert_rows,
    configure,
    mask_of,
    on_new_sim,
    returned,
    zeros,
)

import mjstack
from mjstack.envs import Env
from mjstack.errors import ArgumentError, MjstackError


class Change:
    """A reward term that keeps a tensor of a step for the next one."""

    def __init__(self, env: Env) -> None:
        """Begin with none."""
        self.before = env.action.clone()

    def __call__(self, env: Env) -> torch.Tensor:
        """How much the first action changes."""
        change = (env.action - self.before)[:, 0]
        self.before = env.action.clone()
        return change

    def reset(self, mask: torch.Tensor) -> None:
        """Forget in place."""
        self.before[mask] = 0.0


def test_a_step_is_without_autograd_and_what_it_returns_is_not() -> None:
    """Terms may write into what they kept, in a later step and in a reset of the caller's; a loss
    may be taken of what a step returns, and a buffer be written outside.
    """
    change = "+reward.change={func: test_env.Change, weight: 1.0}"
    env = on_new_sim("native", 3, configure(change))
    env.reset(seed=0)
    for move in actions(env, 3):
        obs, reward, *_ = env.step(move)
    env.reset(mask=mask_of(env, 1))
    env.step(zeros(env))
    assert env.reward_manager.terms[
        env.reward_manager.names.index("change")
    ].call.before.is_inference()
    layer = torch.nn.Linear(obs["policy"].shape[1], 1)
    (layer(obs["policy"]).sum() * reward.sum()).backward()
    assert layer.weight.grad is not None
    reward.add_(1.0)
    env.reward_manager.weights.mul_(0.5)
    env.step(zeros(env))


def test_argument_errors_leave_the_environment_as_it_was(env: Env) -> None:
    action = 0.3 * torch.ones_like(zeros(env))
    expected = [returned(env.step(action)), returned(env.step(-action))]
    env.reset(seed=0)
    attempts: list[Callable[[], object]] = [
        lambda: env.step(action * float("nan")),
        lambda: env.step(action.to("meta")),
        lambda: env.step(action[:1]),
        lambda: env.reset(seed=-1),
        lambda: env.reset(seed=1, mask=mask_of(env, 0)),
        lambda: env.reset(mask=torch.ones(2, dtype=torch.bool)),
    ]
    for move, result in zip((action, -action), expected, strict=True):
        for attempt in attempts:
            fails(ArgumentError, attempt)
        assert_rows(returned(env.step(move)), result, slice(None), slice(None), "native")


@pytest.mark.parametrize(
    ("overrides", "words"),
    [(lambda: "task=reach", "'task=reach'"), (lambda: load_config([]), "Config(")],
    ids=["a string", "a configuration"],
)
def test_overrides_that_are_no_list(overrides: Callable[[], object], words: str) -> None:
    call = lambda: mjstack.make_env(overrides())  # type: ignore[arg-type]  # noqa: E731
    fails(ArgumentError, call, "overrides", words, "['task=reach', 'robot=rebot']")


@pytest.mark.full
def test_ctrl_c_leaves_no_thread_at_work(get_stage: GetStage, monkeypatch: Patch) -> None:
    from mjstack.sim import native

    monkeypatch.setattr(native, "available_cores", lambda: 2)
    sim = native.NativeSimulation(get_stage("so101").model, 64)
    timer = threading.Timer(0.2, lambda: signal.raise_signal(signal.SIGINT))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            sim.step(2000)
        held = sim.qpos.clone()
        time.sleep(0.3)
        assert torch.equal(sim.qpos, held)
    finally:
        timer.join()
        signal.signal(signal.SIGINT, before)
    sim.close()


@pytest.mark.full
def test_torch_has_its_threads_back_after_a_step(monkeypatch: Patch) -> None:
    env = native()
    env.reset(seed=0)
    inside = []
    step = env.sim.step

    def watched(n: int = 1, *, kinematics: bool = False) -> None:
        inside.append(torch.get_num_threads())
        step(n, kinematics=kinematics)

    monkeypatch.setattr(env.sim, "step", watched)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        env.step(zeros(env))
        with pytest.raises(ArgumentError):
            env.step(zeros(env)[:1])
        assert (inside, torch.get_num_threads()) == ([1], 3)
    finally:
        torch.set_num_threads(before)


@pytest.mark.full
def test_a_closed_environment_and_a_missing_field_say_so() -> None:
    env = native()
    with pytest.raises(MjstackError, match="uses_fields"):
        env.sim.fields["body_mass"]
    env.close()
    for call in (lambda: env.step(zeros(env)), env.reset):
        with pytest.raises(mjstack.MjstackError, match="close"):
            call()
