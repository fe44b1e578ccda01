"""Warp, set up before its first use, and ordered with torch's work."""

from contextlib import AbstractContextManager, nullcontext

import torch
import warp as wp

wp.config.log_level = wp.LOG_ERROR  # it would greet on every run

__all__ = ["torch_stream_scope", "wp"]

# One object per torch stream, until the process ends: a second one for the same stream would
# unregister it when freed.
_STREAMS: dict[tuple[str, int], wp.Stream] = {}


def torch_stream_scope(device: wp.Device) -> AbstractContextManager[object]:
    """A context in which Warp's work on a device goes to torch's current stream there.

    Reads and writes of shared memory by torch, before and after, are then ordered with it, and
    neither waits. On Warp's CPU device, which has no streams, it only makes the device the current
    one, where it is not: all of Warp's scopes of that device keep one CUDA context between them, so
    a thread's scope would hand its own context to the thread that waits for it.

    Args:
        device: The Warp device.
    """
    if not device.is_cuda:
        return nullcontext() if wp.get_device() == device else wp.ScopedDevice(device)
    current = torch.cuda.current_stream(wp.device_to_torch(device))
    key = (str(device), current.cuda_stream)
    if key not in _STREAMS:
        _STREAMS[key] = wp.stream_from_torch(current)
    return wp.ScopedStream(_STREAMS[key], sync_enter=False, sync_exit=False)
