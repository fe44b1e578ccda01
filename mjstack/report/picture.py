"""Pictures of a run: the final scene, and a video."""

import copy
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from PIL import Image, ImageDraw

from mjstack.errors import MissingExtra
from mjstack.interrupt import check_interrupt
from mjstack.report.geometry import Fields, write_fields
from mjstack.report.gl import open_renderer
from mjstack.report.page import World, frame_stride

Draw = Callable[[np.ndarray], Iterable[np.ndarray]]
Write = Callable[[Path, Iterator[Image.Image], int, float], None]


def _render(
    model: mujoco.MjModel,
    states: np.ndarray,
    width: int,
    height: int,
    fields: Sequence[Fields] = ({},),
) -> Iterator[np.ndarray]:
    """Draw states offscreen, shape ``(n, nq)``, of worlds with these model fields in turn: images
    of shape ``(height, width, 3)``, uint8.

    Raises:
        MjstackError: This machine cannot draw offscreen.
    """
    model = copy.copy(model)
    data = mujoco.MjData(model)
    renderer = open_renderer(model, height, width)
    x, _, z = model.geom_pos[model.geom("table").id].tolist()
    tall = max(0.0, float(model.stat.center[2]) - z - 0.03)  # m that an arm stands out
    camera = mujoco.MjvCamera()
    camera.lookat = [0.62 * x, 0.0, z + 0.08 + tall]
    camera.distance = 0.55 + x + 1.5 * tall
    camera.azimuth = 140.0
    camera.elevation = -24.0
    with renderer:
        for state, values in zip(states, itertools.cycle(fields), strict=False):
            check_interrupt()
            write_fields(model, values)
            data.qpos[:] = state
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            yield renderer.render()


def save_scene(path: Path, model: mujoco.MjModel, qpos: np.ndarray) -> None:
    """Draw a state, shape ``(nq,)``.

    Raises:
        MjstackError: This machine cannot draw offscreen.
    """
    (image,) = _render(model, qpos[None], 960, 720)
    Image.fromarray(image).save(path)


def save_video(
    path: Path,
    model: mujoco.MjModel,
    worlds: Sequence[World],
    step_dt: float,
    advance: Callable[[str, int, int], None] = lambda what, done, total: None,
    *,
    fps: float = 25.0,
    width: int | None = None,
    draw: Draw | None = None,
) -> None:
    """Write a video of episodes in real time, side by side: an mp4, or a GIF or WebP that loops, by
    the file's ending.

    Args:
        path: The file.
        model: The scene.
        worlds: The worlds with positions at the ends of equally many steps.
        step_dt: Time of a step [s].
        advance: Reports progress.
        fps: Frames per second [Hz], as near as whole steps allow.
        width: Of the video [pixels]; 640 by default with one world, 960 with several.
        draw: Draws a state of every world, shape ``(worlds, nq)``, as images ``(height, width,
            3)``, uint8. By default the scene is seen from the side.

    Raises:
        MjstackError: This machine cannot draw offscreen, or lacks what writes the format.
    """
    write = require_video(path.suffix)
    skip = frame_stride(step_dt, fps)
    states = np.stack([world.qpos[::skip] for world in worlds], 1)
    count, nworld, nq = states.shape
    columns = math.ceil(math.sqrt(nworld))
    wide = (width or (640 if nworld == 1 else 960)) // columns

    images: Iterator[np.ndarray]
    if draw is None:
        fields = [world.fields for world in worlds]
        images = _render(model, states.reshape(-1, nq), wide, 3 * wide // 4, fields)
    else:
        images = (image for frame in states for image in draw(frame))

    def frames() -> Iterator[Image.Image]:
        for done in range(1, count + 1):
            check_interrupt()
            yield _side_by_side(list(itertools.islice(images, nworld)), columns, wide)
            advance("pictures of the video", done, count)

    write(path, frames(), count, step_dt * skip)


def _side_by_side(images: Sequence[np.ndarray], columns: int, wide: int) -> Image.Image:
    """Images of one size in rows, scaled to a width; the places that are left are black."""
    height, width, _ = images[0].shape
    tall = max(1, round(height * wide / width))
    frame = Image.new("RGB", (columns * wide, math.ceil(len(images) / columns) * tall))
    for number, image in enumerate(images):
        scaled = Image.fromarray(image).resize((wide, tall), Image.Resampling.BOX)
        frame.paste(scaled, (number % columns * wide, number // columns * tall))
    return frame


def require_video(ending: str) -> Write:
    """The function that writes a video whose name ends so. It takes the file, the frames, their
    number, and the time between two frames [s].

    Raises:
        MissingExtra: The mp4 writer is not installed.
    """
    if ending in _LOOPS:
        return _write_loop
    if find_spec("imageio_ffmpeg") is None:
        raise MissingExtra("video=true", "imageio-ffmpeg", "video")
    return _write_mp4


def _write_mp4(path: Path, frames: Iterator[Image.Image], count: int, dt: float) -> None:
    from imageio_ffmpeg import write_frames

    first = next(frames)
    writer = write_frames(str(path), first.size, fps=1.0 / dt, macro_block_size=16)
    writer.send(None)
    for frame in itertools.chain([first], frames):
        writer.send(frame.tobytes())
    writer.close()


# Pillow's options by ending. `optimize` makes what has not moved transparent.
_LOOPS: dict[str, dict[str, Any]] = {".gif": {"optimize": True}, ".webp": {"quality": 60}}
_COLORS = 96  # of a GIF; with 255 it is 40 % larger, and looks the same


def _write_loop(path: Path, frames: Iterator[Image.Image], count: int, dt: float) -> None:
    """Write a GIF or a WebP. All frames of a GIF have the first one's colours, without dithering,
    so that what does not move keeps its colour.
    """
    first = next(frames)
    if path.suffix == ".gif":
        first = first.quantize(_COLORS)
        quantize = partial(Image.Image.quantize, palette=first, dither=Image.Dither.NONE)
        frames = map(quantize, frames)
    ends = 10 * np.round(100.0 * dt * np.arange(count + 1)).astype(int)  # a GIF counts in 10 ms
    first.save(
        path,
        save_all=True,
        append_images=frames,
        duration=np.diff(ends).tolist(),
        loop=0,
        **_LOOPS[path.suffix],
    )


def save_images(
    path: Path, rows: Mapping[str, Sequence[np.ndarray]], columns: Sequence[str]
) -> None:
    """Save images, each of shape ``(height, width, 3)``, uint8, in named rows and columns."""
    side = 256
    picture = Image.new("RGB", (side * len(columns), side * len(rows)))
    draw = ImageDraw.Draw(picture)
    for i, (name, images) in enumerate(rows.items()):
        for j, (column, image) in enumerate(zip(columns, images, strict=True)):
            at = (side * j, side * i)
            picture.paste(Image.fromarray(image.astype(np.uint8)).resize((side, side)), at)
            draw.text(at, f" {name}, {column}", stroke_width=1, stroke_fill="black")
    picture.save(path)
