"""Names to addresses, resolved once; facts of a robot's joints; and how low bodies reach."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import mujoco
import numpy as np
import torch
from torch import Tensor

from mjstack.config.schema import RobotCfg, SceneCfg
from mjstack.errors import ConfigError, require_names
from mjstack.math import lowest_point, quat_mul, quat_to_matrix
from mjstack.robots.bodies import forward_kinematics, solid_geoms
from mjstack.robots.guest import OWN_WORLD
from mjstack.robots.jaws import Jaws
from mjstack.robots.posture import Posture, idle_servos, posture
from mjstack.scene.build import CAPSULE_TURN, WORLD, force_sensor
from mjstack.sim.simulation import Columns

_jaws = lru_cache(maxsize=8)(Jaws)  # probed once per model
_APART = 1e-4  # [rad, m] that a joint value may be off
_OFF_EQUALITY = 1e-3  # of the joint's range, that it may besides: values in files are rounded
_GRIP = 20.0  # [N] of each jaw on an object, where the configuration has no joint target
_WIDTH = 0.044  # [m] of an object, where there is none
_SHAPES = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
}


@dataclass(frozen=True, slots=True)
class RobotTensors:
    """The robot's columns and limits as tensors, arm joints first, then the gripper's, in rad or m.

    Limits are of shape ``(n, 2)``, joint values ``(n,)``, the gripper's commands ``(n_gripper,)``.
    """

    qpos: Columns
    qvel: Columns
    ctrl: Columns
    gripper_qpos: Columns
    passive: Columns  # of qpos, which a command determines too: `Posture.columns`
    idle: Columns  # of ctrl: servos of joints that have no command
    range: Tensor  # limits of the joints
    ctrl_range: Tensor  # limits of the joint targets
    home: Tensor
    start: Tensor  # of environments, clear of the table
    gripper_open: Tensor
    gripper_closed: Tensor  # around the narrowest of the scene's objects and that of closed_width
    gripper_travel: Tensor  # the open less the closed one
    idle_ctrl: Tensor  # commands that hold those joints
    zero: Tensor  # qpos0 of the joints


class SceneIndex:
    """Where each named thing of a scene lies in MuJoCo's arrays.

    Attributes:
        robot_qpos: qpos addresses of the arm's and then the gripper's joints.
        robot_qvel: qvel addresses in the same order.
        robot_range: Joint limits in the same order [rad, m], shape ``(n, 2)``.
        posture: Where all joints are, from the robot's.
        ctrl: Actuator indices in the same order.
        ctrl_range: Limits of the joint targets in the same order, of `joint_limits`, shape
            ``(n, 2)``.
        servo_range: What the file's servos take, which LeRobot's units count in, shape ``(n, 2)``.
        n_arm: How many of them are the arm's.
        base: x and y of the body that carries the arm, or, on the world, of its first one [m].
        grasp_sites: The two site indices whose midpoint is the grasp point.
        object_qpos: First qpos address of every object that moves, in the scene's order.
        object_qvel: First qvel address of each of them.
        objects: First qpos address (7 numbers: position, quaternion) and qvel address (6 numbers)
            of every object that moves, by name.
        fixed: Position [m] and quaternion of every object that does not.
        bodies: Body index of every object.
        geoms: Geom indices of every object.
        joints: qpos and qvel address of every hinge and slide of a fixture, by its name.
        jaw_force: First sensordata address of each jaw's force on an object (3 numbers), by the
            object's name.
        jaw_columns: All numbers of these forces, side by side in sensordata, by the object's name.
        support_force: First sensordata addresses of the world's force and of each other object's;
            empty unless ``scene.support_sensors`` is set.
    """

    def __init__(self, model: mujoco.MjModel, robot: RobotCfg, scene: SceneCfg) -> None:
        joints = [model.joint(name).id for name in robot.joints]
        self._robot = robot
        self._tensors: dict[tuple[torch.device, torch.dtype], RobotTensors] = {}
        self.posture = posture(model, tuple(robot.joints))
        _check_poses(self.posture, robot)
        wide = robot.closed_width or _WIDTH
        narrowest = min([wide, *(thing.grip_width for thing in scene.free.values())])
        self._grips = gripper_targets(model, robot, [None, narrowest])
        self.robot_qpos = model.jnt_qposadr[joints]
        self.robot_qvel = model.jnt_dofadr[joints]
        self.robot_range = model.jnt_range[joints]
        self._zero = model.qpos0[self.robot_qpos]
        self.ctrl = np.array([model.actuator(name).id for name in robot.joints])
        self._idle = idle_servos(model, self.ctrl, self.posture)
        self.servo_range = model.actuator_ctrlrange[self.ctrl]
        self.ctrl_range = np.stack(joint_limits(model, robot), axis=1)
        for name, (low, high) in zip(robot.joints, self.ctrl_range, strict=True):
            if not low < high:
                expected = f"one that meets its range {model.joint(name).range.tolist()}"
                span = model.actuator(name).ctrlrange.tolist()
                raise ConfigError(f"ctrlrange of joint {name}", span, expected)
        self.n_arm = len(robot.arm_joints)
        first = model.jnt_bodyid[joints[0]]
        carrier = model.body_parentid[first]
        if model.body(carrier).name in (WORLD, OWN_WORLD):
            carrier = first
        self.base = forward_kinematics(model).xpos[carrier, :2].tolist()
        self.grasp_sites = [model.site(name).id for name in robot.grasp_sites]
        self.objects = {
            name: (int(model.joint(name).qposadr[0]), int(model.joint(name).dofadr[0]))
            for name in scene.free
        }
        self.object_qpos = [qpos for qpos, _ in self.objects.values()]
        self.object_qvel = [qvel for _, qvel in self.objects.values()]
        self.bodies = {name: model.body(name).id for name in scene.objects}
        self.fixed = {
            name: np.concatenate((model.body_pos[body], model.body_quat[body])).tolist()
            for name, body in self.bodies.items()
            if name not in self.objects
        }
        self.geoms = {
            name: np.flatnonzero(model.body_rootid[model.geom_bodyid] == body).tolist()
            for name, body in self.bodies.items()
        }
        fixtures = [self.bodies[name] for name in self.fixed]
        hung = np.isin(model.body_rootid[model.jnt_bodyid], fixtures)
        self.joints = {
            model.joint(n).name: (int(model.jnt_qposadr[n]), int(model.jnt_dofadr[n]))
            for n in np.flatnonzero(hung & (model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)))
        }
        host = torch.device("cpu")  # side by side, so that no device has anything of them
        self._columns = {
            name: (Columns(range(qpos, qpos + 7), host), Columns(range(qvel, qvel + 6), host))
            for name, (qpos, qvel) in self.objects.items()
        }

        def sensors(bodies: Iterable[tuple[str, str]]) -> list[int]:
            return [int(model.sensor(force_sensor(*pair)).adr[0]) for pair in bodies]

        pairs = list(combinations(scene.objects, 2))
        self.jaw_force = {
            name: sensors((jaw, name) for jaw in robot.jaw_bodies) for name in scene.objects
        }
        self.jaw_columns = {
            name: Columns([a + i for a in addresses for i in range(3)], host)
            for name, addresses in self.jaw_force.items()
        }
        self.support_force = {
            name: sensors([(WORLD, name), *(pair for pair in pairs if name in pair)])
            for name in scene.objects
            if scene.support_sensors
        }

    def on(self, device: torch.device, dtype: torch.dtype) -> RobotTensors:
        """The robot's part on a device. Made once: a captured step may not copy from the host."""
        key = (device, dtype)
        if key not in self._tensors:
            gripper = self.robot_qpos[self.n_arm :]
            passive = self.posture.columns
            idle, idle_ctrl = self._idle
            addresses = (self.robot_qpos, self.robot_qvel, self.ctrl, gripper, passive, idle)
            columns = [Columns(a, device) for a in addresses]
            r = self._robot
            poses = (r.home, r.start, *self._grips)
            ranges = (self.robot_range, self.ctrl_range)
            numbers = [torch.tensor(n, dtype=dtype, device=device) for n in (*ranges, *poses)]
            numbers.append(numbers[-2] - numbers[-1])
            numbers += [torch.from_numpy(n).to(device, dtype) for n in (idle_ctrl, self._zero)]
            self.posture.follow(numbers[2])  # which moves its tables there
            self._tensors[key] = RobotTensors(*columns, *numbers)  # type: ignore[arg-type]
        return self._tensors[key]

    def object_columns(self, name: str) -> tuple[Columns, Columns]:
        """Columns of qpos (7 numbers) and of qvel (6) of an object that moves; any other name is
        an error that lists those.
        """
        require_names("object", [name], self._columns)
        return self._columns[name]


