"""The order in which the new state of a control step is evaluated."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mjstack.envs.outputs import Outputs
from mjstack.managers.state import branches, in_one_pass
from mjstack.managers.term import Term
from mjstack.mdp.geometry import lost_state

if TYPE_CHECKING:
    from mjstack.envs.env import Env


class Schedule:
    """Success, terminations, rewards and observations of a state, which does not change meanwhile.

    ``order`` is the work: of a list one after the other, of a tuple side by side, as branches of
    the graph on CUDA.
    """

    def __init__(self, env: "Env", outputs: Outputs) -> None:
        """Take the managers of an environment, and where its results are kept."""
        self._env = env
        self._outputs = outputs
        self._ended: Tensor | None = None
        self._last = True

        def values(terms: Sequence[Term]) -> list[Callable[[], Tensor]]:
            return [partial(term, env) for term in terms if term.reads_state]

        ends = env.termination_manager
        on_cuda = env.device.type == "cuda"  # elsewhere the host looks for faults
        early = env.observation_manager.reads_state
        self.order: list[Any] = [
            (  # What needs the state alone; all that comes after knows its values
                self._achieved,
                [partial(lost_state, env), *values(ends.terms)],
                *values(env.reward_manager.terms),
                *[self._observe] * early,
            ),
            self._judge_success,
            (
                [self._judge_ends, *[env.faults.record_reward] * on_cuda],
                [
                    *[self._observe] * (not early),
                    (self._keep_final, *[self._record_faults] * on_cuda),
                ],
            ),
        ]

    def evaluate(self, ended: Tensor | None, last: bool) -> Tensor | None:
        """Do the work; arguments as of `Env._evaluate`. Returns the worlds whose state is not
        finite, shape ``(nworld,)``, bool; None where the host can see that there are none.
        """
        self._ended = ended
        self._last = last

        def work() -> Tensor | None:
            self._run(self.order)
            return self._broken()

        return in_one_pass(work)

    def _run(self, work: Any) -> None:
        if isinstance(work, list):
            for item in work:
                self._run(item)
        elif isinstance(work, tuple):
            branches(self._env.device, *(partial(self._run, item) for item in work))
        else:
            work()

    def _broken(self) -> Tensor | None:
        lost = lost_state(self._env)
        return None if lost is self._env.sim.no_worlds else lost

    def _achieved(self) -> Tensor:
        env = self._env
        return env.sim.no_worlds if env.success_term is None else env.success_term(env)

    def _judge_success(self) -> None:
        env = self._env
        achieved = self._achieved()
        if self._ended is not None:  # their success stays
            achieved = torch.where(self._ended, env.success, achieved)
        torch.gt(achieved, lost_state(env), out=env.success)  # achieved and not lost

    def _judge_ends(self) -> None:
        self._env.termination_manager.compute(self._ended)
        self._env.reward_manager.compute(void=self._broken(), ended=self._ended)

    def _observe(self) -> None:
        # A held step is seen by what remembers it alone.
        if self._last or self._env.observation_manager.remembers:
            self._env.observation_manager.compute()

    def _keep_final(self) -> None:
        if self._last:
            self._outputs.write_final(self._broken())

    def _record_faults(self) -> None:
        if self._last:
            self._env.faults.record(self._broken())
