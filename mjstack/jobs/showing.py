"""Shows a job's worlds: pictures, the 3-D page and the live view."""

import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from mjstack.config.schema import Config
from mjstack.episodes.stage import Stage
from mjstack.jobs.live import LiveView
from mjstack.report import picture, web
from mjstack.report.geometry import with_fields
from mjstack.report.page import Page, World, frame_stride
from mjstack.report.table import Console
from mjstack.report.write import safely_write


def check_showing(cfg: Config, ending: str = ".mp4") -> None:
    """Raise if this machine cannot show an episode as ``view`` or ``video`` ask for, the video with
    a name of this ending.
    """
    if cfg.view == "web":
        web.check_address(cfg.web.host, cfg.web.port)
    if cfg.video:
        picture.require_video(ending)


def draw_episode(
    stage: Stage, folder: Path, pictured: World | None, draw: Callable[..., None]
) -> None:
    """Draw the one-world episode, if there was one, with `Run.draw`."""
    if pictured is None:
        return
    cfg = stage.cfg
    model = with_fields(stage.assets.visual_model, pictured.fields)
    draw("scene.png", picture.save_scene, model, pictured.qpos[-1])
    if cfg.video:
        path = folder / "episode.mp4"
        problem = safely_write(path, picture.save_video, model, [pictured], cfg.timing.step_dt)
        stage.progress.print_line(problem or f"video: {path}")


def save_page(stage: Stage, folder: Path, page: Page) -> None:
    """Write the 3-D page of the run's worlds, if there were any."""
    cfg = stage.cfg
    if not cfg.web.episode:
        page.notes.append("web.episode=false: no 3-D page")
        return
    path = folder / web.EPISODE
    worlds = web.choose_worlds(page.worlds3d)
    problem = web.lacks_viser()
    if worlds and not problem:
        frame_dt = frame_stride(cfg.timing.step_dt) * cfg.timing.step_dt
        model = stage.assets.visual_model
        problem = safely_write(path, web.save_episode, model, worlds, frame_dt)
        if not problem:
            page.episode = web.EPISODE
            page.notes += web.not_shown(model, worlds)
    if problem:
        page.notes.append(problem)
        stage.progress.print_line(problem)


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
        yield LiveView(server, stage)
    finally:
        web.stop_server(server)
