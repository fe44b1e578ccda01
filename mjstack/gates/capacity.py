"""Gate *capacity*: are the buffers large enough for the whole episode, and how large must
they be?
"""

import math
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial, reduce

import numpy as np

from mjstack.config.schema import Backend
from mjstack.envs.buffers import (
    Peaks,
    Play,
    Workload,
    join_peaks,
    play_random_actions,
    recommend_sizes,
)
from mjstack.episodes.run import Run, each_rank, needs_episode
from mjstack.errors import Unreachable, name_worlds
from mjstack.report.record import GateResult, Status
from mjstack.sim import BatchSizes, resolve_sizes
from mjstack.sim.cameras import image_bytes
from mjstack.sim.sizes import apply_configured, configured_sizes, resolve_env_sizes

# Of thousands of worlds. Peaks of a whole episode are less than the margin higher there, not in the
# few worlds that a CPU plays: docs/history/first-run-2026-11-27.md.
_RANDOM_STEPS = 200
_TITLES = {"task": "driven task", "env": "environments (random actions, randomised starts)"}


@dataclass(kw_only=True, slots=True)
class _Group:
    """Workloads whose worlds have the same buffer sizes."""

    runs: dict[str, Workload]
    peaks: Peaks  # the most that any of them used
    sizes: BatchSizes  # in force
    advice: BatchSizes  # recommended
    lost: str  # physics that was lost in all room tried; nothing may be sized from it then


@each_rank
@needs_episode
def run_capacity(run: Run) -> list[GateResult]:
    """Find the buffer sizes that the driven task, randomised starts and random actions need.

    Peaks are over all steps and all worlds, in room that grows, up to a limit, until nothing is
    lost: a world that has lost physics moves differently. A workload that has lost nothing is not
    played again: room for a peak holds it exactly, and what follows plays in the sizes in force.
    """
    cfg = run.cfg
    t = cfg.gate.capacity
    nworld = run.stage.measuring_nworld
    result = GateResult(name="capacity", status=Status.passed, metrics={"worlds": nworld})

    stage = run.stage
    most = _RANDOM_STEPS if stage.backend[1].startswith("cuda") else cfg.task.episode_steps
    steps = t.random_steps or min(most, cfg.task.episode_steps)
    act: Play = partial(play_random_actions, cfg, steps, advance=stage.progress.advance)
    with closing(stage.measuring_worlds(t.reset)) as worlds:
        loads = {"random_actions": worlds.play(act)}
        try:
            loads["randomized"] = worlds.play(partial(stage.drive, reset=t.reset), driven=True)
        except Unreachable as error:  # starts of the user's own; the rest stands
            result.details.append(f"randomised starts: not measured: {error}")
        loads["task"] = worlds.play(partial(stage.drive, reset=cfg.reset), driven=True)
    task = _recommend(run, resolve_sizes(cfg), {"task": loads.pop("task")})
    env = _recommend(run, resolve_env_sizes(cfg), loads)

    # Problems. Motion that lost physics sizes nothing that follows.
    groups = {"task": task, "env": env}
    run.stage.measured |= {name: part.advice for name, part in groups.items() if not part.lost}
    problems = [text for _, text in _shortages(task)]
    for key, text in _shortages(env):
        # A size that was set may be meant for the batch alone; those of the robot's profile should
        # do for both.
        remarks = result.details if key in configured_sizes(cfg.batch) else problems
        remarks.append(f"environments: {text}")
    if nworld < cfg.nworld:
        result.details.append(
            f"from {nworld} worlds: more of them meet rarer peaks, above all under random actions"
        )

    # Report
    sizes = task.sizes
    peaks = task.peaks
    used = f"{peaks.contacts.max()} of {sizes.nconmax} contacts, {peaks.rows.max()} of"
    result.reason = "; ".join(problems) or f"{used} {sizes.njmax} rows, at most, in {nworld} worlds"
    result.status = Status.failed if problems else Status.passed
    result.thresholds = {
        "contacts_per_world": sizes.nconmax,
        "njmax": sizes.njmax,
        "margin": t.margin,
    }
    result.notes |= {"backend": task.runs["task"].description, "sizes_from": sizes.source}
    for name, group in groups.items():
        _report(run, name, group, result)
    if cameras := cfg.scene.cameras:
        mjwarp = run.stage.backend[0] is Backend.mjwarp
        size = image_bytes(run.stage.model, cameras, cfg.nworld, mjwarp=mjwarp)
        result.metrics["memory.images_mb"] = size / 1e6
    return [result]


