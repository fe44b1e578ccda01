"""Faults of a world while it is stepped: latched on the device until the host reads them."""

from typing import TYPE_CHECKING

import numpy as np
import torch

from mjstack.config.functions import offered
from mjstack.errors import FaultError, name_worlds
from mjstack.managers.state import lost_state
from mjstack.math import all_finite, not_finite
from mjstack.sim import LOST_PHYSICS, BatchSizes, Overflow, Simulation, describe_overflow

if TYPE_CHECKING:
    from mjstack.envs.env import Env

POOL = int(Overflow.BROADPHASE | Overflow.NARROWPHASE)
_HUGE = 1e18  # an action whose square may be more than a float32 holds
FAULT_WINDOW = 200  # steps between two reads of the faults on CUDA; on the CPU each step reads
NO_KEY = "Simplify the model, or run sim=native"


# Each fault and what to do, in the order in which `FaultLatch.record` stacks them.
_FIXES = {
    "actions were not finite": "Check the policy, and the starts that reset terms make",
    "the state is not finite": "Lower the gains or the timestep, or add the termination non_finite",
    "the reward is not finite": "Correct the term",
    "an observation is not finite": "Correct the term",
}


class FaultLatch:
    """Keeps the faults of every world of an environment until it is cleared."""

    def __init__(self, env: "Env", *, check: bool) -> None:
        """Allocate for an environment whose managers are there; ``check`` says whether faults of
        its steps are recorded.
        """
        self._env = env
        self._check = check
        self._steps = 0
        self._any = False  # latched since `clear`, on the CPU
        n = env.nworld
        self._faults = torch.zeros((n, len(_FIXES)), dtype=torch.bool, device=env.device)
        self._reward = torch.zeros(n, device=env.device)  # NaN if one was not finite
        self._overflow = torch.zeros(n, dtype=torch.int32, device=env.device)
        self._none = env.sim.no_worlds
        ends_on = {offered(term.func, "ends_on") for term in env.cfg.termination.values()}
        # A world's own overflow may end its episode; that of the shared pool voids the whole batch.
        self._lost = POOL if "overflow" in ends_on else LOST_PHYSICS
        self._state_ends = "non_finite" in ends_on

    def look(self) -> None:
        """Record the faults of a step and raise the first, on the CPU; a short look at all numbers
        shows that there are none.
        """
        if self._reward.is_cuda or not self._check:
            return
        env = self._env
        numbers = (env.reward_manager.reward, *env.observation_manager.groups.values())
        fine = not self._any and lost_state(env) is self._none and all_finite(*numbers)
        if not fine or bool(env.sim.overflow.any()):
            self.record()
            self.record_reward()
            self.raise_first()

    def after_step(self) -> None:
        """Now and then raise what CUDA has recorded."""
        self._steps += 1
        if self._check and self._faults.is_cuda and self._steps % FAULT_WINDOW == 0:
            self.raise_first()

    def record(self) -> None:
        """Add the faults of a step except for its reward's, before a reset can erase them."""
        if not self._check:
            return
        env = self._env
        self._any = True
        self._overflow |= env.sim.overflow & self._lost
        groups = env.observation_manager.groups.values()
        seen = not_finite(*groups) if groups else self._none
        lost = lost_state(env)
        state = self._none if self._state_ends else lost
        # In a world that is broken the observation adds nothing: True is more than False
        faults = (env.action_manager.not_finite(), state, self._none, seen > lost)
        self._faults |= torch.stack(faults, dim=1)

    def record_reward(self) -> None:
        """Add the fault of a step's reward; may be beside `record`."""
        if self._check:  # 0 times what is not finite is NaN
            self._reward.add_(self._env.reward_manager.reward, alpha=0.0)

    def clear(self) -> None:
        """Clear every fault."""
        self._any = False
        self._faults.zero_()
        self._reward.zero_()
        self._overflow.zero_()

    def raise_first(self) -> None:
        """Read the faults from the device, and wait for it.

        Raises:
            FaultError: Something went wrong; names the worlds and what to do.
        """
        self._faults[:, 2] = self._reward != 0.0
        if not bool(self._faults.any() | (self._overflow != 0).any()):
            return
        env = self._env
        if bool(self._overflow.any()):
            what, keys = describe_loss(self._overflow.cpu().numpy(), env.sim.sizes)
            raise FaultError(what, _capacity_hint(env.sim, keys))
        for column, (what, fix) in enumerate(_FIXES.items()):
            worlds = self._faults[:, column].nonzero()[:, 0].tolist()
            if worlds:
                terms = self._terms(what, worlds[0])
                culprits = f", from {', '.join(terms)}" if terms else ""
                action = env.action[worlds[0]].abs().tolist()
                if largest := max(filter(_HUGE.__lt__, action), default=0.0):
                    culprits += f", after an action of {largest:.3g}"
                    fix = _FIXES["actions were not finite"]
                numbers = env.world[torch.tensor(worlds, device=env.device)].tolist()
                raise FaultError(f"{what} in {name_worlds(numbers, env.nworld)}{culprits}", fix)

    def _terms(self, what: str, world: int) -> list[str]:
        """Names of the terms behind a number that is not finite, as far as their last values
        tell.
        """
        if "reward" in what:
            rewards = self._env.reward_manager
            pairs = zip(rewards.names, rewards.values[world].isfinite().tolist(), strict=True)
            return [f"reward.{name}" for name, is_finite in pairs if not is_finite]
        observations = self._env.observation_manager
        return observations.not_finite_terms(world) if "observation" in what else []


def describe_loss(overflow: np.ndarray, sizes: BatchSizes | None) -> tuple[str, list[str]]:
    """Which buffers overflowed in which worlds, and the keys to raise; empty if none did. Takes
    bits of `Overflow` of each world, shape ``(nworld,)``, and the room there was, if it is fixed.
    """
    bits = int(np.bitwise_or.reduce(overflow))
    if not bits:
        return "", []
    # By default convex pairs have as much room as contacts.
    convex = "nconmax" if sizes is None or sizes.nccdmax is None else "nccdmax"
    by_key = {"njmax": Overflow.NEFC | Overflow.NJMAX_NNZ, "nconmax": POOL}
    by_key[convex] = by_key.get(convex, 0) | Overflow.CCD
    worlds = np.flatnonzero(overflow).tolist()
    what = f"{describe_overflow(bits)} overflow in {name_worlds(worlds, len(overflow))}"
    return what, [key for key, flags in by_key.items() if bits & flags]


def _capacity_hint(sim: Simulation, keys: list[str]) -> str:
    """How much to raise the sizes of overflowed buffers."""
    if not keys:
        return NO_KEY
    sizes = ", ".join(f"{key}={getattr(sim.sizes, key)}" for key in keys)
    peak = f"; up to {int(sim.peak_constraints.max())} rows were needed" if "njmax" in keys else ""
    pool = sim.peak_pool
    if "nconmax" in keys and pool is not None:
        most = max(pool.tolist())
        peak += f"; all worlds together needed {most}, {-(-most // sim.nworld)} per world"
    return f"Raise {' and '.join(f'batch.{key}' for key in keys)} ({sizes}{peak})"