def _check_poses(places: Posture, robot: RobotCfg) -> None:
    """Raise a ConfigError for a joint value that the robot's file does not allow."""
    poses = {
        "home": (robot.joints, robot.home),
        "start": (robot.joints, robot.start),
        "locked": (list(robot.locked), list(robot.locked.values())),
        "gripper_open": (robot.gripper_joints, robot.gripper_open),
        "gripper_closed": (robot.gripper_joints, robot.gripper_closed),
    }
    for key, (names, values) in poses.items():
        command = locked_home(robot)
        columns = [robot.joints.index(name) for name in names]
        if values is not None:
            command[columns] = values
        allowed = places.agree(command)
        for k, name in zip(columns, names, strict=True):
            low, high = places.limits[k] + [-_APART, _APART]
            if not low <= command[k] <= high:
                expected = f"a value within [{low + _APART:.4g}, {high - _APART:.4g}]"
            elif abs(command[k] - allowed[k]) > _APART + _OFF_EQUALITY * (high - low):
                expected = f"{allowed[k]:.4g}, as the file's equalities have it"
            else:
                continue
            raise ConfigError(f"robot.{key} of {name}", float(command[k]), expected)


def joint_limits(model: mujoco.MjModel, robot: RobotCfg) -> tuple[np.ndarray, np.ndarray]:
    """Narrower of the range of each joint, as far as what follows it can, and its servo's: low and
    high limits [rad, m], each of shape ``(n,)``; infinite where there is none.
    """
    servos = [model.actuator(name).id for name in robot.joints]
    limited = model.actuator_ctrllimited[servos, None]
    span = np.where(limited, model.actuator_ctrlrange[servos], [-np.inf, np.inf])
    spans = np.stack((posture(model, tuple(robot.joints)).limits, span))
    return spans[..., 0].max(axis=0), spans[..., 1].min(axis=0)


