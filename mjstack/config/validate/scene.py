"""Checks the scene: what stands where, on the table and apart."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

from mjstack.config.schema import SHAPES, BoxCfg, Config, ObjectCfg, SceneCfg
from mjstack.config.validate.values import length
from mjstack.errors import ConfigError

_TAKEN = ("world", "floor", "table")


def check_scene(cfg: Config) -> None:
    """Table, objects and places, and the box if there is one."""
    scene = cfg.scene
    for name, thing in scene.objects.items():
        _object(scene, name, thing)
    for name, place in scene.places.items():
        key = f"scene.places.{name}"
        if name in scene.objects:
            raise ConfigError(key, name, "a name that no object has")
        _on_table(scene, f"{key}.xy", place.xy, place.random_xy, "place")
    for (one, first), (other, second) in itertools.combinations(scene.objects.items(), 2):
        if not math.dist(first.xy, second.xy) >= first.footprint + second.footprint:
            raise ConfigError(
                f"scene.objects.{one}.xy",
                first.xy,
                f"a position clear of {other}, which is at {second.xy}",
            )
    if scene.box is not None:
        _box(scene, scene.box)


def _object(scene: SceneCfg, name: str, thing: ObjectCfg) -> None:
    key = f"scene.objects.{name}"
    if name in _TAKEN or "/" in name:
        raise ConfigError(key, name, f"a name other than {', '.join(_TAKEN)}, without a slash")
    length(f"{key}.size", thing.size, SHAPES[thing.shape])
    edge = min(thing.size[:2]) if thing.shape == "box" else thing.footprint
    _on_table(scene, f"{key}.xy", thing.xy, (edge, edge), "object")


def _on_table(scene: SceneCfg, key: str, xy: list[float], edge: Sequence[float], what: str) -> None:
    for axis in (0, 1):
        reach = scene.table_half[axis] - edge[axis]
        low = scene.table_center[axis] - reach
        high = scene.table_center[axis] + reach
        if not abs(xy[axis] - scene.table_center[axis]) <= reach:
            raise ConfigError(
                key,
                xy,
                f"{'xy'[axis]} within [{low:.3f}, {high:.3f}] m, so that the {what} is on the"
                " table",
            )


def _box(scene: SceneCfg, box: BoxCfg) -> None:
    if not box.height > box.floor:
        raise ConfigError(
            "scene.box.height", box.height, f"more than the floor's thickness, {box.floor:g} m"
        )
    for key in ("floor_solref", "wall_solref"):
        first, second = getattr(box, key)
        if not (min(first, second) > 0.0 or max(first, second) < 0.0):
            expected = (
                "a time constant [s] and a damping ratio, or stiffness and damping as two negative"
                " numbers"
            )
            raise ConfigError(f"scene.box.{key}", getattr(box, key), expected)
    outer = [half + box.wall for half in box.half]
    for axis in (0, 1):
        if (
            not abs(box.center[axis] - scene.table_center[axis]) + outer[axis]
            <= scene.table_half[axis] + 1e-9
        ):
            raise ConfigError(
                "scene.box.center", box.center, "a box that is on the table with all its walls"
            )
    for name, thing in scene.objects.items():
        if not any(abs(thing.xy[i] - box.center[i]) >= outer[i] + thing.size[0] for i in (0, 1)):
            raise ConfigError(f"scene.objects.{name}.xy", thing.xy, "a position beside the box")
    for name, place in scene.places.items():
        if all(abs(place.xy[i] - box.center[i]) < outer[i] for i in (0, 1)) and not all(
            abs(place.xy[i] - box.center[i]) + place.random_xy[i] < box.half[i] for i in (0, 1)
        ):
            raise ConfigError(f"scene.places.{name}.xy", place.xy, "a position off the walls")
