"""Worlds of an episode in motion, for the run's 3-D page: recorded on the device, failing ones
first.
"""

from pathlib import Path

import numpy as np
from torch import Tensor

from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.recorder import Channels, Read, Recorder
from mjstack.episodes.stage import Stage
from mjstack.files import read_npz, reading, write_npz
from mjstack.report.page import MOST_WORLDS, Page, World, frame_stride
from mjstack.report.write import safely_write

_BYTES = 64 * 2**20  # of one recording
_PARTS = ("label", "failed", "qpos")  # of a world, in the file


def motion_recorder(step_dt: float) -> Recorder:
    """Records the first worlds at the frames of a page, ``qpos`` of shape ``(frames, worlds, nq)``.

    ``step_dt`` is the control interval [s].
    """
    stride = frame_stride(step_dt)

    def bind(env: Env, driver: Driver) -> Read:
        qpos = env.sim.qpos
        first = qpos[: max(1, _BYTES // (len(ends(driver.steps)) * qpos[0].nbytes))]
        return lambda: {"qpos": first}

    def ends(steps: int) -> range:
        return range(0, steps + 1, stride)

    return Recorder(Channels(bind, ends))


def show_batch(
    stage: Stage, page: Page, path: Path, gate: str, qpos: Tensor, failed: np.ndarray
) -> None:
    """Add a gate's worlds to the page, failing ones first. A file keeps them for a resumed run.

    Args:
        stage: On which the gate has played.
        page: The run's page.
        path: The file.
        gate: The gate's name.
        qpos: Positions that `motion_recorder` has recorded of the configured seed.
        failed: Bits of the task's rules, shape ``(nworld,)``.
    """
    rules = stage.check.rules
    chosen = np.argsort(failed[: qpos.shape[1]] == 0, kind="stable")[:MOST_WORLDS].tolist()
    motions = qpos[:, chosen].float().swapaxes(0, 1).cpu().numpy()
    moving: list[World] = []
    for world, motion in zip(chosen, motions, strict=True):
        problem = rules.describe(int(failed[world]))
        label = f"{world}: {problem}" if problem else str(world)
        moving.append(World(label=label, qpos=motion, failed=bool(problem)))
    page.worlds3d[gate] = moving
    arrays = {name: [getattr(world, name) for world in moving] for name in _PARTS}
    if problem := safely_write(path, write_npz, arrays, stops=False):
        stage.progress.print_line(problem)


def restore_batch(page: Page, path: Path, gate: str) -> None:
    """Add the worlds to the page that an earlier call of the run has shown, if it has.

    Raises:
        FolderError: Their file cannot be read.
    """
    if path.exists():
        with reading(path, "Remove it"):
            arrays = read_npz(path)
            page.worlds3d[gate] = [
                World(label=str(label), failed=bool(failed), qpos=qpos)
                for label, failed, qpos in zip(*(arrays[name] for name in _PARTS), strict=True)
            ]