def gripper_targets(
    model: mujoco.MjModel, robot: RobotCfg, widths: Sequence[float | None]
) -> np.ndarray:
    """Joint targets of jaws closed around objects [rad, m], shape ``(n, n_gripper)``.

    ``robot.gripper_closed`` is for ``robot.closed_width``. Around other objects the jaws are as
    much nearer to each other, or farther apart, as far as the joints' ranges allow. Where no width
    is given, it is for any object; where it is not given either, the jaws press with 20 N.
    ``widths`` are those of the objects across the jaws [m]; None is for the open gripper.
    """
    jaws = jaws_of(model, robot)
    low, high = (limits[len(robot.arm_joints) :] for limits in joint_limits(model, robot))
    opened, closed = (
        np.clip(end, low, high) if target is None else np.array(target, dtype=float)
        for end, target in ((jaws.opened, robot.gripper_open), (jaws.shut, robot.gripper_closed))
    )
    probed = robot.gripper_closed is None
    wide = np.array(widths, dtype=float)  # None is NaN
    if not probed and robot.closed_width is None:
        return np.where(np.isnan(wide)[:, None], opened, closed)
    shares = np.linspace(-2.0, 1.0, 301)[:, None]  # of the way from closed (the 200th) to open
    targets = np.clip(closed + shares * (opened - closed), low, high)
    if jaws.carry_sites and not probed:
        apart = jaws.spread(targets)
    else:
        apart = np.maximum.accumulate(jaws.gap(targets))
    goal = wide + apart[200] - (robot.closed_width or 0.0)
    if probed:
        servos = [model.actuator(name).id for name in robot.gripper_joints]
        stiffness = model.actuator_gainprm[servos, 0] @ (opened - closed) ** 2
        goal = wide - _GRIP * (apart[-1] - apart[200]) ** 2 / stiffness
    rows = np.stack([np.interp(goal, apart, column) for column in targets.T], axis=1)
    rows[np.isnan(wide)] = opened
    if not probed:
        rows[wide == robot.closed_width] = closed
    return rows


