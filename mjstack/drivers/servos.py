"""Servos as a driver without a clock leads them."""

import mujoco
import torch
from torch import Tensor

from mjstack.drivers.feedback import State
from mjstack.managers.view import EnvView
from mjstack.math import quat_to_matrix
from mjstack.robots.bodies import ancestors
from mjstack.sim.simulation import Columns


class ServoInverse:
    """By how much servos that differ between worlds, or have backlash, are to be led."""

    def __init__(self, env: EnvView) -> None:
        """Find the figures of the robot's servos, and the weights that they hold."""
        cfg = env.cfg
        self._sim = env.sim

        def live(name: str) -> Tensor:
            if name in env.sim.fields:
                return env.sim.fields[name]
            return torch.from_numpy(getattr(env.sim.model, name)[None].copy()).to(env.device)

        self._gain, self._bias, self._damping, self._friction = map(
            live, ("actuator_gainprm", "actuator_biasprm", "dof_damping", "dof_frictionloss")
        )
        self._servos, self._dofs = (
            Columns(at, env.device) for at in (env.index.ctrl, env.index.robot_qvel)
        )
        self._backlash = cfg.robot.backlash
        self._dt = cfg.timing.step_dt
        moves = [name in cfg.robot.ik_joints for name in cfg.robot.joints]
        self._moves = torch.tensor(moves, device=env.device)

        # Weights that each hinge holds: of the bodies that it moves, and of objects in the hand
        model = env.sim.model
        joints = [model.joint(name).id for name in cfg.robot.joints]
        self._carriers = Columns(model.jnt_bodyid[joints], env.device)
        objects = [env.index.bodies[name] for name in cfg.scene.objects]
        above = [{*ancestors(model, body)} for body in range(model.nbody)]
        moved = [[carrier in bodies for bodies in above] for carrier in self._carriers.indices]
        force = -model.opt.gravity[2] * model.body_mass * (1.0 - model.body_gravcomp)
        hinges = model.jnt_type[joints, None] == mujoco.mjtJoint.mjJNT_HINGE
        self._weights, self._loads, self._centers, self._anchors, self._axes = (
            torch.from_numpy(values).to(env.device, torch.float32)
            for values in (
                moved * force * hinges,
                force[objects] * hinges,
                model.body_ipos,
                model.jnt_pos[joints],
                model.jnt_axis[joints],
            )
        )

    def lead(self, change: Tensor, state: State, holds: Tensor) -> Tensor:
        """The change of the joint targets that moves joints by a change in a control step [rad, m],
        each ``(nworld, nu)``: beyond their lag, except in worlds that hold, ``(nworld,)`` bool;
        beyond dry friction and backlash; and beyond what gravity pulls.
        """
        stiffness = self._servos.read(self._gain)[..., 0]
        damping = self._dofs.read(self._damping) - self._servos.read(self._bias)[..., 2]
        lag = (damping / stiffness).clamp(min=1e-6)
        share = torch.where(self._moves & ~holds[:, None], 1.0 - torch.exp(-self._dt / lag), 1.0)
        stick = self._dofs.read(self._friction) / stiffness + self._backlash
        stick = stick * change / (change.abs() + stick).clamp(min=1e-6)
        return (change / share + stick + self._hold(state) / stiffness).to(change)

    def sag(self, state: State) -> Tensor:
        """How far the servos give under the arm's weight and what is in the hand [rad, m],
        ``(nworld, nu)``.
        """
        return self._hold(state) / self._servos.read(self._gain)[..., 0]

    def _hold(self, state: State) -> Tensor:
        """Torques that hold the arm up, with what is in the hand [N m], ``(nworld, nu)``."""
        sim = self._sim
        turns = quat_to_matrix(sim.xquat.float())
        centers = sim.xpos.float() + (turns * self._centers[:, None]).sum(-1)
        turns = self._carriers.read(turns)
        at = self._carriers.read(sim.xpos).float() + (turns * self._anchors[:, None]).sum(-1)
        x, y, _ = (turns * self._axes[:, None]).sum(-1).unbind(-1)

        def torque(points: Tensor, weights: Tensor) -> Tensor:
            off = points[:, None] - at[:, :, None]
            return ((x[..., None] * off[..., 1] - y[..., None] * off[..., 0]) * weights).sum(-1)

        loads = self._loads * state.in_hand[:, None]
        return torque(centers, self._weights) + torque(state.pos, loads)
