"""The live view: worlds of a running environment in a browser, with plots and images."""

import re
import time
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from typing_extensions import override

from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.motion import world_fields
from mjstack.episodes.rollout import Observer
from mjstack.episodes.stage import Stage
from mjstack.interrupt import check_interrupt
from mjstack.report.page import MOST_WORLDS, World
from mjstack.report.web import Stage as SceneView
from mjstack.sim import StateRenderer

_RATE = 25.0  # pictures per second, at most
_HISTORY = 500  # points of a plot
_FIRST = 16  # worlds that are shown at first
_TEXT = 200  # characters of a text, at most
_GRACE = 3.0  # s in which a page that is loaded anew comes back
_COLORS = ("#4478b8", "#c93434", "#1a7f4b", "#9a6700", "#7b4ab8", "#1f8a99", "#b8447f", "#656d76")
_GREY = (0.6, 0.6, 0.6)
_HEIGHT = "height above the table [mm]"
_REAL = "real time"
_FAST = "as fast as it runs"
_RANGE = r"\d{1,9}(-\d{1,9})?"
_RANGES = re.compile(rf"{_RANGE}(\s*,\s*{_RANGE})*")


class LiveView(Observer):
    """Shows worlds after their steps, at most 25 times per second; its time counts as no part of an
    episode. Between two pictures it costs a look at the clock.

    Attributes:
        paused: Whether the run waits in its next step.
    """

    def __init__(self, server: Any, stage: Stage) -> None:
        """Add the controls to a server of `report.web.start_server`. The stage's cameras are
        rendered here where the environment does not.
        """
        self._server = server
        self._stage = stage
        self._renderers: dict[tuple[str, ...], StateRenderer] = {}  # by model fields of a state
        self._view: SceneView | None = None
        self._nworld = 0
        self._numbers = [0]  # of the worlds in the picture
        self._content: tuple[list[int], list[bytes]] = ([], [])  # these worlds and their fields
        self._part = ""
        self._choice = ("", 0)  # of the last picture: worlds and plotted world
        self._steps = 0  # that a click lets the run make
        self.paused = False

        # Controls; their callbacks run in other threads and set attributes alone.
        gui = server.gui
        pausable = stage.ranks.size == 1  # others would wait for this one
        # Plain text: it repeats names of the configuration and what a browser has sent.
        waiting = "waiting for the first step"
        self._status = gui.add_text("State", waiting, multiline=True, disabled=True)
        self._pause = gui.add_button("Pause", visible=pausable)
        self._pause.on_click(lambda _: self._toggle())
        gui.add_button("Step", visible=pausable).on_click(lambda _: self._advance())
        self._pace = gui.add_dropdown("Pace", (_REAL, _FAST), initial_value=_FAST)
        self._worlds = gui.add_text("Worlds", "", hint=f"such as 0-15, 20; at most {MOST_WORLDS}")
        self._plotted = gui.add_number("Plotted world", 0, min=0, step=1)
        self._plots: dict[tuple[str, ...], Any] = {}
        self._images: dict[str, Any] = {}
        self._history: dict[tuple[str, ...], deque[tuple[float, ...]]] = {}

    def begin(self, part: str) -> None:
        """Name the part of the run that follows."""
        self._part = part

    @override
    def start(self, env: Env, driver: Driver) -> None:
        super().start(env, driver)
        self.aside = 0.0
        self._last = -np.inf
        self._due = time.perf_counter()
        if env.nworld != self._nworld:
            self._nworld = env.nworld
            self._worlds.value = f"0-{min(_FIRST, env.nworld) - 1}" if env.nworld > 1 else "0"
            self._pace.value = _REAL if env.nworld == 1 else _FAST
            self._plotted.max = env.nworld - 1
            self._view = None
        self._history.clear()
        self._show(0)

    def close(self) -> None:
        """Give back what draws the cameras."""
        for renderer in self._renderers.values():
            renderer.close()

    @override
    def after_step(self, step: int) -> None:
        now = time.perf_counter()
        real = self._pace.value == _REAL
        if not (self.paused or real) and now - self._last < 1.0 / _RATE:
            return
        watched = self.paused or bool(self._server.get_clients())
        if not (watched or real):
            self._last = now
            return
        self.env.sim.synchronize()  # what was queued is the episode's time
        began = time.perf_counter()
        if self.paused or (watched and began - self._last >= 1.0 / _RATE):
            self._show(step + 1)
        last_client = time.perf_counter()
        while self.paused and not self._steps:
            check_interrupt()
            time.sleep(0.02)
            if self._server.get_clients():
                last_client = time.perf_counter()
            elif time.perf_counter() - last_client > _GRACE:
                line = "live view: the run was paused, and goes on without a browser"
                self._stage.progress.print_line(line)
                self._toggle()
            if self._choice != (self._worlds.value[:_TEXT], self._plotted.value):
                self._show(step + 1)
        self._steps = max(0, self._steps - 1)
        if real and not self.paused:
            self._due = max(self._due + self.env.cfg.timing.step_dt, time.perf_counter() - 0.2)
            time.sleep(max(0.0, self._due - time.perf_counter()))
        self.aside += time.perf_counter() - began

    def _toggle(self) -> None:
        self.paused = not self.paused
        self._pause.label = "Go on" if self.paused else "Pause"

    def _advance(self) -> None:
        if self.paused:
            self._steps += 1
        else:
            self._toggle()

    def _show(self, step: int) -> None:
        """Draw the chosen worlds, and what is known of the plotted one."""
        env = self.env
        self._last = time.perf_counter()
        text = self._worlds.value[:_TEXT]
        plotted = self._plotted.value
        if plotted != self._choice[1]:
            self._history.clear()  # it is another world's
        self._choice = (text, plotted)
        problem = []
        numbers = read_worlds(text.strip(), env.nworld)
        if not numbers:
            expected = f"numbers from 0 to {env.nworld - 1}, such as 0-15, 20"
            problem.append(f"Worlds: {text!r} names none, expected {expected}")
        self._numbers = numbers or self._numbers
        fields = world_fields(self._stage, env, self._numbers)
        content = [values.tobytes() for world in fields for values in world.values()]
        if self._content != (self._numbers, content):  # an episode may draw its fields anew
            self._content = (self._numbers, content)
            self._view = None
        index = torch.tensor(self._numbers, device=env.device)
        qpos = env.sim.qpos[index].double().cpu().numpy()
        if self._view is None:
            self._server.scene.reset()
            rows = zip(env.world[index].tolist(), qpos[:, None], fields, strict=True)
            worlds = [World(label=str(n), qpos=frames, fields=values) for n, frames, values in rows]
            self._view = SceneView(self._server, self._stage.assets.visual_model, worlds)
        self._view.update(np.nan_to_num(qpos))
        world = min(max(0, int(plotted)), env.nworld - 1)
        terms, lines = self._values(world)
        for title, values in lines.items():
            self._plot(title, step, values)
        # Another part of the run has other lines. Removed plots could still get an update.
        for (title, *names), plot in self._plots.items():
            if plot.visible != (names == list(lines.get(title, ()))):
                plot.visible = not plot.visible
        for name, image in self._render(world).items():
            if image.dtype == torch.uint8:
                pixels = image.cpu().numpy()
                if name not in self._images:
                    self._images[name] = self._server.gui.add_image(pixels, label=name)
                self._images[name].image = pixels
        title = f"{self._part}, step {step:,}, {env.nworld:,} worlds"
        lines_shown = [title, f"world {world}: {terms}", *problem]
        self._status.value = "\n".join(line[: 2 * _TEXT] for line in lines_shown)

    def _values(self, world: int) -> tuple[str, dict[str, dict[str, float]]]:
        """A world's state in words, and the lines of the plots by title."""
        env = self.env
        rewards = env.reward_manager
        ends = env.termination_manager
        words = [f"step {int(env.episode_step[world])} of its episode"]
        if self.driver.phases:
            words.append(f"phase {self.driver.phases[int(self.driver.phase[world])].name}")
        lines: dict[str, dict[str, float]] = {}
        if rewards.names:
            values = rewards.values[world].tolist()
            lines["reward"] = {"sum": sum(values), **dict(zip(rewards.names, values, strict=True))}
            words.append(f"reward {sum(values):.4g}")
            words.append(f"success {'yes' if env.success[world] else 'no'}")
        if ends.names:
            flags = zip(ends.names, ends.values[world].tolist(), strict=True)
            words.append(f"ends: {', '.join(name for name, flag in flags if flag) or 'no'}")
        heights = {
            name: 1e3 * (float(env.sim.qpos[world, at + 2]) - env.cfg.scene.table_top)
            for name, (at, _) in env.index.objects.items()
        }
        if heights:
            lines[_HEIGHT] = heights
        return ", ".join(words), lines

    def _plot(self, title: str, step: int, values: Mapping[str, float]) -> None:
        """Add a point to every line of a plot."""
        key = (title, *values)
        points = self._history.setdefault(key, deque(maxlen=_HISTORY))
        if points and points[-1][0] == step:
            points.pop()  # drawn again, as other worlds were chosen
        points.append((float(step), *np.nan_to_num(list(values.values())).tolist()))
        data = tuple(np.array(column) for column in zip(*points, strict=True))
        if key in self._plots:
            self._plots[key].data = data
            return
        series: list[dict[str, Any]] = [{"label": "step"}]
        for number, name in enumerate(values):
            color = _COLORS[number % len(_COLORS)]
            if title == _HEIGHT:  # the object's own
                rgba = self.env.cfg.scene.objects[name].color or _GREY
                rgb = (round(255 * part) for part in rgba[:3])
                color = f"rgb({', '.join(map(str, rgb))})"
            series.append({"label": name, "stroke": color, "width": 2})
        self._plots[key] = self._server.gui.add_uplot(
            data, tuple(series), title=title, scales={"x": {"time": False}}, height=200
        )

    def _render(self, world: int) -> dict[str, torch.Tensor]:
        """Images of a world: the environment's, or rendered here in an episode that has none."""
        env = self.env
        if env.images or not self._stage.cfg.scene.cameras:
            return {name: images[world] for name, images in env.images.items()}
        row = slice(world, world + 1)
        looks = {name: values[row] for name, values in env.sim.fields.items()}
        names = (*looks,)
        if names not in self._renderers:
            self._renderers[names] = self._stage.color_renderer(1, names)
        images = self._renderers[names].draw(env.sim.qpos[row].nan_to_num(), looks)
        return {name: image[0] for name, image in images.items()}


def read_worlds(text: str, count: int) -> list[int]:
    """Numbers of the worlds that a text such as ``0-15, 20`` names, of those that there are and at
    most 64; empty for any other text.
    """
    if not _RANGES.fullmatch(text):
        return []
    worlds: dict[int, None] = {}
    for part in text.split(","):
        first, _, last = part.strip().partition("-")
        stop = min(int(last or first), count - 1, int(first) + MOST_WORLDS)
        worlds |= dict.fromkeys(range(int(first), stop + 1))
    return list(worlds)[:MOST_WORLDS]
