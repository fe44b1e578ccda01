"""Native worlds that compute with the errors of float32, to measure what these change."""

from collections.abc import Mapping

import mujoco
import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from mjstack.sim.model_fields import FIELD_NAMES
from mjstack.sim.native import NativeSimulation

UNIT = 2.0**-24
"""Largest relative error of rounding to float32."""

_SEARCHED = [
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in ("CYLINDER", "ELLIPSOID", "MESH")
]
_OFF = 1e-5  # m and parts of a quaternion: ten times the tolerance of MuJoCo's search
_TOLERANCE = 1e-8  # of a solver in float32
_LINKS = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
_TERMS = 4  # of a moment of inertia about an axis elsewhere, each of which is rounded


class RoundedSimulation(NativeSimulation):
    """Native worlds whose model, state at every step, inertia times acceleration, and forces of
    constraint rows are off by up to float32's rounding, in each world otherwise. Shapes whose
    contacts MuJoCo has to search for, such as cylinders, lie elsewhere by less than a search in
    float32 can tell.

    Inertia is off by its rounding about the centre of mass of its tree: light links far from it,
    such as a wrist's, lose most by it. If equalities connect bodies, they lie elsewhere by the
    rounding of their positions in the world, which cancels along a chain but not around a loop.
    """

    def __init__(
        self, model: mujoco.MjModel, nworld: int, fields: Mapping[str, Tensor] | None = None
    ) -> None:
        """Arguments as of `NativeSimulation`; ``fields`` are values of one world, which all get."""
        super().__init__(model, nworld, fields=FIELD_NAMES)
        tolerances = np.geomspace(max(model.opt.tolerance, _TOLERANCE), _TOLERANCE, nworld)
        self.batch.expand("opt.tolerance")[:] = tolerances
        self._generator = torch.Generator().manual_seed(0)
        for name, values in (fields or {}).items():
            self.fields[name].copy_(values)
        self._round(*self.fields.values())
        linked = np.isin(model.eq_type, _LINKS).any()
        names = ("body_inertia", *("body_pos", "body_quat") * bool(linked))
        self._bodies = {name: self.fields[name].clone() for name in names}
        solid = (model.geom_contype | model.geom_conaffinity) > 0
        geoms = np.flatnonzero(np.isin(model.geom_type, _SEARCHED) & solid)
        for name in ("geom_pos", "geom_quat"):
            field = self.fields[name]
            field[:, geoms] += _OFF * self._random(nworld, len(geoms), field.shape[-1])

    @override
    def step(self, n: int = 1, *, kinematics: bool = False) -> None:
        for left in reversed(range(n)):
            self._round(self.qpos, self.qvel, self.ctrl)
            super().step(kinematics=kinematics and not left)

    @override
    def forward(self) -> None:
        """Compute everything, and the errors for the steps that follow: of bodies, of the inertia
        matrix and of the rows' forces.
        """
        self._round(self.qpos, self.qvel)
        super().forward()
        data = mujoco.MjData(self.model)
        for name in ("qpos", "qvel", "act", "ctrl"):
            getattr(data, name)[:] = getattr(self, name)[0]
        mujoco.mj_forward(self.model, data)
        away = data.xipos - data.subtree_com[self.model.body_rootid]
        sizes = {
            "body_pos": np.abs(data.xpos).max(1),
            "body_quat": np.ones(self.model.nbody),
            "body_inertia": _TERMS * self.model.body_mass * (away**2).sum(1),
        }
        for name, values in self._bodies.items():
            unit = UNIT * torch.from_numpy(sizes[name])[:, None]
            self.fields[name].copy_(values + unit * self._random(*values.shape))
        inertia = np.empty((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, data, inertia)
        inertial = self._random(self.nworld, *inertia.shape).numpy() * inertia @ data.qacc
        errors = self._random(self.nworld, data.nefc).numpy() * data.efc_force
        applied = self.batch.bind("qfrc_applied")
        for error, row in zip(errors, applied, strict=True):
            mujoco.mj_mulJacTVec(self.model, data, row, error)
        applied[:] = UNIT * (applied + inertial)

    def _round(self, *views: Tensor) -> None:
        for view in views:
            view *= 1.0 + UNIT * self._random(*view.shape)

    def _random(self, *shape: int) -> Tensor:
        """Numbers between -1 and 1, float64."""
        return 2.0 * torch.rand(shape, generator=self._generator, dtype=torch.float64) - 1.0
