"""Warp kernels that count what each world uses of the buffers."""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
import warp as wp


@wp.kernel(enable_backward=False)
def count_contacts(
    nacon: wp.array[int],
    worldid: wp.array[int],
    count: wp.array[int],
) -> None:
    """Counts each world's entries of the packed contact list. The list may claim more than it holds after an overflow."""
    i = wp.tid()
    if i < wp.min(nacon[0], worldid.shape[0]):
        wp.atomic_add(count, worldid[i], 1)


@wp.kernel(enable_backward=False)
def record_peaks(
    nefc: wp.array[int],
    nacon: wp.array[int],
    ncollision: wp.array[int],
    contacts: wp.array[int],
    overflow: wp.array[int],
    peak_nefc: wp.array[int],
    peak_contacts: wp.array[int],
    peak_pool: wp.array[int],
    lost_bits: int,
    lost: wp.array[int],
    limits: wp.array[int],
    advance: int,
    steps: wp.array[wp.int64],
) -> None:
    """Keeps the largest counters, and every overflow bit seen so far: lost physics apart from solver limits."""
    w = wp.tid()
    peak_nefc[w] = wp.max(peak_nefc[w], nefc[w])
    peak_contacts[w] = wp.max(peak_contacts[w], contacts[w])
    lost[w] = lost[w] | (overflow[w] & lost_bits)
    steps[w] = steps[w] + wp.int64(advance)
    limits[w] = limits[w] | (overflow[w] & ~lost_bits)
    if w == 0:
        peak_pool[0] = wp.max(peak_pool[0], nacon[0])
        peak_pool[1] = wp.max(peak_pool[1], ncollision[0])