def jaws_of(model: mujoco.MjModel, robot: RobotCfg) -> Jaws:
    """The robot's jaws, probed once per model."""
    names = (robot.joints, robot.gripper_joints, robot.jaw_bodies, robot.grasp_sites)
    return _jaws(model, *map(tuple, names))


def locked_home(robot: RobotCfg) -> np.ndarray:
    """The robot's home with the locked joints where they are locked [rad, m], shape ``(nu,)``."""
    pairs = zip(robot.joints, robot.home, strict=True)
    return np.array([robot.locked.get(name, value) for name, value in pairs])


def approach_body(model: mujoco.MjModel, robot: RobotCfg) -> int:
    """Index of the body with the robot's approach axis: the last arm joint's, if none is named."""
    if robot.approach_body:
        return int(model.body(robot.approach_body).id)
    return int(model.joint(robot.arm_joints[-1]).bodyid[0])


def turn_sign(model: mujoco.MjModel, robot: RobotCfg) -> float:
    """1.0 where the arm's first joint turns to the left, seen from above; -1.0 where to the right.

    Raises:
        ConfigError: It does not turn about the vertical.
    """
    up = float(forward_kinematics(model).joint(robot.arm_joints[0]).xaxis[2])
    if abs(up) < 0.999:
        expected = f"0, because joint {robot.arm_joints[0]} does not turn about the vertical"
        raise ConfigError("robot.approach_gain", robot.approach_gain, expected)
    return math.copysign(1.0, up)


def lowest_height(
    model: mujoco.MjModel, bodies: Sequence[str | int], xpos: Tensor, xquat: Tensor
) -> Tensor:
    """Height of the lowest point of the colliding geoms of some bodies, without those attached to
    them [m], shape ``(nworld,)``, from the poses of all bodies: positions [m], shape ``(nworld,
    nbody, 3)``, and orientations, ``(nworld, nbody, 4)``.

    Of shapes that objects do not have, such as meshes, the bounding box counts, which reaches
    lower, never higher.
    """
    lowest = []
    for geom in solid_geoms(model, [model.body(name).id for name in bodies]):
        shape = _SHAPES.get(model.geom_type[geom], "box")
        middle, half = model.geom_aabb[geom].reshape(2, 3)
        size = half if shape == "box" else model.geom_size[geom]
        center, quat = np.empty(3), np.empty(4)  # in its body
        turn = CAPSULE_TURN if shape == "capsule" else np.array([1.0, 0.0, 0.0, 0.0])
        mujoco.mju_mulPose(center, quat, model.geom_pos[geom], model.geom_quat[geom], middle, turn)
        turned = xquat[:, model.geom_bodyid[geom]].float()
        offset = (quat_to_matrix(turned) * turned.new_tensor(center)).sum(-1)
        pos = xpos[:, model.geom_bodyid[geom]].float() + offset
        turned = quat_mul(turned, turned.new_tensor(quat).expand_as(turned))
        lowest.append(lowest_point(pos, turned, shape, size.tolist()))
    return torch.stack(lowest, dim=1).amin(1)
