"""How MuJoCo draws offscreen: chosen when mujoco is imported, which decides then."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mujoco

_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}


class BeforeMujoco:
    """Chooses at the import of mujoco: the search takes a while, and Ctrl-C is not handled yet when
    the command imports mjstack.
    """

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        """Find nothing."""
        if name == "mujoco":
            sys.meta_path.remove(self)
            choose_gl()


def choose_gl() -> None:
    """Set ``MUJOCO_GL`` on Linux: the user's choice if its library is there, else what this
    machine has.

    A choice whose library is missing would break the import of mujoco itself; then the scene is not
    drawn.
    """
    from ctypes.util import find_library

    if not sys.platform.startswith("linux"):
        return
    asked = os.environ.get("MUJOCO_GL", "").lower()
    found = [name for name, library in _LIBRARIES.items() if find_library(library)]
    if asked in _LIBRARIES and asked not in found:
        os.environ["MUJOCO_GL"] = "disable"
    elif not asked and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ["MUJOCO_GL"] = found[0] if found else "disable"


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
