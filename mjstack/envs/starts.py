"""Starts of episodes to come, made for all worlds at once on native MuJoCo."""

from collections.abc import Callable
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mjstack.managers.episode import required_fields
from mjstack.managers.term import in_one_pass

if TYPE_CHECKING:
    from mjstack.envs.env import Env

_FEW = 8  # one of so many worlds: where more end at once, nothing is gained


class NextStarts:
    """How the next episode of each world starts, and what is observed then.

    Python takes as long for the start of one world as for those of all. So the first world without
    a start has all of them made, while the worlds' own state is put aside, and a world that ends
    gets its own copied. Terms that are not `repeatable` may look at more than there is ahead of
    time; with one of them, or on MJWarp, nothing is made.
    """

    def __init__(self, env: "Env", start: Callable[[Tensor], None]) -> None:
        """Find what a start consists of.

        Args:
            env: The environment, with its managers.
            start: Puts the masked worlds at the start of their next episode.
        """
        self._env = env
        self._start = start
        sim = env.sim
        observations = env.observation_manager
        terms = chain(env.reset_manager.terms, observations.terms)
        # Somebody else may write a field that no term does
        no_more = sim.fields.keys() == set(required_fields(env.cfg.reset))
        ahead = sim.rows and no_more and all(term.repeatable for term in terms)
        self._rows = [*sim.rows, *map(Tensor.numpy, observations.buffers)] if ahead else []
        self._starts: list[np.ndarray] = []
        self.forget()

    def forget(self) -> None:
        """Have all starts made anew."""
        self._episodes = np.full(self._env.nworld, -1)  # whose starts they are

    def write(self, mask: Tensor) -> bool:
        """Start the next episode of the masked worlds, shape ``(nworld,)``, bool; or leave all as
        they are and return False.
        """
        if not self._rows:
            return False
        env = self._env
        worlds = np.flatnonzero(mask.numpy())
        if len(worlds) * _FEW > env.nworld:
            return False
        episode = env.episode.numpy()
        if (self._episodes[worlds] != episode[worlds] + 1).any():
            self._make_all()
        env.sim.keep_peaks(mask)
        for array, starts in zip(self._rows, self._starts, strict=True):
            array[worlds] = starts[worlds]
        episode[worlds] += 1
        env.episode_step.masked_fill_(mask, 0)
        env.command_delay.reset(mask)
        return True

    def _make_all(self) -> None:
        env = self._env
        others = (
            env.episode,
            env.episode_step,
            env.action_manager.last_two,
            *env.command_delay.buffers,
        )
        arrays = [*self._rows, *map(Tensor.numpy, others)]
        aside = [array.copy() for array in arrays]
        everywhere = torch.ones(env.nworld, dtype=torch.bool)
        try:
            self._start(everywhere)
            env.action_manager.reset(everywhere)
            in_one_pass(partial(env.observation_manager.refresh, everywhere))
            self._episodes = env.episode.numpy().copy()
            self._starts = [array.copy() for array in self._rows]
        finally:
            for array, values in zip(arrays, aside, strict=True):
                array[:] = values
