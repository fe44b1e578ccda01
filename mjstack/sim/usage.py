"""The use of MJWarp's buffers, counted on the device by Warp kernels, and their memory."""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
import dataclasses
from itertools import combinations_with_replacement

import mujoco
import numpy as np
import torch
from torch import Tensor

from mjstack.sim.mujoco_warp import mjw, wp
from mjstack.sim.simulation import LOST_PHYSICS
from mjstack.sim.sizes import BatchSizes


class Usage:
    """The use of buffers by each world, now and at most, and the physics that was lost.

    Attributes:
        views: The counters, by the names that `Simulation` has for them.
    """

    def __init__(self, model: mujoco.MjModel, nworld: int, device: torch.device) -> None:
        self._counts = torch.zeros((5, nworld), dtype=torch.int32, device=device)
        self._steps = torch.zeros(nworld, dtype=torch.int64, device=device)
        pool = torch.zeros(3, dtype=torch.int32, device=device)
        names = ("contact_count", "peak_contacts", "peak_constraints", "overflow", "solver_limits")
        self.views = dict(zip(names, self._counts, strict=True))
        self.views |= {"peak_pool": pool, "step_count": self._steps}
        self._arrays = [wp.from_torch(view) for view in self.views.values()]
        kinds = convex_kinds(model)
        self._kinds = wp.array(kinds, dtype=int)
        self._kind_counts = wp.zeros(int(kinds.max()) + 1, dtype=int)

    def count(self, m: mjw.Model, d: mjw.Data, steps: int) -> None:
        """Count what the worlds use now, and the steps that they have just made."""
        # A thread per world, and at least one for every eighth place of the pool, which is mostly
        # empty.
        stride = max(d.nworld, d.contact.worldid.shape[0] // 8)
        self._arrays[0].zero_()
        self._kind_counts.zero_()
        used = [d.nacon, d.contact.worldid, d.contact.geom, d.nefc, d.ncollision, d.overflow]
        wp.launch(
            record_usage,
            dim=stride,
            inputs=[*used, m.geom_type, self._kinds, LOST_PHYSICS, steps, stride],
            outputs=[self._kind_counts, *self._arrays],
        )

    def clear(self, mask: Tensor) -> None:
        """Clear the counters of the worlds of a mask, shape ``(nworld,)``, bool."""
        self._counts.masked_fill_(mask, 0)
        self._steps.masked_fill_(mask, 0)


def convex_kinds(model: mujoco.MjModel) -> np.ndarray:
    """Numbers the combinations of geom types that collide by the convex algorithm, else -1.

    Planes are always primitive, and so is everything among spheres, capsules and boxes, and a
    sphere with a cylinder.
    """
    g = mujoco.mjtGeom
    shapes = sorted({*model.geom_type.tolist()} - {g.mjGEOM_PLANE, g.mjGEOM_SDF})
    primitive = {g.mjGEOM_SPHERE, g.mjGEOM_CAPSULE, g.mjGEOM_BOX}
    round_ = {g.mjGEOM_SPHERE, g.mjGEOM_CYLINDER}
    kinds = np.full(2 * (model.geom_type.max(initial=0) + 1,), -1, dtype=np.int32)
    pairs = list(combinations_with_replacement(shapes, 2))
    convex = [pair for pair in pairs if not ({*pair} <= primitive or {*pair} == round_)]
    for number, (a, b) in enumerate(convex):
        kinds[a, b] = kinds[b, a] = number
    return kinds


def array_bytes(node: object) -> int:
    """Bytes of all Warp arrays in a dataclass and in the dataclasses in it."""
    if isinstance(node, wp.array):
        return int(node.capacity)
    if dataclasses.is_dataclass(node):
        return sum(array_bytes(getattr(node, field.name)) for field in dataclasses.fields(node))
    return 0


def data_bytes(model: mujoco.MjModel, nworld: int, sizes: BatchSizes) -> int:
    """Bytes of MJWarp's data for these sizes, computed without allocating it: all that grows with
    nworld, but for per-world fields and what a step borrows.

    Every array is as long as nworld, as the contact pool, or constant. So two small ones on the CPU
    tell the rest.
    """
    with wp.ScopedDevice("cpu"):
        single, double = (
            array_bytes(mjw.make_data(model, nworld=n, **sizes.as_kwargs())) for n in (1, 2)
        )
    return single + (nworld - 1) * (double - single)


@wp.kernel(enable_backward=False)
def record_usage(
    nacon: wp.array[int],
    worldid: wp.array[int],
    geom: wp.array[wp.vec2i],
    nefc: wp.array[int],
    ncollision: wp.array[int],
    overflow: wp.array[int],
    geom_type: wp.array[int],
    kinds: wp.array2d[int],
    lost_bits: int,
    advance: int,
    stride: int,
    kind_counts: wp.array[int],
    contacts: wp.array[int],
    peak_contacts: wp.array[int],
    peak_nefc: wp.array[int],
    lost: wp.array[int],
    limits: wp.array[int],
    peak_pool: wp.array[int],
    steps: wp.array[wp.int64],
) -> None:
    """Count each world's contacts, and keep the largest counters and every overflow bit seen so
    far; also the most contacts that convex collision found for one combination of geom types.

    ``contacts`` and ``kind_counts`` are zero before. The packed list may claim more contacts than
    it holds after an overflow. A world's last increment of its counter is its number of contacts,
    so the largest one seen is the peak.

    MJWarp has room for naccdmax penetrating pairs of each combination, and each such pair gives at
    least one contact. ``kinds`` numbers the combinations, and is negative for those that are no
    convex collision.
    """
    i = wp.tid()
    for c in range(i, wp.min(nacon[0], worldid.shape[0]), stride):  # type: ignore[arg-type]
        world = worldid[c]
        wp.atomic_max(peak_contacts, world, wp.atomic_add(contacts, world, 1) + 1)
        if kind_counts.shape[0] > 0:
            kind = kinds[geom_type[geom[c][0]], geom_type[geom[c][1]]]
            if kind >= 0:
                wp.atomic_max(peak_pool, 2, wp.atomic_add(kind_counts, kind, 1) + 1)
    if i < steps.shape[0]:
        peak_nefc[i] = wp.max(peak_nefc[i], nefc[i])
        lost[i] = lost[i] | (overflow[i] & lost_bits)
        limits[i] = limits[i] | (overflow[i] & ~lost_bits)
        steps[i] = steps[i] + wp.int64(advance)
    if i == 0:
        peak_pool[0] = wp.max(peak_pool[0], nacon[0])
        peak_pool[1] = wp.max(peak_pool[1], ncollision[0])
