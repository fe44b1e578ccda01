"""The robot and the scene: table, objects, places and perhaps a box."""

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from omegaconf import MISSING

from mjstack.config.fields import spec

OUTPUTS = ("rgb", "depth", "segmentation")
_ROUND = (2, "radius and half length")
_SQUARE = 0.004  # m: jaws take a box whose sides differ by no more across any of them
SHAPES = {  # and the sizes of each
    "box": (3, "half sizes"),
    "cylinder": _ROUND,
    "sphere": (1, "the radius"),
    "capsule": _ROUND,
}


def _dot(a: Iterable[float], b: Iterable[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _friction() -> list[float]:
    return [1.0, 0.005, 0.0005]


@dataclass(slots=True)
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
    stiffness and damping."""
    wall_solref: list[float] = spec(length=2)
    """Contact parameters of the walls."""


class Grasp(NamedTuple):
    """How jaws take an object from above.

    Attributes:
        axis: Number of the body axis whose heading tells how they are turned.
        turn: From that heading to the way that they close [rad].
        period: After which turn the object looks the same to them [rad]; 0: after any.
        width: Size of the object between them [m].
    """

    axis: int
    turn: float
    period: float
    width: float


@dataclass(slots=True)
class ShapeCfg:
    """A shape, its size, and how it is turned."""

    shape: str = spec("box", choices=tuple(SHAPES))
    """box, cylinder (its length along its z axis), sphere, or capsule (along its x axis)."""
    size: list[float] = spec(factory=list, unit="m", ge=1e-4, le=10.0)
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
        return [part / length for part in self.quat]

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
        return self.half[2] if self.upright else self.reach((0.0, 0.0, 1.0))

    @property
    def footprint(self) -> float:
        """Radius of the disc that it covers at any yaw [m]."""
        if not self.upright:  # around a box that holds it, turned about its own axes alone
            signs = itertools.product((-1.0, 1.0), repeat=3)
            corners = [[s * h for s, h in zip(sign, self.half, strict=True)] for sign in signs]
            rows = self.axes[:2]
            return max(math.hypot(*(_dot(row, at) for row in rows)) for at in corners)
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

    def reach(self, direction: Sequence[float]) -> float:
        """How far it reaches from its centre in a direction, a unit vector [m]."""
        x, y, z = (abs(_dot(direction, axis)) for axis in zip(*self.axes, strict=True))
        if self.shape == "box":
            return _dot((x, y, z), self.size)
        radius = self.size[0]
        if self.shape == "cylinder":
            return radius * math.hypot(x, y) + self.size[1] * z
        return radius + (self.size[1] * x if self.shape == "capsule" else 0.0)


@dataclass(slots=True)
class PartCfg(ShapeCfg):
    """A part of a fixed object."""

    pos: list[float] = spec(factory=lambda: [0.0, 0.0, 0.0], unit="m", length=3)
    """Its centre in the object's frame, whose origin stands on the table."""


@dataclass(slots=True)
class ObjectCfg(ShapeCfg):
    """An object that stands on the table at the start, or is fixed to the world."""

    mass: float | None = spec(None, unit="kg", ge=1e-5, le=1000.0)
    """Mass; a fixed object needs none."""
    friction: list[float] = spec(factory=_friction, length=3, gt=0.0)
    """Sliding, torsional and rolling coefficient."""
    color: list[float] = spec(factory=lambda: [0.6, 0.6, 0.6, 1.0], length=4, ge=0.0, le=1.0)
    """Red, green, blue and alpha, 0 to 1."""
    xy: list[float] = spec(factory=list, unit="m")
    """Nominal position of its centre, standing on the table."""
    pos: list[float] | None = spec(None, unit="m", length=3)
    """Nominal position of its centre, in place of ``xy``: also over the table."""
    fixed: bool = False
    """Whether it is fixed to the world. Fixed objects may touch and overlap each other."""
    parts: dict[str, PartCfg] = field(default_factory=dict)
    """Shapes of a fixed object that has several, by name, in place of ``shape`` and ``size``."""
    file: str | None = None
    """A fixed object's MJCF file, in place of them: relative to the YAML, or to the working
    folder."""

    @property
    def pieces(self) -> dict[str, PartCfg]:
        """Its shapes in its own frame, by the names of their geoms but for the object's."""
        if self.parts or self.file:
            return {f"_{name}": part for name, part in self.parts.items()}
        return {"": PartCfg(shape=self.shape, size=self.size)}

    @property
    def half_height(self) -> float:
        """Height of the centre above what it stands on [m]; 0 of one made of parts."""
        return 0.0 if self.parts or self.file else super(ObjectCfg, self).half_height

    @property
    def grasp(self) -> Grasp:
        """How jaws take it from above; of a box whose sides differ, across the shorter one."""
        up = [abs(part) for part in self.axes[2]]
        vertical = up.index(max(up))
        if self.shape == "box":
            first, second = (k for k in range(3) if k != vertical)
            widths = [2.0 * self.half[k] for k in (first, second)]
            if abs(widths[0] - widths[1]) <= _SQUARE:
                return Grasp(first, 0.0, 0.5 * math.pi, max(widths))
            axis = second if widths[1] < widths[0] else first
            return Grasp(axis, 0.0, math.pi, min(widths))
        length = {"cylinder": 2, "capsule": 0}.get(self.shape, vertical)
        lies = length != vertical
        return Grasp(length, 0.5 * math.pi, math.pi * lies, 2.0 * self.size[0])

    @property
    def has_faces(self) -> bool:
        """Whether it matters how jaws that grasp it from above are turned."""
        return self.grasp.period > 0.0

    @property
    def radius(self) -> float:
        """Radius of the sphere around its centre that holds it [m]."""
        if self.shape == "capsule":
            return sum(self.size)
        return math.hypot(*(half / self.size[0] for half in self.half)) * self.size[0]


@dataclass(slots=True)
class PlaceCfg:
    """A named spot on the table."""

    xy: list[float] = spec(unit="m", length=2)
    """Its position, or the centre of the region from which it is drawn."""
    random_xy: list[float] = spec(factory=lambda: [0.0, 0.0], unit="m", length=2, ge=0.0)
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
    up: list[float] = spec(factory=lambda: [0.0, 0.0, 1.0], length=3)
    """The direction that points up in the image."""


@dataclass(slots=True)
class CameraCfg:
    """A camera, whose images are observations. Vertical field of view and size give its rays."""

    pose: CameraPoseCfg | None = None
    """Its pose. null: ``robot.wrist_camera``, on the gripper."""
    size: list[int] = spec(factory=lambda: [128, 128], unit="pixels", length=2, ge=1, le=4096)
    """Height and width of the image."""
    fovy: float = spec(45.0, unit="deg", ge=1.0, le=170.0)
    """Vertical field of view."""
    rate: float | None = spec(None, unit="Hz", gt=0.0)
    """Images per second. null: one in every control step."""
    outputs: list[str] = spec(factory=lambda: ["rgb"], choices=OUTPUTS)
    """Its observations: ``rgb`` colours, ``depth`` [m], ``segmentation`` numbers of things."""
    terminal: bool = False
    """Whether the last image of an episode is drawn too, for ``final_obs``."""


@dataclass(slots=True)
class SceneCfg:
    """A table, objects and places on it, and perhaps a box."""

    name: str = spec()
    """Its name, which selects the robot's ``placements``."""
    table_center: list[float] = spec(unit="m", length=3)
    """Centre of the table, a box."""
    table_half: list[float] = spec(unit="m", length=3, gt=0.0)
    """Half sizes of the table."""
    frame: str = spec("world", choices=("world", "table"))
    """Where positions of objects and places count from: the arm's base, or the middle of the
    table's top. Loading turns them into the world's."""
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
    cameras: dict[str, CameraCfg] = field(default_factory=dict)
    """Cameras by name. Without any, the model has nothing that only pictures need."""
    grasp_offset: float = spec(0.0, unit="m")
    """How far above an object's centre the grasp point is for phases ``in_hand``."""

    @property
    def free(self) -> dict[str, ObjectCfg]:
        """The objects that move."""
        return {name: thing for name, thing in self.objects.items() if not thing.fixed}

    @property
    def table_top(self) -> float:
        """Height [m] of the table's surface."""
        return self.table_center[2] + self.table_half[2]


@dataclass(slots=True)
class ModelCfg:
    """Source of the robot's MJCF file."""

    source: str = spec(choices=("builtin", "menagerie"))
    """``builtin``: ``robot.file``, or mjstack's own file of the robot. ``menagerie``: MuJoCo
    Menagerie's."""


@dataclass(slots=True)
class PlacementsCfg:
    """Where a scene's objects stand for one robot, and the buffer sizes its contacts need."""

    table_center: list[float] = spec(unit="m", length=3)
    """Centre of the table."""
    table_half: list[float] = spec(unit="m", length=3, gt=0.0)
    """Half sizes of the table."""
    objects: dict[str, list[float]] = spec(factory=dict, unit="m", length=2)
    """Nominal x and y of each object."""
    places: dict[str, list[float]] = spec(factory=dict, unit="m", length=2)
    """x and y of each place."""
    random_xy: list[float] = spec(unit="m", length=2, ge=0.0)
    """How far ``reset=randomized`` moves each object, plus or minus."""
    box_center: list[float] | None = spec(None, unit="m", length=2)
    """Centre of the box."""
    grasp_offset: float = spec(0.0, unit="m")
    """How far above an object's centre it is held."""
    home: list[float] | None = spec(None, unit="rad, m")
    """Joint values at which this scene's task begins, where ``robot.home`` would collide."""
    nconmax: int = spec(128, ge=1)
    """Contacts per world while a driver does the task."""
    njmax: int = spec(300, ge=1)
    """Constraint rows per world while a driver does the task."""
    env_nconmax: int = spec(128, ge=1)
    """Contacts per world under random actions."""
    env_njmax: int = spec(768, ge=1)
    """Constraint rows per world under random actions."""


@dataclass(slots=True)
class ServoCfg:
    """A joint's position servo and friction, for a slide in N and m. null: the file's own."""

    stiffness: float | None = spec(None, unit="N m/rad", gt=0.0)
    """Torque per position error."""
    damping: float | None = spec(None, unit="N m s/rad", ge=0.0)
    """The servo's own torque against velocity."""
    armature: float | None = spec(None, unit="kg m^2", ge=0.0)
    """Inertia of rotor and gears, at the joint."""
    dry_friction: float | None = spec(None, unit="N m", ge=0.0)
    """Torque that holds against any slow motion."""
    viscous_friction: float | None = spec(None, unit="N m s/rad", ge=0.0)
    """The joint's torque against velocity."""
    effort: float | None = spec(None, unit="N m", gt=0.0)
    """Largest torque; it replaces ``robot.arm_force_limit``."""


@dataclass(slots=True)
class RobotCfg:
    """An arm with a gripper: names in its MJCF file, and joint targets of its tasks.

    Every joint named here has a position servo, and a range. Joint values are rad, or m for slides.
    """

    name: str = MISSING
    """The robot's name."""
    title: str = ""
    """The name in tables and reports. Empty: ``name``."""
    lerobot_type: str = ""
    """Type of the real robot in LeRobot's datasets. Empty: ``name``."""
    file: str | None = None
    """An MJCF file: an absolute path, or one relative to the YAML that names it, or to the working
    folder. null: mjstack's own file of the robot."""
    menagerie_name: str = ""
    """The robot's folder in MuJoCo Menagerie, for ``model=menagerie``."""
    menagerie_file: str = ""
    """Its file there."""
    replace_collision: bool = False
    """Whether ``model=menagerie`` gets the collision geoms of mjstack's own file."""

    arm_joints: list[str] = spec()
    """Joints of the arm, from the base on."""
    gripper_joints: list[str] = MISSING
    """Joints of the gripper."""
    jaw_bodies: list[str] = MISSING
    """Bodies that touch a grasped object. A sensor measures the force of each on each object."""
    grasp_sites: list[str] = spec(length=2)
    """Two sites, one on each jaw. Their midpoint is the grasp point."""
    grasp_parts: dict[str, list[str]] = field(default_factory=dict)
    """Where a grasp site goes that the file lacks: the mean of these geoms or bodies of one jaw."""
    home: list[float] = spec(unit="rad, m")
    """Joint values at which a driven episode begins."""
    start: list[float] = spec(factory=list, unit="rad, m")
    """Joint values at which environments begin, clear of the table. Empty: ``home``."""
    gripper_open: list[float] = spec(unit="rad, m")
    """Joint targets of the open gripper."""
    gripper_closed: list[float] = spec(unit="rad, m")
    """Joint targets of the gripper around an object."""
    arm_force_limit: float | None = spec(None, unit="N m, N", gt=0.0)
    """Largest force of the arm's servos. null: the file's own."""
    servos: dict[str, ServoCfg] = spec(factory=dict)
    """Servos by joint, which the group ``actuator`` chooses; other joints have the file's own."""

    locked: dict[str, float] = spec(factory=dict, unit="rad, m")
    """Arm joints that inverse kinematics holds, with their values."""
    ik_joints: list[str] = field(default_factory=list)
    """Arm joints for inverse kinematics, each moves both grasp sites. Empty: all not locked."""
    approach_body: str = ""
    """Body with the approach axis: the last that carries both jaws. Empty: the body of the last arm
    joint."""
    approach_axis: list[float] = spec(factory=lambda: [0.0, 0.0, -1.0], length=3)
    """Direction from the wrist towards the grasped object, in that body's frame."""
    roll_joint: str | None = None
    """Arm joint that turns the gripper about the approach axis. null: there is none, and no yaw
    alignment."""
    posture_gain: float = spec(0.0, ge=0.0, le=1.0)
    """Closed loop: share per iteration of the way to the nominal joint values, in the null
    space."""
    approach_gain: float = spec(0.0, unit="rad", ge=0.0, le=1.0)
    """Closed loop: turn per iteration of the approach axis towards the desired one."""
    yaw_alignment: float = spec(0.0, ge=0.0, le=1.0)
    """Closed loop: how far the jaws turn to an object's nearest face."""
    approach_height: float = spec(0.1, unit="m", gt=0.0)
    """Height above an object at which a grasp begins."""
    finger_room: float = spec(0.01, unit="m", ge=0.0)
    """Free room around an object for the open jaws."""
    wrist_camera: CameraPoseCfg | None = None
    """Pose of a camera on the gripper. null: there is none."""
    placements: dict[str, PlacementsCfg] = field(default_factory=dict)
    """Where the objects of each scene stand for this robot."""

    @property
    def joints(self) -> list[str]:
        """The arm's joints and then the gripper's, in the order of all joint values."""
        return [*self.arm_joints, *self.gripper_joints]

    @property
    def grips(self) -> dict[str, list[float]]:
        """Joint targets of the gripper by the word for it in a phase."""
        return {"open": self.gripper_open, "closed": self.gripper_closed}
