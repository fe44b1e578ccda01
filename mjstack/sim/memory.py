"""Memory that is left."""

import re
import sys
from pathlib import Path

import torch

_LIMITS = (
    "/proc/meminfo",
    "/sys/fs/cgroup/memory.max",
    "/sys/fs/cgroup/memory/memory.limit_in_bytes",
)


def available_memory() -> int:
    """Memory that this process may still take, in bytes: the system's, or its container's."""
    text = "".join(path.read_text() for path in map(Path, _LIMITS) if path.exists())
    limits = re.findall(r"(?m)^(?:MemAvailable: +(\d+) kB|(\d+))$", text)
    return min((1024 * int(kib or 0) or int(limit) for kib, limit in limits), default=sys.maxsize)


def free_memory(device: torch.device) -> int:
    """Memory of a device that is free, in bytes; of the CPU `available_memory`."""
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else available_memory()


def give_back_memory(device: torch.device) -> None:
    """Free what torch keeps on a CUDA device: pieces into which a large block may not fit."""
    if device.type == "cuda":
        with torch.cuda.device(device):
            torch.cuda.empty_cache()
