"""Checks the scene: what stands where, on the table and apart."""

from __future__ import annotations

import math

from mjstack.config.schema import BoxCfg, Config, SceneCfg
from mjstack.config.validate.values import length, not_negative, positive
from mjstack.errors import ConfigError


def check_scene(cfg: Config) -> None:
    """Table and cubes, and the box if there is one."""
    scene = cfg.scene
    for key, size in (
        ("table_center", 3),
        ("table_half", 3),
        ("table_friction", 3),
        ("cube_friction", 3),
    ):
        length(f"scene.{key}", getattr(scene, key), size)
    positive("scene.cube_half", scene.cube_half, "m")
    positive("scene.cube_mass", scene.cube_mass, "kg")
    for key in ("table_half", "table_friction", "cube_friction"):
        for number in getattr(scene, key):
            positive(f"scene.{key}", number)
    for key in ("red_xy", "blue_xy"):
        value = getattr(scene, key)
        length(f"scene.{key}", value, 2)
        for axis in (0, 1):
            reach = scene.table_half[axis] - scene.cube_half
            if not abs(value[axis] - scene.table_center[axis]) <= reach:
                low = scene.table_center[axis] - reach
                high = scene.table_center[axis] + reach
                raise ConfigError(
                    f"scene.{key}",
                    value,
                    f"{'xy'[axis]} within [{low:.3f}, {high:.3f}] m, so that the cube is on the"
                    " table",
                )
    length("scene.random_xy", scene.random_xy, 2)
    for number in scene.random_xy:
        not_negative("scene.random_xy", number, "m")
    apart = math.dist(scene.red_xy, scene.blue_xy)
    if not apart >= 2.0 * math.sqrt(2.0) * scene.cube_half:
        raise ConfigError(
            "scene.red_xy",
            scene.red_xy,
            f"a cube that does not touch the blue one at {scene.blue_xy}",
        )
    if scene.box is not None:
        _box(scene, scene.box)


def _box(scene: SceneCfg, box: BoxCfg) -> None:
    for key, size in (
        ("center", 2),
        ("half", 2),
        ("friction", 3),
        ("floor_solref", 2),
        ("wall_solref", 2),
    ):
        length(f"scene.box.{key}", getattr(box, key), size)
    for name in ("floor", "wall", "height"):
        positive(f"scene.box.{name}", getattr(box, name), "m")
    for key in ("half", "friction"):
        for number in getattr(box, key):
            positive(f"scene.box.{key}", number)
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
    for key in ("red_xy", "blue_xy"):
        xy = getattr(scene, key)
        if not any(abs(xy[i] - box.center[i]) >= outer[i] + scene.cube_half for i in (0, 1)):
            raise ConfigError(f"scene.{key}", xy, "a cube beside the box")
    for key in ("red_slot", "blue_slot"):
        slot = getattr(scene, key)
        length(f"scene.{key}", slot or [], 2)
        if not all(abs(slot[i] - box.center[i]) <= box.half[i] - scene.cube_half for i in (0, 1)):
            raise ConfigError(f"scene.{key}", slot, "a place in the box")
