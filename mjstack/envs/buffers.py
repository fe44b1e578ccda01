"""Sizes MJWarp's buffers from what worlds use: peaks over a run, sizes with a margin, and random
actions to find them.
"""

import gc
import logging
import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial

import mujoco
import numpy as np
import torch

from mjstack.config.schema import Backend, Config
from mjstack.envs.camera_schedule import without_images
from mjstack.envs.env import Env
from mjstack.envs.faults import NO_KEY, POOL, describe_loss
from mjstack.errors import FaultError
from mjstack.managers.episode import required_fields
from mjstack.managers.view import random_uniform
from mjstack.scene import SceneIndex
from mjstack.sim import LOST_PHYSICS, BatchSizes, Overflow, Simulation, make_simulation
from mjstack.sim.sizes import apply_configured, robot_sizes

log = logging.getLogger(__name__)

ROWS = int(Overflow.NEFC | Overflow.NJMAX_NNZ)
SIZED = ROWS | POOL | int(Overflow.CCD)
_GROWTH = 8  # times the room for random actions: the most to measure in
# Of random actions on CUDA. Peaks of a whole episode are less than the margin higher in thousands
# of worlds, not in the few that a CPU plays: docs/history/first-run-2026-11-27.md.
_RANDOM_STEPS = 200
_STEP = 8  # sizes are multiples of this
# Sizes above _LARGE are multiples of _COARSE. Every njmax needs another solver kernel, which takes
# seconds to compile, and on CUDA random actions differ from run to run.
_LARGE, _COARSE = 256, 64
_POOLS = ("contacts", "pairs", "ccd_pairs")  # as the simulation counts them

Advance = Callable[[str, int, int], None]
"""Reports progress: the work in progress, how much is done, and of how much."""


@dataclass(frozen=True, kw_only=True)
class Peaks:
    """The most that worlds used over all physics steps of a run, and what they lost.

    Worlds that start anew in between are counted on: the simulation keeps what a masked reset
    erases (`Simulation.lasting_peaks`). So nothing is read while the run goes on.

    Attributes:
        contacts: Contacts of each world, shape ``(nworld,)``.
        rows: Constraint rows of each world, shape ``(nworld,)``.
        overflow: Bits of `Overflow` raised in each world, shape ``(nworld,)``.
        pools: Of all worlds at once by name: contacts, broad-phase pairs, which the contact pool
            must hold too, and convex pairs of one combination of geom types. Native MuJoCo has no
            pool and counts no pairs: contacts alone, the sum of the worlds' peaks, which bounds
            them.
        sizes: The room that there was, or None on native MuJoCo, which has no fixed buffers.
        description: Backend and hardware.
    """

    contacts: np.ndarray
    rows: np.ndarray
    overflow: np.ndarray
    pools: dict[str, int]
    sizes: BatchSizes | None
    description: str

    @property
    def needs(self) -> dict[str, float]:
        """Entries that each buffer must have, per world, by the key of its size. Pools are shared:
        what all worlds had at once, divided by their number. Native MuJoCo counts no convex pairs.
        """
        pool = max(self.pools["contacts"], self.pools.get("pairs", 0))
        needs = {"njmax": float(self.rows.max()), "nconmax": pool / len(self.rows)}
        if "ccd_pairs" in self.pools:
            needs["nccdmax"] = self.pools["ccd_pairs"] / len(self.rows)
        return needs

    @property
    def loss(self) -> str:
        """The physics that was lost although there was room to spare, and what to do; empty if none
        was.
        """
        loss, keys = describe_loss(self.overflow, self.sizes)
        if not loss:
            return ""
        fix = f"Set {' and '.join(f'batch.{key}' for key in keys)} higher still" if keys else NO_KEY
        room = f" even with {self.sizes.as_overrides()}" if self.sizes is not None else ""
        return f"{loss}{room}. {fix}"


def read_peaks(sim: Simulation) -> Peaks:
    """The peaks since the simulation's last full reset. Waits for the device."""
    contacts, rows, bits = (peaks.cpu().numpy().astype(np.int64) for peaks in sim.lasting_peaks())
    pools = [int(contacts.sum())] if sim.peak_pool is None else sim.peak_pool.tolist()
    return Peaks(
        contacts=contacts,
        rows=rows,
        overflow=bits & LOST_PHYSICS,
        pools=dict(zip(_POOLS, pools, strict=False)),
        sizes=sim.sizes,
        description=sim.description,
    )


