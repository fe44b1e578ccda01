"""Worlds in a browser: an episode as one HTML file with play and scrub, and the scene that the live
view shows. The only module that imports viser.
"""

import base64
import contextlib
import errno
import io
import json
import logging
import math
import os
import re
import secrets
import socket
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import patch
from urllib.parse import parse_qs, urlsplit

import mujoco
import numpy as np

from mjstack.errors import ConfigError, MissingExtra, MjstackError
from mjstack.interrupt import check_interrupt
from mjstack.report.geometry import Shape, Shapes
from mjstack.report.page import MOST_WORLDS, World

EPISODE = "episode.html"
_LENGTH = 4.0 / 2**15  # m, to which positions are rounded
_TURN = 1.0 / 2**12  # of quaternions
_LOOPBACK = ("127.0.0.1", "::1", "[::1]", "localhost")
_PORT = re.compile(r":\d+$")
_MESSAGE = 2**16  # bytes, the largest of a browser
_MARGIN = 0.12  # m between worlds
_UNSEEN = ("site_", "cam_", "light_", "mat_")  # beginnings of model fields that it does not show
_COLORS = ("db5952", "d99a2b", "8d63c9", "2f9e8f", "c45a9c", "7a8b3c")  # of broken rules
_FILTER = """<script>{
const motions = %s, shown = decodeURIComponent(location.hash.slice(1));
if (motions[shown]) window.__VISER_EMBED_DATA__ = motions[shown][1];
addEventListener("hashchange", () => location.reload());
addEventListener("DOMContentLoaded", () => {
  const list = document.createElement("select");
  list.id = "rules";
  list.style = "position: fixed; top: 1em; left: 1em; z-index: 9";
  for (const rule of ["", ...Object.keys(motions)]) {
    const option = new Option(rule || "all worlds", rule, false, rule === shown);
    if (rule) option.style.color = "#" + motions[rule][0];
    list.add(option);
  }
  list.onchange = () => { location.hash = list.value };
  document.body.append(list);
});
}</script>"""


def lacks_viser() -> str:
    """Why there can be no page of an episode; empty if there can."""
    if find_spec("viser") is None:
        return str(MissingExtra(EPISODE, "viser", "web"))
    return ""


