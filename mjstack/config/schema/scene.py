"""The scene: table, objects, places and cameras."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from operator import mul

from mjstack.config.fields import FITS, spec

SEEN = (*FITS, "images")  # what a policy sees
OUTPUTS = ("rgb", "depth", "segmentation")
_ROUND = (2, "radius and half length")
SHAPES = {  # and the sizes of each
    "box": (3, "half sizes"),
    "cylinder": _ROUND,
    "sphere": (1, "the radius"),
    "capsule": _ROUND,
}


@dataclass(slots=True)
class ShapeCfg:
    """A shape, its size, and how it is turned."""

    shape: str = spec("box", choices=tuple(SHAPES), changes=FITS)
    """box, cylinder (its length along its z axis), sphere, or capsule (along its x axis)."""
    size: list[float] = spec([], unit="m", ge=1e-4, le=10.0, changes=FITS)
    """Half sizes of a box; radius of a sphere; radius and half length of the others."""
    yaw: float = spec(0.0, unit="rad")
    """Turn about the vertical."""
    quat: list[float] | None = spec(None, length=4)
    """Orientation (w, x, y, z), in place of ``yaw``. [0.707, 0.707, 0, 0] lays a cylinder down."""

    @property
    def turned(self) -> list[float]:
        """Orientation, a unit quaternion."""
        if self.quat is None:
            return [math.cos(0.5 * self.yaw), 0.0, 0.0, math.sin(0.5 * self.yaw)]
        length = math.hypot(*self.quat)
        return [component / length for component in self.quat]

    @property
    def upright(self) -> bool:
        """Whether its z axis points up."""
        return self.quat is None or not any(self.quat[1:3])

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
        up = [abs(component) for component in self.axes[2]]
        if self.shape == "box":
            return sum(map(mul, up, self.size))
        radius = self.size[0]
        if self.shape == "cylinder":
            return radius * math.hypot(*up[:2]) + self.size[1] * up[2]
        return radius + (self.size[1] * up[0] if self.shape == "capsule" else 0.0)

    @property
    def footprint(self) -> float:
        """Radius of the disc that it covers at any yaw [m]."""
        if not self.upright:  # around a box that holds it, turned about its own axes alone
            corners = itertools.product(*((-half, half) for half in self.half))
            return max(math.hypot(*(sum(map(mul, r, at)) for r in self.axes[:2])) for at in corners)
        if self.shape == "box":
            return math.hypot(1.0, self.size[1] / self.size[0]) * self.size[0]
        return sum(self.size) if self.shape == "capsule" else self.size[0]

    @property
    def axes(self) -> list[list[float]]:
        """Rotation matrix: its columns are its own axes."""
        w, x, y, z = self.turned
        return [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]


@dataclass(slots=True)
class PartCfg(ShapeCfg):
    """A part of a fixed object."""

    pos: list[float] = spec([0.0, 0.0, 0.0], unit="m", length=3)
    """Its centre in the object's frame, whose origin stands on the table."""
    solref: list[float] | None = spec(None, length=2)
    """Contact parameters: time constant [s] and damping ratio, or, negative, stiffness and
    damping. null: MuJoCo's."""


@dataclass(slots=True)
class JointCfg:
    """A joint of a fixture, where it is to differ from the file's."""

    damping: float | None = spec(None, unit="N s/m, N m s/rad", ge=0.0, le=1e6)
    """Damping."""
    range: list[float] | None = spec(None, unit="m, rad", length=2)
    """Least and largest position."""


@dataclass(slots=True)
class ObjectCfg(ShapeCfg):
    """An object that stands on the table at the start, or is fixed to the world."""

    mass: float | None = spec(None, unit="kg", ge=1e-5, le=1000.0)
    """Mass. What is fixed needs none, and an MJCF file may have it."""
    density: float | None = spec(None, unit="kg/m3", ge=1e-3, le=1e5)
    """Density, in place of ``mass``."""
    friction: list[float] | None = spec(None, length=3, gt=0.0)
    """Sliding, torsional and rolling coefficient. null: the file's, or [1, 0.005, 0.0005]."""
    color: list[float] | None = spec(None, length=4, ge=0.0, le=1.0)
    """Red, green, blue and alpha, 0 to 1. null: the file's, or grey."""
    width: float | None = spec(None, unit="m", gt=0.0)
    """Width across the jaws that grasp it. null: its narrower side, seen from above."""
    xy: list[float] = spec([], unit="m")
    """Nominal position, standing on the table: of its centre, or a fixed file's origin."""
    pos: list[float] | None = spec(None, unit="m", length=3)
    """The same in x, y and z, in place of ``xy``: also over the table, fixed also beside it."""
    fixed: bool = False
    """Whether it is fixed to the world. Fixed objects may touch and overlap each other."""
    parts: dict[str, PartCfg] = spec({})
    """Shapes of a fixed object that has several, by name, in place of ``shape`` and ``size``."""
    file: str | None = None
    """Its MJCF file, or a mesh, in place of them: relative to the YAML that names it, or on the
    command line to the working folder.
    """
    joints: dict[str, JointCfg] = spec({})
    """Joints of a fixed object's file, by their names there."""

    @property
    def pieces(self) -> dict[str, PartCfg]:
        """Its shapes in its own frame, by the names of their geoms but for the object's."""
        if self.parts or self.file:
            return {f"_{name}": component for name, component in self.parts.items()}
        return {"": PartCfg(shape=self.shape, size=self.size)}

    @property
    def half_height(self) -> float:
        """Height of the centre above what it stands on [m], or of a fixed file's origin; 0 of one
        made of parts.
        """
        if self.file is None:
            return 0.0 if self.parts else super(ObjectCfg, self).half_height
        from mjstack.config.mjcf import measure  # loads mujoco

        solid = measure(self.file, fixed=self.fixed)
        up = self.axes[2]
        return -min(sum(map(mul, up, point)) for point in solid.points)

    @property
    def form(self) -> tuple[str, Sequence[float]]:
        """Shape and sizes, as of `lowest_point`: of a file's, points of its hull."""
        if self.file is None:
            return self.shape, self.size
        from mjstack.config.mjcf import measure

        return "hull", tuple(itertools.chain(*measure(self.file, fixed=self.fixed).points))

    @property
    def has_faces(self) -> bool:
        """Whether it matters how jaws that grasp it from above are turned."""
        return self.shape != "sphere" and not (self.shape == "cylinder" and self.upright)

    @property
    def level_axes(self) -> list[int]:
        """Numbers of its two most level axes as it starts, the narrower one first."""
        up = max(range(3), key=lambda k: abs(self.axes[2][k]))
        return sorted((k for k in range(3) if k != up), key=lambda k: self.half[k])

    @property
    def grip_width(self) -> float:
        """How wide it is across the jaws that grasp it from above [m]."""
        return self.width or 2.0 * self.half[self.level_axes[0]]

    @property
    def oblong(self) -> bool:
        """Whether jaws fit it across its narrower side alone, as it starts."""
        narrow, wide = (self.half[axis] for axis in self.level_axes)
        return wide - narrow > 1e-6

    @property
    def heading(self) -> tuple[int, float]:
        """Number of the axis whose heading is its yaw, and from there to the jaws' way [rad]."""
        if not self.oblong:
            return (0 if self.upright else self.level_axes[0]), 0.0
        narrow, wide = self.level_axes
        axis = 2 if self.shape == "cylinder" else wide  # it rolls about that one
        return axis, 0.0 if axis == narrow else 0.5 * math.pi

    @property
    def radius(self) -> float:
        """Radius of the sphere around its centre that holds it [m]."""
        if self.shape == "capsule":
            return sum(self.size)
        return math.hypot(*(half / self.size[0] for half in self.size)) * self.size[0]


