"""The task, and the scripted motion that does it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING

from mjstack.config.schema.term import TermCfg


@dataclass(kw_only=True, slots=True)
class TaskCfg:
    """What has to be achieved, sampled at step ends. The rules' thresholds are in `StackCheckCfg`
    and `BoxCheckCfg`.

    ``check`` names the subclass of ``EpisodeCheck`` that judges a scripted episode. ``instruction``
    says in words what is to be done, for datasets; null: the task's name.
    """

    name: str = MISSING
    instruction: str | None = None
    control_hz: float = MISSING
    episode_steps: int = MISSING
    goal_height: float = MISSING
    check: str = MISSING
    success: TermCfg | None = None


@dataclass(kw_only=True, slots=True)
class PhaseCfg:
    """One phase of the scripted grasp.

    ``anchor`` is one of `mjstack.scene.phases.build_anchors`, such as ``red`` (a cube's centre), or
    null (the last target holds). The target lies ``h_scale`` approach heights plus ``offset`` above
    it, and ``scene.grasp_offset`` too where the cube is ``in_hand``.

    The rest is for a controller that watches (``controller=closed_loop``): ``look`` measures the
    anchor's cube anew when the phase begins, ``grasps`` names the cube that both jaws must press on
    when it ends, and ``retry`` the phase to go back to if they do not.
    """

    anchor: str | None = None
    h_scale: float = 0.0
    offset: float = 0.0
    in_hand: bool = False
    gripper: str = MISSING
    seconds: float = MISSING
    look: bool = False
    grasps: str | None = None
    retry: str | None = None


@dataclass(kw_only=True, slots=True)
class ControllerCfg:
    """The scripted motion. Its commands go through the action terms of ``action``.

    ``knots``, ``ik_tolerance`` and ``ik_iterations`` are mink's, which plans. A controller that
    watches makes ``step_iterations`` of batched inverse kinematics per step; ``posture_gain`` pulls
    redundant joints to mink's nominal plan and ``approach_gain`` tilts the gripper as the cube's
    place needs it; ``align`` is the share by which the jaws turn towards a cube's nearest face; a
    retry may go up to ``hurry`` times as fast, and must be over ``rest_seconds`` before the window
    of rest.
    """

    name: str = MISSING
    action: dict[str, Any] = MISSING
    phases: dict[str, PhaseCfg] = MISSING
    knots: int = MISSING
    ik_tolerance: float = MISSING
    ik_iterations: int = MISSING
    step_iterations: int = MISSING
    posture_gain: float = MISSING
    approach_gain: float = MISSING
    align: float = MISSING
    hurry: float = MISSING
    rest_seconds: float = MISSING
