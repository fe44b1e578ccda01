"""Shows a job's worlds: pictures, the 3-D page, the live view and MuJoCo's viewer."""

import copy
import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from importlib import import_module
from pathlib import Path

import numpy as np

from mjstack.config.schema import Config
from mjstack.episodes.motion import world_fields
from mjstack.episodes.rollout import Hook, Observer
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError
from mjstack.jobs.live import LiveView
from mjstack.report import picture, web
from mjstack.report.geometry import geom_colors, with_fields, write_fields
from mjstack.report.page import Page, World, frame_stride
from mjstack.report.table import Console
from mjstack.report.write import safely_write
from mjstack.robots.bodies import forward_kinematics, geom_corners
from mjstack.sim import Simulation

_STILL = 1e-3  # m


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
    stage: Stage, folder: Path, pictured: World | None, page: Page, draw: Callable[..., None]
) -> None:
    """Draw the one-world episode, if there was one, with `Run.draw`."""
    if pictured is None:
        return
    cfg = stage.cfg
    qpos = pictured.qpos
    model = with_fields(stage.assets.visual_model, pictured.fields)
    colors = geom_colors(model)
    data = forward_kinematics(model)
    objects = {}
    for name in stage.index.objects:
        geoms = np.flatnonzero(model.geom_bodyid == model.body(name).id)
        objects[name] = (0.5 * np.ptp(geom_corners(data, geoms), (0, 1)), colors[geoms[0]])
    title = f"{cfg.robot.title}, {cfg.task.name}: {pictured.label}"
    draw("scene.png", picture.save_scene, model, qpos[-1])
    bodies = [stage.index.bodies[name] for name in stage.index.fixed]
    geoms = np.flatnonzero(np.isin(model.body_rootid[model.geom_bodyid], bodies))
    fixed = geom_corners(data, geoms)
    places = {
        name: (model.geom(f"place/{name}").pos[:2], place.xy, place.random_xy)
        for name, place in cfg.scene.places.items()
    }
    columns = [at + axis for at in stage.index.object_qpos for axis in range(3)]
    ways = qpos[:, columns].reshape(len(qpos), -1, 3)
    if np.nanmax(np.abs(ways - ways[0]), initial=0.0) > _STILL:
        draw("trajectories.png", picture.save_trajectories, ways, objects, fixed, places, title)
    else:
        page.notes.append("trajectories.png is not drawn: no object has moved")
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
    model = copy.copy(stage.assets.visual_model)
    window = picture.Window(model, stage.cfg.timing.step_dt)

    def show(step: int, sim: Simulation) -> None:
        write_fields(model, *world_fields(stage, hook.env, [0]))
        window.show(sim.qpos[0].cpu().numpy())

    hook = Hook(show)
    return [hook]
