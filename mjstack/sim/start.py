"""Configures and starts Warp, in one place: it would greet on every run, and where there is no CUDA warn of that."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress

import torch
import warp as wp

__all__ = ["wp"]

NO_DRIVER = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. GPU execution will not be available."


def call_without_line(work: Callable[[], None], line: bytes) -> None:
    """Does some work and takes a line out of what is written to stderr meanwhile, native code's included.

    Whatever else is written comes afterwards. Where stderr is closed, or nothing can be kept, the work is done all the same.
    """
    with suppress(OSError, AttributeError, ValueError):  # no stderr, or one of Python's own making
        sys.stderr.flush()
    try:
        kept, stderr = tempfile.TemporaryFile(), os.dup(2)  # noqa: SIM115 (closed below)
    except OSError:
        work()
        return
    with kept:
        os.dup2(kept.fileno(), 2)
        try:
            work()
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            kept.seek(0)
            with open(2, "wb", closefd=False) as out:
                out.writelines(text for text in kept.read().splitlines(keepends=True) if text.rstrip() != line)


wp.config.log_level = wp.LOG_ERROR
if not torch.cuda.is_available():  # with CUDA, Warp starts when it is first used
    call_without_line(wp.init, NO_DRIVER)  # printed by Warp's library itself, past log_level
