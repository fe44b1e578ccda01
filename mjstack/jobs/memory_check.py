"""Whether as many worlds as are asked for could fit into this machine at all."""

from __future__ import annotations

import os

import mujoco
import torch

from mjstack.config.schema import Backend, Config
from mjstack.errors import ConfigError
from mjstack.sim import BatchSizes, resolve_backend, resolve_sizes
from mjstack.sim.native import native_bytes

_GIB = 1 << 30
_UNCHECKED = 100_000  # worlds; fewer are not worth loading Warp for
_OF_THE_BATCH = {
    "batch",
    "throughput",
    "success",
}  # gates; capacity measures that many on CUDA alone


def check_room(cfg: Config, model: mujoco.MjModel) -> None:
    """Raises a `ConfigError` if the simulation of the worlds alone is larger than the memory there
    is.

    Controllers, tapes and check come on top, and other processes hold memory too: what passes here
    may still not fit.

    Args:
        cfg: The configuration.
        model: The compiled model.
    """
    backend, device = resolve_backend(cfg)
    gates = _OF_THE_BATCH | ({"capacity"} if device.startswith("cuda") else set())
    if cfg.nworld <= _UNCHECKED or not (cfg.job.name == "study" or gates & set(cfg.gates)):
        return
    if backend is Backend.native:
        least = native_bytes(model, cfg.nworld)
    else:
        from mjstack.sim.usage import data_bytes  # loads Warp

        sizes = (
            BatchSizes(nconmax=1, njmax=1) if cfg.batch.auto else resolve_sizes(cfg)
        )  # auto: not measured yet
        least = data_bytes(model, cfg.nworld, sizes)
    there = total_memory(device)
    if there is not None and least > there:
        where = "this machine" if device == "cpu" else device
        raise ConfigError(
            "nworld",
            cfg.nworld,
            f"worlds that fit into the {there / _GIB:.0f} GiB of {where}, and these need"
            f" {least / _GIB:.0f} GiB or more",
            "Use fewer",
        )


def total_memory(device: str) -> int | None:
    """Bytes of memory of a device, free or taken: ``cpu``, or a CUDA device such as ``cuda:0``.
    None if it is not known.
    """
    if device.startswith("cuda"):
        return int(torch.cuda.get_device_properties(device).total_memory)
    if not hasattr(os, "sysconf"):  # Windows
        return None
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