def join_peaks(a: Peaks, b: Peaks) -> Peaks:
    """The larger of the peaks of two runs of as many worlds."""
    return replace(
        a,
        contacts=np.maximum(a.contacts, b.contacts),
        rows=np.maximum(a.rows, b.rows),
        overflow=a.overflow | b.overflow,
        pools={name: max(peak, b.pools[name]) for name, peak in a.pools.items()},
    )


def recommend_sizes(peaks: Peaks, margin: float, source: str) -> BatchSizes:
    """Sizes with a margin over the peaks, in multiples of 8, from 256 on of 64. Where convex pairs
    are not counted, their room stays as much as there is for contacts.
    """
    sizes = {}
    for key, need in peaks.needs.items():
        step = _STEP if margin * need <= _LARGE else _COARSE
        sizes[key] = max(step, step * math.ceil(margin * need / step))
    if "nccdmax" in sizes:
        sizes["nccdmax"] = min(sizes["nccdmax"], sizes["nconmax"])
    return BatchSizes(**sizes, source=source)


def measure_peaks(
    cfg: Config,
    model: mujoco.MjModel,
    nworld: int,
    backend: Backend,
    device: str,
    *,
    drive: Callable[[Simulation], object] | None = None,
    advance: Advance = lambda what, done, total: None,
) -> Peaks:
    """Play a workload in new worlds, and again in worlds with twice the room wherever it was too
    little, up to a limit: ``drive``, the driven task, or else random actions.

    Peaks of a run that lost physics are those of another motion. Where the last run, which is
    returned, has lost some too, its ``overflow`` tells: nothing may be sized from it.
    """
    c = cfg.gate.capacity
    on_cuda = device.startswith("cuda")
    steps = min(_RANDOM_STEPS if on_cuda else cfg.task.episode_steps, cfg.task.episode_steps)
    play = drive or partial(play_random_actions, cfg, c.random_steps or steps, advance=advance)
    first = robot_sizes(cfg, driven=drive is not None)
    most = robot_sizes(cfg, driven=False)
    sizes = {
        key: max(getattr(first, key), getattr(cfg.batch, key) or 0) for key in ("nconmax", "njmax")
    }
    while True:
        sim = make_simulation(
            model,
            cfg,
            nworld if on_cuda else min(nworld, c.cpu_nworld),
            backend=backend,
            device=device,
            fields=required_fields(cfg.reset),
            sizes=BatchSizes(**sizes, source="measuring"),
        )
        with closing(sim), torch.no_grad():
            play(sim)
            peaks = read_peaks(sim)
        del sim
        gc.collect()  # an environment and its managers refer to each other, and hold the worlds
        bits = int(np.bitwise_or.reduce(peaks.overflow))
        # In this room convex pairs have as much as contacts, so they grow together.
        lacking = {"njmax": bits & ROWS, "nconmax": bits & SIZED & ~ROWS}
        larger = {
            key: max(size, min(2 * size, _GROWTH * getattr(most, key))) if lacking[key] else size
            for key, size in sizes.items()
        }
        if peaks.sizes is None or larger == sizes:
            return peaks
        sizes = larger
        log.info("%s overflow while measuring: again with %s", Overflow(bits), sizes)


def measured_sizes(cfg: Config, peaks: Peaks, source: str) -> BatchSizes:
    """Sizes for ``batch=auto`` from a workload, which ``source`` has in words, with the configured
    margin; sizes that the configuration sets win.

    Raises:
        FaultError: A world lost physics; names the worlds and what to do.
    """
    if peaks.loss:
        raise FaultError(f"batch=auto: sizes cannot be measured by {source}: {peaks.loss}")
    margin = cfg.gate.capacity.margin
    how = f"batch=auto: {source} in {len(peaks.rows)} worlds, times {margin:g}"
    sizes = apply_configured(cfg, recommend_sizes(peaks, margin, how))
    log.info("%s", sizes)
    return sizes


def play_random_actions(
    cfg: Config, steps: int, sim: Simulation, advance: Advance = lambda what, done, total: None
) -> None:
    """Step worlds with actions drawn evenly from the action range. Worlds that end start anew."""
    index = SceneIndex(sim.model, cfg.robot, cfg.scene)
    env = Env(sim, index, without_images(cfg), check_faults=False)  # a lack of room is looked for
    env.reset(seed=cfg.seed)
    actions = env.action_manager
    for step in range(steps):
        share = random_uniform(
            env, "probe.action", actions.action_dim, 0.0, 1.0, step=env.episode_step
        )
        env.step(actions.low + (actions.high - actions.low) * share)
        advance("random actions", step + 1, steps)
