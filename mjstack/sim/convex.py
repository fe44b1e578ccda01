"""Which pairs of geoms MJWarp sends to its convex collision."""

from __future__ import annotations

import mujoco
import numpy as np


def convex_kinds(model: mujoco.MjModel) -> np.ndarray | None:
    """Numbers the combinations of geom types that collide by the convex algorithm, else -1; None if
    the model has none.

    Planes are always primitive, and so is everything among spheres, capsules and boxes, and a
    sphere with a cylinder.
    """
    g = mujoco.mjtGeom
    present = {int(t) for t in model.geom_type}
    shapes = [
        int(t)
        for t in (
            g.mjGEOM_HFIELD,
            g.mjGEOM_SPHERE,
            g.mjGEOM_CAPSULE,
            g.mjGEOM_ELLIPSOID,
            g.mjGEOM_CYLINDER,
        )
    ]
    shapes += [int(t) for t in (g.mjGEOM_BOX, g.mjGEOM_MESH)]
    simple = {int(g.mjGEOM_SPHERE), int(g.mjGEOM_CAPSULE), int(g.mjGEOM_BOX)}
    kinds = np.full(2 * (max(present) + 1,), -1, dtype=np.int32)
    number = 0
    for i, a in enumerate(shapes):
        for b in shapes[i:]:
            primitive = {a, b} <= simple or {a, b} == {int(g.mjGEOM_SPHERE), int(g.mjGEOM_CYLINDER)}
            if not primitive and {a, b} <= present:
                kinds[a, b] = kinds[b, a] = number
                number += 1
    return kinds if number else None
