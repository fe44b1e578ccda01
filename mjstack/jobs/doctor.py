"""``mjstack doctor``: what this machine has and lacks, on a page for a bug report."""

import os
import platform
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import cast

import torch

from mjstack.config.load import load_config
from mjstack.errors import MjstackError
from mjstack.report.gl import require_offscreen
from mjstack.report.provenance import collect_provenance
from mjstack.scene import build_model
from mjstack.sim import resolve_backend, resolve_sizes
from mjstack.sim.build import cuda_driver
from mjstack.sim.memory import available_memory
from mjstack.sim.usage import data_bytes
from mjstack.sim.warp_setup import wp

# Packages of the extras, by the one that needs them
_EXTRAS = {
    "cluster": "submitit",
    "datasets": "pyarrow",
    "export": "onnx",
    "gpu": "nvidia-ml-py",
    "lerobot": "lerobot",
    "notebook": "nbclient",
    "train": "rsl-rl-lib",
    "video": "imageio-ffmpeg",
    "web": "viser",
}
_GIB = 2**30


def findings(overrides: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Versions, processor, GPUs, OpenGL, the kernel cache, and the memory that the buffers of a
    configuration take: a name and a sentence each. No kernel is compiled.

    Raises:
        MjstackError: The configuration is wrong.
    """
    cfg = load_config(overrides)
    facts = collect_provenance()
    versions = cast(dict[str, str], facts["versions"])
    folder = Path(__file__).parents[1]
    yield "mjstack", f"{versions.pop('mjstack')}, commit {facts['git_commit']}, {folder}"
    yield "system", f"{platform.platform()}, Python {versions.pop('python')}"
    yield "packages", ", ".join(f"{name} {version}" for name, version in versions.items())
    yield "extras", ", ".join(f"{extra}: {_version(name)}" for extra, name in _EXTRAS.items())
    free = available_memory() / _GIB
    yield "processor", f"{facts['cpu']}, {facts['cpu_count']} cores, {free:.1f} GiB of memory free"

    # GPUs
    yield "torch", f"{torch.__version__}, built for CUDA {torch.version.cuda or 'not at all'}"
    if not torch.cuda.is_available():
        yield "GPU", f"none that torch can use (driver: {cuda_driver()})"
    for number in range(torch.cuda.device_count()):
        left, total = (size / _GIB for size in torch.cuda.mem_get_info(number))
        name = torch.cuda.get_device_name(number)
        yield "GPU", f"{name}, {left:.1f} of {total:.1f} GiB free, driver {cuda_driver()}"

    # Warp
    wp.init()
    cache = Path(wp.config.kernel_cache_dir)
    files = [path for path in cache.rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files) / _GIB
    cached = f"{cache}, {size:.2f} GiB"
    if not os.access(cache, os.W_OK):
        cached += ", not writable: kernels are compiled in every run. Set WARP_CACHE_PATH"
    yield "kernel cache", cached

    # Pictures
    model = build_model(cfg)
    choice = f"MUJOCO_GL={os.environ.get('MUJOCO_GL', 'not set')}"
    try:
        require_offscreen(build_model(cfg, visuals=True))
        yield "OpenGL", f"{choice}, draws offscreen"
    except MjstackError as error:
        yield "OpenGL", f"no pictures: {error}"

    # Buffers
    sizes = resolve_sizes(cfg)
    need = data_bytes(model, cfg.nworld, sizes) / _GIB
    what = f"{cfg.robot.name}, task {cfg.task.name}, {cfg.nworld} worlds"
    yield "buffers", f"{what}: {sizes}; MJWarp's data of {need:.2f} GiB, and what a step borrows"
    try:
        yield "backend", " on ".join(resolve_backend(cfg))
    except MjstackError as error:
        yield "backend", f"none: {error}"


def _version(package: str) -> str:
    try:
        return f"{package} {metadata.version(package)}"
    except metadata.PackageNotFoundError:
        return f"{package} is not installed"
