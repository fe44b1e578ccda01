"""The phases of the scripted motion: when they are, and where the grasp point goes in each."""

from dataclasses import dataclass

import numpy as np

from mjstack.config.schema import Config, PhaseCfg, SceneCfg


@dataclass(frozen=True, slots=True)
class Target:
    """Where a phase brings the grasp point."""

    source: int  # number of its anchor among `source_names`
    # Number of the source towards which the offset's x axis points; the anchor itself for world x
    toward: int
    offset: tuple[float, float]  # along that axis and to its left [m]
    z: float  # height [m]
    above: float  # over the anchor's centre, or over the table where a place is the anchor [m]


@dataclass(frozen=True, slots=True)
class Phase:
    """A phase of the scripted motion."""

    name: str
    start: int  # its first step in the episode
    stop: int  # the first step after it
    spec: PhaseCfg
    target: Target | None  # None where the last target holds
    grasped: int  # number of the object that it grasps, or -1
    carried: int  # number of the object that is in the hand all through it, or -1
    width: float | None  # to which the jaws close [m]; None for an open gripper


def source_names(scene: SceneCfg) -> list[str]:
    """Names of all that a phase can have as its anchor: the objects, then the places."""
    return [*scene.objects, *scene.places]


def nominal_xy(scene: SceneCfg) -> np.ndarray:
    """Nominal position of every source [m], shape ``(sources, 2)``."""
    sources = scene.objects | scene.places
    return np.array([source.xy for source in sources.values()]).reshape(-1, 2)


def build_phases(cfg: Config) -> list[Phase]:
    """The controller's phases laid out over the episode's steps.

    An object that was put onto another one is as high as that makes it in the phases that follow.
    """
    scene = cfg.scene
    sources = source_names(scene)
    bottom = dict.fromkeys(sources, 0.0)  # above the table, when a phase begins
    for name, thing in scene.objects.items():
        if thing.pos is not None:
            bottom[name] = thing.pos[2] - thing.half_height - scene.table_top
    halves = {name: thing.half_height for name, thing in scene.objects.items()}
    phases: list[Phase] = []
    start = 0
    load = ""  # the object that was grasped last
    in_hand = False
    rest = 0.0  # height above the table at which the last target would leave it
    for name, spec in cfg.controller.phases.items():
        if spec.gripper == "open" and in_hand:
            bottom[load] = rest
            in_hand = False
        target = None
        if spec.anchor is not None:
            half = halves.get(spec.anchor, 0.0)  # a place has none
            centre = bottom[spec.anchor] + half
            up = 0.0 if spec.level == "table" else centre
            rest = 0.0
            if spec.level == "on_top":
                rest = up + half
                up = rest + halves[load]
            x, y, rise = spec.offset
            grip = scene.grasp_offset if spec.in_hand else 0.0
            above = spec.h_scale * cfg.robot.approach_height + rise + grip
            source = sources.index(spec.anchor)
            toward = sources.index(spec.toward or spec.anchor)
            z = scene.table_top + up + above
            target = Target(source, toward, (x, y), z, up + above - centre)
        stop = start + round(spec.seconds / cfg.timing.step_dt)
        grasped = -1 if spec.grasps is None else sources.index(spec.grasps)
        carried = sources.index(load) if in_hand and spec.grasps is None else -1
        if spec.grasps is not None:
            load = spec.grasps
            in_hand = True
        width = spec.width
        if width is None:
            width = scene.objects[load].grip_width if in_hand else cfg.robot.closed_width or 0.0
        width = width if spec.gripper == "closed" else None
        phases.append(Phase(name, start, stop, spec, target, grasped, carried, width))
        start = stop
    return phases


def target_xy(target: Target, sources: np.ndarray) -> np.ndarray:
    """Where a target is, from where all sources are [m], shape ``(..., sources, 2)``; shape
    ``(..., 2)``.
    """
    at = sources[..., target.source, :]
    along, left = target.offset
    away = sources[..., target.toward, :] - at
    angle = np.arctan2(away[..., 1], away[..., 0])
    cos = np.cos(angle)
    sin = np.sin(angle)
    return at + np.stack((along * cos - left * sin, along * sin + left * cos), axis=-1)


def object_targets(cfg: Config) -> dict[str, list[tuple[Phase, Target]]]:
    """Phases to each free object, in order; each height, offset and opening once."""
    out: dict[str, dict[tuple, tuple[Phase, Target]]] = {name: {} for name in cfg.scene.free}
    names = source_names(cfg.scene)
    for phase in build_phases(cfg):
        target = phase.target
        if target is not None and (thing := names[target.source]) in out:
            key = (round(target.z, 6), phase.width, target.offset, target.toward)
            out[thing].setdefault(key, (phase, target))
    return {name: list(targets.values()) for name, targets in out.items()}
