"""Shows a job's worlds: pictures, the 3-D page, the live view and MuJoCo's viewer."""

import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from importlib import import_module
from pathlib import Path

import numpy as np

from mjstack.config.schema import Config
from mjstack.episodes.rollout import Hook, Observer
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError
from mjstack.jobs.live import LiveView
from mjstack.report import picture, web
from mjstack.report.page import Page, frame_stride
from mjstack.report.table import Console
from mjstack.report.write import safely_write
from mjstack.scene.index import geom_corners
from mjstack.sim import Simulation


def check_showing(cfg: Config, ending: str = ".mp4") -> None:
    """Raise if this machine cannot show an episode as ``view`` or ``video`` ask for, the video with
    a name of this ending.
    """
    if cfg.view == "web":
        web.check_address(cfg.web.host, cfg.web.port)
    elif cfg.view == "true" and not picture.opens_windows():
        display = os.environ.get("DISPLAY", "not set")
        expected = f"a display that opens windows (DISPLAY={display})"
        raise ConfigError("view", "true", expected, "Use view=web or video=true instead")
    if cfg.video:
        picture.require_video(ending)


def load_drawing() -> None:
    """Load what draws pictures and pages."""
    for name in ("matplotlib.figure", "trimesh"):
        with suppress(Exception):  # what draws says why
            import_module(name)


def draw_episode(
    stage: Stage, folder: Path, pictured: tuple[str, np.ndarray] | None, draw: Callable[..., None]
) -> None:
    """Draw the one-world episode, if there was one, with `Run.draw`."""
    if pictured is None:
        return
    world, qpos = pictured
    cfg = stage.cfg
    model = stage.assets.visual_model
    objects = {name: (thing.half, thing.color) for name, thing in cfg.scene.free.items()}
    positions = np.stack([qpos[:, a : a + 3] for a in stage.index.object_qpos], axis=1)
    title = f"{cfg.robot.title}, {cfg.task.name}: {world}"
    draw("scene.png", picture.save_scene, model, qpos[-1])
    bodies = [stage.index.bodies[name] for name in stage.index.fixed]
    geoms = np.flatnonzero(np.isin(model.body_rootid[model.geom_bodyid], bodies))
    fixed = geom_corners(model, geoms)
    places = {name: (place.xy, place.random_xy) for name, place in cfg.scene.places.items()}
    draw("trajectories.png", picture.save_trajectories, positions, objects, fixed, places, title)
    if cfg.video:
        path = folder / "episode.mp4"
        problem = safely_write(path, picture.save_video, model, qpos[None], cfg.timing.step_dt)
        stage.progress.print_line(problem or f"video: {path}")


def save_page(stage: Stage, folder: Path, page: Page) -> str:
    """Write the 3-D page of the run's worlds, if there were any; return why there is none."""
    cfg = stage.cfg
    if not cfg.web.episode:
        return "web.episode=false: no 3-D page"
    path = folder / web.EPISODE
    worlds = web.choose_worlds(page.worlds3d)
    problem = web.lacks_viser()
    if worlds and not problem:
        frame_dt = frame_stride(cfg.timing.step_dt) * cfg.timing.step_dt
        problem = safely_write(path, web.save_episode, stage.assets.visual_model, worlds, frame_dt)
    if path.exists():  # perhaps an earlier call's, of seeds that were read back
        page.episode = web.EPISODE
    if problem:
        stage.progress.print_line(problem)
    return problem


@contextmanager
def serve_live_view(stage: Stage, console: Console) -> Iterator[LiveView | None]:
    """Serve the live view inside, if it is asked for."""
    cfg = stage.cfg
    if cfg.view != "web":
        yield None
        return
    token = secrets.token_urlsafe()
    server = web.start_server(cfg.web.host, cfg.web.port, token)
    try:
        console.print(f"live view: http://{cfg.web.host}:{server.get_port()}/?token={token}")
        with closing(LiveView(server, stage)) as live:
            yield live
    finally:
        web.stop_server(server)


def find_viewers(stage: Stage) -> list[Observer]:
    """MuJoCo's viewer of a one-world episode in real time, if it is asked for; closing the window
    lets the run go on.
    """
    if stage.cfg.view != "true":
        return []
    window = picture.Window(stage.assets.visual_model, stage.cfg.timing.step_dt)

    def show(step: int, sim: Simulation) -> None:
        window.show(sim.qpos[0].cpu().numpy())

    return [Hook(show)]
