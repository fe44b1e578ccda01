"""Managers: actions, observations, resets, terminations and rewards as named terms over all worlds
at once.
"""

import mjstack.report.gl  # noqa: F401  (before mujoco)
from mjstack.managers.action import ActionManager, ActionTerm
from mjstack.managers.episode import (
    ResetManager,
    RewardManager,
    TerminationManager,
    required_fields,
)
from mjstack.managers.observation import ObservationManager
from mjstack.managers.view import (
    EnvView,
    episode_draw,
    offers,
    random_uniform,
    uses_fields,
)

__all__ = [
    "ActionManager",
    "ActionTerm",
    "EnvView",
    "ObservationManager",
    "ResetManager",
    "RewardManager",
    "TerminationManager",
    "episode_draw",
    "offers",
    "random_uniform",
    "required_fields",
    "uses_fields",
]
