"""How far the servos of an arm give under its weight."""

import mujoco
import numpy as np
import torch
from torch import Tensor

from mjstack.managers.view import EnvView
from mjstack.math import quat_to_matrix


class Sag:
    """The sag of every world's arm, by masses, links and servos of the model.

    Attributes:
        base: Number of the first link's body.
    """

    def __init__(self, env: EnvView) -> None:
        """Take from the model which weights bend which of the arm's servos, and how much."""
        self._sim = env.sim
        model = env.sim.model
        actuators = env.index.ctrl[: env.index.n_arm].tolist()
        joints = model.actuator_trnid[actuators, 0]
        bodies = np.arange(model.nbody)
        carries = np.zeros((len(joints), model.nbody), dtype=bool)
        above = bodies
        while above.any():  # from each body up to the world
            carries |= model.jnt_bodyid[joints][:, None] == above
            above = model.body_parentid[above]
        weight = model.body_mass * (1.0 - model.body_gravcomp) * abs(model.opt.gravity[2])
        heavy = bodies[carries.any(0) & (weight > 0.0)]
        bends = carries * weight / model.actuator_gainprm[actuators, :1]

        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, device=env.device)

        self.base = int(model.jnt_bodyid[joints[0]])
        self._links = tensor(model.jnt_bodyid[joints]).long()
        self._axes = tensor(model.jnt_axis[joints]).float()
        self._anchors = tensor(model.jnt_pos[joints]).float()
        self._hinges = tensor(model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE)[:, None]
        self._heavy = tensor(heavy)
        self._centers = tensor(model.body_ipos[heavy]).float()
        self._bends = tensor(bends[:, heavy]).float()

    def bend(self) -> Tensor:
        """How far each servo gives [rad, m], shape ``(nworld, n_arm)``."""
        pos = self._sim.xpos.float()
        turn = quat_to_matrix(self._sim.xquat.float())
        links = turn[:, self._links]
        axes = (links * self._axes[:, None]).sum(-1)
        anchors = pos[:, self._links] + (links * self._anchors[:, None]).sum(-1)
        centers = pos[:, self._heavy] + (turn[:, self._heavy] * self._centers[:, None]).sum(-1)
        arms = centers[:, None] - anchors[:, :, None]
        torque = axes[..., :1] * arms[..., 1] - axes[..., 1:2] * arms[..., 0]
        force = torch.where(self._hinges, torque, axes[..., 2:])
        return (force * self._bends).sum(-1)
