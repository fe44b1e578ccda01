"""Inverse kinematics of many worlds at once, on the device where their commands are."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp

from mjstack.config.schema import RobotCfg
from mjstack.errors import ArgumentError, ConfigError, MjstackError, UnknownName
from mjstack.kinematics.ik_kernels import (
    HINGE,
    SLIDE,
    Chain,
    Shape,
    directions_kernel,
    grasp_point_kernel,
    solve_kernel,
)
from mjstack.kinematics.joints import approach_body, joint_limits
from mjstack.scene.index import find
from mjstack.sim.streams import torch_stream_scope

_KINDS = {int(mujoco.mjtJoint.mjJNT_HINGE): HINGE, int(mujoco.mjtJoint.mjJNT_SLIDE): SLIDE}
_NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])

_Pose = tuple[np.ndarray, np.ndarray]  # position and quaternion (wxyz)
_Link = tuple[_Pose, np.ndarray, int, int]  # frame, axis, kind, column of the command

# m: with a gain, an iterate this close to the target replaces a closer one that came before
_NEAR = 0.00002
_LEAST_WITH_GAIN = 4  # iterations


class BatchedIk:
    """Brings the grasp point, the midpoint of two sites, to a target in every world: damped least
    squares, float32.

    A solve is one kernel launch, a fixed number of iterations, and neither reads back to the host
    nor allocates, so that a CUDA graph can hold it. What it returns are its own buffers,
    overwritten by the next call.

    The arms have more joints than a point needs. What the spare ones do is open by default: each
    solve takes the shortest way. With ``posture_gain`` they go towards a posture, with
    ``approach_gain`` they turn the gripper's approach axis down or to a given direction, in both
    cases as far as the centre stays on its target, and a step at a time: what is left after one
    solve goes on in the next.

    Commands are joint positions in the order of the robot's arm joints and then its gripper joints;
    everything is in the world frame. Joints on the way to the sites that have no command stay where
    the model has them at qpos0.

    Attributes:
        unreachable: Whether the last solve ended farther than ``tolerance`` from its target, or had
            input that is not finite, shape ``(nworld,)``, bool.
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
        posture_gain: float = 0.0,
        approach_gain: float = 0.0,
        tolerance: float = 0.0005,
        block_dim: int = 32,
    ) -> None:
        """Reads the chain from the model, allocates, and loads the kernels.

        Eight iterations follow a target that moves by millimetres; one anywhere in the workspace
        takes up to 40.

        Args:
            model: A compiled model that contains the robot, alone or in a scene. It is not kept.
            robot: The robot's profile.
            nworld: Number of worlds.
            device: Where the worlds are: ``"cpu"`` or ``"cuda:N"``.
            iterations: Steps per solve. With a gain at least 4, because the last two or three, or a
                quarter of many, go for the target alone.
            damping: Of the least squares at the target [m/rad]; it grows with the distance. More is
                calmer near a stretched arm, and slower there.
            max_step: Largest change of any joint per iteration [rad].
            posture_gain: Share of the way to the posture that is wished for per iteration, from 0
                to 1.
            approach_gain: Turn that is wished for per iteration where the approach axis is
                horizontal [rad], from 0 to 1.
            tolerance: Distance beyond which a target counts as unreachable [m].
            block_dim: CUDA threads per block. Few, because a world is one thread, and many
                processors then share the worlds.

        Raises:
            UnknownName: The model lacks a joint, actuator, site or body of the robot.
            MjstackError: An argument is out of range, or a commanded joint is neither hinge nor
                slide.
        """
        gained = posture_gain > 0.0 or approach_gain > 0.0
        for name, value, least in (
            ("nworld", nworld, 1),
            ("iterations", iterations, _LEAST_WITH_GAIN if gained else 1),
            ("block_dim", block_dim, 1),
        ):
            if value < least:
                raise ArgumentError(name, value, f"an integer of at least {least}")
        for name, number in (
            ("damping", damping),
            ("max_step", max_step),
            ("tolerance", tolerance),
        ):
            if not 0.0 < number < np.inf:
                raise ArgumentError(name, number, "a positive number")
        for name, number in (("posture_gain", posture_gain), ("approach_gain", approach_gain)):
            if not 0.0 <= number <= 1.0:
                raise ArgumentError(name, number, "a number from 0 to 1")
        names = [*robot.arm_joints, *robot.gripper_joints]
        joints = [find(model, "joint", name) for name in names]
        for name in robot.ik_joints:
            if name not in robot.arm_joints:
                raise UnknownName("arm joint", name, robot.arm_joints)
        moved = [robot.arm_joints.index(name) for name in robot.ik_joints]
        low = np.full(len(names), -np.inf, dtype=np.float32)
        high = np.full(len(names), np.inf, dtype=np.float32)
        low[moved], high[moved] = _round_inwards(*joint_limits(model, robot.ik_joints))
        home = np.array(robot.home, dtype=np.float32)
        for name, angle in robot.locked.items():
            home[names.index(name)] = angle
        self.nworld = nworld
        self._n = len(names)
        self._device = wp.get_device(str(device))
        self.device = wp.device_to_torch(self._device)
        self._block_dim = block_dim
        self._posture_gain = posture_gain
        self._approach_gain = approach_gain
        # In the last iterations no gain counts, so they undo what it cost in distance: measured, 2
        # of 4, 3 of 8, 10 of 40.
        wishing = iterations - max(min(3, iterations // 2), iterations // 4) if gained else 0
        near = _NEAR if gained else -1.0
        self._settings = [
            iterations,
            wishing,
            damping,
            max_step,
            posture_gain,
            approach_gain,
            near,
            tolerance,
        ]
        with wp.ScopedDevice(self._device):
            self._chain, shape = _build_chain(model, robot, joints, moved, low, high)
            self._wp_given, self._wp_command, self._wp_posture = (
                wp.zeros((nworld, self._n), dtype=float) for _ in range(3)
            )
            self._wp_home = wp.array(np.tile(home, (nworld, 1)), dtype=float)
            (
                self._wp_target,
                self._wp_wished,
                self._wp_centre,
                self._wp_closing,
                self._wp_approach,
            ) = (wp.zeros(nworld, dtype=wp.vec3) for _ in range(5))
            self._wp_down = wp.full(nworld, wp.vec3(0.0, 0.0, -1.0), dtype=wp.vec3)
            self._wp_distance = wp.zeros(nworld, dtype=float)
            self._wp_unreachable = wp.zeros(nworld, dtype=wp.bool)
        self._kernel = solve_kernel(shape)
        self._given, self._target, self._posture, self._command, self._distance = (
            wp.to_torch(a)
            for a in (
                self._wp_given,
                self._wp_target,
                self._wp_posture,
                self._wp_command,
                self._wp_distance,
            )
        )
        self._wished, self._centre, self._closing, self._approach = (
            wp.to_torch(a)
            for a in (self._wp_wished, self._wp_centre, self._wp_closing, self._wp_approach)
        )
        self.unreachable = wp.to_torch(self._wp_unreachable)
        wp.synchronize_device(
            self._device
        )  # the buffers are filled before torch's stream writes into them
        self.grasp_point(self._given)  # compiles and loads the kernels: a capture may do neither
        self.directions(self._given)
        self.solve(self._given, self._target)
        wp.synchronize_device(self._device)

    def grasp_point(self, command: torch.Tensor) -> torch.Tensor:
        """Forward kinematics.

        Args:
            command: Joint positions [rad, m], shape ``(nworld, n_arm + n_gripper)``, float32 or
                float64.

        Returns:
            Grasp point [m], shape ``(nworld, 3)``, float32.
        """
        self._take("command", self._given, command)
        self._launch(grasp_point_kernel, [self._chain, self._wp_given, self._wp_centre])
        return self._centre

    def directions(self, command: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Where the gripper points, both in one launch.

        Args:
            command: Joint positions [rad, m], shape ``(nworld, n_arm + n_gripper)``, float32 or
                float64.

        Returns:
            The closing and the approach axis, as below, unit vectors, shape ``(nworld, 3)`` each,
            float32.
        """
        self._take("command", self._given, command)
        self._launch(
            directions_kernel, [self._chain, self._wp_given, self._wp_closing, self._wp_approach]
        )
        return self._closing, self._approach

    def closing_axis(self, command: torch.Tensor) -> torch.Tensor:
        """Unit vector from the first grasp_point site to the second; zero where they meet.

        Args:
            command: Joint positions [rad, m], shape ``(nworld, n_arm + n_gripper)``, float32 or
                float64.

        Returns:
            The closing axis, shape ``(nworld, 3)``, float32.
        """
        return self.directions(command)[0]

    def approach(self, command: torch.Tensor) -> torch.Tensor:
        """The robot's approach axis, from the wrist towards what is grasped.

        Args:
            command: Joint positions [rad, m], shape ``(nworld, n_arm + n_gripper)``, float32 or
                float64.

        Returns:
            A unit vector, shape ``(nworld, 3)``, float32.
        """
        return self.directions(command)[1]

    def solve(
        self,
        command: torch.Tensor,
        target: torch.Tensor,
        posture: torch.Tensor | None = None,
        approach: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Moves the robot's ik joints from a command towards a target; the other joints stay as
        given.

        The ik joints end within the range of the joint and of its actuator, whatever they start
        from, and the result is never farther from the target than the start, put within that range;
        with a gain, not if that makes it more than 20 um. A world whose command, target, posture or
        approach is not finite keeps its command, and its distance is NaN; the others do not notice.

        Args:
            command: Where to start [rad, m], shape ``(nworld, n_arm + n_gripper)``, float32 or
                float64.
            target: Where the grasp point goes [m], shape ``(nworld, 3)``, float32 or float64.
            posture: Where ``posture_gain`` draws the ik joints [rad, m], shape ``(n_arm +
                n_gripper,)`` for all worlds or ``(nworld, n_arm + n_gripper)``; the robot's home if
                None.
            approach: Where ``approach_gain`` turns the approach axis, unit vectors, shape
                ``(nworld, 3)``; down if None.

        Returns:
            The new command, shape ``(nworld, n_arm + n_gripper)``, and the distance that is left
            [m], shape ``(nworld,)``, both float32.

        Raises:
            ArgumentError: A shape is wrong, or there is a posture or an approach and no gain for
                it.
        """
        self._take("command", self._given, command)
        self._take("target", self._target, target)
        if posture is not None:
            if self._posture_gain == 0.0:
                raise ArgumentError(
                    "posture",
                    "one",
                    "None, because posture_gain is 0",
                    "Build the solver with a posture_gain",
                )
            self._take(
                "posture",
                self._posture,
                posture.expand(self.nworld, -1) if posture.dim() == 1 else posture,
            )
        if approach is not None:
            if self._approach_gain == 0.0:
                raise ArgumentError(
                    "approach",
                    "one",
                    "None, because approach_gain is 0",
                    "Build the solver with an approach_gain",
                )
            self._take("approach", self._wished, approach)
        self._launch(
            self._kernel,
            [
                self._chain,
                self._wp_given,
                self._wp_target,
                self._wp_home if posture is None else self._wp_posture,
                self._wp_down if approach is None else self._wp_wished,
                *self._settings,
                self._wp_command,
                self._wp_distance,
                self._wp_unreachable,
            ],
        )
        return self._command, self._distance

    def _launch(self, kernel: wp.Kernel, inputs: list[Any]) -> None:
        """Runs a kernel over the worlds, in torch's order."""
        with torch_stream_scope(self._device):
            wp.launch(kernel, dim=self.nworld, inputs=inputs, block_dim=self._block_dim)

    def _take(self, name: str, buffer: torch.Tensor, values: torch.Tensor) -> None:
        """Copies an argument into float32 memory that keeps its address."""
        if values.shape != buffer.shape:  # else copy_ would broadcast it
            raise ArgumentError(
                name, f"shape {tuple(values.shape)}", f"shape {tuple(buffer.shape)}"
            )
        buffer.copy_(values)


def _round_inwards(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Limits as float32 that are not outside of the given ones."""
    low32 = low.astype(np.float32)
    high32 = high.astype(np.float32)
    return (
        np.where(low32 < low, np.nextafter(low32, np.float32(np.inf)), low32),
        np.where(high32 > high, np.nextafter(high32, np.float32(-np.inf)), high32),
    )


def _build_chain(
    model: mujoco.MjModel,
    robot: RobotCfg,
    joints: list[int],
    moved: list[int],
    low: np.ndarray,
    high: np.ndarray,
) -> tuple[Chain, Shape]:
    """Reads the bodies from the world to each site.

    Args:
        model: The compiled model.
        robot: The robot's profile.
        joints: Joint index of each column of the command.
        moved: Columns that inverse kinematics moves.
        low: Where each column is kept, from here [rad, m].
        high: To there [rad, m].

    Returns:
        The chain, in Warp arrays on the current device, and its shape.
    """
    first, second = (find(model, "site", name) for name in robot.grasp_sites)
    first_path = _path(model, model.site_bodyid[first])
    second_path = _path(model, model.site_bodyid[second])
    shared = len([body for body in first_path if body in second_path])
    columns = {joint: column for column, joint in enumerate(joints)}
    chain = Chain()
    links = []

    def extend(bodies: list[int], start: _Pose) -> _Pose:
        """Appends the bodies' links; returns the frame after them, seen from the last
        one's joint.
        """
        pose = start
        for body in bodies:
            pose = _compose(pose, (model.body_pos[body], model.body_quat[body]))
            for joint in _joints(model, body):
                if joint in columns:
                    pose = _compose(pose, (model.jnt_pos[joint], _NO_TURN))
                    links.append(_read_link(model, joint, pose, columns[joint]))
                    pose = (-model.jnt_pos[joint], _NO_TURN)
        return pose

    trunk = extend(first_path[:shared], (np.zeros(3), _NO_TURN))
    chain.trunk = len(links)
    chain.approach = wp.vec3(
        *_read_approach(model, robot, first_path[:shared], trunk, set(columns))
    )
    end = extend(first_path[shared:], trunk)
    chain.first_site = wp.vec3(*_compose(end, (model.site_pos[first], _NO_TURN))[0])
    chain.fork = len(links)
    end = extend(second_path[shared:], trunk)
    chain.second_site = wp.vec3(*_compose(end, (model.site_pos[second], _NO_TURN))[0])
    chain.end = len(links)
    kinds = [kind for _, _, kind, _ in links]
    column = [column for *_, column in links]
    chain.frame = wp.array(
        [[*pos, *quat[1:], quat[0]] for (pos, quat), *_ in links], dtype=wp.transform
    )  # Warp: xyzw
    chain.axis = wp.array([axis for _, axis, *_ in links], dtype=wp.vec3)
    chain.kind = wp.array(kinds, dtype=int)
    chain.column = wp.array(column, dtype=int)
    chain.low = wp.array(low[column], dtype=float)
    chain.high = wp.array(high[column], dtype=float)
    shape = Shape(tuple(kinds), tuple(c in moved for c in column), chain.trunk, chain.fork)
    return chain, shape


def _read_approach(
    model: mujoco.MjModel, robot: RobotCfg, trunk: list[int], end: _Pose, commanded: set[int]
) -> np.ndarray:
    """The approach axis seen from the trunk's last link.

    Args:
        model: The compiled model.
        robot: The robot's profile.
        trunk: Bodies that carry both sites, from the world's side.
        end: Frame of the last of them, seen from the trunk's last link.
        commanded: Joints that have a column in the command.
    """
    first = max((i for i, b in enumerate(trunk) if commanded & set(_joints(model, b))), default=0)
    rigid = trunk[first:]
    body = approach_body(model, robot)
    if body not in rigid:
        names = ", ".join(model.body(b).name for b in rigid) or "none"
        expected = (
            "a body that carries both grasp_point sites and that every joint before them moves:"
            f" {names}"
        )
        raise ConfigError("robot.approach_body", model.body(body).name, expected)
    turn = np.empty(4)
    back = end[1].copy()  # from the last body of the trunk to this one, against the way
    for b in reversed(rigid[rigid.index(body) + 1 :]):
        mujoco.mju_negQuat(turn, model.body_quat[b])
        mujoco.mju_mulQuat(back, back.copy(), turn)
    out = np.empty(3)
    mujoco.mju_rotVecQuat(out, np.array(robot.approach_axis, dtype=float), back)
    return out / np.linalg.norm(out)


def _read_link(model: mujoco.MjModel, joint: int, pose: _Pose, column: int) -> _Link:
    """A joint whose frame at qpos0 is ``pose``. The frame at command 0 is turned, or shifted, back
    by qpos0.
    """
    kind = int(model.jnt_type[joint])
    axis = model.jnt_axis[joint].copy()
    if kind not in _KINDS:
        name = model.joint(joint).name
        type_ = mujoco.mjtJoint(kind).name.removeprefix("mjJNT_").lower()
        raise MjstackError(
            f"joint '{name}' is of type {type_}, expected hinge or slide. Command no other joints."
        )
    zero = float(model.qpos0[model.jnt_qposadr[joint]])
    turn = _NO_TURN.copy()
    if _KINDS[kind] == HINGE:
        mujoco.mju_axisAngle2Quat(turn, axis, -zero)
        back = (np.zeros(3), turn)
    else:
        back = (-zero * axis, turn)
    return _compose(pose, back), axis, _KINDS[kind], column


def _path(model: mujoco.MjModel, body: int) -> list[int]:
    """Bodies from the world, which is left out, to one."""
    path: list[int] = []
    while body:
        path.insert(0, int(body))
        body = model.body_parentid[body]
    return path


def _joints(model: mujoco.MjModel, body: int) -> range:
    return range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])


def _compose(a: _Pose, b: _Pose) -> _Pose:
    pos = np.empty(3)
    quat = np.empty(4)
    mujoco.mju_mulPose(pos, quat, a[0], a[1], b[0], b[1])
    return pos, quat
