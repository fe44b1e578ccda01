"""Counters of what the worlds use of MJWarp's buffers, kept on the device by Warp kernels."""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
import mujoco
import numpy as np
import torch
import warp as wp

from mjstack.sim.engine import mjw
from mjstack.sim.simulation import LOST_PHYSICS


class Usage:
    """The use of buffers by each world, now and at most, and the physics that was lost.

    Attributes:
        contacts: Contacts of the last step or forward, shape ``(nworld,)``, int32.
        peak_contacts: The most since the world's last reset, shape ``(nworld,)``, int32.
        peak_rows: Most constraint rows since then, shape ``(nworld,)``, int32.
        peak_pool: Most contacts, broad-phase pairs and contacts of one kind of convex collision, of
            all worlds at once since the last full reset, shape ``(3,)``, int32.
        overflow: Bits of `Overflow` since the world's last reset, shape ``(nworld,)``, int32.
        limits: Bits of `SolverLimit`, the same.
        steps: Physics steps since the world's last reset, shape ``(nworld,)``, int64.
        most: Peak contacts, peak rows and overflow bits that masked resets have erased since the
            last full one. They are taken in just before such a reset, and not in every substep:
            nothing else lowers a counter, so the two together never miss one, and it costs a
            captured step three small operations.
    """

    def __init__(self, model: mujoco.MjModel, nworld: int) -> None:
        """Allocate the counters on Warp's current device."""
        self._contacts, self._peak_contacts, self._peak_rows, self._lost, self._limits = (
            wp.zeros(nworld, dtype=int) for _ in range(5)
        )
        self._peak_pool = wp.zeros(3, dtype=int)
        self._steps = wp.zeros(nworld, dtype=wp.int64)
        self._mask = wp.zeros(nworld, dtype=bool)
        kinds = convex_kinds(model)
        self._kinds = None if kinds is None else wp.array(kinds, dtype=int)
        self._kind_counts = wp.zeros(0 if kinds is None else int(kinds.max()) + 1, dtype=int)
        self.contacts = wp.to_torch(self._contacts)
        self.peak_contacts = wp.to_torch(self._peak_contacts)
        self.peak_rows = wp.to_torch(self._peak_rows)
        self.peak_pool = wp.to_torch(self._peak_pool)
        self.overflow = wp.to_torch(self._lost)
        self.limits = wp.to_torch(self._limits)
        self.steps = wp.to_torch(self._steps)
        self._torch_mask = wp.to_torch(self._mask)
        self.most = tuple(torch.zeros_like(self.overflow) for _ in range(3))

    def count(self, m: mjw.Model, d: mjw.Data, steps: int) -> None:
        """Count what the worlds use now, and the steps that they have just made."""
        nworld = len(self.contacts)
        pool = d.contact.worldid.shape[0]
        # A thread per world, and at least one for every eighth place of the pool, which is mostly
        # empty.
        stride = max(nworld, pool // 8)
        self._contacts.zero_()
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
            outputs=[
                self._contacts,
                self._peak_contacts,
                self._peak_rows,
                self._peak_pool,
                self._lost,
                self._limits,
                self._steps,
            ],
        )
        if self._kinds is not None:
            self._kind_counts.zero_()
            wp.launch(
                record_convex_contacts,
                dim=stride,
                inputs=[d.nacon, d.contact.geom, m.geom_type, self._kinds, stride],
                outputs=[self._kind_counts, self._peak_pool],
            )

    def select(self, mask: torch.Tensor | None) -> wp.array:
        """Keep the peaks that a reset of some worlds would erase; return the mask for Warp.

        Args:
            mask: The worlds (None: all), shape ``(nworld,)``, bool.
        """
        contacts, rows, bits = self.most
        if mask is None:
            self._torch_mask.fill_(True)
            self.peak_pool.zero_()
            for buffer in self.most:
                buffer.zero_()
        else:
            self._torch_mask.copy_(mask)
            torch.maximum(contacts, self.peak_contacts, out=contacts)
            torch.maximum(rows, self.peak_rows, out=rows)
            bits |= self.overflow
        return self._mask

    def clear(self) -> None:
        """Clear the counters of the worlds that were selected."""
        wp.launch(
            clear_counters,
            dim=len(self.contacts),
            inputs=[self._mask],
            outputs=[
                self._peak_contacts,
                self._peak_rows,
                self._contacts,
                self._lost,
                self._limits,
                self._steps,
            ],
        )


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
    """Count each world's contacts, and keeps the largest counters and every overflow bit seen so
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


@wp.kernel(enable_backward=False)
def clear_counters(
    mask: wp.array[bool],
    peak_contacts: wp.array[int],
    peak_nefc: wp.array[int],
    contacts: wp.array[int],
    lost: wp.array[int],
    limits: wp.array[int],
    steps: wp.array[wp.int64],
) -> None:
    """Start the counters of the masked worlds anew."""
    w = wp.tid()
    if mask[w]:
        peak_contacts[w] = 0
        peak_nefc[w] = 0
        contacts[w] = 0
        lost[w] = 0
        limits[w] = 0
        steps[w] = wp.int64(0)
