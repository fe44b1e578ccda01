"""Chooses a backend and a device: the only branch on the backend."""

import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import mujoco
import torch
from torch import Tensor

from mjstack.config.schema import Backend, Config
from mjstack.errors import (
    ArgumentError,
    ConfigError,
    DeviceError,
    MjstackError,
    is_out_of_memory,
)
from mjstack.sim.native import NativeSimulation
from mjstack.sim.simulation import Simulation
from mjstack.sim.sizes import BatchSizes, resolve_sizes


def resolve_device(requested: str) -> str:
    """``cpu`` or ``cuda:N`` for a requested device; ``auto`` under torchrun is the process's own.

    Raises:
        DeviceError: The CUDA device is not there.
    """
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if requested == "auto":
        return f"cuda:{int(os.environ.get('LOCAL_RANK', 0)) % count}" if count else "cpu"
    if requested.startswith("cuda") and int(requested.partition(":")[2]) >= count:
        devices = ", ".join(f"cuda:{number}" for number in range(count)) or "no CUDA device"
        raise DeviceError(
            f"sim.device={requested}: this process sees {devices}. Use sim.device=auto or"
            " sim.device=cpu."
        )
    return requested


def resolve_backend(
    cfg: Config, backend: Backend | None = None, device: str | None = None
) -> tuple[Backend, str]:
    """Backend (never auto) and device of a simulation; arguments override what is configured."""
    device = device or resolve_device(cfg.sim.device)
    backend = backend or cfg.sim.backend
    if backend is Backend.auto:
        backend = Backend.mjwarp if device.startswith("cuda") else Backend.native
    if cfg.sim.backend is Backend.native and cfg.sim.device.startswith("cuda"):
        expected = "cpu or auto, because native MuJoCo runs on the CPU"
        raise ConfigError("sim.device", cfg.sim.device, expected, "Use sim=mjwarp")
    return backend, "cpu" if backend is Backend.native else device


def make_simulation(
    model: mujoco.MjModel,
    cfg: Config,
    nworld: int,
    *,
    backend: Backend | None = None,
    device: str | None = None,
    fields: Sequence[str] = (),
    sizes: BatchSizes | None = None,
) -> Simulation:
    """Build a simulation of a compiled model, whose timestep is set, by ``sim``, ``batch`` and
    ``graph`` of the configuration. ``backend``, ``device`` and ``sizes`` of MJWarp's buffers
    override what is configured. ``fields`` may differ from world to world, by MuJoCo's names.

    Raises:
        UnknownName: A field does not exist, or cannot differ.
        MjstackError: The backend, or ``sim.step``, does not implement a feature of the model. Or
            the worlds do not fit on the GPU.
    """
    backend, device = resolve_backend(cfg, backend, device)
    if backend is Backend.native:
        return NativeSimulation(model, nworld, fields=fields)
    from mjstack.sim.mjwarp import MjwarpSimulation  # loads Warp, which native runs do not need
    from mjstack.sim.usage import data_bytes

    sizes = sizes or resolve_sizes(cfg)
    free = 0 if device == "cpu" else torch.cuda.mem_get_info(device)[0]
    try:
        return MjwarpSimulation(model, cfg, nworld, sizes, device, fields)
    except Exception as error:
        if not free or not is_out_of_memory(f"{type(error).__name__}: {error}"):
            raise
        needed = data_bytes(model, nworld, sizes)
        fit = int(0.8 * nworld * free / needed)  # the rest is for what steps borrow
        if not 0 < fit < nworld:
            raise
        raise MjstackError(
            f"out of memory: {nworld:,} worlds with {sizes.as_overrides()} need"
            f" {needed / 2**30:.1f} GiB, {free / 2**30:.1f} are free, expected at most {fit:,}",
            "Run fewer worlds, or ones with smaller buffers",
        ) from error


class StateRenderer:
    """Draws states, each in a world of its own: an image depends on nothing else. All steps of an
    episode can be drawn at once, whenever they are needed. ``labels`` are as of `Cameras`.
    """

    def __init__(self, model: mujoco.MjModel, cfg: Config, count: int, **options: Any) -> None:
        """Make worlds and the configuration's cameras for at most ``count`` states at once; options
        as of `make_simulation`.

        Raises:
            MjstackError: The images do not fit into memory.
        """
        self._sim = make_simulation(model, cfg, count, **options)
        self._cameras = self._sim.make_cameras(cfg.scene.cameras)
        self._images = self._cameras.allocate()
        self._world = torch.arange(count, device=self._sim.device)
        self.labels = self._cameras.labels

    def draw(self, qpos: Tensor, fields: Mapping[str, Tensor] | None = None) -> dict[str, Tensor]:
        """Draw states, shape ``(n, nq)``, n at most ``count``, with model fields of each by name,
        each ``(n, ...)``. Returns images as of `Cameras.allocate`, a row for each state; the next
        call writes into them.

        Raises:
            ArgumentError: There are more states than worlds.
            MjstackError: This machine cannot draw.
        """
        n = len(qpos)
        if n > self._sim.nworld:
            raise ArgumentError("qpos", f"{n} states", f"at most {self._sim.nworld}")
        self._sim.qpos[:n] = qpos
        for name, values in (fields or {}).items():
            self._sim.fields[name][:n] = values
        self._sim.kinematics()
        mask = None if n == len(self._world) else self._world < n
        self._cameras.draw(self._images, dict.fromkeys(self._cameras.cameras, mask))
        return {name: image[:n] for name, image in self._images.items()}

    def close(self) -> None:
        """Give the worlds back."""
        self._sim.synchronize()
        self._cameras.close()
        self._sim.close()


def cuda_uuid(device: str) -> str:
    """The GPU's identity, by which other tools know it."""
    return f"GPU-{torch.cuda.get_device_properties(device).uuid}"


def device_memory(device: str) -> tuple[int, int] | None:
    """GPU memory in bytes: what torch's and Warp's arrays of this process hold, and what is taken
    on the whole GPU.

    The second has the captured graphs, CUDA's own share, freed memory that a pool keeps, and other
    processes in it too. None on a CPU.
    """
    if device == "cpu":
        return None
    import warp as wp  # native runs do not need it

    torch.cuda.synchronize(device)
    free, total = torch.cuda.mem_get_info(device)
    where = wp.get_device(device)
    pooled = wp.get_mempool_used_mem_current(where) if where.is_mempool_enabled else 0
    return torch.cuda.memory_allocated(device) + pooled, total - free


def cuda_driver() -> str:
    """Version of the NVIDIA driver, from the kernel module; ``unknown`` where it does not tell."""
    with suppress(OSError):
        text = Path("/proc/driver/nvidia/version").read_text()
        if match := re.search(r"\b\d{3}\.\d+(\.\d+)?\b", text):
            return match.group()
    return "unknown"
