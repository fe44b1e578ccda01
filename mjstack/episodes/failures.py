"""Where an episode goes wrong: the first sign of failure of every world, kept on the device."""

from enum import IntEnum

import torch
from torch import Tensor

from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.rollout import Observer
from mjstack.math import not_finite
from mjstack.sim.simulation import LOST_PHYSICS

GONE_STEPS = 3  # in a row without load on both jaws: less may be a touch in passing


class Sign(IntEnum):
    """The first sign of failure. Of several in one step, the lowest number counts."""

    NONE = 0
    PHYSICS = 1
    EMPTY = 2
    DROPPED = 3
    MISSED = 4
    LEFT = 5


_TEXTS = (  # of each sign
    "no sign before the result",
    "physics lost",
    "grasp empty at the last try",
    "held object lost its load",
    "not in place when let go",
    "left its place",
)


def describe_sign(sign: int, phase: str) -> str:
    """A sign in words, with the phase's name if there is one."""
    return f"{phase}: {_TEXTS[sign]}" if phase else _TEXTS[sign]


class FailureMonitor(Observer):
    """Records the first sign of failure in every world, with its phase and step.

    These are signs:

    - PHYSICS: the state is not finite, or a buffer overflowed.
    - EMPTY: a phase that grasps is over, both jaws did not press on its object in its last step,
      and the world goes on.
    - DROPPED: between that phase and the next opening of the gripper, both jaws have not pressed on
      the object for three steps.
    - MISSED: an object's release, the first phase after the last one that carries it, is over, and
      the object is not where it belongs. Objects that no phase carries have none.
    - LEFT: later, an object that was where it belongs is so no more. That may be in a phase of
      another object.

    A grasp that is tried again is no sign. A sign need not lead to failure, nor has every failure
    one: objects that are in place but move break their rule alone.

    Attributes:
        sign: Number of the `Sign`, shape ``(nworld,)``, int64.
        phase: Number of the phase in which it was seen, -1 without one or without phases, shape
            ``(nworld,)``, int64.
        step: The step in whose end it was seen, -1 without one, shape ``(nworld,)``, int64; where a
            phase ended with it, the first one after that phase.
    """

    def start(self, env: Env, driver: Driver) -> None:
        """Read what belongs where, and allocate for the environment's worlds."""
        super().start(env, driver)
        device = env.device
        self._check = env.check
        # Numbers of objects are the check's. Without phases there is one, which moves nothing.
        names = list(env.cfg.scene.objects)
        column = {
            names.index(name): column_number
            for column_number, name in enumerate(self._check.objects)
        }
        grasped = [column.get(phase.grasped, -1) for phase in driver.phases] or [-1]
        carried = [column.get(phase.carried, -1) for phase in driver.phases] or [-1]
        # The phase that lets go of each object last; one that never comes for what is not carried
        last = {column_number: number for number, column_number in enumerate(carried)}
        released = [
            last.get(column_number, len(carried) - 1) + 1 for column_number in column.values()
        ]
        self._grasped = torch.tensor(grasped, device=device)
        self._carried = torch.tensor(carried, device=device)
        self._release = torch.tensor(released, device=device)
        self.sign = torch.zeros(env.nworld, dtype=torch.int64, device=device)
        self.phase = torch.full_like(self.sign, -1)
        self.step = torch.full_like(self.sign, -1)
        self._count = torch.zeros_like(self.sign[:1])
        self._at = torch.zeros_like(self.sign)
        self._gone = torch.zeros_like(self.sign)
        self._loaded = self.sign.new_zeros((env.nworld, len(released)), dtype=torch.bool)
        self._placed = torch.zeros_like(self._loaded)

    def update(self) -> None:
        """Process the end of a step. Fixed shapes, no host read."""
        sim = self.env.sim
        phase = self.driver.phase
        loaded = self.env.state.in_hand
        placed = self.env.state.value(self._check.placed)

        lost = not_finite(sim.qpos, sim.qvel) | ((sim.overflow & LOST_PHYSICS) != 0)
        entered = phase > self._at
        grasped = self._grasped.index_select(0, self._at)
        empty = entered & (grasped >= 0) & ~_column_of(self._loaded, grasped)
        carried = self._carried.index_select(0, phase)
        self._gone.add_(1).mul_((carried >= 0) & ~_column_of(loaded, carried))
        dropped = self._gone >= GONE_STEPS
        missed = entered & ((self._at[:, None] == self._release) & ~self._placed).any(1)
        left = ((phase[:, None] > self._release) & self._placed & ~placed).any(1)

        seen = torch.zeros_like(self.sign)
        seen.masked_fill_(left, Sign.LEFT)
        seen.masked_fill_(missed, Sign.MISSED)
        seen.masked_fill_(dropped, Sign.DROPPED)
        seen.masked_fill_(empty, Sign.EMPTY)
        seen.masked_fill_(lost, Sign.PHYSICS)
        first = (self.sign == 0) & (seen > 0)
        ended = (seen == Sign.EMPTY) | (seen == Sign.MISSED)  # what the phase before has left
        self.sign.copy_(torch.where(first, seen, self.sign))
        if self.driver.phases:
            self.phase.copy_(torch.where(first, torch.where(ended, self._at, phase), self.phase))
        self.step.copy_(torch.where(first, self._count, self.step))
        self._at.copy_(phase)
        self._loaded.copy_(loaded)
        self._placed.copy_(placed)
        self._count += 1


def _column_of(table: Tensor, column: Tensor) -> Tensor:
    """Each world's column, shape ``(nworld,)``; the first one where there is none (-1)."""
    if not table.shape[1]:  # the task is about no object
        return torch.zeros_like(column, dtype=torch.bool)
    return table.gather(1, column.clamp(min=0)[:, None])[:, 0]
