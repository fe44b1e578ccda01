"""Pictures of a run: the final scene, the objects' way there, and a video."""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import mujoco
import numpy as np

from mjstack.errors import MissingExtra, MjstackError
from mjstack.report.figure import figure

Drawn = tuple[Sequence[float], Sequence[float]]


class SceneCamera:
    """Draws a model offscreen."""

    def __init__(self, model: mujoco.MjModel, width: int = 960, height: int = 720) -> None:
        """Open a renderer.

        Raises:
            MjstackError: This machine cannot draw offscreen.
        """
        self._model = model
        self._data = mujoco.MjData(model)
        try:
            self._renderer = mujoco.Renderer(model, height, width)
        except Exception as error:  # OpenGL loaders fail in their own ways
            gl = os.environ.get("MUJOCO_GL", "not set")
            raise MjstackError(
                f"offscreen rendering fails (MUJOCO_GL={gl}: {type(error).__name__}). Set"
                " MUJOCO_GL=egl or osmesa."
            ) from error
        table = model.geom("table").id
        x, _, z = model.geom_pos[table].tolist()
        tall = max(0.0, float(model.stat.center[2]) - z - 0.03)  # m that an arm stands out
        self._camera = mujoco.MjvCamera()
        self._camera.lookat = [0.62 * x, 0.0, z + 0.08 + tall]
        self._camera.distance = 0.55 + x + 1.5 * tall
        self._camera.azimuth = 140.0
        self._camera.elevation = -24.0

    def draw(self, qpos: np.ndarray) -> np.ndarray:
        """An image of one state, shape ``(height, width, 3)``, uint8."""
        self._data.qpos[:] = qpos
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, self._camera)
        return self._renderer.render()

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()


def save_scene(path: Path, model: mujoco.MjModel, qpos: np.ndarray) -> None:
    """Draw a state, shape ``(nq,)``.

    Raises:
        MjstackError: This machine cannot draw offscreen.
    """
    camera = SceneCamera(model)
    plt.imsave(path, camera.draw(qpos))
    camera.close()


def save_video(path: Path, model: mujoco.MjModel, qpos: np.ndarray, step_dt: float) -> None:
    """Write an mp4 of an episode in real time.

    Args:
        path: The file.
        model: The scene with visuals.
        qpos: States at the ends of steps, shape ``(steps, nq)``.
        step_dt: Time between them [s].

    Raises:
        MjstackError: This machine cannot draw offscreen, or lacks the extra ``video``.
    """
    writer_of = require_video()
    skip = max(1, round(1.0 / (25.0 * step_dt)))
    camera = SceneCamera(model, 640, 480)
    writer = writer_of(str(path), (640, 480), fps=1.0 / (step_dt * skip), macro_block_size=16)
    writer.send(None)
    for state in qpos[::skip]:
        writer.send(np.ascontiguousarray(camera.draw(state)))
    writer.close()
    camera.close()


def require_video() -> Callable[..., Any]:
    """The mp4 writer.

    Raises:
        MissingExtra: It is not installed.
    """
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise MissingExtra("video=true", "imageio-ffmpeg", "video") from error
    return imageio_ffmpeg.write_frames


def save_trajectories(
    path: Path, positions: np.ndarray, objects: Mapping[str, Drawn], title: str
) -> None:
    """Plot the objects' way.

    Args:
        path: The picture.
        positions: Of each object over the episode [m], shape ``(steps, objects, 3)``.
        objects: Half sizes [m] and color of each object, by name.
        title: What is shown.
    """
    with figure(path, title, 3, figsize=(13, 4)) as (_, (side, above, height)):
        for number, (name, (half, color)) in enumerate(objects.items()):
            mm = 1e3 * positions[:, number]
            for axes, row in ((side, 2), (above, 0)):
                axes.plot(mm[:, 1], mm[:, row], color=color, label=name)
                width, depth = 2e3 * half[1], 2e3 * half[row]
                for at, style in ((mm[0], {"fill": False}), (mm[-1], {"alpha": 0.5})):
                    corner = (at[1] - width / 2, at[row] - depth / 2)
                    axes.add_patch(plt.Rectangle(corner, width, depth, color=color, **style))
            height.plot(mm[:, 2], color=color, label=name)
        front = "from the front (outline: start, filled: end)"
        side.set(xlabel="y [mm]", ylabel="z [mm]", title=front, aspect="equal")
        above.set(xlabel="y [mm]", ylabel="x [mm]", title="from above", aspect="equal")
        height.set(xlabel="control step", ylabel="z [mm]", title="height of the centre")
        for axes in (side, above, height):
            axes.grid(alpha=0.3)
            axes.margins(0.1)
        height.legend(frameon=False)
