"""Inertia of the bodies that MuJoCo calls simple, such as a free cube, when it differs from world
to world.

Native MuJoCo does not compute the mass matrix of a simple body: it reads ``dof_M0``, which the
compiler made from mass, inertia and armature. A body whose mass is changed would weigh more and
resist no more, so ``dof_M0`` has to follow.
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np


class SimpleBodies:
    """Keeps ``dof_M0`` of simple bodies up to date with per-world mass, inertia and armature.

    Attributes:
        dof_M0: Diagonal of the mass matrix at qpos0 [kg, kg m2], shape ``(nworld, nv)``.
    """

    FIELDS = frozenset({"body_mass", "body_inertia", "dof_armature"})

    def __init__(
        self, model: mujoco.MjModel, fields: Mapping[str, np.ndarray], nworld: int
    ) -> None:
        """Finds the degrees of freedom and what their inertia is made of.

        Args:
            model: The compiled model.
            fields: Every world's values of the fields that differ.
            nworld: Number of worlds.
        """
        self.dof_M0 = np.repeat(model.dof_M0[None], nworld, axis=0)
        self._dofs = np.flatnonzero(model.dof_simplenum)
        self._bodies = model.dof_bodyid[self._dofs]
        self._sources = [
            fields.get(name, getattr(model, name)[None])
            for name in ("body_mass", "body_inertia", "dof_armature")
        ]
        # A simple body's inertial step is its own frame, so inertia is diagonal there: M0 =
        # armature + a * mass + b . inertia.
        self._a, self._b = np.zeros(len(self._dofs)), np.zeros((len(self._dofs), 3))
        for i, dof in enumerate(self._dofs):
            joint = model.dof_jntid[dof]
            k = int(dof - model.jnt_dofadr[joint])
            kind = model.jnt_type[joint]
            if kind == mujoco.mjtJoint.mjJNT_SLIDE or (
                kind == mujoco.mjtJoint.mjJNT_FREE and k < 3
            ):
                self._a[i] = 1.0
            elif kind == mujoco.mjtJoint.mjJNT_HINGE:
                axis = model.jnt_axis[joint]
                self._a[i] = np.sum(np.cross(axis, model.jnt_pos[joint]) ** 2)
                self._b[i] = axis**2
            else:
                self._b[i, k % 3] = 1.0

    def update(self) -> None:
        """Computes dof_M0 from what the fields hold now."""
        mass, inertia, armature = self._sources
        spin = (inertia[:, self._bodies] * self._b).sum(-1)
        self.dof_M0[:, self._dofs] = (
            armature[:, self._dofs] + mass[:, self._bodies] * self._a + spin
        )
