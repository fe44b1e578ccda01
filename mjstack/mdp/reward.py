"""Reward terms: functions of the environment that return ``(nworld,)``, mostly between 0 and 1."""

import torch
from torch import Tensor

from mjstack.config.fields import Positive
from mjstack.managers.view import EnvView, offers
from mjstack.math import norm
from mjstack.mdp import observation
from mjstack.mdp.geometry import above_table


@offers(reads="state")
def reach(env: EnvView, *, object: str, scale: Positive, height: float = 0.0) -> Tensor:
    """Nearness of the grasp point to a point above an object: ``1 - tanh(distance / scale)``.

    Args:
        env: The environment.
        object: Scene object.
        scale: Distance over which the reward falls [m].
        height: How far above the object's centre the point is [m].
    """
    offset = observation.grasp_point_to_object(env, object=object, height=height)
    return 1.0 - torch.tanh(norm(offset) / scale)


@offers(reads="state")
def lift(env: EnvView, *, object: str, height: Positive) -> Tensor:
    """Height of an object's lowest point above the table as a fraction of ``height`` [m], from 0 to
    1.
    """
    return (above_table(env, object) / height).clamp(0.0, 1.0)


def success(env: EnvView) -> Tensor:
    """1 in a step in which the task is achieved."""
    return env.success.to(torch.float32)


@offers(reads="state")
def action_rate(env: EnvView) -> Tensor:
    """Squared change of the action since the last step, summed."""
    return (env.action - env.previous_action).square().sum(1)


@offers(reads="state")
def joint_vel(env: EnvView) -> Tensor:
    """Squared joint velocities [rad^2/s^2], summed."""
    return observation.joint_vel(env).square().sum(1)
