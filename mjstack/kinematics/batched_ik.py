"""Inverse kinematics of many worlds at once, on the device where their commands are."""

from __future__ import annotations

import mujoco
import numpy as np
import torch
import warp as wp

from mjstack.config.schema import RobotCfg
from mjstack.errors import ArgumentError, MjstackError, UnknownName
from mjstack.kinematics.ik_kernels import HINGE, SLIDE, Chain, Moved, Scratch, aperture_kernel, solve_kernel
from mjstack.scene.index import find
from mjstack.sim.streams import torch_stream_scope

_KINDS = {int(mujoco.mjtJoint.mjJNT_HINGE): HINGE, int(mujoco.mjtJoint.mjJNT_SLIDE): SLIDE}
_NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])

_Pose = tuple[np.ndarray, np.ndarray]  # position and quaternion (wxyz)
_Link = tuple[_Pose, np.ndarray, int, int, int]  # frame, axis, kind, column of the command, index among the moved joints


class BatchedIk:
    """Brings the aperture centre, the midpoint of two sites, to a target in every world: damped least squares, float32.

    A solve is one kernel launch, a fixed number of iterations, and neither reads back to the host nor allocates, so that a
    CUDA graph can hold it. What it returns are its own buffers, overwritten by the next call.

    Commands are joint positions in the order of the robot's arm joints and then its gripper joints; everything is in the
    world frame. Joints on the way to the sites that have no command stay where the model has them at qpos0.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        robot: RobotCfg,
        nworld: int,
        device: str | torch.device,
        *,
        iterations: int = 8,
        damping: float = 0.005,
        max_step: float = 0.3,
    ) -> None:
        """Reads the chain from the model, allocates, and loads the kernels.

        Eight iterations follow a target that moves by millimetres; one anywhere in the workspace takes up to 40.

        Args:
            model: A compiled model that contains the robot, alone or in a scene. It is not kept.
            robot: The robot's profile.
            nworld: Number of worlds.
            device: Where the worlds are: ``"cpu"`` or ``"cuda:N"``.
            iterations: Steps per solve.
            damping: Of the least squares at the target [m/rad]; it grows with the distance. More is calmer near a stretched
                arm, and slower there.
            max_step: Largest change of any joint per iteration [rad].

        Raises:
            UnknownName: The model lacks a joint, actuator or site of the robot.
            MjstackError: An argument is out of range, or a commanded joint is neither hinge nor slide.
        """
        for name, value, least in (("nworld", nworld, 1), ("iterations", iterations, 1)):
            if value < least:
                raise ArgumentError(name, value, f"an integer of at least {least}")
        for name, number in (("damping", damping), ("max_step", max_step)):
            if not 0.0 < number < np.inf:
                raise ArgumentError(name, number, "a positive number")
        names = [*robot.arm_joints, *robot.gripper_joints]
        joints = [find(model, "joint", name) for name in names]
        moved = []
        for name in robot.ik_joints:
            if name not in robot.arm_joints:
                raise UnknownName("arm joint", name, robot.arm_joints)
            moved.append(robot.arm_joints.index(name))
        limits = _limits(model, [names[c] for c in moved])
        self.nworld = nworld
        self._n = len(names)
        self._device = wp.get_device(str(device))
        self.device = wp.device_to_torch(self._device)
        self._settings = [iterations, damping, max_step]
        with wp.ScopedDevice(self._device):
            self._chain = _build_chain(model, robot, joints, moved)
            self._moved = Moved()
            self._moved.column = wp.array(moved, dtype=int)
            self._moved.low, self._moved.high = wp.array(limits[0], dtype=float), wp.array(limits[1], dtype=float)
            self._scratch = Scratch()
            self._scratch.command = wp.zeros((nworld, self._n), dtype=float)
            for field in ("anchor", "axis", "jacobian"):
                setattr(self._scratch, field, wp.zeros((len(moved), nworld), dtype=wp.vec3))
            self._scratch.step = wp.zeros((len(moved), nworld), dtype=float)
            self._scratch.held = wp.zeros((len(moved), nworld), dtype=int)
            self._wp_given, self._wp_command = (wp.zeros((nworld, self._n), dtype=float) for _ in range(2))
            self._wp_target, self._wp_centre = (wp.zeros(nworld, dtype=wp.vec3) for _ in range(2))
            self._wp_distance = wp.zeros(nworld, dtype=float)
        self._given, self._target = wp.to_torch(self._wp_given), wp.to_torch(self._wp_target)
        self._command, self._distance = wp.to_torch(self._wp_command), wp.to_torch(self._wp_distance)
        self._centre = wp.to_torch(self._wp_centre)
        wp.synchronize_device(self._device)  # the buffers are filled before torch's stream writes into them
        self.aperture(self._given)  # compiles and loads the kernels: a capture may do neither
        self.solve(self._given, self._target)
        wp.synchronize_device(self._device)

    def aperture(self, command: torch.Tensor) -> torch.Tensor:
        """Forward kinematics.

        Args:
            command: Joint positions [rad, m], shape ``(nworld, n_arm + n_gripper)``, float32 or float64.

        Returns:
            Aperture centre [m], shape ``(nworld, 3)``, float32.
        """
        self._take("command", self._given, command)
        with torch_stream_scope(self._device):
            wp.launch(aperture_kernel, dim=self.nworld, inputs=[self._chain, self._scratch, self._wp_given, self._wp_centre])
        return self._centre

    def solve(self, command: torch.Tensor, target: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Moves the robot's ik joints from a command towards a target; the other joints stay as given.

        The ik joints end within the range of the joint and of its actuator, whatever they start from, and the result is never
        farther from the target than the start, put within that range. A world whose command or target is not finite keeps its
        command, and its distance is NaN; the others do not notice.

        Args:
            command: Where to start [rad, m], shape ``(nworld, n_arm + n_gripper)``, float32 or float64.
            target: Where the aperture centre goes [m], shape ``(nworld, 3)``, float32 or float64.

        Returns:
            The new command, shape ``(nworld, n_arm + n_gripper)``, and the distance that is left [m], shape ``(nworld,)``,
            both float32.
        """
        self._take("command", self._given, command)
        self._take("target", self._target, target)
        with torch_stream_scope(self._device):
            wp.launch(
                solve_kernel,
                dim=self.nworld,
                inputs=[
                    self._chain,
                    self._moved,
                    self._scratch,
                    self._wp_given,
                    self._wp_target,
                    *self._settings,
                    self._wp_command,
                    self._wp_distance,
                ],
            )
        return self._command, self._distance

    def _take(self, name: str, buffer: torch.Tensor, values: torch.Tensor) -> None:
        """Copies an argument into float32 memory that keeps its address."""
        if values.shape != buffer.shape:  # else copy_ would broadcast it
            raise ArgumentError(name, f"shape {tuple(values.shape)}", f"shape {tuple(buffer.shape)}")
        buffer.copy_(values)


