"""The next thing to do, and how far jaws have to roll for it, from the state alone."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mjstack.drivers.feedback import STAY, FeedbackDriver, State
from mjstack.managers.view import EnvView
from mjstack.math import atan2, norm

_UPRIGHT = 1e-3  # horizontal part of an approach axis that points straight down


class Due(NamedTuple):
    """The next thing to do in each world: the number of the move and of its object; from its centre
    to the grasp point that moves it; whether the jaws push, and whether the object is grasped or
    being pushed; whether it is led along with the grasp point; whether jaws close on it, let go of
    it, and whether all is done; whether the gripper is beside an object that was let go of.
    """

    move: Tensor
    object: Tensor
    offset: Tensor
    pushes: Tensor
    grasped: Tensor
    led: Tensor
    closes: Tensor
    opens: Tensor
    over: Tensor
    beside: Tensor


class TurningDriver(FeedbackDriver):
    """Base class of a driver without a clock that turns its jaws."""

    def __init__(self, env: EnvView, nominal: np.ndarray) -> None:
        """Allocate for the environment's worlds; arguments and errors as of `FeedbackDriver`."""
        super().__init__(env, nominal, clock=False)
        self._quarters = 0.5 * math.pi * torch.arange(4, device=env.device)[:, None]

    def _turn_left(self, state: State, due: Due, aligns: Tensor, phase: Tensor) -> Tensor:
        """How far the open jaws have to roll to the nearer face of an object [rad], shape
        ``(nworld,)``; where it has no faces or is pushed, to where they are locked. Where a phase
        aligns, how far with the object in them.
        """
        if not self._aligns:
            return torch.zeros_like(state.opening)
        yaw = self._seen[self._worlds, due.object, 2]
        axes = (state.closing, state.approach)
        turn = self._jaw_turn(state.q, axes, yaw, due.object)
        locked = self._nominal[0, self._roll_column] - state.q[:, self._roll_column]
        turn = torch.where(self._has_faces[due.object] & ~due.pushes, turn, locked)
        return torch.where(aligns, self._held_turn(state.q, phase, due.object), turn)

    def _jaw_turn(self, q: Tensor, axes: Sequence[Tensor], yaw: Tensor, number: Tensor) -> Tensor:
        """How far the jaws of an arm at ``q`` have to roll to the nearest face of an object [rad],
        ``(nworld,)``, by closing and approach axis, the object's yaw and its number.
        """
        # The closing axis at a roll of zero: horizontal. The way from there to a face is the same
        # at any roll. So the face that is chosen is still the nearer one after the next step.
        closing, approach = axes
        x, y, z = approach.unbind(1)
        level = torch.where(torch.hypot(x, y) > _UPRIGHT, atan2(x, -y), 0.0)
        axis = torch.stack((torch.cos(level), torch.sin(level), torch.zeros_like(z)), dim=1)
        side = torch.linalg.cross(approach, axis)
        now = atan2((closing * side).sum(1), (closing * axis).sum(1))
        faces = (yaw - level) + self._quarters
        turns = atan2(-torch.sin(faces), torch.cos(faces) * (-z).clamp(min=0.2)) - now
        return self._nearest_turn(q, turns, number, self._cfg.controller.yaw_alignment)

    def _held_turn(self, q: Tensor, phase: Tensor, number: Tensor) -> Tensor:
        """How far the jaws have to roll until the object that they hold, of this number, lies along
        a face of the phase's anchor [rad], ``(nworld,)``; 0 where it has no faces.
        """
        yaw = self._planar()[self._worlds, number, 2]
        off = yaw - self._last_seen(self._source, phase)[:, 2]
        return self._nearest_turn(q, off + self._quarters, number, 1.0) * self._has_faces[number]

    def _nearest_turn(self, q: Tensor, turns: Tensor, number: Tensor, share: float) -> Tensor:
        """The turn that leads to the nearer face within the joint's range, of four seen from below,
        shape ``(4, nworld)``: an oblong object has two. So much of it as ``share`` says.
        """
        roll = q[:, self._roll_column] - self._nominal[0, self._roll_column]
        oblong = self._oblong[number]
        rolls = roll - self._roll_sign * atan2(torch.sin(turns), torch.cos(turns))
        cost = (rolls - STAY * roll).abs() + self._beyond(rolls)
        cost += oblong * self._detour(rolls, roll)
        cost[1::2].masked_fill_(oblong, math.inf)
        goal = rolls.gather(0, cost.argmin(0, keepdim=True))[0]
        return torch.where(oblong, 1.0, share) * goal - roll


def directions(begins: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vectors of ways, zero where they have no length, and their lengths."""
    way = ends - begins
    length = norm(way)
    return way / length.clamp(min=1e-6)[..., None], length
