"""The arrays of worlds in memory: those that stay, and the ones that a step borrows."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable

import mujoco

from mjstack.sim.sizes import BatchSizes
from mjstack.sim.warp_setup import mjw, wp

_UNITS = {"B": 1, "KB": 1 << 10, "MB": 1 << 20, "GB": 1 << 30}


def array_bytes(node: object) -> int:
    """Bytes of all Warp arrays in a dataclass and in the dataclasses in it."""
    if isinstance(node, wp.array):
        return int(node.capacity)
    if dataclasses.is_dataclass(node):
        return sum(array_bytes(getattr(node, field.name)) for field in dataclasses.fields(node))
    return 0


def data_bytes(model: mujoco.MjModel, nworld: int, sizes: BatchSizes) -> int:
    """Compute `MjwarpSimulation.memory_bytes` for these sizes, without allocating it.

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


def borrowed_bytes(call: Callable[[], None], device: str) -> int | None:
    """The most that Warp allocates at once on a device in a call, or None if its report cannot be
    read.
    """
    lines: list[str] = []
    with wp.ScopedMemoryTracker("mjstack", report_func=lines.append) as tracker:
        tracker.clear()
        call()
    _, _, peaks = "".join(lines).partition("Peak usage:")
    peak = re.search(rf"^\s+{re.escape(device)}\s+([\d.]+) (B|KB|MB|GB)$", peaks, re.MULTILINE)
    return None if peak is None else int(float(peak[1]) * _UNITS[peak[2]])
