"""The use of MJWarp's buffers, counted on the device by Warp kernels, and their memory."""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
import dataclasses
from itertools import combinations_with_replacement

import mujoco
import numpy as np
import torch

from mjstack.sim.simulation import LOST_PHYSICS
from mjstack.sim.sizes import BatchSizes
from mjstack.sim.warp_setup import mjw, wp


class Usage:
    """The use of buffers by each world, now and at most, and the physics that was lost.

    Attributes:
        contacts: ``contact_count`` of `Simulation`.
        peak_contacts: Its ``peak_contacts``.
        peak_rows: Its ``peak_constraints``.
        peak_pool: Its ``peak_pool``.
        overflow: Its ``overflow``.
        limits: Its ``solver_limits``.
        steps: Its ``step_count``.
    """

    def __init__(self, model: mujoco.MjModel, nworld: int, device: torch.device) -> None:
        """Allocate the counters."""
        counts = torch.zeros((5, nworld), dtype=torch.int32, device=device)
        self.contacts, self.peak_contacts, self.peak_rows, self.overflow, self.limits = counts
        self.peak_pool = torch.zeros(3, dtype=torch.int32, device=device)
        self.steps = torch.zeros(nworld, dtype=torch.int64, device=device)
        self._arrays = [wp.from_torch(view) for view in (*counts, self.peak_pool, self.steps)]
        self._perworld = counts
        kinds = convex_kinds(model)
        self._kinds = wp.array(kinds, dtype=int)
        self._kind_counts = wp.zeros(int(kinds.max()) + 1, dtype=int)

    def count(self, m: mjw.Model, d: mjw.Data, steps: int) -> None:
        """Count what the worlds use now, and the steps that they have just made."""
        nworld = len(self.contacts)
        pool = d.contact.worldid.shape[0]
        # A thread per world, and at least one for every eighth place of the pool, which is mostly
        # empty.
        stride = max(nworld, pool // 8)
        contacts, peak_contacts, peak_rows, lost, limits, peak_pool, steps_made = self._arrays
        contacts.zero_()
        wp.launch(
            record_usage,
            dim=stride,
            inputs=[
                d.nacon,
                d.contact.worldid,
                d.nefc,
                d.ncollision,
                d.overflow,
                LOST_PHYSICS,
                steps,
                stride,
            ],
            outputs=[contacts, peak_contacts, peak_rows, peak_pool, lost, limits, steps_made],
        )
        if self._kind_counts.size:
            self._kind_counts.zero_()
            wp.launch(
                record_convex_contacts,
                dim=stride,
                inputs=[d.nacon, d.contact.geom, m.geom_type, self._kinds, stride],
                outputs=[self._kind_counts, peak_pool],
            )

    def clear(self, mask: torch.Tensor) -> None:
        """Clear the counters of the worlds of a mask, shape ``(nworld,)``, bool."""
        self._perworld.masked_fill_(mask, 0)
        self.steps.masked_fill_(mask, 0)


def convex_kinds(model: mujoco.MjModel) -> np.ndarray:
    """Numbers the combinations of geom types that collide by the convex algorithm, else -1.

    Planes are always primitive, and so is everything among spheres, capsules and boxes, and a
    sphere with a cylinder.
    """
    g = mujoco.mjtGeom
    shapes = sorted({*model.geom_type.tolist()} - {int(g.mjGEOM_PLANE), int(g.mjGEOM_SDF)})
    primitive = {int(g.mjGEOM_SPHERE), int(g.mjGEOM_CAPSULE), int(g.mjGEOM_BOX)}
    round_ = {int(g.mjGEOM_SPHERE), int(g.mjGEOM_CYLINDER)}
    kinds = np.full(2 * (model.geom_type.max(initial=0) + 1,), -1, dtype=np.int32)
    number = 0
    for a, b in combinations_with_replacement(shapes, 2):
        if not ({a, b} <= primitive or {a, b} == round_):
            kinds[a, b] = kinds[b, a] = number
            number += 1
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

    Args:
        model: The compiled model.
        nworld: Number of worlds.
        sizes: Buffer sizes.
    """
    share = dataclasses.replace(sizes, naconmax=None, naccdmax=None)
    with wp.ScopedDevice("cpu"):
        one, two, longer = (
            array_bytes(
                mjw.make_data(model, nworld=n, **dataclasses.replace(share, nconmax=c).as_kwargs(n))
            )
            for n, c in ((1, sizes.nconmax), (2, sizes.nconmax), (1, sizes.nconmax + 1))
        )
    per_contact = longer - one
    per_world = two - one - sizes.nconmax * per_contact
    constant = one - per_world - sizes.nconmax * per_contact
    return constant + nworld * per_world + sizes.contact_pool(nworld) * per_contact


@wp.kernel(enable_backward=False)
def record_usage(
    nacon: wp.array[int],
    worldid: wp.array[int],
    nefc: wp.array[int],
    ncollision: wp.array[int],
    overflow: wp.array[int],
    lost_bits: int,
    advance: int,
    stride: int,
    contacts: wp.array[int],
    peak_contacts: wp.array[int],
    peak_nefc: wp.array[int],
    peak_pool: wp.array[int],
    lost: wp.array[int],
    limits: wp.array[int],
    steps: wp.array[wp.int64],
) -> None:
    """Count each world's contacts, and keep the largest counters and every overflow bit seen so
    far.

    ``contacts`` is zero before. The packed list may claim more contacts than it holds after an
    overflow. A world's last increment of its counter is its number of contacts, so the largest one
    seen is the peak.
    """
    i = wp.tid()
    for c in range(i, wp.min(nacon[0], worldid.shape[0]), stride):  # type: ignore[arg-type]
        found = worldid[c]
        wp.atomic_max(peak_contacts, found, wp.atomic_add(contacts, found, 1) + 1)
    if i < steps.shape[0]:
        peak_nefc[i] = wp.max(peak_nefc[i], nefc[i])
        lost[i] = lost[i] | (overflow[i] & lost_bits)
        limits[i] = limits[i] | (overflow[i] & ~lost_bits)
        steps[i] = steps[i] + wp.int64(advance)
    if i == 0:
        peak_pool[0] = wp.max(peak_pool[0], nacon[0])
        peak_pool[1] = wp.max(peak_pool[1], ncollision[0])


@wp.kernel(enable_backward=False)
def record_convex_contacts(
    nacon: wp.array[int],
    geom: wp.array[wp.vec2i],
    geom_type: wp.array[int],
    kinds: wp.array2d[int],
    stride: int,
    counts: wp.array[int],
    peak_pool: wp.array[int],
) -> None:
    """Keep the most contacts that convex collision found for one combination of geom types;
    ``counts`` is zero before.

    MJWarp has room for naccdmax penetrating pairs of each combination, and each such pair gives at
    least one contact. ``kinds`` numbers the combinations, and is negative for those that are no
    convex collision.
    """
    i = wp.tid()
    for c in range(i, wp.min(nacon[0], geom.shape[0]), stride):  # type: ignore[arg-type]
        kind = kinds[geom_type[geom[c][0]], geom_type[geom[c][1]]]
        if kind >= 0:
            wp.atomic_max(peak_pool, 2, wp.atomic_add(counts, kind, 1) + 1)