def _limits(model: mujoco.MjModel, names: list[str]) -> np.ndarray:
    """Narrower of joint and actuator range [rad, m], shape ``(2, n)``, float32, rounded inwards."""
    low, high = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    for k, name in enumerate(names):
        joint, actuator = find(model, "joint", name), find(model, "actuator", name)
        for limited, span in (
            (model.jnt_limited[joint], model.jnt_range[joint]),
            (model.actuator_ctrllimited[actuator], model.actuator_ctrlrange[actuator]),
        ):
            if limited:
                low[k], high[k] = max(low[k], span[0]), min(high[k], span[1])
    out = np.stack([low, high]).astype(np.float32)
    out[0] = np.where(out[0] < low, np.nextafter(out[0], np.float32(np.inf)), out[0])
    out[1] = np.where(out[1] > high, np.nextafter(out[1], np.float32(-np.inf)), out[1])
    return out


def _build_chain(model: mujoco.MjModel, robot: RobotCfg, joints: list[int], moved: list[int]) -> Chain:
    """Reads the bodies from the world to each site.

    Args:
        model: The compiled model.
        robot: The robot's profile.
        joints: Joint index of each column of the command.
        moved: Columns that inverse kinematics moves.

    Returns:
        The chain, in Warp arrays on the current device.
    """
    first, second = (find(model, "site", name) for name in robot.aperture_sites)
    first_path, second_path = _path(model, first), _path(model, second)
    shared = len([body for body in first_path if body in second_path])
    columns = {joint: column for column, joint in enumerate(joints)}
    chain, links = Chain(), []

    def extend(bodies: list[int], start: _Pose) -> _Pose:
        """Appends the bodies' links; returns the frame after them, seen from the last one's joint."""
        pose = start
        for body in bodies:
            pose = _compose(pose, (model.body_pos[body], model.body_quat[body]))
            for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
                if joint in columns:
                    pose = _compose(pose, (model.jnt_pos[joint], _NO_TURN))
                    links.append(_read_link(model, joint, pose, columns[joint], moved))
                    pose = (-model.jnt_pos[joint], _NO_TURN)
        return pose

    trunk = extend(first_path[:shared], (np.zeros(3), _NO_TURN))
    chain.trunk = len(links)
    end = extend(first_path[shared:], trunk)
    chain.first_site = wp.vec3(*_compose(end, (model.site_pos[first], _NO_TURN))[0])
    chain.fork = len(links)
    end = extend(second_path[shared:], trunk)
    chain.second_site = wp.vec3(*_compose(end, (model.site_pos[second], _NO_TURN))[0])
    chain.end = len(links)
    chain.frame = wp.array([[*pos, *quat[1:], quat[0]] for (pos, quat), *_ in links], dtype=wp.transform)  # Warp: xyzw
    chain.axis = wp.array([axis for _, axis, *_ in links], dtype=wp.vec3)
    chain.kind = wp.array([kind for _, _, kind, *_ in links], dtype=int)
    chain.column = wp.array([column for *_, column, _ in links], dtype=int)
    chain.moved = wp.array([k for *_, k in links], dtype=int)
    return chain


