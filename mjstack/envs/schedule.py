"""The order in which the new state of a control step is evaluated."""

from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mjstack.envs.outputs import Outputs
from mjstack.managers.state import branches, lost_state

if TYPE_CHECKING:
    from mjstack.envs.env import Env


def step_order(env: "Env", outputs: Outputs, ended: Tensor | None, last: bool) -> list[Any]:
    """Success, terminations, rewards and observations of a state, which does not change meanwhile:
    work for `run`. Arguments as of `Env._evaluate`, and where results are kept.
    """
    ends = env.termination_manager
    rewards = env.reward_manager
    observations = env.observation_manager
    # A held step is seen by what remembers it alone.
    observe = [observations.compute] * (last or observations.remembers)
    early = observe * observations.reads_state
    on_cuda = env.device.type == "cuda"  # elsewhere the host looks for faults
    success = env.success_term or (lambda env: env.sim.no_worlds)

    def judge_success() -> None:
        achieved = success(env)
        if ended is not None:  # their success stays
            achieved = torch.where(ended, env.success, achieved)
        torch.gt(achieved, lost_state(env), out=env.success)  # achieved and not lost

    return [
        (  # What needs the state alone: what comes after knows its values
            partial(success, env),
            [partial(lost_state, env), *(partial(term, env) for term in ends.early)],
            *(partial(term, env) for term in rewards.early),
            *early,
        ),
        judge_success,
        (
            [
                partial(ends.compute, ended),
                partial(rewards.compute, ended),
                *[env.faults.record_reward] * on_cuda,
            ],
            [
                *observe[len(early) :],
                *[(outputs.write_final, *[env.faults.record] * on_cuda)] * last,
            ],
        ),
    ]


def run(device: torch.device, work: Any) -> None:
    """Do work: of a list one after the other, of a tuple side by side, as branches on CUDA."""
    if isinstance(work, list):
        for item in work:
            run(device, item)
    elif isinstance(work, tuple):
        branches(device, *(partial(run, device, item) for item in work))
    else:
        work()