@dataclass(slots=True)
class PlaceCfg:
    """A named spot on the table."""

    xy: list[float] = spec(unit="m", length=2)
    """Its position, or the centre of the region from which it is drawn."""
    random_xy: list[float] = spec([0.0, 0.0], unit="m", length=2, ge=0.0)
    """Half-widths of the region from which each episode draws it; 0: always at ``xy``."""


@dataclass(slots=True)
class CameraPoseCfg:
    """A camera's place, and the point it looks at, in the frame of what carries it."""

    mount: str = spec()
    """``table``: the middle of the table's top, with the world's axes. ``world``, or a body of the
    robot or the scene."""
    pos: list[float] = spec(unit="m", length=3)
    """Position of the camera."""
    target: list[float] = spec(unit="m", length=3)
    """The point in the middle of the image."""
    up: list[float] = spec([0.0, 0.0, 1.0], length=3)
    """The direction that points up in the image."""


@dataclass(slots=True)
class CameraCfg:
    """A camera, whose images are observations. Vertical field of view and size give its rays."""

    pose: CameraPoseCfg | None = spec(None, changes=SEEN)
    """Its pose. null: ``robot.wrist_camera``, on the gripper."""
    size: list[int] = spec([128, 128], unit="pixels", length=2, ge=1, le=4096, changes=SEEN)
    """Height and width of the image."""
    fovy: float = spec(45.0, unit="deg", ge=1.0, le=170.0, changes=SEEN)
    """Vertical field of view."""
    rate: float | None = spec(None, unit="Hz", gt=0.0)
    """Images per second. null: one in every control step."""
    outputs: list[str] = spec(["rgb"], choices=OUTPUTS)
    """Its observations: ``rgb`` colours, ``depth`` [m], ``segmentation`` numbers of things."""
    terminal: bool = False
    """Whether the last image of an episode is drawn too, for ``final_obs``."""


@dataclass(slots=True)
class SceneCfg:
    """A table, and objects and places on it."""

    name: str = spec(changes=("episodes", "images"))
    """Its name, which selects the robot's ``placements``."""
    table_center: list[float] = spec(unit="m", length=3)
    """Centre of the table, a box."""
    table_half: list[float] = spec(unit="m", length=3, gt=0.0)
    """Half sizes of the table."""
    frame: str = spec("world", choices=("world", "table"))
    """Where positions of objects and places count from: the world's origin, at which an arm stands
    by default, or the middle of the table's top. Loading turns them into the world's."""
    table_friction: list[float] = spec([1.0, 0.005, 0.0005], length=3, gt=0.0)
    """Sliding, torsional and rolling coefficient of the table."""
    random_xy: list[float] = spec([0.03, 0.03], unit="m", length=2, ge=0.0)
    """How far ``reset=randomized`` moves each object off its ``xy``, plus or minus."""
    objects: dict[str, ObjectCfg] = spec({})
    """Objects by name, in the order in which everything lists them."""
    places: dict[str, PlaceCfg] = spec({})
    """Named spots on the table."""
    support_sensors: bool = False
    """Whether sensors measure what presses on each object beside the jaws."""
    cameras: dict[str, CameraCfg] = spec({})
    """Cameras by name. Without any, the model has nothing that only pictures need."""
    grasp_offset: float = spec(0.0, unit="m")
    """How far above an object's centre the grasp point is for phases ``in_hand``."""

    @property
    def free(self) -> dict[str, ObjectCfg]:
        """The objects that move."""
        return {
            name: object_cfg for name, object_cfg in self.objects.items() if not object_cfg.fixed
        }

    @property
    def table_top(self) -> float:
        """Height [m] of the table's surface."""
        return self.table_center[2] + self.table_half[2]
