"""How episodes begin; on native MuJoCo the starts of all worlds are made at once."""

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mjstack.managers.episode import required_fields
from mjstack.managers.term import in_one_pass
from mjstack.sim.native import NativeSimulation

if TYPE_CHECKING:
    from mjstack.envs.env import Env


class Starts:
    """Begins episodes of an environment.

    On native MuJoCo Python takes as long for one start as for all. So the first world that needs
    one has all made, and observed, while the worlds are put aside; a world that ends gets its own
    copied. This holds for terms that are `repeatable`, and if reset terms write all fields.
    """

    def __init__(self, env: "Env") -> None:
        """Take the environment, which may have no managers but for resets yet."""
        self._env = env
        self._rows: list[np.ndarray] = []

    def forget(self) -> None:
        """Have all starts made anew, with the managers that there are now."""
        env = self._env
        ahead, self._observed = (
            all(term.repeatable for term in manager.terms)
            for manager in (env.reset_manager, env.observation_manager)
        )
        same_fields = env.sim.fields.keys() == set(required_fields(env.cfg.reset))
        if ahead and same_fields and isinstance(env.sim, NativeSimulation):
            observed = env.observation_manager.buffers if self._observed else ()
            self._rows = [*env.sim.rows, *map(Tensor.numpy, observed)]
        self._episodes = np.full(env.nworld, -1)  # whose starts they are
        self._starts: list[np.ndarray] = []

    def begin(self, mask: Tensor) -> None:
        """Begin and observe the next episode of the masked worlds, shape ``(nworld,)``, bool."""
        env = self._env
        ready = self._write(mask)
        if not ready:
            self.start(mask)
        env.command_delay.reset(mask)
        for manager in (env.action_manager, env.termination_manager, env.reward_manager):
            manager.reset(mask)
        env.success.masked_fill_(mask, False)
        if env.success_term is not None:
            env.success_term.reset(mask)
        if not (ready and self._observed):
            in_one_pass(partial(env.observation_manager.refresh, mask))

    def start(self, mask: Tensor) -> None:
        """Put the masked worlds at their next start, from seed, world and episode alone."""
        env = self._env
        env.episode += mask
        env.episode_step.masked_fill_(mask, 0)
        env.reset_manager.reset(mask)
        env.sim.kinematics(mask)

    def _write(self, mask: Tensor) -> bool:
        """What `start` does and what is observed then, unless too many worlds end."""
        if not self._rows:
            return False
        env = self._env
        worlds = np.flatnonzero(mask.numpy())
        if 8 * len(worlds) > env.nworld:  # nothing would be gained
            return False
        episode = env.episode.numpy()
        if (self._episodes[worlds] != episode[worlds] + 1).any():
            self._make_all()
        env.sim.keep_peaks(mask)
        for array, starts in zip(self._rows, self._starts, strict=True):
            array[worlds] = starts[worlds]
        episode[worlds] += 1
        env.episode_step.masked_fill_(mask, 0)
        return True

    def _make_all(self) -> None:
        env = self._env
        counters = (env.episode, env.episode_step, env.action, env.previous_action)
        arrays = [*self._rows, *map(Tensor.numpy, counters)]
        aside = [array.copy() for array in arrays]
        everywhere = torch.ones(env.nworld, dtype=torch.bool)
        try:
            self.start(everywhere)
            if self._observed:
                env.action_manager.reset(everywhere)
                in_one_pass(partial(env.observation_manager.refresh, everywhere))
            self._episodes = env.episode.numpy().copy()
            self._starts = [array.copy() for array in self._rows]
        finally:
            for array, values in zip(arrays, aside, strict=True):
                array[:] = values
