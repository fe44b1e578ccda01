"""Sizes MJWarp's buffers from what worlds use: peaks over a run, sizes with a margin, and random
actions to find them.
"""

import gc
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

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
from mjstack.sim.sizes import apply_configured, resolve_measuring_sizes

log = logging.getLogger(__name__)

ROWS = int(Overflow.NEFC | Overflow.NJMAX_NNZ)
SIZED = ROWS | POOL | int(Overflow.CCD)
_GROWTHS = 3  # of the room to measure in, each by 2
_STEP = 8  # sizes are multiples of this

Advance = Callable[[str, int, int], None]
"""Reports progress: the work in progress, how much is done, and of how much."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Peaks:
    """The most that worlds used over all physics steps of a run, and what they lost.

    Worlds that start anew in between are counted on: the simulation keeps what a masked reset
    erases (``most_contacts``, ``most_constraints``, ``overflow_ever``). So nothing is read while
    the run goes on.

    Attributes:
        nworld: Number of worlds.
        contacts: Contacts of each world, shape ``(nworld,)``.
        rows: Constraint rows of each world, shape ``(nworld,)``.
        overflow: Bits of `Overflow` raised in each world, shape ``(nworld,)``.
        pool_contacts: Contacts of all worlds at once. Native MuJoCo has no pool: the sum of the
            worlds' peaks, which bounds it.
        pool_pairs: Broad-phase pairs of all worlds at once, which the pool must hold too; None
            where they are not counted.
        pool_ccd_pairs: Convex pairs of one combination of geom types, of all worlds at once; None
            where they are not counted.
    """

    nworld: int
    contacts: np.ndarray
    rows: np.ndarray
    overflow: np.ndarray
    pool_contacts: int
    pool_pairs: int | None = None
    pool_ccd_pairs: int | None = None

    @property
    def pool(self) -> int:
        """Entries that the contact pool must have."""
        return max(self.pool_contacts, self.pool_pairs or 0)


def read_peaks(sim: Simulation) -> Peaks:
    """The peaks since the simulation's last full reset. Waits for the device."""
    contacts = sim.most_contacts.cpu().numpy().astype(np.int64)
    counted = sim.peak_pool
    pool: list[Any] = [int(contacts.sum()), None, None] if counted is None else counted.tolist()
    return Peaks(
        nworld=sim.nworld,
        contacts=contacts,
        rows=sim.most_constraints.cpu().numpy().astype(np.int64),
        overflow=sim.overflow_ever.cpu().numpy() & LOST_PHYSICS,
        pool_contacts=pool[0],
        pool_pairs=pool[1],
        pool_ccd_pairs=pool[2],
    )


def join_peaks(a: Peaks, b: Peaks) -> Peaks:
    """The larger of the peaks of two runs of the same worlds."""

    def larger(name: str) -> Any:
        counts = getattr(a, name), getattr(b, name)
        return None if None in counts else max(counts)

    return Peaks(
        nworld=a.nworld,
        contacts=np.maximum(a.contacts, b.contacts),
        rows=np.maximum(a.rows, b.rows),
        overflow=a.overflow | b.overflow,
        **{name: larger(name) for name in ("pool_contacts", "pool_pairs", "pool_ccd_pairs")},
    )


