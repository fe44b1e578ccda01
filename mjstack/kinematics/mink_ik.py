"""Inverse kinematics with mink on a model of the robot alone: the reference, which plans grasps."""

import copy
import math

import mink
import numpy as np
from numpy import ndarray

from mjstack.config.mjcf import compile_scene
from mjstack.config.schema import ModelCfg, RobotCfg
from mjstack.robots import robot_spec
from mjstack.robots.guest import grasp_jacobian, mujoco_errors
from mjstack.robots.posture import Posture, posture
from mjstack.scene.index import locked_home

_POSTURE_COST = 1e-3  # pulls the redundant joints home; moves the grasp point by micrometres
_ITERATIONS = 60  # at most, per solve
_CONVERGED = 0.1  # share of the tolerance: Newton's method squares the error, so that is enough
_MAX_STEP = 0.3  # [rad, m] per iteration: a far target is approached on one branch of solutions


class GraspPointTask(mink.Task):
    """Drive the grasp point, the midpoint of two sites, to a point.

    The midpoint belongs to no single frame: on a jaw that swings it moves with the jaw's angle.
    """

    def __init__(self, sites: list[int]) -> None:
        """Store the two site indices; the target is set before each solve."""
        super().__init__(cost=np.ones(3))
        self.target = np.zeros(3)
        self._sites = sites

    def compute_error(self, configuration: mink.Configuration) -> ndarray:
        """Grasp point minus target [m], shape ``(3,)``."""
        return configuration.data.site_xpos[self._sites].mean(axis=0) - self.target

    def compute_jacobian(self, configuration: mink.Configuration) -> ndarray:
        """Mean of the two sites' translational Jacobians, shape ``(3, nv)``."""
        return grasp_jacobian(configuration.data, self._sites)


class _Frozen(mink.DofFreezingTask):
    """Hold degrees of freedom; those that follow a moving joint go along."""

    def __init__(
        self, configuration: mink.Configuration, coupling: Posture, moving: ndarray
    ) -> None:
        """Take the numbers of the commanded joints that move."""
        model = configuration.model
        addresses = model.jnt_qposadr[model.dof_jntid]
        self._columns = [addresses.tolist().index(c) for c in coupling.commanded[moving]]
        super().__init__(model, np.setdiff1d(np.arange(model.nv), self._columns).tolist())
        self._coupling = coupling
        self._moving = moving
        self.along = bool(np.isin(coupling.leader, moving).any())

    def compute_jacobian(self, configuration: mink.Configuration) -> ndarray:
        """Rows of the identity, less the slopes of what goes along, shape ``(frozen, nv)``."""
        jacobian = super().compute_jacobian(configuration).copy()
        if self.along:
            shares = self._coupling.shares(configuration.q[self._coupling.commanded])
            jacobian[:, self._columns] -= shares[self.dof_indices][:, self._moving]
        return jacobian


class GraspIk:
    """Arm positions that bring the grasp point to a target at a given gripper opening."""

    def __init__(self, robot: RobotCfg, model: ModelCfg, *, tolerance: float) -> None:
        """Compile the robot without a scene, from its description ``model``; ``tolerance`` is the
        distance that counts as reached [m].
        """
        with mujoco_errors(robot.name):
            spec = robot_spec(robot, model)
            spec.compiler.discardvisual = True
            self.model = compile_scene(spec)
        self.tolerance = tolerance
        joints = [self.model.joint(name).id for name in robot.joints]
        self._qpos = self.model.jnt_qposadr[joints]
        self._coupling = posture(self.model, tuple(robot.joints))
        self.home = locked_home(robot)
        self._configuration = mink.Configuration(self.model)
        moving = np.array([robot.joints.index(name) for name in robot.ik_joints])
        moving = np.setdiff1d(moving, self._coupling.coupled)
        self._frozen = _Frozen(self._configuration, self._coupling, moving)
        self._task = GraspPointTask([self.model.site(name).id for name in robot.grasp_sites])
        self._posture = mink.PostureTask(self.model, cost=_POSTURE_COST)
        limited = copy.copy(self.model)
        limited.jnt_limited[np.setdiff1d(np.arange(self.model.njnt), joints)] = False
        limited.jnt_range[joints] = self._coupling.limits
        self._limits = [mink.ConfigurationLimit(limited, gain=1.0)]
        self._posture.set_target(self._coupling.qpos(self.home))

    def solve(self, target: ndarray, start: ndarray) -> tuple[ndarray, float]:
        """Find joint positions [rad, m], shape ``(nu,)``, arm joints first, for a target of the
        grasp point [m], shape ``(3,)``, from those of ``start``; the gripper's stay. Returns them,
        and the distance that is left [m].
        """
        self._task.target[:] = target
        configuration = self._configuration
        configuration.update(self._coupling.qpos(start))
        nearest = configuration.q[self._qpos].copy()
        distance = math.inf
        for _ in range(_ITERATIONS):
            try:
                step = mink.solve_ik(
                    configuration,
                    [self._task, self._posture],
                    dt=1.0,
                    solver="daqp",
                    damping=1e-9,
                    limits=self._limits,
                    constraints=[self._frozen],
                )
            except mink.NoSolutionFound:
                break
            largest = float(np.abs(step).max())
            configuration.integrate_inplace(step * min(1.0, _MAX_STEP / max(largest, 1e-12)), 1.0)
            if self._frozen.along:
                command = self._coupling.agree(configuration.q[self._qpos])
                configuration.update(self._coupling.qpos(command))
            left = float(np.linalg.norm(self._task.compute_error(configuration)))
            # The pull towards home can end in oscillations, farther from the target.
            if left < distance:
                nearest = configuration.q[self._qpos].copy()
                distance = left
            if distance < _CONVERGED * self.tolerance:
                break
        if math.isinf(distance):
            distance = float(np.linalg.norm(self._task.compute_error(configuration)))
        return nearest, distance

    def grasp_point(self, q: ndarray) -> ndarray:
        """Grasp point [m] at joint positions of shape ``(nu,)``, shape ``(3,)``."""
        self._configuration.update(self._coupling.qpos(q))
        return self._task.compute_error(self._configuration) + self._task.target
