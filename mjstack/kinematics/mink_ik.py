"""Inverse kinematics with mink on a model of the robot alone: the reference, which plans grasps."""

import math

import mink
import mujoco
import numpy as np
from numpy import ndarray

from mjstack.config.mjcf import compile_scene
from mjstack.config.schema import ModelCfg, RobotCfg
from mjstack.errors import ConfigError
from mjstack.robots import robot_spec
from mjstack.robots.guest import mujoco_errors
from mjstack.scene.index import locked_home

_POSTURE_COST = 1e-3  # pulls the redundant joints home; moves the grasp point by micrometres
_ITERATIONS = 60  # at most, per solve
_CONVERGED = 0.1  # share of the tolerance: Newton's method squares the error, so that is enough
_MAX_STEP = 0.3  # [rad, m] per iteration: a far target is approached on one branch of solutions


class GraspPointTask(mink.Task):
    """Drive the grasp point, the midpoint of two sites, to a point.

    The midpoint belongs to no single frame: on a jaw that swings it moves with the jaw's angle.
    """

    def __init__(self, sites: list[int], nv: int) -> None:
        """Store the two site indices; the target is set before each solve."""
        super().__init__(cost=np.ones(3))
        self.target = np.zeros(3)
        self._sites = sites
        self._jac = np.empty((2, 3, nv))

    def compute_error(self, configuration: mink.Configuration) -> ndarray:
        """Grasp point minus target [m], shape ``(3,)``."""
        return configuration.data.site_xpos[self._sites].mean(axis=0) - self.target

    def compute_jacobian(self, configuration: mink.Configuration) -> ndarray:
        """Mean of the two sites' translational Jacobians, shape ``(3, nv)``."""
        for jac, site in zip(self._jac, self._sites, strict=True):
            mujoco.mj_jacSite(configuration.model, configuration.data, jac, None, site)
        return self._jac.mean(axis=0)


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
        for key in ("home", "gripper_open", "gripper_closed"):
            values = getattr(robot, key)
            for name, value in zip(robot.joints[-len(values) :], values, strict=True):
                low, high = self.model.joint(name).range
                if not low <= value <= high:
                    raise ConfigError(
                        f"robot.{key} of {name}", value, f"a value within [{low:.4g}, {high:.4g}]"
                    )
        self._qpos = self.model.jnt_qposadr[joints]
        self.home = locked_home(robot)
        self._configuration = mink.Configuration(self.model)
        moving = {int(self.model.joint(name).dofadr[0]) for name in robot.ik_joints}
        frozen = [dof for dof in range(self.model.nv) if dof not in moving]
        self._task = GraspPointTask(
            [self.model.site(name).id for name in robot.grasp_sites], self.model.nv
        )
        self._posture = mink.PostureTask(self.model, cost=_POSTURE_COST)
        self._limits = [mink.ConfigurationLimit(self.model, gain=1.0)]
        self._constraints = [mink.DofFreezingTask(self.model, frozen)]
        self._posture.set_target(self._to_qpos(self.home))

    def solve(self, target: ndarray, start: ndarray) -> tuple[ndarray, float]:
        """Find joint positions [rad, m], shape ``(nu,)``, arm joints first, for a target of the
        grasp point [m], shape ``(3,)``, from those of ``start``; the gripper's stay. Returns them,
        and the distance that is left [m].
        """
        self._task.target[:] = target
        configuration = self._configuration
        configuration.update(self._to_qpos(start))
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
                    constraints=self._constraints,
                )
            except mink.NoSolutionFound:
                break
            largest = float(np.abs(step).max())
            configuration.integrate_inplace(step * min(1.0, _MAX_STEP / max(largest, 1e-12)), 1.0)
            left = float(np.linalg.norm(self._task.compute_error(configuration)))
            # The pull towards home can end in oscillations, farther from the target.
            if left < distance:
                nearest = configuration.q[self._qpos].copy()
                distance = left
            if distance < _CONVERGED * self.tolerance:
                break
        return nearest, distance

    def grasp_point(self, q: ndarray) -> ndarray:
        """Grasp point [m] at joint positions of shape ``(nu,)``, shape ``(3,)``."""
        self._configuration.update(self._to_qpos(q))
        return self._task.compute_error(self._configuration) + self._task.target

    def _to_qpos(self, q: ndarray) -> ndarray:
        qpos = self.model.qpos0.copy()
        qpos[self._qpos] = q
        return qpos
