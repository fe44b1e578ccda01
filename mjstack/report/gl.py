"""Chooses how MuJoCo draws offscreen. Import before mujoco, which decides at its own import."""

from __future__ import annotations

import ctypes.util
import os
import sys


def choose_gl() -> None:
    """Sets ``MUJOCO_GL`` on a Linux machine without a screen, unless the user has set it."""
    if not sys.platform.startswith("linux") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return
    for library, name in (("EGL", "egl"), ("OSMesa", "osmesa")):
        if ctypes.util.find_library(library):
            os.environ.setdefault("MUJOCO_GL", name)
            return
    os.environ.setdefault("MUJOCO_GL", "disable")