def recommend_sizes(peaks: Peaks, margin: float, source: str) -> BatchSizes:
    """Sizes with a margin over the peaks, in multiples of 8.

    Pools are shared: what all worlds had at once, divided by their number, is what each needs.
    Where convex pairs are not counted, their room stays MJWarp's default, as much as there is for
    contacts.
    """
    nconmax = _with_margin(peaks.pool / peaks.nworld, margin)
    convex = peaks.pool_ccd_pairs
    return BatchSizes(
        nconmax=nconmax,
        njmax=_with_margin(float(peaks.rows.max()), margin),
        nccdmax=(
            None if convex is None else min(nconmax, _with_margin(convex / peaks.nworld, margin))
        ),
        source=source,
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class Workload:
    """One run and what it used.

    Attributes:
        peaks: The most it used.
        sizes: The room it had, or None on native MuJoCo, which has no fixed buffers.
        final: State at the end, shape ``(nworld, nq)``.
        failed: Bits of the rules that each world broke, shape ``(nworld,)``; zero for random
            actions, which nothing judges.
        description: Backend and hardware.
    """

    peaks: Peaks
    sizes: BatchSizes | None
    final: np.ndarray
    failed: np.ndarray
    description: str


def play_workload(
    cfg: Config,
    make: Callable[[BatchSizes], Simulation],
    play: Callable[[Simulation], np.ndarray],
    sizes: BatchSizes | None = None,
) -> Workload:
    """Play something in worlds of these sizes; without, with room to spare, and with twice the
    room wherever even that was too little.

    Peaks of a run that lost physics are those of another motion. Where the last run has lost some
    too, its ``overflow`` tells: nothing may be sized from it.

    Args:
        cfg: The configuration.
        make: Makes the worlds.
        play: Plays in them, and returns the bits of the rules that each world broke.
        sizes: Of the buffers.

    Returns:
        The last run.
    """
    room = sizes or resolve_measuring_sizes(cfg)
    for growths_left in reversed(range(_GROWTHS + 1)):
        sim = make(room)
        try:
            failed = play(sim)
            done = Workload(
                peaks=read_peaks(sim),
                sizes=sim.sizes,
                final=sim.qpos.cpu().numpy().copy(),
                failed=failed,
                description=sim.description,
            )
        finally:
            sim.close()
            del sim
            gc.collect()  # an environment and its managers refer to each other, and hold the worlds
        bits = int(np.bitwise_or.reduce(done.peaks.overflow)) & SIZED
        if sizes or done.sizes is None or not (bits and growths_left):
            break
        # In this room convex pairs have as much as contacts, so they grow together.
        room = replace(
            room,
            njmax=room.njmax * (2 if bits & ROWS else 1),
            nconmax=room.nconmax * (2 if bits & ~ROWS else 1),
        )
        log.info("%s overflow while measuring: again with %s", Overflow(bits), room.as_overrides())
    return done


def describe_run_loss(run: Workload) -> str:
    """The physics that a run lost although there was room to spare, and what to do; empty if it
    lost none.
    """
    loss, keys = describe_loss(run.peaks.overflow, run.sizes)
    if not loss:
        return ""
    fix = f"Set {' and '.join(f'batch.{key}' for key in keys)} higher still" if keys else NO_KEY
    room = f" even with {run.sizes.as_overrides()}" if run.sizes is not None else ""
    return f"{loss}{room}. {fix}"


def measured_sizes(cfg: Config, what: str, run: Workload, source: str) -> BatchSizes:
    """Sizes for ``batch=auto`` from one run, such as of ``the driven task``, with the configured
    margin and their source in words.

    Raises:
        FaultError: A world lost physics; names the worlds and what to do.
    """
    if loss := describe_run_loss(run):
        raise FaultError(f"batch=auto: what {what} needs cannot be measured: {loss}")
    margin = cfg.gate.capacity.margin
    return recommend_sizes(run.peaks, margin, f"batch=auto: {source}, times {margin:g}")


def play_random_actions(env: Env, steps: int, advance: Advance | None = None) -> None:
    """Step worlds that have started with actions drawn evenly from the action range; worlds that
    end start anew.

    Args:
        env: The environment.
        steps: How long.
        advance: Told how many steps are done.
    """
    low = env.action_manager.low
    high = env.action_manager.high
    for step in range(steps):
        draw = random_uniform(
            env, "probe.action", env.action_manager.action_dim, 0.0, 1.0, step=env.episode_step
        )
        env.step(low + (high - low) * draw)
        if advance is not None:
            advance("random actions", step + 1, steps)


def random_actions(
    cfg: Config, steps: int, advance: Advance | None = None
) -> Callable[[Simulation], np.ndarray]:
    """Random actions for `play_workload`; arguments as of `play_random_actions`."""

    def play(sim: Simulation) -> np.ndarray:
        # A lack of room is what this looks for.
        index = SceneIndex(sim.model, cfg.robot, cfg.scene)
        env = Env(sim, index, without_images(cfg), check_faults=False)
        env.reset(seed=cfg.seed)
        play_random_actions(env, steps, advance)
        return np.zeros(sim.nworld, dtype=np.int64)

    return play


def probe_env_sizes(cfg: Config, model: mujoco.MjModel, nworld: int, device: str) -> BatchSizes:
    """Sizes for an environment on MJWarp with ``batch=auto``, from a probe of random actions; sizes
    that the configuration sets win.

    Args:
        cfg: The configuration.
        model: The compiled scene.
        nworld: Worlds of the environment.
        device: Its device.

    Raises:
        FaultError: Physics was lost in all the room that the probe tried.
    """
    c = cfg.gate.capacity
    worlds = min(nworld, c.probe_nworld if device.startswith("cuda") else c.cpu_nworld)

    def make(sizes: BatchSizes) -> Simulation:
        fields = required_fields(cfg.reset)
        return make_simulation(
            model, cfg, worlds, backend=Backend.mjwarp, device=device, fields=fields, sizes=sizes
        )

    with torch.no_grad():
        probe = play_workload(cfg, make, random_actions(cfg, c.probe_steps))
    source = f"{c.probe_steps} steps of random actions in {worlds} worlds"
    found = measured_sizes(cfg, f"an environment of {worlds} worlds", probe, source)
    sizes = apply_configured(cfg, found)
    log.info("%s", sizes)
    return sizes


def _with_margin(peak: float, margin: float) -> int:
    return max(_STEP, _STEP * math.ceil(margin * peak / _STEP))