def _read_link(model: mujoco.MjModel, joint: int, pose: _Pose, column: int, moved: list[int]) -> _Link:
    """A joint whose frame at qpos0 is ``pose``. The frame at command 0 is turned, or shifted, back by qpos0."""
    kind, axis = int(model.jnt_type[joint]), model.jnt_axis[joint].copy()
    if kind not in _KINDS:
        name, type_ = model.joint(joint).name, mujoco.mjtJoint(kind).name.removeprefix("mjJNT_").lower()
        raise MjstackError(f"joint '{name}' is of type {type_}, expected hinge or slide. Command no other joints.")
    zero = float(model.qpos0[model.jnt_qposadr[joint]])
    turn = _NO_TURN.copy()
    if _KINDS[kind] == HINGE:
        mujoco.mju_axisAngle2Quat(turn, axis, -zero)
        back = (np.zeros(3), turn)
    else:
        back = (-zero * axis, turn)
    return _compose(pose, back), axis, _KINDS[kind], column, moved.index(column) if column in moved else -1


def _path(model: mujoco.MjModel, site: int) -> list[int]:
    """Bodies from the world, which is left out, to the one that carries a site."""
    path: list[int] = []
    body = int(model.site_bodyid[site])
    while body:
        path.insert(0, body)
        body = int(model.body_parentid[body])
    return path


def _compose(a: _Pose, b: _Pose) -> _Pose:
    pos, quat = np.empty(3), np.empty(4)
    mujoco.mju_mulPose(pos, quat, a[0], a[1], b[0], b[1])
    return pos, quat