def _recommend(run: Run, configured: BatchSizes, runs: dict[str, Workload]) -> _Group:
    """Recommend sizes for some workloads."""
    cfg = run.cfg
    margin = cfg.gate.capacity.margin
    peaks = reduce(join_peaks, (load.peaks for load in runs.values()))
    how = f"batch=auto: gate capacity, {run.stage.measuring_nworld} worlds, times {margin:g}"
    advice = recommend_sizes(peaks, margin, how if cfg.batch.auto else "gate capacity")
    return _Group(
        runs=runs,
        peaks=peaks,
        sizes=apply_configured(cfg, advice) if cfg.batch.auto else configured,
        advice=advice,
        lost="; ".join(load.loss for load in runs.values() if load.sizes and load.loss),
    )


def _report(run: Run, name: str, group: _Group, result: GateResult) -> None:
    """Add the peaks, recommended sizes and memory of a group, ``task`` or ``env``, to the
    result.
    """
    native = any(load.sizes is None for load in group.runs.values())
    for workload, load in group.runs.items():
        prefix = "" if workload == "task" else f"{workload}."
        peaks = load.peaks
        result.metrics |= {
            f"{prefix}peak_contacts_per_world": int(peaks.contacts.max()),
            **{f"{prefix}pool_{key}": peak for key, peak in peaks.pools.items()},
            f"{prefix}peak_constraint_rows_per_world": int(peaks.rows.max()),
        }
    title = _TITLES[name]
    line = f"{title}: {group.advice.as_overrides()}"
    if group.lost:
        line = f"{title}: not known, physics was lost"
    elif native and name == "task":
        line += " (contacts alone: native MuJoCo does not count the pairs that share their pool)"
    run.print_line(line)
    result.details.append(line)
    if group.lost:
        return
    prefix = "recommended" if name == "task" else "recommended_env"
    for key, size in configured_sizes(group.advice).items():
        result.metrics[f"{prefix}.{key}"] = size
    if not native:
        from mjstack.sim.usage import data_bytes  # loads Warp, which native runs do not need

        for which, sizes in (("current", group.sizes), ("recommended", group.advice)):
            size = data_bytes(run.stage.model, run.cfg.nworld, sizes)
            result.metrics[f"memory.{name}.{which}_mb"] = size / 1e6


def _shortages(group: _Group) -> Iterator[tuple[str, str]]:
    """Buffers in force that are too small for a group's peaks: the key of each, and a sentence; or
    the physics that was lost. Exactly at capacity fits.
    """
    if group.lost:
        yield "", group.lost
        return
    peaks = group.peaks
    rooms = configured_sizes(group.sizes)
    # Buffer, most needed per world, and use of each world. MJWarp counts what all worlds hold at
    # once. Convex pairs are in the contact pool too, so without a size of their own they fit.
    needs: dict[str, tuple[str, float, np.ndarray]] = {
        "njmax": ("njmax", peaks.rows.max(), peaks.rows),
        "nconmax": ("contact pool", peaks.share, peaks.contacts),
        "nccdmax": ("convex pairs", peaks.convex_share or 0.0, np.zeros(0)),
    }
    for key, (name, need, used) in needs.items():
        room = rooms.get(key, math.inf)
        if need > room:
            worlds = np.flatnonzero(used > room).tolist()
            where = f" in {name_worlds(worlds, len(used))}" if worlds else ""
            fix = f"Raise it: batch.{key}={getattr(group.advice, key)}"
            problem = f"{name} overflow{where}; room for {room:g} per world, {need:g} needed"
            yield key, f"{problem}. {fix}"
