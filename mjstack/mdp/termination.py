"""Termination terms: functions or classes that return ``(nworld,)`` bool."""

import math

import torch
from torch import Tensor

from mjstack.config.fields import Count, NotNegative
from mjstack.managers.state import lost_state
from mjstack.managers.view import EnvView, offers
from mjstack.math import constant
from mjstack.mdp.geometry import robot, zeros
from mjstack.mdp.observation import joint_pos
from mjstack.sim import LOST_PHYSICS
from mjstack.sim.simulation import Columns


@offers(reads="state")
def time_out(env: EnvView, *, steps: Count) -> Tensor:
    """After this many steps."""
    return env.episode_step >= steps


def success(env: EnvView) -> Tensor:
    """Once the task is achieved."""
    return env.success


def _outside(values: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Whether one of a world's values is outside its range, shape ``(nworld,)``, bool."""
    # Mostly none is, and the host sees it at once; NaN equals nothing
    if not values.is_cuda and torch.equal(values.clamp(low, high), values):
        return torch.zeros(len(values), dtype=torch.bool)
    return ((values < low) | (values > high)).any(1)


@offers(reads="state")
class ObjectOffTable:
    """When an object's centre is beside the table or below its top."""

    def __init__(self, env: EnvView) -> None:
        scene = env.cfg.scene
        x, y, _ = scene.table_half
        triples = ([*scene.table_center[:2], 0.0], [-x, -y, scene.table_top], [x, y, math.inf])
        numbers = [constant(three * len(scene.free), env.sim.qpos) for three in triples]
        self._center, self._low, self._high = numbers
        columns = [first + axis for first in env.index.object_qpos for axis in range(3)]
        self._columns = Columns(columns, env.device)

    def __call__(self, env: EnvView) -> Tensor:
        """True for worlds with an object off the table, shape ``(nworld,)``."""
        at = env.sim.part("qpos", self._columns)
        return _outside(at - self._center, self._low, self._high)


@offers(reads="state")
class JointLimit:
    """When a joint of the robot is outside its range by more than a part of it: MuJoCo's limits are
    soft.
    """

    def __init__(self, env: EnvView, *, margin: NotNegative) -> None:
        """Read the ranges.

        Args:
            env: The environment.
            margin: How far outside is too far, as a fraction of each joint's range.
        """
        limits = robot(env).range
        room = margin * (limits[:, 1] - limits[:, 0])
        self._low = limits[:, 0] - room
        self._high = limits[:, 1] + room

    def __call__(self, env: EnvView) -> Tensor:
        """True for worlds with a joint outside, shape ``(nworld,)``."""
        read, off = joint_pos(env), zeros(env)
        return _outside(read if off is None else read + off.to(read), self._low, self._high)


@offers(ends_on="non_finite", reads="state")
def non_finite(env: EnvView) -> Tensor:
    """When a position or velocity is NaN or infinite: such a world cannot go on."""
    return lost_state(env).clone()  # which is not to be written into


@offers(ends_on="overflow", reads="state")
def overflow(env: EnvView) -> Tensor:
    """When a buffer of the world was too small, so that physics was lost."""
    return (env.sim.overflow & LOST_PHYSICS) != 0
