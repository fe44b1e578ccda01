"""``mjstack doctor``: what this machine has and lacks, on a page for a bug report."""

import os
import platform
from collections.abc import Callable, Iterable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import cast

import torch

from mjstack.config.load import load_config
from mjstack.config.schema import Config
from mjstack.errors import describe_error
from mjstack.report.gl import require_offscreen
from mjstack.report.provenance import collect_provenance
from mjstack.scene import build_model
from mjstack.sim import resolve_backend, resolve_sizes
from mjstack.sim.build import cuda_driver
from mjstack.sim.memory import available_memory

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
    configuration take: a name and a sentence each, which has the error of one that fails. No
    kernel is compiled.

    Raises:
        MjstackError: The configuration is wrong.
    """
    cfg = load_config(overrides)
    provenance = collect_provenance()
    versions = cast(dict[str, str], provenance["versions"])
    folder = Path(__file__).parents[1]
    yield "mjstack", f"{versions.pop('mjstack')}, commit {provenance['git_commit']}, {folder}"
    yield "system", f"{platform.platform()}, Python {versions.pop('python')}"
    yield "packages", ", ".join(f"{name} {version}" for name, version in versions.items())
    yield "extras", ", ".join(f"{extra}: {_version(name)}" for extra, name in _EXTRAS.items())
    yield "torch", f"{torch.__version__}, built for CUDA {torch.version.cuda or 'not at all'}"
    sections: dict[str, Callable[[], Iterable[str]]] = {
        "processor": lambda: [
            f"{provenance['cpu']}, {provenance['cpu_count']} cores, {_free_memory()}"
        ],
        "GPU": _gpus,
        "kernel cache": lambda: [_kernel_cache()],
        "OpenGL": lambda: [_pictures(cfg)],
        "buffers": lambda: [_buffers(cfg)],
        "backend": lambda: [" on ".join(resolve_backend(cfg))],
    }
    for name, describe in sections.items():
        try:
            yield from ((name, text) for text in describe())
        except Exception as error:
            yield name, f"none: {describe_error(error)}"


def _free_memory() -> str:
    return f"{available_memory() / _GIB:.1f} GiB of memory free"


def _gpus() -> Iterator[str]:
    if not torch.cuda.is_available():
        yield f"none that torch can use (driver: {cuda_driver()})"
    for number in range(torch.cuda.device_count()):
        left, total = (size / _GIB for size in torch.cuda.mem_get_info(number))
        name = torch.cuda.get_device_name(number)
        yield f"{name}, {left:.1f} of {total:.1f} GiB free, driver {cuda_driver()}"


def _kernel_cache() -> str:
    from mjstack.sim.warp_setup import CACHE_PROBLEM, wp  # raises where no folder can be written

    wp.init()
    cache = Path(wp.config.kernel_cache_dir)
    size = sum(path.stat().st_size for path in cache.rglob("*") if path.is_file()) / _GIB
    return CACHE_PROBLEM or f"{cache}, {size:.2f} GiB"


def _pictures(cfg: Config) -> str:
    require_offscreen(build_model(cfg, visuals=True))
    return f"MUJOCO_GL={os.environ.get('MUJOCO_GL', 'not set')}, draws offscreen"


def _buffers(cfg: Config) -> str:
    from mjstack.sim.usage import data_bytes  # loads Warp

    sizes = resolve_sizes(cfg)
    need = data_bytes(build_model(cfg), cfg.nworld, sizes) / _GIB
    scene = f"{cfg.robot.name}, task {cfg.task.name}, {cfg.nworld} worlds"
    return f"{scene}: {sizes}; MJWarp's data of {need:.2f} GiB, and what a step borrows"


def _version(package: str) -> str:
    try:
        return f"{package} {metadata.version(package)}"
    except metadata.PackageNotFoundError:
        return f"{package} is not installed"
