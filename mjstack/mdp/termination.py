"""Termination terms: functions or classes that return ``(nworld,)`` bool."""

import math

from torch import Tensor

from mjstack.config.fields import Count, NotNegative
from mjstack.managers.view import EnvView, ignores_success, offers
from mjstack.mdp.geometry import lost_state, robot
from mjstack.mdp.observation import joint_pos, positions
from mjstack.sim import LOST_PHYSICS


@ignores_success
def time_out(env: EnvView, *, steps: Count) -> Tensor:
    """After this many steps."""
    return env.episode_step >= steps


def success(env: EnvView) -> Tensor:
    """Once the task is achieved."""
    return env.success


@ignores_success
class ObjectOffTable:
    """When an object's centre is beside the table or below its top."""

    def __init__(self, env: EnvView) -> None:
        scene = env.cfg.scene
        x, y, _ = scene.table_half
        constant = env.index.constant
        self._center = constant([*scene.table_center[:2], 0.0], env.sim.qpos)
        self._low = constant([-x, -y, scene.table_top], env.sim.qpos)
        self._high = constant([x, y, math.inf], env.sim.qpos)

    def __call__(self, env: EnvView) -> Tensor:
        """True for worlds with an object off the table, shape ``(nworld,)``."""
        offset = positions(env).unflatten(1, (-1, 3)) - self._center
        return ((offset < self._low) | (offset > self._high)).flatten(1).any(1)


@ignores_success
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
        q = joint_pos(env)
        return ((q < self._low) | (q > self._high)).any(1)


@ignores_success
@offers(ends_on="non_finite")
def non_finite(env: EnvView) -> Tensor:
    """When a position or velocity is NaN or infinite: such a world cannot go on."""
    return lost_state(env)


@ignores_success
@offers(ends_on="overflow")
def overflow(env: EnvView) -> Tensor:
    """When a buffer of the world was too small, so that physics was lost."""
    return (env.sim.overflow & LOST_PHYSICS) != 0
