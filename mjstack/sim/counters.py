"""Warp kernels that count what the worlds use of the buffers."""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
import warp as wp


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
    """Counts each world's contacts, and keeps the largest counters and every overflow bit seen so
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
    """Keeps the most contacts that convex collision found for one combination of geom types;
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
    """Starts the counters of the masked worlds anew."""
    w = wp.tid()
    if mask[w]:
        peak_contacts[w] = 0
        peak_nefc[w] = 0
        contacts[w] = 0
        lost[w] = 0
        limits[w] = 0
        steps[w] = wp.int64(0)
