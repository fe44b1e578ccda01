"""The scene: table and cubes, and perhaps a box."""

from __future__ import annotations

from dataclasses import dataclass

from omegaconf import MISSING


@dataclass(kw_only=True, slots=True)
class BoxCfg:
    """A receiving box on the table: a floor and four walls, fixed to the world.

    ``center`` and ``half`` are of its inside, in x and y. Walls stand on the table around the
    floor; ``height`` is their rim's above the table.
    """

    center: list[float] = MISSING
    half: list[float] = MISSING
    floor: float = MISSING
    wall: float = MISSING
    height: float = MISSING
    friction: list[float] = MISSING
    floor_solref: list[float] = MISSING
    wall_solref: list[float] = MISSING


@dataclass(kw_only=True, slots=True)
class SceneCfg:
    """Table and cubes, and perhaps a box."""

    name: str = MISSING
    table_center: list[float] = MISSING
    table_half: list[float] = MISSING
    table_friction: list[float] = MISSING
    red_xy: list[float] = MISSING
    blue_xy: list[float] = MISSING
    random_xy: list[float] = MISSING
    cube_half: float = MISSING
    cube_mass: float = MISSING
    cube_friction: list[float] = MISSING
    # A box, the cubes' places in it, and how far above a cube's centre it is held.
    box: BoxCfg | None = None
    red_slot: list[float] | None = MISSING  # OmegaConf cannot merge an interpolation into null
    blue_slot: list[float] | None = MISSING
    grasp_offset: float = 0.0
