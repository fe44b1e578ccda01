"""Reach of an arm: inverse kinematics of many points at once in NumPy, for checks.

`mink_ik` plans and `batched_ik` runs with the worlds. Here points have nothing to do with worlds,
and Warp is not loaded.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy import ndarray

from mjstack.config.schema import RobotCfg
from mjstack.robots.guest import grasp_jacobian
from mjstack.robots.posture import posture
from mjstack.scene.index import joint_limits, locked_home

_ITERATIONS = 60  # at most, per start
_DAMPING = 1e-3  # [m/rad] at the point; it grows with the distance
_MAX_STEP = 0.3  # [rad, m] per joint and iteration
_CONVERGED = 1e-6  # [m]
_STILL = 1e-5  # [rad, m] a smaller step ends the search
# [rad] off home, of each hinge after the first: every start has its own branch of solutions
STARTS = (0.0, -0.6, 0.6)


class PointReach:
    """Inverse kinematics for one opening of the gripper, without collisions.

    Arm joints are hinges and slides. Those that are not ik joints stay at the robot's home, or
    where they are locked.
    """

    def __init__(self, model: mujoco.MjModel, robot: RobotCfg, gripper: Sequence[float]) -> None:
        """Read axes and limits of the ik joints from a compiled model, which contains the robot,
        alone or in a scene, and is not kept. ``gripper`` has the gripper's positions [rad, m].
        """
        data = mujoco.MjData(model)
        home = locked_home(robot)
        home[len(robot.arm_joints) :] = gripper
        self._coupling = coupling = posture(model, tuple(robot.joints))
        data.qpos[:] = coupling.qpos(home)
        mujoco.mj_kinematics(model, data)
        moving = {robot.joints.index(name) for name in robot.ik_joints} - {*coupling.coupled}
        joints = sorted(
            (model.joint(robot.joints[k]).id for k in moving),
            key=lambda j: int(model.jnt_bodyid[j]),
        )
        self._native = (data, home) if moving & {*coupling.leader} else None
        self._columns = [robot.joints.index(model.joint(joint).name) for joint in joints]
        self._hinges = model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE
        self._home = data.qpos[model.jnt_qposadr[joints]]
        self._anchors = data.xanchor[joints].copy()
        self._axes = data.xaxis[joints].copy()
        sites = [model.site(name).id for name in robot.grasp_sites]
        self._sites = sites
        self.tip = data.site_xpos[sites].mean(axis=0)  # the grasp point at home [m], ``(3,)``
        self._low, self._high = joint_limits(model, robot, self._columns)

    def solve(self, points: ndarray) -> tuple[ndarray, ndarray]:
        """Bring the grasp point as near to each point [m], shape ``(n, 3)``, as possible, from a
        few starts. Returns positions of the ik joints [rad, m], shape ``(n, joints)``, and the
        distance that is left [m], shape ``(n,)``.
        """
        best = np.tile(self._home, (len(points), 1))
        distance = np.linalg.norm(points - self.forward(best)[1], axis=1)
        for off in STARTS:
            if (distance <= _CONVERGED).all():
                break
            q = self.descend(self.start(points, off), points)
            left = np.linalg.norm(points - self.forward(q)[1], axis=1)
            better = left < distance
            best[better] = q[better]
            distance[better] = left[better]
        return best, distance

    def start(self, points: ndarray, off: float) -> ndarray:
        """Home, other hinges bent by ``off`` [rad], a first upright one towards the points."""
        q = np.tile(self._home + off * self._hinges, (len(points), 1))
        q[:, 0] = self._home[0]
        up = self._axes[0, 2]
        if abs(up) > 0.99 and self._hinges[0]:
            plane = np.array([1.0, 1.0j, 0.0])
            arm = (self.tip - self._anchors[0]) @ plane
            q[:, 0] += np.sign(up) * np.angle((points - self._anchors[0]) @ plane * arm.conj())
        return np.clip(q, self._low, self._high)

    def descend(self, start: ndarray, goals: ndarray) -> ndarray:
        """Damped least squares towards goals of `forward`, within the limits."""
        q = start.copy()
        left = np.arange(len(goals))
        for _ in range(_ITERATIONS):
            if not left.size:
                break
            jacobian, pose = self.forward(q[left])
            error = goals[left] - pose
            damping = _DAMPING + 0.05 * np.linalg.norm(error, axis=1)
            before = q[left]
            step = self._step(before, jacobian, error, damping)
            q[left] = np.clip(before + step, self._low, self._high)
            left = left[np.abs(q[left] - before).max(axis=1) >= _STILL]
        return q

    def _step(self, q: ndarray, jacobian: ndarray, error: ndarray, damping: ndarray) -> ndarray:
        """One step. A joint that would leave its range is held, and the others are solved again."""
        weight = np.square(damping)[:, None, None] * np.eye(q.shape[1])
        free = np.ones_like(q, dtype=bool)
        for _ in range(3):
            open_ = jacobian * free[:, None]
            turned = open_.swapaxes(1, 2)
            step = np.linalg.solve(turned @ open_ + weight, turned @ error[..., None])[..., 0]
            step = free * step
            free &= ~(((q <= self._low) & (step < 0.0)) | ((q >= self._high) & (step > 0.0)))
        largest = np.abs(step).max(axis=1, keepdims=True)
        return step * np.minimum(1.0, _MAX_STEP / np.maximum(largest, 1e-12))

    def forward(self, q: ndarray) -> tuple[ndarray, ndarray]:
        """The Jacobian of the grasp point, shape ``(n, 3, joints)``, and the grasp point [m], shape
        ``(n, 3)``.

        A product of exponentials: each joint moves the links after it about, or along, its axis at
        home. Where joints follow these, MuJoCo computes both.
        """
        if self._native is not None:
            return self._forward_native(q)
        n, joints = q.shape
        rotation = np.tile(np.eye(3), (n, 1, 1))
        shift = np.zeros((n, 3))
        axes = np.empty((n, joints, 3))
        anchors = np.empty((n, joints, 3))
        for k, (axis, anchor) in enumerate(zip(self._axes, self._anchors, strict=True)):
            moved = q[:, k] - self._home[k]
            axes[:, k] = rotation @ axis
            anchors[:, k] = rotation @ anchor + shift
            if self._hinges[k]:
                rotation = rotation @ _rotations(axis, moved)
                shift = anchors[:, k] - rotation @ anchor
            else:
                shift = shift + axes[:, k] * moved[:, None]
        tip = rotation @ self.tip + shift
        rows = np.where(self._hinges[:, None], np.cross(axes, tip[:, None] - anchors), axes)
        return rows.swapaxes(1, 2), tip

    def _forward_native(self, q: ndarray) -> tuple[ndarray, ndarray]:
        assert self._native is not None
        data, home = self._native
        command = home.copy()
        jacobians, tips = np.empty((len(q), 3, q.shape[1])), np.empty((len(q), 3))
        for k, command[self._columns] in enumerate(q):
            data.qpos[:] = self._coupling.qpos(command)
            mujoco.mj_kinematics(data.model, data)
            mujoco.mj_comPos(data.model, data)
            jacobian = grasp_jacobian(data, self._sites)
            jacobians[k] = jacobian @ self._coupling.shares(command)[:, self._columns]
            tips[k] = data.site_xpos[self._sites].mean(axis=0)
        return jacobians, tips


def _rotations(axis: ndarray, angles: ndarray) -> ndarray:
    """Rotations about one axis, shape ``(n, 3, 3)``."""
    cross = np.cross(axis, np.eye(3)).T
    turns = angles[:, None, None]
    return np.eye(3) + np.sin(turns) * cross + (1.0 - np.cos(turns)) * (cross @ cross)
