"""Reach of an arm: inverse kinematics of many points at once in NumPy, for checks and maps.

`mink_ik` plans and `batched_ik` runs with the worlds. Here points have nothing to do with worlds,
Warp is not loaded, and the gripper's tilt matters too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from mjstack.config.schema import RobotCfg
from mjstack.kinematics.joints import approach_body, joint_limits
from mjstack.scene.index import find

_DAMPING = 1e-3  # [m/rad] of the steps towards a point
_MAX_STEP = 0.3  # [rad, m] per joint and iteration
_CONVERGED = 1e-6  # [m]
_STILL = 1e-5  # [rad, m] a smaller step ends the search
_POINTING = 0.02  # [m/rad] weight of the approach axis against the position
# [rad] off home, of each hinge after the first: every start has its own branch of solutions
_STARTS = (-0.6, 0.0, 0.6)


@dataclass(frozen=True, slots=True)
class Reached:
    """Solutions at the points.

    Attributes:
        q: Positions of the ik joints [rad, m], shape ``(n, joints)``.
        distance: Distance of the grasp point from the point [m], shape ``(n,)``.
        tilt: Angle of the approach axis to straight down [rad], shape ``(n,)``.
    """

    q: np.ndarray
    distance: np.ndarray
    tilt: np.ndarray


class PointReach:
    """Inverse kinematics for one opening of the gripper, without collisions.

    Arm joints are hinges and slides. Those that are not ik joints stay at the robot's home, or
    where they are locked.
    """

    def __init__(self, model: mujoco.MjModel, robot: RobotCfg, gripper: Sequence[float]) -> None:
        """Read axes and limits of the ik joints.

        Args:
            model: A compiled model that contains the robot, alone or in a scene. It is not kept.
            robot: The robot's profile.
            gripper: Joint positions of the gripper [rad, m].

        Raises:
            UnknownName: The model lacks a joint or site of the robot.
        """
        data = mujoco.MjData(model)
        n_arm = len(robot.arm_joints)
        positions = dict(
            zip(
                [*robot.arm_joints, *robot.gripper_joints],
                [*robot.home[:n_arm], *gripper],
                strict=True,
            )
        )
        positions |= robot.locked
        for name, value in positions.items():
            data.qpos[model.jnt_qposadr[find(model, "joint", name)]] = value
        mujoco.mj_kinematics(model, data)
        joints = sorted(
            (find(model, "joint", name) for name in robot.ik_joints),
            key=lambda j: int(model.jnt_bodyid[j]),
        )
        self._slides = model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_SLIDE
        self._home = np.array([positions[model.joint(j).name] for j in joints])
        self._anchors = data.xanchor[joints].copy()
        self._axes = data.xaxis[joints].copy()
        sites = [find(model, "site", name) for name in robot.grasp_sites]
        self._tip = data.site_xpos[sites].mean(axis=0)
        turned = data.xmat[approach_body(model, robot)].reshape(3, 3)
        self._pointing = turned @ robot.approach_axis
        self._low, self._high = joint_limits(model, [model.joint(j).name for j in joints])

    def solve(self, points: np.ndarray, iterations: int = 60) -> Reached:
        """Bring the grasp point as near to each point as possible, from a few starts.

        Args:
            points: Targets [m], shape ``(n, 3)``.
            iterations: Most steps per start.
        """
        q = np.tile(self._home, (len(points), 1))
        distance = np.full(len(points), np.inf)
        for off in sorted(_STARTS, key=abs):
            left = np.flatnonzero(distance > _CONVERGED)
            if not left.size:
                break
            found, error = self._descend(self._start(points[left], off), points[left], iterations)
            better = error < distance[left]
            q[left[better]] = found[better]
            distance[left[better]] = error[better]
        return Reached(q, distance, self._tilt(q))

    def solve_upright(self, points: np.ndarray, tolerance: float, iterations: int = 60) -> Reached:
        """Solve, and of the solutions within tolerance take the one with the least tilt.

        Args:
            points: Targets [m], shape ``(n, 3)``.
            tolerance: Distance that counts as reached [m].
            iterations: Most steps per start.
        """
        best = self.solve(points, iterations)
        q = best.q.copy()
        distance = best.distance.copy()
        tilt = best.tilt.copy()
        reached = np.flatnonzero(distance <= tolerance)
        for start in [q[reached], *(self._start(points[reached], off) for off in _STARTS)]:
            found, _ = self._descend(start, points[reached], iterations, _POINTING)
            found, error = self._descend(found, points[reached], iterations)
            lower = (error <= tolerance) & (self._tilt(found) < tilt[reached])
            rows = reached[lower]
            q[rows], distance[rows], tilt[rows] = (
                found[lower],
                error[lower],
                self._tilt(found)[lower],
            )
        return Reached(q, distance, tilt)

    def _start(self, points: np.ndarray, off: float) -> np.ndarray:
        """Home with the other hinges bent by ``off``; a first hinge that is upright turns towards
        the points.
        """
        q = np.tile(self._home + np.where(self._slides, 0.0, off), (len(points), 1))
        axis = self._axes[0]
        anchor = self._anchors[0]
        q[:, 0] = self._home[0]
        if abs(axis[2]) > 0.99 and not self._slides[0]:
            ahead = points - anchor
            arm = self._tip - anchor
            turn = np.arctan2(ahead[:, 1], ahead[:, 0]) - np.arctan2(arm[1], arm[0])
            q[:, 0] += np.sign(axis[2]) * ((turn + np.pi) % (2.0 * np.pi) - np.pi)
        return np.clip(q, self._low, self._high)

    def _descend(
        self, start: np.ndarray, points: np.ndarray, iterations: int, pointing: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Damped least squares within the limits. Reached points drop out, unless ``pointing``
        reduces their tilt.
        """
        q = start.copy()
        left = np.arange(len(points))
        for _ in range(iterations):
            jacobian, tip, direction = self._forward(q[left])
            error = points[left] - tip
            far = np.linalg.norm(error, axis=1)
            if pointing:
                turning = np.cross(self._world_axes, direction[:, None]).swapaxes(1, 2)
                turning[..., self._slides] = 0.0
                jacobian = np.concatenate((jacobian, pointing * turning), axis=1)
                error = np.concatenate((error, pointing * ([0.0, 0.0, -1.0] - direction)), axis=1)
            else:
                keep = far > _CONVERGED
                left = left[keep]
                jacobian = jacobian[keep]
                error = error[keep]
                far = far[keep]
                if not left.size:
                    break
            step = self._step(
                q[left], jacobian, error, _DAMPING if pointing else _DAMPING + 0.05 * far
            )
            moved = np.clip(q[left] + step, self._low, self._high)
            still = np.abs(moved - q[left]).max(axis=1) < _STILL
            q[left] = moved
            left = left[~still]
            if not left.size:
                break
        return q, np.linalg.norm(points - self._forward(q)[1], axis=1)

    def _step(
        self, q: np.ndarray, jacobian: np.ndarray, error: np.ndarray, damping: np.ndarray | float
    ) -> np.ndarray:
        """One step. A joint that would leave its range is held, and the others are solved again."""
        weight = np.broadcast_to(np.square(damping), len(q))[:, None, None] * np.eye(q.shape[1])
        free = np.ones_like(q, dtype=bool)
        for _ in range(3):
            open_ = jacobian * free[:, None]
            rhs = np.einsum("nij,ni->nj", open_, error)[..., None]
            step = (
                np.linalg.solve(np.einsum("nij,nik->njk", open_, open_) + weight, rhs)[..., 0]
                * free
            )
            out = ((q <= self._low) & (step < 0.0)) | ((q >= self._high) & (step > 0.0))
            if not out.any():
                break
            free &= ~out
        return step * np.minimum(
            1.0, _MAX_STEP / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12)
        )

    def _forward(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Jacobian ``(n, 3, joints)``, grasp point and pointing direction, both ``(n, 3)``.

        A product of exponentials: each joint moves the links after it about, or along, its axis at
        home.
        """
        n, joints = q.shape
        rotation = np.tile(np.eye(3), (n, 1, 1))
        shift = np.zeros((n, 3))
        axes = np.empty((n, joints, 3))
        anchors = np.empty((n, joints, 3))
        for k, (axis, anchor) in enumerate(zip(self._axes, self._anchors, strict=True)):
            axes[:, k] = rotation @ axis
            anchors[:, k] = rotation @ anchor + shift
            if self._slides[k]:
                shift = shift + axes[:, k] * (q[:, k] - self._home[k])[:, None]
                continue
            turn = _rotations(axis, q[:, k] - self._home[k])
            shift = shift + np.einsum("nij,nj->ni", rotation, anchor - turn @ anchor)
            rotation = rotation @ turn
        tip = rotation @ self._tip + shift
        self._world_axes = axes
        columns = np.where(self._slides[:, None], axes, np.cross(axes, tip[:, None] - anchors))
        return columns.swapaxes(1, 2), tip, rotation @ self._pointing

    def _tilt(self, q: np.ndarray) -> np.ndarray:
        return np.arccos(np.clip(-self._forward(q)[2][:, 2], -1.0, 1.0))


def _rotations(axis: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Rotations about one axis, shape ``(n, 3, 3)``."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    s = np.sin(angles)[:, None, None]
    c = np.cos(angles)[:, None, None]
    return np.eye(3) + s * cross + (1.0 - c) * (cross @ cross)
