"""Warp, set up before its first use, and ordered with torch's work."""

import atexit
import ctypes
import logging
import os
import shutil
import tempfile
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path

import torch
import warp as wp

from mjstack.errors import MjstackError, first_line

__all__ = ["torch_stream_scope", "wp"]

log = logging.getLogger(__name__)

# One object per torch stream, until the process ends: a second one for the same stream would
# unregister it when freed.
_STREAMS: dict[tuple[str, int], wp.Stream] = {}
_CACHE = "WARP_CACHE_PATH"  # processes that this one starts read it


def _kernel_cache() -> tuple[str, str]:
    """The folder for compiled kernels, and what is wrong with the usual one. In place of one that
    cannot be written it is a temporary folder, with links to the kernels of that one.

    Raises:
        MjstackError: No folder can be written.
    """
    caches = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    usual = Path(os.environ.get(_CACHE) or f"{caches}/warp")
    try:
        usual = usual.expanduser()
        version = usual / wp.config.version  # Warp adds it
        version.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=version).close()
        return str(usual), ""
    except (OSError, RuntimeError) as error:  # the other one: there is no home folder
        reason = getattr(error, "strerror", None) or first_line(error)
        problem = f"kernel cache {usual}: cannot be written ({reason})"
    fix = f"Set {_CACHE} to a folder of yours"
    try:
        folder = tempfile.mkdtemp(prefix="mjstack-kernels-")
    except OSError as error:
        raise MjstackError(f"{problem}, and there is no temporary folder", fix) from error
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for file in (usual / wp.config.version).rglob("*"):
        link = folder / file.relative_to(usual)
        if file.is_file():
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(file.absolute())
    os.environ[_CACHE] = folder
    problem = f"{problem}, so that new kernels are compiled in every run. {fix}."
    log.warning("%s", problem)
    return folder, problem


def _has_driver() -> bool:
    """Whether Warp will find a CUDA driver."""
    for name in ("libcuda.so", "libcuda.so.1"):
        with suppress(OSError):
            return bool(ctypes.CDLL(name))
    return False


def _init_without_driver() -> None:
    """Initialize Warp without what its C++ code writes, also for runs on the CPU, where there is no
    CUDA driver.
    """
    error_output = os.dup(2)
    reader, writer = os.pipe()
    os.dup2(writer, 2)
    os.close(writer)
    try:
        wp.init()
    finally:
        os.dup2(error_output, 2)
        with open(reader, "rb") as pipe, open(error_output, "wb") as output:
            output.writelines(line for line in pipe if b"load the NVIDIA CUDA driver" not in line)


def torch_stream_scope(device: wp.Device) -> AbstractContextManager[object]:
    """A context in which Warp's work on a device goes to torch's current stream there.

    Reads and writes of shared memory by torch, before and after, are then ordered with it, and
    neither waits. On Warp's CPU device, which has no streams, it only makes the device the current
    one, where it is not: all of Warp's scopes of that device keep one CUDA context between them, so
    a thread's scope would hand its own context to the thread that waits for it.
    """
    if not device.is_cuda:
        return nullcontext() if wp.get_device() == device else wp.ScopedDevice(device)
    current = torch.cuda.current_stream(wp.device_to_torch(device))
    key = (str(device), current.cuda_stream)
    if key not in _STREAMS:
        _STREAMS[key] = wp.stream_from_torch(current)
    return wp.ScopedStream(_STREAMS[key], sync_enter=False, sync_exit=False)


wp.config.log_level = wp.LOG_ERROR  # it would greet on every run
CACHE_PROBLEM = ""  # a sentence; empty if kernels are kept for later runs
if wp.config.kernel_cache_dir is None:  # else the caller has set it, or has used Warp
    wp.config.kernel_cache_dir, CACHE_PROBLEM = _kernel_cache()
if not _has_driver():
    with suppress(OSError):  # of a closed error output, which shows nothing anyway
        _init_without_driver()
