"""Chooses how MuJoCo draws offscreen. Import before mujoco, which decides at its own import."""

import ctypes.util
import os
import sys

_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}


def choose_gl() -> None:
    """Set ``MUJOCO_GL`` on Linux: the user's choice if its library is there, else what this
    machine has.

    A choice whose library is missing would break the import of mujoco itself; then the scene is not
    drawn.
    """
    if not sys.platform.startswith("linux"):
        return
    asked = os.environ.get("MUJOCO_GL", "").lower()
    found = [name for name, library in _LIBRARIES.items() if ctypes.util.find_library(library)]
    if asked in _LIBRARIES and asked not in found:
        os.environ["MUJOCO_GL"] = "disable"
    elif not asked and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ["MUJOCO_GL"] = found[0] if found else "disable"
