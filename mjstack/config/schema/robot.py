"""The robot: names in its MJCF file, servos, and where each scene's objects stand for it."""

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from mjstack.config.fields import FITS, spec
from mjstack.config.schema.scene import CameraPoseCfg


@dataclass(slots=True)
class ModelCfg:
    """Source of the robot's MJCF file."""

    source: str = spec(choices=("builtin", "menagerie"), changes=("episodes", "images"))
    """``builtin``: ``robot.file``, or mjstack's own file. ``menagerie``: MuJoCo Menagerie's."""


@dataclass(slots=True)
class PlacementsCfg:
    """Where a scene's objects stand for one robot, and the buffer sizes its contacts need."""

    table_center: list[float] = spec(unit="m", length=3)
    """Centre of the table."""
    table_half: list[float] = spec(unit="m", length=3, gt=0.0)
    """Half sizes of the table."""
    objects: dict[str, Any] = spec({}, vectors=True, unit="m", length=2)
    """Nominal x and y of each object."""
    places: dict[str, Any] = spec({}, vectors=True, unit="m", length=2)
    """x and y of each place."""
    random_xy: list[float] = spec(unit="m", length=2, ge=0.0)
    """How far ``reset=randomized`` moves each object, plus or minus."""
    grasp_offset: float = spec(0.0, unit="m")
    """How far above an object's centre it is held."""
    home: list[float] | None = spec(None, unit="rad, m")
    """Joint values at which this scene's task begins, where ``robot.home`` would collide."""
    nconmax: int = spec(128, ge=1, le=100_000)
    """Contacts per world while a driver does the task."""
    njmax: int = spec(300, ge=1, le=100_000)
    """Constraint rows per world while a driver does the task."""
    env_nconmax: int = spec(128, ge=1, le=100_000)
    """Contacts per world under random actions."""
    env_njmax: int = spec(768, ge=1, le=100_000)
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
class BasePoseCfg:
    """Where a robot stands: the frame of its file in the world."""

    pos: list[float] = spec([0.0, 0.0, 0.0], unit="m", length=3)
    """Position."""
    quat: list[float] = spec([1.0, 0.0, 0.0, 0.0], length=4)
    """Rotation (w, x, y, z)."""


@dataclass(slots=True)
class RobotCfg:
    """An arm with a gripper: names in its MJCF file, and joint targets of its tasks.

    Every joint named here has a position servo, and a range. Joint values are rad, or m for slides.
    """

    name: str = spec(changes=(*FITS, "images"))
    """The robot's name."""
    title: str = ""
    """The name in tables and reports. Empty: ``name``."""
    lerobot_type: str = ""
    """Type of the real robot in LeRobot's datasets. Empty: ``name``."""
    file: str | None = None
    """An MJCF file: an absolute path, or one relative to the YAML that names it, or to the working
    folder. null: mjstack's own file of the robot."""
    root: str = ""
    """Body of the file that is the robot, with all below it; the rest is left out. Empty: the whole
    file, without floors, lights, free and mocap bodies."""
    base: BasePoseCfg = field(default_factory=BasePoseCfg)
    """Where the file's origin stands in the world, such as on a pedestal."""
    gravcomp: Any = spec("auto", choices=("auto", True, False))
    """Whether gravity of the robot's bodies is compensated. auto: as in its file, and where that
    compensates none, if the hand would sag more than 2 mm at home."""
    exclude: list[Any] = spec([])
    """Pairs of the robot's bodies that do not collide, such as ``[world, link1]``. world:
    what its file has in the worldbody."""
    collision: Any = spec("hull 64", changes=("episodes",))
    """How its meshes collide: ``file``, as they are; ``hull N``, as convex hulls of N vertices at
    most, nearest to them; ``primitives``, as boxes and capsules around them."""
    menagerie_name: str = ""
    """The robot's folder in MuJoCo Menagerie, for ``model=menagerie``."""
    menagerie_file: str = ""
    """Its file there."""
    replace_collision: bool = False
    """Whether ``model=menagerie`` gets the collision geoms of mjstack's own file."""

    arm_joints: list[str] = spec(changes=FITS)
    """Joints of the arm, from the base on."""
    gripper_joints: list[str] = spec(changes=FITS)
    """Joints of the gripper."""
    jaw_bodies: list[str] = MISSING
    """Bodies that touch a grasped object, each with all below it. A sensor measures the force of
    each on each object."""
    grasp_sites: list[str] = spec(["grasp_first", "grasp_second"], length=2)
    """Two sites, one on each jaw, or both on the palm. Their midpoint is the grasp point. Those of
    the default, which no key places and the file lacks, go to where the jaws touch an object."""
    grasp_parts: dict[str, list[str]] = spec({})
    """Where a grasp site goes that the file lacks: the mean of these geoms of a jaw, or a body."""
    grasp_pos: dict[str, Any] = spec({}, vectors=True, unit="m", length=3)
    """Where such a site lies in the frame of that body; its origin, or the geoms' mean."""
    home: list[float] = spec(unit="rad, m", changes=FITS)
    """Joint values at which a driven episode begins."""
    start: list[float] = spec([], unit="rad, m")
    """Joint values at which environments begin, clear of the table. Empty: ``home``."""
    gripper_open: list[float] | None = spec(None, unit="rad, m", changes=FITS)
    """Joint targets of the open gripper. null: as far as joints and servos allow."""
    gripper_closed: list[float] | None = spec(None, unit="rad, m", changes=FITS)
    """Joint targets of the gripper around an object as wide as ``closed_width``; around any object
    where a task or the command line sets it alone. null: the jaws press with 20 N."""
    closed_width: float | None = spec(0.044, unit="m", gt=0.0)
    """Width of the object that ``gripper_closed`` is for. Around another one the jaws close as much
    nearer or farther. null: that target is for any object."""
    arm_force_limit: float | None = spec(None, unit="N m, N", gt=0.0)
    """Largest force of the arm's servos. null: the file's own."""
    servos: dict[str, ServoCfg] = spec({})
    """Servos by joint, which the group ``actuator`` chooses; other joints have the file's own. One
    with stiffness, damping and effort is made where the file has a motor, or none."""
    backlash: float = spec(0.0, unit="rad, m", ge=0.0)
    """Play of the gears of each arm joint, to either side: so far from a command that comes from
    one side its servo stays."""
    ranges: dict[str, Any] = spec({}, vectors=True, unit="rad, m", length=2)
    """Ranges of joints, in place of the file's own."""

    locked: dict[str, float] = spec({}, unit="rad, m")
    """Arm joints that inverse kinematics holds, with their values."""
    ik_joints: list[str] = spec([])
    """Arm joints for inverse kinematics, each moves both grasp sites. Empty: all not locked."""
    approach_body: str = ""
    """Body with the approach axis: the last that carries both jaws. Empty: the last arm joint's."""
    approach_axis: list[float] = spec([0.0, 0.0, -1.0], length=3)
    """Direction from the wrist towards the grasped object, in that body's frame."""
    roll_joint: str | None = None
    """Arm joint that turns the gripper about the approach axis. null: none, so no yaw alignment."""
    posture_gain: float = spec(0.0, ge=0.0, le=1.0)
    """Closed loop: share per iteration of the way to the nominal joints, in the null space."""
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
    placements: dict[str, PlacementsCfg] = spec({})
    """Where the objects of each scene stand for this robot."""

    @property
    def joints(self) -> list[str]:
        """The arm's joints and then the gripper's, in the order of all joint values."""
        return [*self.arm_joints, *self.gripper_joints]
