"""Worlds of an episode in motion, for the run's 3-D page: recorded on the device, failing ones
first, each beside its copy on native MuJoCo.
"""

import logging
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mjstack.config.schema import Backend
from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.context import RunContext
from mjstack.episodes.rollout import Observer, WorldRecorder
from mjstack.errors import RunError
from mjstack.files import reading, write_npz
from mjstack.interrupt import check_interrupt
from mjstack.report.web import MOST, World, frame_stride, lacks_viser
from mjstack.report.write import safely_write

log = logging.getLogger(__name__)

_BYTES = 64 * 2**20  # of one recording
_MARKS = ("label", "failed", "twin")  # of a world, in the file beside its positions
_TWINS = 8  # failing worlds that native MuJoCo plays too


class MotionRecorder(Observer):
    """Records positions at the frames of a page, in as many of the first worlds as 64 MiB hold. A
    frame is a copy on the device.
    """

    def start(self, env: Env, driver: Driver) -> None:
        """See `Observer`."""
        super().start(env, driver)
        qpos = env.sim.qpos
        self._stride = frame_stride(env.cfg.timing.step_dt)
        frames = driver.steps // self._stride + 1
        row = frames * qpos.shape[1] * qpos.element_size()
        self._count = max(1, min(len(qpos), _BYTES // row))
        shape = (frames, self._count, qpos.shape[1])
        self._frames = torch.full(shape, torch.nan, dtype=qpos.dtype, device=qpos.device)
        self._frames[0].copy_(qpos[: self._count])

    def after_step(self, step: int) -> None:
        """See `Observer`."""
        frame, rest = divmod(step + 1, self._stride)
        if rest == 0:
            self._frames[frame].copy_(self.env.sim.qpos[: self._count])

    @property
    def recorded(self) -> int:
        """Number of worlds."""
        return self._count

    def positions(self, worlds: Sequence[int]) -> np.ndarray:
        """Recorded positions of some worlds, shape ``(worlds, frames, nq)``."""
        return self._frames[:, list(worlds)].swapaxes(0, 1).double().cpu().numpy()


def records_motion(context: RunContext) -> bool:
    """Whether the run leaves a 3-D page."""
    return context.folder is not None and context.cfg.web.episode and not lacks_viser()


def show_world(
    context: RunContext, part: str, label: str, recorder: WorldRecorder, *, failed: bool
) -> None:
    """Add a world that was played alone to the page."""
    if records_motion(context):
        qpos = recorder.qpos[:: frame_stride(context.cfg.timing.step_dt)]
        context.page.worlds3d[part] = [World(label=label, qpos=qpos, failed=failed)]


def show_batch(
    context: RunContext, gate: str, recorder: MotionRecorder, failed: np.ndarray
) -> None:
    """Add a gate's worlds to the page: failing ones, each beside its copy on native MuJoCo where
    that was not the backend, and then others. A file keeps them for a resumed run.

    Args:
        context: The gate's run.
        gate: Its name.
        recorder: Has seen the episode of the configured seed.
        failed: Bits of the task's rules, shape ``(nworld,)``.
    """
    rules = context.check.rules
    failing = [world for world in np.flatnonzero(failed).tolist() if world < recorder.recorded]
    twins = _play_twins(context, failing[:_TWINS])
    others = [world for world in range(recorder.recorded) if not failed[world]]
    chosen = [*failing, *others][: MOST - len(twins)]
    shown: list[World] = []
    motions = recorder.positions(chosen).astype(np.float32)
    for world, qpos in zip(chosen, motions, strict=True):
        bits = int(failed[world])
        shown.append(
            World(label=_label(str(world), rules.broken(bits)), qpos=qpos, failed=bits > 0)
        )
        if world in twins:
            shown.append(twins[world])
    context.page.worlds3d[gate] = shown
    arrays: dict[str, Any] = {name: [getattr(world, name) for world in shown] for name in _MARKS}
    arrays["qpos"] = [world.qpos for world in shown]
    if problem := safely_write(_path(context, gate), write_npz, arrays, stops=False):
        context.print_line(problem)


def restore_batch(context: RunContext, gate: str) -> None:
    """Add the worlds to the page that an earlier call of the run has shown, if it has.

    Raises:
        RunError: Their file cannot be read.
    """
    path = _path(context, gate)
    if path.exists():
        with reading(path, RunError, "Remove it"), np.load(path) as held:
            labels, failed, twin = (held[name].tolist() for name in _MARKS)
            rows = zip(labels, held["qpos"], failed, twin, strict=True)
            context.page.worlds3d[gate] = [
                World(label=label, qpos=qpos, failed=lost, twin=copy)
                for label, qpos, lost, copy in rows
            ]


def _path(context: RunContext, gate: str) -> Path:
    assert context.folder is not None
    return context.folder / f"motion_{gate}.npz"


def _play_twins(context: RunContext, worlds: Sequence[int]) -> dict[int, World]:
    """Some worlds on native MuJoCo, by number; none if that was the backend, or where it fails."""
    if not worlds or context.backend[0] is Backend.native:
        return {}
    recorder = MotionRecorder()
    try:
        with closing(context.simulation(len(worlds), Backend.native, "cpu")) as sim:
            episode = context.play(sim, context.cfg.reset, [recorder], worlds=worlds)
        positions = recorder.positions(range(len(worlds))).astype(np.float32)
    except Exception:
        check_interrupt()
        log.exception("no copies of failing worlds on native MuJoCo")
        return {}
    broken = [context.check.rules.broken(bits) for bits in episode.failed.tolist()]
    return {
        world: World(label=_label(f"{world}, native", rules), qpos=qpos, twin=True)
        for world, qpos, rules in zip(worlds, positions, broken, strict=True)
    }


def _label(name: str, broken: Sequence[str]) -> str:
    return f"{name}: {' '.join(broken)}" if broken else name
