"""What goes wrong in a world while it is stepped: latched on the device, and told to
whoever looks.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum

import torch

from mjstack.config.schema import TerminationTermCfg
from mjstack.errors import FaultError, name_worlds
from mjstack.managers.action import ActionManager
from mjstack.managers.observation import ObservationManager
from mjstack.managers.reward import RewardManager
from mjstack.managers.term import resolve_func
from mjstack.math import not_finite
from mjstack.sim import LOST_PHYSICS, Overflow, Simulation, describe_overflow

_POOL = int(Overflow.BROADPHASE | Overflow.NARROWPHASE)


class Fault(Enum):
    """What went wrong in a world, latched until the host looks; in the order in which
    `FaultLatch.record` stacks them.
    """

    ACTION = "actions were not finite"
    STATE = "the state is not finite"
    REWARD = "the reward is not finite"
    OBSERVATION = "an observation is not finite"


_FIXES = {
    Fault.ACTION: "Check what the policy returns",
    Fault.STATE: "Lower the gains or the timestep, or add the termination non_finite",
    Fault.REWARD: "Correct the term",
    Fault.OBSERVATION: "Correct the term",
}


class FaultLatch:
    """Keeps the faults of every world of an environment until it is cleared."""

    def __init__(
        self,
        sim: Simulation,
        actions: ActionManager,
        rewards: RewardManager,
        observations: ObservationManager,
        termination: Mapping[str, TerminationTermCfg],
    ) -> None:
        """Allocate for the worlds of a simulation, whose managers are there."""
        self._sim = sim
        self._actions = actions
        self._rewards = rewards
        self._observations = observations
        self._faults = torch.zeros((sim.nworld, len(Fault)), dtype=torch.bool, device=sim.device)
        self._overflow = torch.zeros(sim.nworld, dtype=torch.int32, device=sim.device)
        self._none = torch.zeros(sim.nworld, dtype=torch.bool, device=sim.device)
        funcs = [resolve_func(f"termination.{n}", cfg.func) for n, cfg in termination.items()]
        ends_on = {getattr(func, "ends_on", None) for func in funcs}
        # A world's own overflow may end its episode; that of the shared pool voids the whole batch.
        self._lost = _POOL if "overflow" in ends_on else LOST_PHYSICS
        self._state_ends = "non_finite" in ends_on

    def record(self, broken: torch.Tensor) -> None:
        """Add the faults of a step, before a reset can erase them.

        Args:
            broken: Worlds whose state is not finite, shape ``(nworld,)``, bool.
        """
        self._overflow |= self._sim.overflow & self._lost
        bad_action = self._actions.not_finite
        reward = self._rewards.reward
        groups = self._observations.groups.values()
        seen = not_finite(*groups) if groups else self._none
        state = self._none if self._state_ends else broken
        self._faults |= torch.stack((bad_action, state, reward * 0.0 != 0.0, seen & ~broken), dim=1)
        bad_action.zero_()

    def clear(self) -> None:
        """Clear every fault."""
        self._faults.zero_()
        self._overflow.zero_()

    def raise_first(self) -> None:
        """Read the faults from the device, and wait for it.

        Raises:
            FaultError: Something went wrong; names the worlds and what to do.
        """
        if not bool(self._faults.any() | (self._overflow != 0).any()):
            return
        nworld = self._sim.nworld
        overflow = self._overflow.tolist()
        lost = [w for w, bits in enumerate(overflow) if bits]
        if lost:
            bits = 0
            for w in lost:
                bits |= overflow[w]
            what = f"{describe_overflow(bits)} overflow in {name_worlds(lost, nworld)}"
            raise FaultError(what, _capacity_hint(self._sim, bits))
        for column, fault in enumerate(Fault):
            worlds = self._faults[:, column].nonzero()[:, 0].tolist()
            if worlds:
                where = f"{name_worlds(worlds, nworld)}{self._culprits(fault, worlds[0])}"
                raise FaultError(f"{fault.value} in {where}", _FIXES[fault])

    def _culprits(self, fault: Fault, world: int) -> str:
        """Names the terms behind a number that is not finite, as far as their last values tell."""
        rewards = self._rewards
        if fault is Fault.REWARD:
            bad = ~torch.isfinite(rewards.values[world])
            names = [n for n, is_bad in zip(rewards.names, bad.tolist(), strict=True) if is_bad]
            return f", from reward.{', reward.'.join(names)}" if names else ""
        if fault is Fault.OBSERVATION:
            terms = self._observations.not_finite_terms(world)
            return f", from {', '.join(terms)}" if terms else ""
        return ""


def count_start(sim: Simulation) -> bool:
    """Counts the contacts of a full start, which MJWarp's pool must hold before the first step.
    Waits for the device.

    Returns:
        Whether the state was computed with for it: native MuJoCo has no such pool.

    Raises:
        FaultError: The start does not fit.
    """
    sizes = sim.sizes
    pool = sim.peak_pool
    if sizes is None or pool is None:
        return False
    pool.zero_()  # it has the peak of everything before
    sim.forward()
    used = max(pool.tolist())
    room = sizes.contact_pool(sim.nworld)
    if used > room:
        key, value = (
            ("naconmax", sizes.naconmax)
            if sizes.naconmax is not None
            else ("nconmax", sizes.nconmax)
        )
        per_world = -(-used // sim.nworld)
        need = used if sizes.naconmax is not None else per_world
        raise FaultError(
            f"batch.{key}={value}: the start of {sim.nworld} worlds needs at least {used} contacts"
            f" and collision pairs ({per_world} per world), and there is room for {room}",
            f"Raise it to more than batch.{key}={need}, or choose a reset with fewer contacts",
        )
    return True


def _capacity_hint(sim: Simulation, bits: int) -> str:
    """What to raise for some overflow bits."""
    sizes = sim.sizes
    pool = sim.peak_pool
    # The pools' own sizes take precedence where they are set.
    contacts = "nconmax" if getattr(sizes, "naconmax", None) is None else "naconmax"
    convex = "nccdmax" if getattr(sizes, "naccdmax", None) is None else "naccdmax"
    by_key = {"njmax": Overflow.NEFC | Overflow.NJMAX_NNZ, contacts: _POOL, convex: Overflow.CCD}
    keys = [key for key, flags in by_key.items() if bits & flags]
    if not keys:
        return "Simplify the model, or use sim=native"
    held = ", ".join(f"{key}={getattr(sizes, key, None)}" for key in keys)
    peak = f"; up to {int(sim.peak_constraints.max())} rows were needed" if "njmax" in keys else ""
    if contacts in keys and pool is not None:
        most = max(pool.tolist())
        peak += f"; all worlds together needed {most}, {-(-most // sim.nworld)} per world"
    return f"Raise {' and '.join(f'batch.{key}' for key in keys)} ({held}{peak})"
