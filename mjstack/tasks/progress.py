"""Reward in stages for tasks in which objects are carried to their goals."""

import torch
from torch import Tensor

from mjstack.config.fields import Fraction, Positive
from mjstack.errors import ConfigError
from mjstack.managers.view import EnvView, ignores_success
from mjstack.math import norm
from mjstack.mdp.observation import grasp_point_pos
from mjstack.tasks.check import make_check

STAGES = ("reach", "lift", "carry", "place", "release")
BELOW = 0.005  # m below its goal that an object over it may be: contacts are soft


@ignores_success
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
    may start anywhere. Along an expert's episode the stage never falls.
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
        self._check = make_check(env.cfg)
        self._view = self._check.view(env)
        names = list(self._check.goals(self._view.step()))
        if not names:
            expected = "a check with goals, which this reward follows"
            raise ConfigError("task.check.func", type(self._check).__name__, expected)
        self._columns = self._view.columns(names)
        self._within = within
        self._height = height
        self._near = near
        # Ranges of the stages: those measured by a distance first (reach, carry, place), then lift
        # and release. An open_fraction of 0 takes any opening.
        constant = self._view.constant
        self._ranges = constant(scale, scale, scale, height, max(open_fraction, 1e-6))
        self._number = constant(0.0, 2.0, 3.0, 1.0, 4.0)

    def __call__(self, env: EnvView) -> Tensor:
        """The reward, shape ``(nworld,)``."""
        step = self._view.step()
        read = self._columns.read
        pos = read(step.pos)
        goals = list(self._check.goals(step).values())
        goal = torch.stack(goals, dim=1) if len(goals) > 1 else goals[0][:, None]
        low = read(step.height)
        in_hand = read(step.in_hand)
        placed = read(self._check.placed(step))

        # Which stages each object has got to
        offset = pos - goal
        above = offset[..., 2]
        away = norm(pos - grasp_point_pos(env).float()[:, None])
        across = norm(offset[..., :2])
        grasped = in_hand & (away <= self._within)
        lifted = grasped & (low >= self._height)
        over = (across <= self._near) & (above >= -BELOW)
        reached = torch.stack((torch.ones_like(lifted), lifted, over, grasped, placed), dim=-1)

        # How far it has got in each: the last one that it has got to is worth most
        opening = step.narrowest.expand_as(low)
        done = torch.stack((away, across, above.abs(), low, opening), dim=-1) / self._ranges
        near = 1.0 - torch.tanh(done[..., :3])
        worth = torch.cat((near, done[..., 3:].clamp(0.0, 1.0)), dim=-1) + self._number
        value = (worth * reached).amax(-1) / len(STAGES)
        if len(goals) == 1:
            return value[:, 0]

        # One object after the other
        finished = (placed & ~in_hand)[:, :-1]
        value[:, :-1].masked_fill_(finished, 1.0)
        value[:, 1:].mul_(finished.cumprod(1))
        return value.mean(1)