class Stage:
    """Worlds side by side in a viser server's scene."""

    def __init__(
        self,
        server: Any,
        model: mujoco.MjModel,
        worlds: Sequence[World],
        rules: Sequence[str] = (),
    ) -> None:
        """Add the worlds to a ``viser.ViserServer``, in the state of their model with visuals.

        In worlds that failed, the table and what stands still in all worlds alike have the colour
        of the first rule that they broke, by its number in ``rules``.
        """
        self._shapes = shapes = Shapes(model, [world.fields for world in worlds])
        low, high = shapes.box()
        self._offsets = _grid(len(worlds), high[:2] - low[:2] + _MARGIN)
        self._handles: list[tuple[Shape, Any]] = []
        places, turns = self._round(*shapes.poses(shapes.rest))
        self._last = (places, turns)
        failed = np.array([bool(world.rules) for world in worlds])
        first = [rules.index(world.rules[0]) if world.rules else 0 for world in worlds]
        colors = np.array([[*bytes.fromhex(_color(number))] for number in first]) / 255.0
        for number, shape in enumerate(shapes.meshes):
            rgba = shape.rgba.copy()
            marked = failed[shape.worlds] & shape.table
            rgba[marked, :3] = colors[shape.worlds][marked]
            alpha = rgba[:, 3]
            handle = server.scene.add_batched_meshes_simple(
                f"/{number}",
                shape.mesh[0].astype(np.float32),
                shape.mesh[1],
                turns[shape.worlds, shape.pose],
                places[shape.worlds, shape.pose],
                batched_colors=np.round(255.0 * rgba[:, :3]).astype(np.uint8),
                batched_opacities=None if np.ptp(alpha) == 0.0 else alpha / alpha.max(),
                opacity=None if alpha.min() == 1.0 else float(alpha.max()),
                flat_shading=True,
                cast_shadow=shape.pose > 0,
                lod="off",
            )
            self._handles.append((shape, handle))

        # Texts, the floor, and where one looks from
        for number, world in enumerate(worlds):
            x, y = self._offsets[number]
            server.scene.add_label(
                f"/label/{number}",
                world.caption,
                position=(x + high[0], y + 0.5 * (low[1] + high[1]), low[2]),
                anchor="top-center",
                font_size_mode="scene",
                font_scene_height=0.035,
            )
        size = (high - low)[:2]
        span = np.ptp(self._offsets, 0) + size
        middle = 0.5 * (low + high)[:2]
        centre = np.array([*self._offsets.mean(0) + middle, 0.0])
        server.scene.add_grid(
            "/floor",
            width=float(span[0] + 2.0),
            height=float(span[1] + 2.0),
            cell_size=0.1,
            section_size=1.0,
            position=[centre[0], centre[1], low[2] - 1e-3],
        )
        server.scene.set_up_direction("+z")
        server.scene.configure_environment_map(None)
        server.scene.configure_default_lights(False)
        server.scene.add_light_hemisphere("/sky", intensity=1.6, ground_color=(120, 120, 130))
        server.scene.add_light_directional(
            "/sun", position=centre + np.array([1.0, -1.5, 3.0]), intensity=1.6, cast_shadow=True
        )
        if failed.any():  # one looks at the first of these
            centre[:2] = self._offsets[failed.argmax()] + middle
            span = size
        reach = 0.3 + 0.56 * float(np.linalg.norm(span))
        server.initial_camera.position = centre + reach * np.array([0.75, -0.45, 0.6])
        server.initial_camera.look_at = centre + reach * np.array([0.1, -0.06, 0.0])

    def update(self, qpos: np.ndarray) -> None:
        """Move the worlds to positions of shape ``(worlds, nq)``; what rests costs nothing."""
        places, turns = self._round(*self._shapes.poses(qpos))
        old_places, old_turns = self._last
        for shape, handle in self._handles:
            at = (shape.worlds, shape.pose)
            if not np.array_equal(old_places[at], places[at]):
                handle.batched_positions = places[at]
            if not np.array_equal(old_turns[at], turns[at]):
                handle.batched_wxyzs = turns[at]
        self._last = (places, turns)

    def _round(self, places: np.ndarray, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses in the scene, with as many bits as eyes need: the file is compressed."""
        places[..., :2] += self._offsets[:, None]
        places = _LENGTH * np.round(places / _LENGTH)
        return places.astype(np.float32), (_TURN * np.round(turns / _TURN)).astype(np.float32)


def choose_worlds(parts: Mapping[str, Sequence[World]]) -> list[World]:
    """At most 64 worlds of a run's parts: those alone, and equal shares of the rest."""
    single = [part[0] for part in parts.values() if len(part) == 1][:MOST_WORLDS]
    batches = [part for part in parts.values() if len(part) > 1]
    share = (MOST_WORLDS - len(single)) // max(1, len(batches))
    return [*(world for part in batches for world in part[:share]), *single]


def not_shown(model: mujoco.MjModel, worlds: Sequence[World]) -> list[str]:
    """Name in one line the differences between worlds that a page does not show, if any."""
    fields = {
        name
        for world in worlds
        for name, values in world.fields.items()
        if name.startswith(_UNSEEN) and not np.allclose(values, getattr(model, name))
    }
    names = [*sorted(fields - {"mat_rgba"}), *Shapes(model, [w.fields for w in worlds]).missing]
    return [f"{EPISODE} does not show how worlds differ in {', '.join(names)}"] * bool(names)


def save_episode(
    path: Path, model: mujoco.MjModel, worlds: Sequence[World], frame_dt: float
) -> None:
    """Write worlds in motion, side by side, as one HTML file, which plays without a server. A world
    that ends earlier stays. A list on the page, or ``#RULE`` behind its address, shows the worlds
    that broke a rule alone. ``model`` has visuals, ``frame_dt`` is the time between frames [s].

    Raises:
        OSError: The file cannot be written.
    """
    rules = list(dict.fromkeys(rule for world in worlds for rule in world.rules))
    page = _record(model, worlds, rules, frame_dt).as_html()
    motions = {}
    for number, rule in enumerate(rules):
        broken = [world for world in worlds if rule in world.rules]
        motion = _record(model, broken, rules, frame_dt).serialize()
        motions[rule] = [_color(number), base64.b64encode(motion).decode()]
    script = _FILTER % json.dumps(motions).replace("<", "\\u003c") if rules else ""
    page = page.replace("<title>Viser</title>", "<title>Episode</title>", 1)
    path.write_text(page.replace("</head>", f"{script}</head>", 1), encoding="utf-8")


def _record(
    model: mujoco.MjModel, worlds: Sequence[World], rules: Sequence[str], frame_dt: float
) -> Any:
    """Viser's recording of worlds in motion; arguments as of `Stage` and `save_episode`."""
    server = start_server("127.0.0.1", 0)
    try:
        stage = Stage(server, model, worlds, rules)
        qpos = np.stack([_fill(world, worlds) for world in worlds], axis=1)
        stage.update(qpos[0])
        scene = server.get_scene_serializer()
        with server.atomic():  # no browser waits for the messages
            for row in qpos[1:]:
                check_interrupt()
                scene.insert_sleep(frame_dt)
                stage.update(row)
        scene.insert_sleep(1.0)
        return scene
    finally:
        stop_server(server)


def _color(number: int) -> str:
    """The colour of a rule, by its number, as hexadecimal digits."""
    return _COLORS[number % len(_COLORS)]


def check_address(host: str, port: int) -> None:
    """Raise where the live view cannot be served.

    Raises:
        MissingExtra: viser is not installed.
        ConfigError: The address is not this machine's, or another program has the port.
    """
    if find_spec("viser") is None:
        raise MissingExtra("view=web", "viser", "web")
    try:
        socket.create_server((host, port)).close()
    except OSError as error:
        if error.errno in (errno.EADDRINUSE, errno.EACCES):
            expected = f"a port that is free on {host} ({os.strerror(error.errno)})"
            raise ConfigError("web.port", port, expected, "Set another web.port") from error
        expected = "an address of this machine, such as 127.0.0.1"
        raise ConfigError("web.host", host, expected) from error


def start_server(host: str, port: int, token: str = "") -> Any:
    """A viser server that answers those alone who know a token.

    Args:
        host: Address.
        port: 0 is any that is free. Ask `check_address` of others: where one is in use, viser tries
            the next ones and then hangs.
        token: In the address of the page, ``/?token=...``. Empty: a random one.

    Raises:
        MjstackError: This viser opens its websockets in another way than the known one.
    """
    import viser
    from viser.infra import _infra

    # viser has no hook for requests: what it hands to websockets is wrapped while it starts.
    asyncio_server = _infra.websockets.asyncio.server
    serve = asyncio_server.serve
    token = token or secrets.token_urlsafe()
    guarded = []

    def serve_guarded(*args: Any, process_request: Any, **options: Any) -> Any:
        guarded.append(port)
        answer = partial(_answer, process_request, token, host in _LOOPBACK)
        return serve(*args, process_request=answer, **options | {"max_size": _MESSAGE})

    logging.getLogger("websockets").setLevel(logging.WARNING)
    with (
        patch.object(asyncio_server, "serve", serve_guarded),
        contextlib.redirect_stdout(io.StringIO()),  # its banner
    ):
        server = viser.ViserServer(host=host, port=port, verbose=False)
    if not guarded:
        stop_server(server)
        raise MjstackError(f"viser {viser.__version__} cannot be guarded, expected 1.1.1")
    return server


def _answer(
    process: Callable[[Any, Any], Any], token: str, local: bool, connection: Any, request: Any
) -> Any:
    """Answer a request of a browser, HTTP or the start of a websocket.

    The page's address has the token. Its answer makes it a cookie, which the page's websocket
    brings; a page of another site cannot send it (SameSite=Strict), nor can a script read it.
    Another port of this host is the same site, so that Origin has to be Host. On this machine alone
    (``local``) Host counts too: another name may lead here.
    """
    hosts = request.headers.get_all("Host")
    cookie = f"mjstack-{token}=1"
    cookies = "; ".join(request.headers.get_all("Cookie")).split("; ")
    fresh = token in parse_qs(urlsplit(request.path).query).get("token", [])
    origins = request.headers.get_all("Origin")  # a browser sends that of a websocket
    refused = not (fresh or cookie in cookies) or len(hosts) != 1
    refused |= any(origin != f"http://{host}" for origin in origins for host in hosts)
    refused |= local and not all(_PORT.sub("", host) in _LOOPBACK for host in hosts)
    if refused:
        text = "Open the whole address that the run has printed, with its token.\n"
        return connection.respond(403, text)
    response = process(connection, request)
    if fresh and response is not None:
        response.headers["Set-Cookie"] = f"{cookie}; HttpOnly; SameSite=Strict; Path=/"
    return response


def stop_server(server: Any) -> None:
    """End a server."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _fill(world: World, worlds: Sequence[World]) -> np.ndarray:
    """A world's positions at every frame of the page: it stays where it ended, or where numbers
    ceased.
    """
    count = max(len(member.qpos) for member in worlds)
    finite = np.isfinite(world.qpos).all(1)
    last = np.maximum.accumulate(np.where(finite, np.arange(len(finite)), -1))
    last = np.where(last < 0, int(finite.argmax()), last)
    rows = np.minimum(np.arange(count), len(finite) - 1)
    return np.nan_to_num(world.qpos)[last[rows]]


def _grid(count: int, size: np.ndarray) -> np.ndarray:
    """Positions of worlds of a size in x and y [m], shape ``(count, 2)``."""
    columns = min(count, math.ceil(math.sqrt(count * size[0] / size[1])))
    number = np.arange(count)
    return np.column_stack((-size[0] * (number // columns), size[1] * (number % columns)))
