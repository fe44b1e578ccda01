"""How far jaws have to roll, to a face of an object or with one in them, from the state alone."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from mjstack.drivers.feedback import STAY, FeedbackDriver
from mjstack.managers.view import EnvView
from mjstack.math import atan2

_UPRIGHT = 1e-3  # horizontal part of an approach axis that points straight down


class TurningDriver(FeedbackDriver):
    """Base class of a driver without a clock that turns its jaws."""

    def __init__(self, env: EnvView, nominal: np.ndarray) -> None:
        """Allocate for the environment's worlds; arguments and errors as of `FeedbackDriver`."""
        super().__init__(env, nominal, clock=False)
        self._quarters = 0.5 * math.pi * torch.arange(4, device=env.device)[:, None]

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
