"""The scene: a table, objects and places on it, and perhaps a box."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from mjstack.config.fields import spec

SHAPES = {"box": 3, "cylinder": 2, "sphere": 1, "capsule": 2}  # and how many sizes each has


def _friction() -> list[float]:
    return [1.0, 0.005, 0.0005]


@dataclass(kw_only=True, slots=True)
class BoxCfg:
    """A receiving box on the table: a floor and four walls around it, fixed to the world."""

    center: list[float] = spec(unit="m", length=2)
    """x and y of the centre of its inside."""
    half: list[float] = spec(unit="m", length=2, gt=0.0)
    """Half sizes of its inside in x and y."""
    floor: float = spec(unit="m", gt=0.0)
    """Thickness of the floor."""
    wall: float = spec(unit="m", gt=0.0)
    """Thickness of the walls."""
    height: float = spec(unit="m", gt=0.0)
    """Height of the rim above the table."""
    friction: list[float] = spec(length=3, gt=0.0)
    """Sliding, torsional and rolling coefficient."""
    floor_solref: list[float] = spec(length=2)
    """Contact parameters of the floor: time constant [s] and damping ratio, or, negative,
    stiffness and damping.
    """
    wall_solref: list[float] = spec(length=2)
    """Contact parameters of the walls."""


@dataclass(kw_only=True, slots=True)
class ObjectCfg:
    """An object that stands on the table at the start."""

    shape: str = spec("box", choices=tuple(SHAPES))
    """box, cylinder (upright), sphere, or capsule (lying along its own x axis)."""
    size: list[float] = spec(unit="m", gt=0.0)
    """Half sizes of a box; radius of a sphere; radius and half length of the others."""
    mass: float = spec(unit="kg", gt=0.0)
    """Mass."""
    friction: list[float] = spec(factory=_friction, length=3, gt=0.0)
    """Sliding, torsional and rolling coefficient."""
    color: list[float] = spec(factory=lambda: [0.6, 0.6, 0.6, 1.0], length=4, ge=0.0, le=1.0)
    """Red, green, blue and alpha, 0 to 1."""
    xy: list[float] = spec(unit="m", length=2)
    """Nominal position of its centre."""
    fixed: bool = False
    """Whether it is fixed to the world."""

    @property
    def half(self) -> list[float]:
        """Half sizes of the box along its own axes that holds it [m]."""
        if self.shape == "box":
            return self.size
        radius = self.size[0]
        if self.shape == "capsule":
            return [sum(self.size), radius, radius]
        return [radius, radius, self.size[-1]]

    @property
    def half_height(self) -> float:
        """Height of the centre above what it stands on [m]."""
        return self.half[2]

    @property
    def footprint(self) -> float:
        """Radius of the disc that it covers at any yaw [m]."""
        if self.shape == "box":
            return math.hypot(1.0, self.size[1] / self.size[0]) * self.size[0]
        return sum(self.size) if self.shape == "capsule" else self.size[0]

    @property
    def radius(self) -> float:
        """Radius of the sphere around its centre that holds it [m]."""
        if self.shape == "capsule":
            return sum(self.size)
        return math.hypot(*(half / self.size[0] for half in self.size)) * self.size[0]


@dataclass(kw_only=True, slots=True)
class PlaceCfg:
    """A named spot on the table."""

    xy: list[float] = spec(unit="m", length=2)
    """Its position, or the centre of the region from which it is drawn."""
    random_xy: list[float] = spec(factory=lambda: [0.0, 0.0], unit="m", length=2, ge=0.0)
    """Half-widths of the region from which each episode draws it; 0: always at ``xy``."""


@dataclass(kw_only=True, slots=True)
class SceneCfg:
    """A table, objects and places on it, and perhaps a box."""

    name: str = spec()
    """Its name, which selects the robot's ``placements``."""
    table_center: list[float] = spec(unit="m", length=3)
    """Centre of the table, a box."""
    table_half: list[float] = spec(unit="m", length=3, gt=0.0)
    """Half sizes of the table."""
    table_friction: list[float] = spec(factory=_friction, length=3, gt=0.0)
    """Sliding, torsional and rolling coefficient of the table."""
    random_xy: list[float] = spec(factory=lambda: [0.03, 0.03], unit="m", length=2, ge=0.0)
    """How far ``reset=randomized`` moves each object off its ``xy``, plus or minus."""
    objects: dict[str, ObjectCfg] = field(default_factory=dict)
    """Objects by name, in the order in which everything lists them."""
    places: dict[str, PlaceCfg] = field(default_factory=dict)
    """Named spots on the table."""
    support_sensors: bool = False
    """Whether sensors measure what presses on each object beside the jaws."""
    box: BoxCfg | None = None
    """A receiving box."""
    grasp_offset: float = spec(0.0, unit="m")
    """How far above an object's centre the grasp point is for phases ``in_hand``."""

    @property
    def free(self) -> dict[str, ObjectCfg]:
        """The objects that move."""
        return {name: thing for name, thing in self.objects.items() if not thing.fixed}
