"""Shows a job's worlds: pictures, the 3-D page, the live view and MuJoCo's viewer."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
from rich.markup import escape

from mjstack.config.schema import Config
from mjstack.episodes.context import RunContext
from mjstack.episodes.live import LiveView
from mjstack.episodes.rollout import Hook, Observer, StepHook
from mjstack.errors import ConfigError
from mjstack.report.picture import (
    opens_windows,
    require_video,
    save_scene,
    save_trajectories,
    save_video,
)
from mjstack.report.table import Console
from mjstack.report.web import (
    EPISODE,
    check_address,
    choose_worlds,
    frame_stride,
    lacks_viser,
    save_episode,
    start_server,
    stop_server,
)
from mjstack.report.write import safely_write
from mjstack.sim import Simulation


def check_showing(cfg: Config, ending: str = ".mp4") -> None:
    """Raise if this machine cannot show an episode as ``view`` or ``video`` ask for, the video with
    a name of this ending.
    """
    if cfg.view == "web":
        check_address(cfg.web.host, cfg.web.port)
    elif cfg.view == "true" and not opens_windows():
        shown = os.environ.get("DISPLAY", "not set")
        expected = f"a display that opens windows (DISPLAY={shown})"
        raise ConfigError("view", "true", expected, "Use view=web or video=true instead")
    if cfg.video:
        require_video(ending)


def draw_episode(context: RunContext, console: Console) -> list[str]:
    """Draw the one-world episode, if there was one; return the pictures' file names."""
    if context.artifacts.shown is None:
        return []
    world, episode = context.artifacts.shown
    cfg = context.cfg
    folder = cast(Path, context.folder)
    objects = {name: (thing.half, thing.color) for name, thing in cfg.scene.free.items()}
    positions = np.stack([episode.qpos[:, a : a + 3] for a in context.index.object_qpos], axis=1)
    title = f"{cfg.robot.title}, {cfg.task.name}: {world}"
    model = context.stage.visual_model
    drawn: dict[str, tuple[Callable[..., object], tuple]] = {
        "scene.png": (save_scene, (model, episode.qpos[-1])),
        "trajectories.png": (save_trajectories, (positions, objects, title)),
    }
    if cfg.video:
        drawn["episode.mp4"] = (save_video, (model, episode.qpos[None], cfg.timing.step_dt))
    pictures = []
    for name, (draw, args) in drawn.items():
        if problem := safely_write(folder / name, draw, *args):
            console.print(escape(problem))
        elif name.endswith(".png"):
            pictures.append(name)
        else:
            console.print(escape(f"video: {folder}/{name}"))
    return pictures


def save_page(context: RunContext) -> str:
    """Write the 3-D page of the run's worlds, if there were any; return why there is none."""
    cfg = context.cfg
    page = context.page
    folder = cast(Path, context.folder)
    if not cfg.web.episode:
        return "web.episode=false: no 3-D page"
    worlds = choose_worlds(page.worlds3d)
    problem = lacks_viser()
    if worlds and not problem:
        frame_dt = frame_stride(cfg.timing.step_dt) * cfg.timing.step_dt
        shown = (context.stage.visual_model, worlds, frame_dt)
        problem = safely_write(folder / EPISODE, save_episode, *shown)
    if (folder / EPISODE).exists():  # perhaps an earlier call's, of seeds that were read back
        page.episode = EPISODE
    if problem:
        context.print_line(problem)
    return problem


@contextmanager
def serve_live_view(context: RunContext, console: Console) -> Iterator[LiveView | None]:
    """Serve the live view inside, if it is asked for."""
    cfg = context.cfg
    if cfg.view != "web":
        yield None
        return
    check_address(cfg.web.host, cfg.web.port)  # another program may have come first
    server = start_server(cfg.web.host, cfg.web.port)
    try:
        console.print(f"live view: http://{cfg.web.host}:{server.get_port()}")
        with closing(
            LiveView(
                server,
                lambda: context.stage.visual_model,
                renderer=partial(context.stage.color_renderer, 1) if cfg.scene.cameras else None,
                pausable=context.ranks.size == 1,
                print_line=console.print,
            )
        ) as live:
            yield live
    finally:
        stop_server(server)


def find_viewers(context: RunContext) -> list[Observer]:
    """MuJoCo's viewer, if it is asked for."""
    return [Hook(_viewer(context))] if context.cfg.view == "true" else []


def _viewer(context: RunContext) -> StepHook:
    """Show a one-world episode in MuJoCo's viewer, in real time; closing the window lets the run
    go on.
    """
    import mujoco.viewer

    model = context.stage.visual_model
    data = mujoco.MjData(model)
    handle = mujoco.viewer.launch_passive(model, data)

    def show(step: int, sim: Simulation) -> None:
        if not handle.is_running():
            return
        began = time.perf_counter()
        data.qpos[:] = sim.qpos[0].cpu().numpy()
        mujoco.mj_forward(model, data)
        handle.sync()
        time.sleep(max(0.0, context.cfg.timing.step_dt - (time.perf_counter() - began)))

    return show
