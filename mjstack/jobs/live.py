"""The live view: worlds of a running environment in a browser."""

import re
import time
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

_RATE = 25.0  # pictures per second, at most
_FIRST = 16  # worlds that are shown at first
_TEXT = 200  # characters of a text, at most
_GRACE = 3.0  # s in which a page that is loaded anew comes back
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
        """Add the controls to a server of `report.web.start_server`."""
        self._server = server
        self._stage = stage
        self._view: SceneView | None = None
        self._nworld = 0
        self._numbers = [0]  # of the worlds in the picture
        self._content: tuple[list[int], list[bytes]] = ([], [])  # these worlds and their fields
        self._section = ""
        self._choice = ""  # of worlds in the last picture
        self.paused = False

        # Controls; their callbacks run in other threads and set attributes alone.
        gui = server.gui
        pausable = stage.ranks.size == 1  # others would wait for this one
        # Plain text: it repeats names of the configuration and what a browser has sent.
        waiting = "waiting for the first step"
        self._status = gui.add_text("State", waiting, multiline=True, disabled=True)
        self._pause = gui.add_button("Pause", visible=pausable)
        self._pause.on_click(lambda _: self._toggle())
        self._pace = gui.add_dropdown("Pace", (_REAL, _FAST), initial_value=_FAST)
        self._worlds = gui.add_text("Worlds", "", hint=f"such as 0-15, 20; at most {MOST_WORLDS}")

    def begin(self, section: str) -> None:
        """Name the part of the run that follows."""
        self._section = section

    @override
    def start(self, env: Env, driver: Driver) -> None:
        super().start(env, driver)
        self.aside = 0.0
        self._last = -np.inf
        self._next_frame = time.perf_counter()
        if env.nworld != self._nworld:
            self._nworld = env.nworld
            self._worlds.value = f"0-{min(_FIRST, env.nworld) - 1}" if env.nworld > 1 else "0"
            self._pace.value = _REAL if env.nworld == 1 else _FAST
            self._view = None
        self._show(0)

    @override
    def after_step(self, step: int) -> None:
        clock = time.perf_counter()
        real = self._pace.value == _REAL
        if not (self.paused or real) and clock - self._last < 1.0 / _RATE:
            return
        watched = self.paused or bool(self._server.get_clients())
        if not (watched or real):
            self._last = clock
            return
        self.env.sim.synchronize()  # what was queued is the episode's time
        began = time.perf_counter()
        if self.paused or (watched and began - self._last >= 1.0 / _RATE):
            self._show(step + 1)
        last_client = time.perf_counter()
        while self.paused:
            check_interrupt()
            time.sleep(0.02)
            if self._server.get_clients():
                last_client = time.perf_counter()
            elif time.perf_counter() - last_client > _GRACE:
                line = "live view: the run was paused, and goes on without a browser"
                self._stage.progress.print_line(line)
                self._toggle()
            if self._choice != self._worlds.value[:_TEXT]:
                self._show(step + 1)
        if real and not self.paused:
            self._next_frame = max(
                self._next_frame + self.env.cfg.timing.step_dt, time.perf_counter() - 0.2
            )
            time.sleep(max(0.0, self._next_frame - time.perf_counter()))
        self.aside += time.perf_counter() - began

    def _toggle(self) -> None:
        self.paused = not self.paused
        self._pause.label = "Go on" if self.paused else "Pause"

    def _show(self, step: int) -> None:
        """Draw the chosen worlds, and say how the first of them is."""
        env = self.env
        self._last = time.perf_counter()
        text = self._worlds.value[:_TEXT]
        self._choice = text
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
        title = f"{self._section}, step {step:,}, {env.nworld:,} worlds"
        world = self._numbers[0]
        lines = [title, f"world {world}: {self._describe(world)}", *problem]
        self._status.value = "\n".join(line[: 2 * _TEXT] for line in lines)

    def _describe(self, world: int) -> str:
        """A world's state in words."""
        env = self.env
        rewards = env.reward_manager
        ends = env.termination_manager
        texts = [f"step {int(env.episode_step[world])} of its episode"]
        if self.driver.phases:
            texts.append(f"phase {self.driver.phases[int(self.driver.phase[world])].name}")
        if rewards.names:
            values = zip(rewards.names, rewards.values[world].tolist(), strict=True)
            texts.append(f"reward {', '.join(f'{name} {value:.3g}' for name, value in values)}")
            texts.append(f"success {'yes' if env.success[world] else 'no'}")
        if ends.names:
            flags = zip(ends.names, ends.values[world].tolist(), strict=True)
            texts.append(f"ends: {', '.join(name for name, flag in flags if flag) or 'no'}")
        return ", ".join(texts)


def read_worlds(text: str, count: int) -> list[int]:
    """Numbers of the worlds that a text such as ``0-15, 20`` names, of those that there are and at
    most 64; empty for any other text.
    """
    if not _RANGES.fullmatch(text):
        return []
    worlds: dict[int, None] = {}
    for item in text.split(","):
        first, _, last = item.strip().partition("-")
        stop = min(int(last or first), count - 1, int(first) + MOST_WORLDS)
        worlds |= dict.fromkeys(range(int(first), stop + 1))
    return list(worlds)[:MOST_WORLDS]
