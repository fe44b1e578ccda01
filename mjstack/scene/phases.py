"""The phases of the scripted motion: when they are, and where the grasp point goes in each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjstack.config.schema import Config, SceneCfg
from mjstack.scene.build import table_top


@dataclass(frozen=True, slots=True)
class Phase:
    """A phase as steps ``start`` to ``stop`` (exclusive) of the episode."""

    name: str
    start: int
    stop: int


@dataclass(frozen=True, slots=True)
class Target:
    """Where a phase brings the grasp point.

    Attributes:
        source: Number of its anchor among `source_names`.
        toward: Number of the source towards which the offset's x axis points; -1 for world x.
        offset: Along that axis and to its left [m].
        z: Height [m].
    """

    source: int
    toward: int
    offset: tuple[float, float]
    z: float


@dataclass(frozen=True, slots=True)
class ObjectTarget:
    """Where a phase brings the grasp point at an object that stands on the table.

    Attributes:
        phase: The first phase that does.
        height: Above the object's centre [m].
        gripper: ``open`` or ``closed``.
        target: The target.
    """

    phase: str
    height: float
    gripper: str
    target: Target


def build_phases(cfg: Config) -> list[Phase]:
    """The controller's phases laid out over the episode's steps."""
    phases = []
    start = 0
    for name, phase in cfg.controller.phases.items():
        stop = start + round(phase.seconds / cfg.timing.step_dt)
        phases.append(Phase(name, start, stop))
        start = stop
    return phases


def source_names(scene: SceneCfg) -> list[str]:
    """Names of all that a phase can have as its anchor: the objects, then the places."""
    return [*scene.objects, *scene.places]


def nominal_xy(scene: SceneCfg) -> np.ndarray:
    """Nominal position of every source [m], shape ``(sources, 2)``."""
    objects = [thing.xy for thing in scene.objects.values()]
    return np.array([*objects, *(place.xy for place in scene.places.values())]).reshape(-1, 2)


def build_targets(cfg: Config) -> dict[str, Target | None]:
    """The target of every phase; None where the last target holds.

    An object that was put onto another one is as high as that makes it in the phases that follow.
    """
    scene = cfg.scene
    sources = source_names(scene)
    bottom = dict.fromkeys(sources, 0.0)  # above the table, when a phase begins
    targets: dict[str, Target | None] = {}
    held = ""  # the object that was grasped last
    in_hand = False
    rest = 0.0  # height above the table at which the last target would leave it
    for name, spec in cfg.controller.phases.items():
        if spec.gripper == "open" and in_hand:
            bottom[held] = rest
            in_hand = False
        targets[name] = None
        if spec.anchor is not None:
            thing = scene.objects.get(spec.anchor)
            half = thing.half_height if thing is not None else 0.0
            up = 0.0 if spec.level == "table" else bottom[spec.anchor] + half
            rest = 0.0
            if spec.level == "on_top":
                rest = up + half
                up = rest + scene.objects[held].half_height
            above = (
                spec.h_scale * cfg.robot.approach_height
                + spec.offset[2]
                + (scene.grasp_offset if spec.in_hand else 0.0)
            )
            toward = -1 if spec.toward is None else sources.index(spec.toward)
            offset = (spec.offset[0], spec.offset[1])
            z = table_top(scene) + up + above
            targets[name] = Target(sources.index(spec.anchor), toward, offset, z)
        if spec.grasps is not None:
            held = spec.grasps
            in_hand = True
    return targets


def target_xy(target: Target, sources: np.ndarray) -> np.ndarray:
    """Where a target is, from where all sources are [m], shape ``(..., sources, 2)``; shape
    ``(..., 2)``.
    """
    at = sources[..., target.source, :]
    along, left = target.offset
    if target.toward < 0:
        return at + target.offset
    away = sources[..., target.toward, :] - at
    angle = np.arctan2(away[..., 1], away[..., 0])
    cos = np.cos(angle)
    sin = np.sin(angle)
    return at + np.stack((along * cos - left * sin, along * sin + left * cos), axis=-1)


def object_targets(cfg: Config) -> dict[str, list[ObjectTarget]]:
    """What the phases ask of the position of each free object, in their order; each height, offset
    and opening once.
    """
    found: dict[str, dict[tuple, ObjectTarget]] = {name: {} for name in cfg.scene.free}
    names = source_names(cfg.scene)
    for name, target in build_targets(cfg).items():
        if target is None or names[target.source] not in found:
            continue
        thing = names[target.source]
        gripper = cfg.controller.phases[name].gripper
        center = table_top(cfg.scene) + cfg.scene.objects[thing].half_height
        height = target.z - center
        key = (round(height, 6), gripper, target.offset, target.toward)
        found[thing].setdefault(key, ObjectTarget(name, height, gripper, target))
    return {name: list(targets.values()) for name, targets in found.items()}


def grasped_objects(cfg: Config) -> list[int]:
    """Number of the object that each phase grasps, or -1."""
    numbers = {name: number for number, name in enumerate(cfg.scene.objects)}
    return [numbers.get(spec.grasps or "", -1) for spec in cfg.controller.phases.values()]


def carried_objects(cfg: Config) -> list[int]:
    """Number of the object that is in the hand all through each phase, or -1."""
    out = []
    held = -1
    for spec, grasped in zip(cfg.controller.phases.values(), grasped_objects(cfg), strict=True):
        if spec.gripper == "open":
            held = -1
        out.append(held if grasped < 0 else -1)
        if grasped >= 0:
            held = grasped
    return out
