"""The phases of the scripted motion: when they are, and where the grasp point goes in each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mjstack.config.schema import Config, PhaseCfg, SceneCfg
from mjstack.errors import ConfigError

RED = 0
BLUE = 1
FIXED = 2
_NUMBERS = {"red": RED, "blue": BLUE, None: -1}


@dataclass(frozen=True, slots=True)
class Phase:
    """A phase as steps ``start`` to ``stop`` (exclusive) of the episode."""

    name: str
    start: int
    stop: int


@dataclass(frozen=True, slots=True)
class Anchor:
    """What a phase's target counts from.

    Attributes:
        source: ``RED`` or ``BLUE``, where x and y are those of a cube, or ``FIXED``.
        xy: The fixed place [m]; for a cube, zero.
        z: Height [m].
    """

    source: int
    xy: tuple[float, float]
    z: float


@dataclass(frozen=True, slots=True)
class CubeTarget:
    """Where a phase brings the grasp point above a cube that stands on the table.

    Attributes:
        phase: The first phase that does.
        height: Above the cube's centre [m].
        gripper: ``open`` or ``closed``.
    """

    phase: str
    height: float
    gripper: str


def build_phases(cfg: Config) -> list[Phase]:
    """The controller's phases laid out over the episode's steps."""
    phases = []
    start = 0
    for name, phase in cfg.controller.phases.items():
        stop = start + round(phase.seconds / cfg.timing.step_dt)
        phases.append(Phase(name, start, stop))
        start = stop
    return phases


def build_anchors(scene: SceneCfg) -> dict[str, Anchor]:
    """The anchors of a scene, by the name that a phase uses.

    ``red``, ``blue``: a cube's centre. ``on_blue``: red's centre once it is stacked. ``over_red``,
    ``over_blue``: the table's surface where a cube stands. ``red_slot``, ``blue_slot``: the table's
    surface under a cube's place in the box.
    """
    top = scene.table_center[2] + scene.table_half[2]
    half = scene.cube_half
    anchors = {
        "red": Anchor(RED, (0.0, 0.0), top + half),
        "blue": Anchor(BLUE, (0.0, 0.0), top + half),
        "on_blue": Anchor(BLUE, (0.0, 0.0), top + 3.0 * half),
        "over_red": Anchor(RED, (0.0, 0.0), top),
        "over_blue": Anchor(BLUE, (0.0, 0.0), top),
    }
    for name in ("red_slot", "blue_slot"):
        if (xy := getattr(scene, name)) is not None:
            anchors[name] = Anchor(FIXED, (xy[0], xy[1]), top)
    return anchors


def anchor_of(cfg: Config, phase: str) -> Anchor | None:
    """The anchor of a phase, its height being that of the phase's target; None where the last
    target holds.

    Raises:
        ConfigError: The scene has no such anchor.
    """
    spec = cfg.controller.phases[phase]
    anchors = build_anchors(cfg.scene)
    if spec.anchor is None:
        return None
    if spec.anchor not in anchors:
        expected = f"one of {', '.join(anchors)} (scene {cfg.scene.name})"
        raise ConfigError(f"controller.phases.{phase}.anchor", spec.anchor, expected)
    found = anchors[spec.anchor]
    above = (
        spec.h_scale * cfg.robot.approach_height
        + spec.offset
        + (cfg.scene.grasp_offset if spec.in_hand else 0.0)
    )
    return Anchor(found.source, found.xy, found.z + above)


def cube_targets(cfg: Config) -> tuple[list[CubeTarget], list[CubeTarget]]:
    """What the phases ask of the place of red, and of blue, in their order; each height and opening
    once.

    Raises:
        ConfigError: The scene lacks the anchor of a phase.
    """
    center = build_anchors(cfg.scene)["red"].z
    found: tuple[dict[tuple[float, str], CubeTarget], ...] = ({}, {})
    for name, spec in cfg.controller.phases.items():
        anchor = anchor_of(cfg, name)
        if anchor is not None and anchor.source in (RED, BLUE):
            target = CubeTarget(name, anchor.z - center, spec.gripper)
            found[anchor.source].setdefault((round(target.height, 6), spec.gripper), target)
    return list(found[RED].values()), list(found[BLUE].values())


def grasped_cubes(specs: Sequence[PhaseCfg]) -> list[int]:
    """Number of the cube that each phase grasps, or -1."""
    return [_NUMBERS[spec.grasps] for spec in specs]


def carried_cubes(specs: Sequence[PhaseCfg]) -> list[int]:
    """Number of the cube that is in the hand all through each phase, or -1."""
    out = []
    cube = -1
    for spec in specs:
        if spec.gripper == "open":
            cube = -1
        out.append(cube if spec.grasps is None else -1)
        if spec.grasps is not None:
            cube = _NUMBERS[spec.grasps]
    return out
