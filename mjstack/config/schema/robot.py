"""The robot: its description's source, its parts, and where a scene's objects stand for it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from omegaconf import MISSING


class ModelSource(Enum):
    """Where the robot description comes from."""

    builtin = "builtin"
    menagerie = "menagerie"


@dataclass(kw_only=True, slots=True)
class ModelCfg:
    """Source of the robot description."""

    source: ModelSource = MISSING


@dataclass(kw_only=True, slots=True)
class PlacementsCfg:
    """Where a scene's objects stand for one robot, and the buffer sizes its contacts need.

    ``random_xy`` is how far ``reset=randomized`` moves each cube off its place in x and y.
    ``nconmax`` and ``njmax`` are for the scripted task, ``env_nconmax`` and ``env_njmax`` for
    random actions. A scene with a box has a ``home`` of its own, clear of it.
    """

    table_center: list[float] = MISSING
    table_half: list[float] = MISSING
    red_xy: list[float] = MISSING
    blue_xy: list[float] = MISSING
    random_xy: list[float] = MISSING
    box_center: list[float] | None = None
    red_slot: list[float] | None = None
    blue_slot: list[float] | None = None
    grasp_offset: float = 0.0
    home: list[float] | None = None
    nconmax: int = MISSING
    njmax: int = MISSING
    env_nconmax: int = MISSING
    env_njmax: int = MISSING


@dataclass(kw_only=True, slots=True)
class RobotCfg:
    """An arm: names of its parts and the commands of the task.

    ``home`` is where the scripted task starts; ``start`` is clear of the table, for environments.
    ``finger_room`` is what the open jaws need around a cube.
    """

    name: str = MISSING
    title: str = MISSING
    menagerie_name: str = MISSING
    menagerie_file: str = MISSING
    arm_joints: list[str] = MISSING
    gripper_joints: list[str] = MISSING
    home: list[float] = MISSING
    start: list[float] = MISSING
    gripper_open: list[float] = MISSING
    gripper_closed: list[float] = MISSING
    ik_joints: list[str] = MISSING
    locked: dict[str, float] = MISSING
    arm_force_limit: float | None = None
    grasp_sites: list[str] = MISSING
    grasp_geoms: dict[str, list[str]] = field(default_factory=dict)
    grasp_bodies: dict[str, str] = field(default_factory=dict)
    approach_body: str = MISSING
    approach_axis: list[float] = MISSING
    jaw_bodies: list[str] = MISSING
    replace_collision: bool = False
    roll_joint: str = MISSING
    posture_gain: float = MISSING
    approach_gain: float = MISSING
    align: float = MISSING
    approach_height: float = MISSING
    finger_room: float = MISSING
    placements: dict[str, PlacementsCfg] = MISSING
