"""Bodies and geoms of a compiled model: subtrees, geoms that collide, and boxes around them."""

from collections.abc import Iterator, Sequence
from itertools import product

import mujoco
import numpy as np
from numpy import ndarray
from numpy.typing import ArrayLike

_SIGNS = np.array(list(product((-1.0, 1.0), repeat=3)))


def forward_kinematics(model: mujoco.MjModel, qpos: ArrayLike | None = None) -> mujoco.MjData:
    """A model's bodies where some positions [rad, m] bring them, shape ``(nq,)``; by default those
    of the file.
    """
    data = mujoco.MjData(model)
    if qpos is not None:
        data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return data


def ancestors(model: mujoco.MjModel, body: int) -> Iterator[int]:
    """A body and those that carry it, without the world."""
    while body:
        yield int(body)
        body = model.body_parentid[body]


def subtree(model: mujoco.MjModel, body: int) -> list[int]:
    """A body and those that it carries."""
    return [b for b in range(body, model.nbody) if b == body or body in ancestors(model, b)]


def solid_geoms(model: mujoco.MjModel, bodies: Sequence[int] | ndarray | None = None) -> ndarray:
    """Geoms that collide, of some bodies, or of all."""
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    return np.flatnonzero(solid if bodies is None else solid & np.isin(model.geom_bodyid, bodies))


def world_boxes(data: mujoco.MjData, geoms: Sequence[int] | ndarray) -> tuple[ndarray, ndarray]:
    """Centres and half sizes [m], ``(n, 3)``, of the world-aligned boxes that hold some geoms."""
    middle, half = data.model.geom_aabb[geoms].reshape(-1, 2, 3).swapaxes(0, 1)
    rotation = data.geom_xmat[geoms].reshape(-1, 3, 3)
    centers = data.geom_xpos[geoms] + np.einsum("nij,nj->ni", rotation, middle)
    return centers, np.einsum("nij,nj->ni", np.abs(rotation), half)


def geom_corners(data: mujoco.MjData, geoms: Sequence[int] | ndarray) -> ndarray:
    """Corners of the boxes around some geoms, by signs [m], shape ``(n, 8, 3)``."""
    middle, half = data.model.geom_aabb[geoms].reshape(-1, 2, 3).swapaxes(0, 1)
    corners = middle[:, None] + _SIGNS * half[:, None]
    turned = corners @ data.geom_xmat[geoms].reshape(-1, 3, 3).swapaxes(1, 2)
    return data.geom_xpos[geoms][:, None] + turned
