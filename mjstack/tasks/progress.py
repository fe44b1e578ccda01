"""Reward in stages for tasks in which objects are carried to their goals."""

from functools import partial
from math import inf

import torch
from torch import Tensor

from mjstack.config.fields import Fraction, Positive
from mjstack.errors import ConfigError
from mjstack.managers.state import branches
from mjstack.managers.view import EnvView, offers
from mjstack.math import norm
from mjstack.mdp.observation import grasp_point_pos

STAGES = ("reach", "lift", "carry", "place", "release")
SUPPORT_GAP = 0.005  # m below its goal that an object over it may be: contacts are soft


@offers(reads="state")
class Progress:
    """Progress of a task whose check has `EpisodeCheck.goals`, from 0 to 1.

    Every object goes through five stages, which measured predicates unlock:

    - reach: grows as the grasp point gets nearer;
    - lift, once all jaws press on the object and the grasp point is ``within`` its centre: grows
      with the height of its lowest point, up to ``height``;
    - carry, once it is held that high: grows as it gets nearer to its goal horizontally;
    - place, once it is ``near`` its goal horizontally, and not below it: grows as it comes down;
    - release, once it is where it belongs (`EpisodeCheck.placed`): grows with the measured opening
      of the gripper, up to ``open_fraction``.

    Each is worth a fifth, so every state of a later stage is worth more than any of an earlier one.
    An object that is where it belongs and not in the hand is done, and the next one's stages begin;
    the mean over the objects is returned. It is a function of the state alone, so that an episode
    may start anywhere. Along an expert's episode the stage never falls. A state that is not finite
    has no defined reward.
    """

    def __init__(
        self,
        env: EnvView,
        *,
        scale: Positive = 0.2,
        within: Positive = 0.02,
        height: Positive = 0.04,
        near: Positive = 0.03,
        open_fraction: Fraction = 0.8,
    ) -> None:
        """Take the thresholds.

        Args:
            env: The environment.
            scale: Distance over which nearness falls, ``1 - tanh(distance / scale)`` [m].
            within: Largest distance of the grasp point from the centre of an object in the hand
                [m]. Closed jaws that press on the top of a cube are farther away.
            height: How high an object is lifted before it is carried [m].
            near: Largest horizontal distance from the goal at which an object is lowered [m].
            open_fraction: Share of the gripper's opening at which the last object is let go.

        Raises:
            MjstackError: The task has no check, or one without goals.
        """
        self._check = env.check
        self._state = env.state
        names = list(self._check.goals(self._state))
        if not names:
            expected = "a check with goals, which this reward follows"
            raise ConfigError("task.check.func", type(self._check).__name__, expected)
        self._columns = self._state.columns(names)
        # Of away, across, above, low and opening, see `_measure`: the range over which each counts
        # (an open_fraction of 0 takes any opening), the number of the stage that it measures, and
        # from where to where it unlocks stages.
        constant = self._state.constant
        self._ranges = constant(scale, scale, scale, height, max(open_fraction, 1e-6))
        self._nearest = constant(1.0)
        self._number = constant(0.0, 2.0, 3.0, 1.0, 4.0)
        self._least = constant(-inf, -inf, -SUPPORT_GAP, height, -inf)
        self._most = constant(within, near, inf, inf, inf)
        # Conditions of each of these stages. Any opening will do, so the first has none.
        distance, offset_xy, offset_z, low, opening, in_hand, placed = range(7)
        conditions = [[opening] * 3, [in_hand, distance, low], [offset_xy, offset_z, offset_z]]
        conditions += [[in_hand, distance, distance], [placed] * 3]
        self._conditions = torch.tensor(conditions, device=env.device).flatten()

    def __call__(self, env: EnvView) -> Tensor:
        """The reward, shape ``(nworld,)``."""
        works = (self._measure, partial(self._state.value, self._check.placed))
        (measured, in_hand), placed = branches(env.device, *works)
        placed = self._columns.read(placed)

        # Which stages each object has got to
        within = measured.clamp(self._least, self._most) == measured
        predicates = torch.cat((within, in_hand[..., None], placed[..., None]), dim=-1)
        reached = predicates.index_select(-1, self._conditions).unflatten(-1, (5, 3)).all(-1)

        # How far it has got in each: the last one that it has got to is worth most
        worth = measured / self._ranges
        nearness = worth[..., :3]
        torch.sub(self._nearest, nearness.abs_().tanh_(), out=nearness)
        worth.clamp_(0.0, 1.0).add_(self._number).mul_(reached)
        value = worth.amax(-1) / len(STAGES)
        if value.shape[1] == 1:
            return value[:, 0]

        # One object after the other
        finished = (placed & ~in_hand)[:, :-1]
        value[:, :-1].masked_fill_(finished, 1.0)
        value[:, 1:].mul_(finished.cumprod(1))
        return value.mean(1)

    def _measure(self) -> tuple[Tensor, Tensor]:
        """Of each object its distance from the grasp point, that from its goal horizontally and
        upwards, the height of its lowest point [m], and the gripper's opening, shape ``(nworld,
        objects, 5)``; and whether it is in the hand, shape ``(nworld, objects)``.
        """
        step = self._state
        pos = self._columns.read(step.pos)
        goals = list(self._check.goals(step).values())
        offset = pos - (torch.stack(goals, dim=1) if len(goals) > 1 else goals[0][:, None])
        distance = norm(pos - grasp_point_pos(step.env).float()[:, None])
        low = self._columns.read(step.height)
        opening = step.narrowest.expand_as(low)
        measures = (distance, norm(offset[..., :2]), offset[..., 2], low, opening)
        return torch.stack(measures, dim=-1), self._columns.read(step.in_hand)
