"""How MuJoCo draws offscreen. mujoco decides when it is imported: so every package that imports it
imports this module first, which chooses.
"""

from __future__ import annotations

import os
import sys
from ctypes.util import find_library
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mujoco

_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}


def choose_gl() -> None:
    """Set ``MUJOCO_GL`` on Linux: the user's choice if its library is there, else what this
    machine has.

    A choice whose library is missing would break the import of mujoco itself; then the scene is not
    drawn.
    """
    choice = os.environ.get("MUJOCO_GL", "").lower()
    windows = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if not sys.platform.startswith("linux") or ((choice or windows) and choice not in _LIBRARIES):
        return
    candidates = [choice] if choice else list(_LIBRARIES)
    available = (name for name in candidates if find_library(_LIBRARIES[name]))
    os.environ["MUJOCO_GL"] = next(available, "disable")


def open_renderer(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    """MuJoCo's offscreen renderer of a model. Its OpenGL context belongs to this thread.

    Raises:
        MjstackError: This machine cannot draw offscreen.
    """
    import mujoco

    from mjstack.errors import MjstackError  # not with mjstack: Ctrl-C is not handled there yet

    try:
        return mujoco.Renderer(model, height, width)
    except Exception as error:  # OpenGL loaders fail in their own ways
        gl = os.environ.get("MUJOCO_GL", "not set")
        raise MjstackError(
            f"offscreen rendering fails (MUJOCO_GL={gl}: {type(error).__name__}), expected OpenGL"
            " by EGL or OSMesa",
            "Set MUJOCO_GL=egl or osmesa",
        ) from error


def require_offscreen(model: mujoco.MjModel) -> None:
    """Try to draw.

    Raises:
        MjstackError: This machine cannot draw offscreen.
    """
    open_renderer(model, 16, 16).close()


choose_gl()
