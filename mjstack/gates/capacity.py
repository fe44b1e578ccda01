"""Gate *capacity*: are the buffers large enough for the whole episode, and how large must
they be?
"""

import math
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
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

    runs: dict[str, Workload]  # with room to spare
    peaks: Peaks  # the most that any of them used
    sizes: BatchSizes  # in force
    advice: BatchSizes  # recommended
    lost: str  # physics that was lost with room to spare; nothing may be sized from it then
    problems: list[str] = field(default_factory=list)  # at the recommended sizes


@each_rank
@needs_episode
def run_capacity(run: Run) -> list[GateResult]:
    """Find the buffer sizes that the driven task, randomised starts and random actions need, and
    try them.

    Peaks are over all steps and all worlds, in worlds with room to spare: one that has lost physics
    moves differently. All workloads are played in the same worlds.
    """
    cfg = run.cfg
    t = cfg.gate.capacity
    nworld = run.stage.measuring_nworld
    result = GateResult(name="capacity", status=Status.passed, metrics={"worlds": nworld})

    stage = run.stage
    most = _RANDOM_STEPS if stage.backend[1].startswith("cuda") else cfg.task.episode_steps
    steps = t.random_steps or min(most, cfg.task.episode_steps)
    plays: dict[str, Play] = {
        "random_actions": partial(play_random_actions, cfg, steps, advance=stage.progress.advance),
        "randomized": lambda sim: stage.play(sim, t.reset).failed,
        "task": lambda sim: stage.play(sim, cfg.reset).failed,
    }
    loads = {}
    with closing(stage.measuring_worlds(t.reset)) as worlds:
        for name, play in plays.items():
            try:
                loads[name] = worlds.play(play)
            except Unreachable as error:
                if name != "randomized":
                    raise
                # Starts of the user's own; the rest stands
                result.details.append(f"randomised starts: not measured: {error}")
    task = _recommend(run, result, resolve_sizes(cfg), {"task": loads.pop("task")}, plays)
    env = _recommend(run, result, resolve_env_sizes(cfg), loads, plays)

    # Problems. Motion that lost physics sizes nothing that follows.
    groups = {"task": task, "env": env}
    run.stage.measured |= {name: part.advice for name, part in groups.items() if not part.lost}
    problems = [text for _, text in _shortages(task)]
    for key, text in _shortages(env):
        # A size that was set may be meant for the batch alone; those of the robot's profile should
        # do for both.
        remarks = result.details if key in configured_sizes(cfg.batch) else problems
        remarks.append(f"environments: {text}")
    problems += env.problems + task.problems
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
    if task.runs["task"].sizes is None:
        result.notes["rerun"] = "sizes were not tried: native MuJoCo has no fixed buffers"
    elif task.lost or env.lost:
        result.notes["rerun"] = "sizes were not tried where peaks are not known"
    return [result]


def _recommend(
    run: Run,
    result: GateResult,
    configured: BatchSizes,
    runs: dict[str, Workload],
    plays: Mapping[str, Play],
) -> _Group:
    """Recommend sizes for some workloads, and try those on MJWarp."""
    cfg = run.cfg
    margin = cfg.gate.capacity.margin
    peaks = reduce(join_peaks, (load.peaks for load in runs.values()))
    how = f"batch=auto: gate capacity, {run.stage.measuring_nworld} worlds, times {margin:g}"
    advice = recommend_sizes(peaks, margin, how if cfg.batch.auto else "gate capacity")
    group = _Group(
        runs=runs,
        peaks=peaks,
        sizes=apply_configured(cfg, advice) if cfg.batch.auto else configured,
        advice=advice,
        lost="; ".join(load.loss for load in runs.values() if load.sizes and load.loss),
    )
    exact = not run.stage.backend[1].startswith("cuda")
    resets = [cfg.gate.capacity.reset] if "randomized" in runs else []
    with closing(run.stage.measuring_worlds(*resets, sizes=advice)) as worlds:
        for workload, load in runs.items():
            if load.sizes is None or group.lost:
                continue
            if not _needs(load.peaks) & _needs(peaks):  # it would try nothing
                result.notes[f"rerun.{workload}"] = "another workload needs more of everything"
            else:
                again = worlds.play(plays[workload])
                group.problems += _compare(workload, load, again, result, exact=exact)
    return group


def _needs(peaks: Peaks) -> set[tuple[str, float]]:
    """What the buffers must hold, by kind, without the kinds that are not used."""
    needs = {"rows": peaks.rows.max(), "pool": peaks.share, "convex": peaks.convex_share or 0.0}
    return {(kind, float(need)) for kind, need in needs.items() if need}


def _compare(
    name: str, first: Workload, again: Workload, result: GateResult, *, exact: bool
) -> list[str]:
    """Hold a run at exactly the recommended sizes against the first one.

    Nothing may be lost. Where runs repeat bit for bit, the outcome is to be the same too; where
    they do not, a world near a threshold may fall on its other side, which is reported. Returns the
    problem, if any.
    """
    assert again.sizes is not None, "native MuJoCo has no sizes to try"
    sizes = again.sizes.as_overrides()
    count = len(first.failed)
    lost = np.flatnonzero(again.peaks.overflow).tolist()
    flipped = np.flatnonzero((first.failed == 0) != (again.failed == 0)).tolist()
    same = (first.final == again.final) | (np.isnan(first.final) & np.isnan(again.final))
    moved = np.flatnonzero(~same.all(1)).tolist()

    # Figures
    metrics: dict[str, float] = {
        "overflow_worlds": len(lost),
        "peak_constraint_rows_per_world": int(again.peaks.rows.max()),
    }
    if name != "random_actions":  # nothing judges these
        metrics |= {"succeeded": int((again.failed == 0).sum()), "flipped_worlds": len(flipped)}
    if exact:
        metrics["same_final_state"] = not moved
    result.metrics |= {f"rerun.{name}.{key}": value for key, value in metrics.items()}
    result.notes[f"rerun.{name}.sizes"] = sizes

    # The first problem
    problems = {"overflow": lost, "another result": flipped}
    if exact:
        problems["another final state"] = moved
    for problem, worlds in problems.items():
        if worlds:
            text = f"{name} at {sizes}: {problem} in {name_worlds(worlds, count)}"
            if worlds is not flipped or exact:
                return [text]
            result.details.append(f"{text}: on CUDA sums have no fixed order")
    return []


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
