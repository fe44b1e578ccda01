"""How episodes begin; on native MuJoCo the starts of all worlds are made at once."""

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mjstack.managers.term import in_one_pass
from mjstack.sim.native import NativeSimulation

if TYPE_CHECKING:
    from mjstack.envs.env import Env


class _Ready(NamedTuple):
    """The next start of every world, and what it follows from; arrays have a row for each world."""

    seed: int
    inputs: list[np.ndarray]  # copies of `Starts._inputs` at the time
    rows: list[np.ndarray]  # what goes into `Starts._rows`


class Starts:
    """Begins episodes of an environment.

    On native MuJoCo a start takes Python as long in one world as in some hundred. So the first
    world that needs one has those of all worlds made and observed, while the worlds' state is put
    aside; a world that ends gets its own copied. Terms that are not `repeatable` are called when a
    world ends.
    """

    def __init__(self, env: "Env") -> None:
        """Take the environment, which may have no managers but for resets yet."""
        self._env = env
        self._rows: list[np.ndarray] = []

    def forget(self) -> None:
        """Have all starts made anew, by the managers that there are now."""
        env = self._env
        ahead, self._observed = (
            all(term.repeatable for term in manager.terms)
            for manager in (env.reset_manager, env.observation_manager)
        )
        self._rows = []
        if ahead and isinstance(env.sim, NativeSimulation):
            observed = env.observation_manager.buffers if self._observed else ()
            self._rows = [*env.sim.rows, *map(Tensor.numpy, observed)]
        inputs = (env.episode, env.world, *env.sim.fields.values()) if self._rows else ()
        self._inputs = [*map(Tensor.numpy, inputs)]
        self._ready: _Ready | None = None

    def begin(self, mask: Tensor) -> None:
        """Begin and observe the next episode of the masked worlds, shape ``(nworld,)``, bool."""
        env = self._env
        written = self._write(mask)
        if not written:
            self.start(mask)
        env.command_delay.reset(mask)
        for manager in (env.action_manager, env.termination_manager, env.reward_manager):
            manager.reset(mask)
        env.success.masked_fill_(mask, False)
        if env.success_term is not None:
            env.success_term.reset(mask)
        if not (written and self._observed):
            in_one_pass(partial(env.observation_manager.refresh, mask))

    def start(self, mask: Tensor) -> None:
        """Put the masked worlds at their next start, from seed, world and episode alone."""
        env = self._env
        env.episode += mask
        env.episode_step.masked_fill_(mask, 0)
        env.reset_manager.reset(mask)
        env.sim.kinematics(mask)

    def _write(self, mask: Tensor) -> bool:
        """Copy the starts of the masked worlds. Returns False, and changes nothing, where terms
        have to be called: so many worlds end that nothing would be gained, or none.
        """
        if not self._rows:
            return False
        env = self._env
        worlds = np.flatnonzero(mask.numpy())
        if not 0 < 8 * len(worlds) <= env.nworld:
            return False
        rows = worlds if len(worlds) > 1 else worlds[0]  # a number is read ten times faster
        ready = self._ready
        if (
            ready is None
            or ready.seed != env.seed
            or any(
                (now[rows] != before[rows]).any()
                for now, before in zip(self._inputs, ready.inputs, strict=True)
            )
        ):
            self._ready = ready = self._make_all()
        env.sim.keep_peaks(mask)
        for array, starts in zip(self._rows, ready.rows, strict=True):
            array[rows] = starts[rows]
        env.episode += mask
        env.episode_step.masked_fill_(mask, 0)
        return True

    def _make_all(self) -> _Ready:
        """The next start of every world; the worlds are then where they were."""
        env = self._env
        counters = (env.episode, env.episode_step, env.success, env.action, env.previous_action)
        arrays = [*self._rows, *map(Tensor.numpy, counters)]
        aside = [array.copy() for array in arrays]
        inputs = [array.copy() for array in self._inputs]
        everywhere = torch.ones(env.nworld, dtype=torch.bool)
        try:
            self.start(everywhere)
            env.action_manager.reset(everywhere)
            env.success.zero_()
            if self._observed:
                in_one_pass(partial(env.observation_manager.refresh, everywhere))
            return _Ready(env.seed, inputs, [array.copy() for array in self._rows])
        finally:
            for array, values in zip(arrays, aside, strict=True):
                array[:] = values
