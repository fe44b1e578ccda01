"""How low bodies reach, from their poses and the shapes of their geoms."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import torch

from mjstack.math import quat_z_row

_CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
_SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)


class LowestPoint:
    """The lowest point of the colliding geoms of some bodies.

    Each geom is a box, a ball around it, and a disc across its z axis, some of them of size 0:
    together they are a box, sphere, capsule or cylinder. Of other shapes, such as meshes, the
    bounding box counts, which reaches lower, never higher.
    """

    def __init__(self, model: mujoco.MjModel, bodies: Sequence[str], device: torch.device) -> None:
        """Reads the geoms.

        Args:
            model: The compiled scene.
            bodies: Names of the bodies; those attached to them do not count.
            device: Where poses are.
        """
        wanted = [model.body(name).id for name in bodies]
        collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        geoms = np.flatnonzero(collides & np.isin(model.geom_bodyid, wanted))
        center = np.zeros((len(geoms), 3))
        axes = np.zeros((len(geoms), 3, 3))
        box = np.zeros((len(geoms), 3))
        ball = np.zeros(len(geoms))
        disc = np.zeros(len(geoms))
        for i, geom in enumerate(geoms):
            kind = int(model.geom_type[geom])
            size = model.geom_size[geom]
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
            axes[i] = turn.reshape(3, 3)
            center[i] = model.geom_pos[geom]
            if kind == _SPHERE:
                ball[i] = size[0]
            elif kind == _CAPSULE:
                ball[i] = size[0]
                box[i, 2] = size[1]
            elif kind == _CYLINDER:
                disc[i] = size[0]
                box[i, 2] = size[1]
            elif kind == _BOX:
                box[i] = size
            else:
                middle, half = model.geom_aabb[geom].reshape(2, 3)
                center[i] += axes[i] @ middle
                box[i] = half

        def constant(values: np.ndarray) -> torch.Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        self._body = torch.tensor(model.geom_bodyid[geoms].copy(), dtype=torch.int64, device=device)
        self._center, self._axes, self._box, self._ball, self._disc = map(
            constant, (center, axes, box, ball, disc)
        )

    def height(self, xpos: torch.Tensor, xquat: torch.Tensor) -> torch.Tensor:
        """Height of the lowest point [m], shape ``(nworld,)``.

        Args:
            xpos: Positions of all bodies [m], shape ``(nworld, nbody, 3)``.
            xquat: Their orientations, shape ``(nworld, nbody, 4)``.
        """
        up = quat_z_row(xquat.index_select(1, self._body).float())  # world z in each geom's body
        along = (up[..., None] * self._axes).sum(-2)  # and in each geom
        middle = xpos[..., 2].index_select(1, self._body).float() + (up * self._center).sum(-1)
        reach = (
            (along.abs() * self._box).sum(-1)
            + self._ball
            + self._disc * torch.linalg.vector_norm(along[..., :2], dim=-1)
        )
        return (middle - reach).amin(1)
