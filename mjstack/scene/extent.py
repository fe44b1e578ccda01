"""How low bodies reach, from their poses and the shapes of their geoms."""

from collections.abc import Sequence

import mujoco
import numpy as np
import torch

from mjstack.math import quat_z_row


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
        g = mujoco.mjtGeom
        kind = model.geom_type[geoms]
        radius = model.geom_size[geoms, 0]
        middle, half = model.geom_aabb[geoms].reshape(-1, 2, 3).swapaxes(0, 1)
        # Of round shapes the box is only what lies between the balls or discs: half a length in z.
        half = half.copy()
        rounded = np.isin(kind, (g.mjGEOM_SPHERE, g.mjGEOM_CAPSULE, g.mjGEOM_CYLINDER))
        half[rounded] = 0.0
        long = np.isin(kind, (g.mjGEOM_CAPSULE, g.mjGEOM_CYLINDER))
        half[long, 2] = model.geom_size[geoms[long], 1]
        axes = np.zeros((len(geoms), 3, 3))
        for matrix, quat in zip(axes, model.geom_quat[geoms], strict=True):
            mujoco.mju_quat2Mat(matrix.reshape(9), quat)
        center = model.geom_pos[geoms] + (axes @ middle[..., None])[..., 0]

        def constant(values: np.ndarray) -> torch.Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        self._body = torch.tensor(model.geom_bodyid[geoms].copy(), dtype=torch.int64, device=device)
        self._center = constant(center)
        self._axes = constant(axes)
        self._box = constant(half)
        self._disc = constant(radius * (kind == g.mjGEOM_CYLINDER))
        self._ball = constant(radius * np.isin(kind, (g.mjGEOM_SPHERE, g.mjGEOM_CAPSULE)))

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
