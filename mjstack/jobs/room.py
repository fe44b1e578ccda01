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
_ALWAYS_FIT = 100_000  # worlds; some 10 GB of MJWarp's buffers at most, and not worth loading Warp for
_OF_THE_BATCH = {"batch", "throughput", "success"}


def check_room(cfg: Config, model: mujoco.MjModel) -> None:
    """Raises a `ConfigError` if the simulation of the worlds alone is larger than the memory there is.

    Controllers, tapes and evidence come on top, and other processes hold memory too: what passes here may still not fit.

    Args:
        cfg: The configuration.
        model: The compiled model.
    """
    if cfg.nworld <= _ALWAYS_FIT or not _OF_THE_BATCH & set(cfg.gates):
        return
    backend, device = resolve_backend(cfg)
    if backend is Backend.native:
        least = native_bytes(model, cfg.nworld)
    else:
        from mjstack.sim.memory import data_bytes  # loads Warp

        sizes = BatchSizes(nconmax=1, njmax=1) if cfg.batch.auto else resolve_sizes(cfg)  # auto: not measured yet
        least = data_bytes(model, cfg.nworld, sizes)
    there = total_memory(device)
    if least > there:
        where = "this machine" if device == "cpu" else device
        raise ConfigError(
            "nworld",
            cfg.nworld,
            f"worlds that fit into the {there / _GIB:.0f} GiB of {where}, and these need {least / _GIB:.0f} GiB or more",
            "Use fewer",
        )


def total_memory(device: str) -> int:
    """Bytes of memory of a device, free or taken: ``cpu``, or a CUDA device such as ``cuda:0``."""
    if device.startswith("cuda"):
        return int(torch.cuda.get_device_properties(device).total_memory)
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
