"""Gate *capacity*: are the buffers large enough for the whole episode, and how large must
they be?
"""

import math
from dataclasses import replace
from functools import reduce

import numpy as np

from mjstack.config.schema import Backend
from mjstack.envs.buffers import Peaks, join_peaks, recommend_sizes
from mjstack.episodes.run import Run, each_rank, needs_episode
from mjstack.errors import Unreachable, name_worlds
from mjstack.report.figure import Figure, figures
from mjstack.report.record import GateResult, Status
from mjstack.sim import BatchSizes, resolve_sizes
from mjstack.sim.cameras import image_bytes
from mjstack.sim.sizes import apply_configured, configured_sizes

_BUFFERS = {"njmax": "njmax", "nconmax": "contact pool", "nccdmax": "convex pairs"}
_TITLES = {"task": "driven task", "env": "environments (random actions, randomised starts)"}


@each_rank
@needs_episode
def run_capacity(run: Run) -> list[GateResult]:
    """Find the buffer sizes that the driven task needs, for the batch, and those that the task,
    also from the starts of gate *success*, and random actions need, for environments.

    Peaks are over all steps and all worlds, in room that grows, up to a limit, until nothing is
    lost: a world that has lost physics moves differently. A workload that has lost nothing is not
    played again: room for a peak holds it exactly, and what follows plays in the sizes in force.
    """
    cfg = run.cfg
    stage = run.stage
    task = stage.measure()
    nworld = len(task.rows)
    result = GateResult(name="capacity", status=Status.passed, figures=figures(worlds=nworld))
    loads = {"": task, "random_actions": stage.measure(driven=False)}
    try:
        randomized = stage.with_config(replace(cfg, reset=cfg.gate.success.reset))
        loads["randomized"] = randomized.measure()
    except Unreachable as error:  # starts of the user's own; the rest stands
        result.details.append(f"randomised starts: not measured: {error}")
    for workload, load in loads.items():
        result.figures += figures(
            workload,
            peak_contacts_per_world=int(load.contacts.max()),
            **{f"pool_{key}": peak for key, peak in load.pools.items()},
            peak_constraint_rows_per_world=int(load.rows.max()),
        )
    sizes, shortages = _judge(run, "task", task, result)
    problems = list(shortages.values())
    _, shortages = _judge(run, "env", reduce(join_peaks, loads.values()), result)
    for key, text in shortages.items():
        # A size that was set may be meant for the batch alone; those of the robot's profile should
        # do for both.
        remarks = result.details if key in configured_sizes(cfg.batch) else problems
        remarks.append(f"environments: {text}")
    if nworld < cfg.nworld:
        result.details.append(
            f"from {nworld} worlds: more of them meet rarer peaks, above all under random actions"
        )
    used = f"{task.contacts.max()} of {sizes.nconmax} contacts, {task.rows.max()} of"
    result.reason = "; ".join(problems) or f"{used} {sizes.njmax} rows, at most, in {nworld} worlds"
    result.status = Status.failed if problems else Status.passed
    result.figures += [
        Figure("contacts_per_world", high=sizes.nconmax),
        Figure("njmax", high=sizes.njmax),
        Figure("margin", high=cfg.gate.capacity.margin),
    ]
    result.notes |= {"backend": task.description, "sizes_from": sizes.source}
    if cameras := cfg.scene.cameras:
        mjwarp = stage.backend[0] is Backend.mjwarp
        size = image_bytes(stage.model, cameras, cfg.nworld, mjwarp=mjwarp)
        result.figures.append(Figure("images", size / 1e6, "MB", "memory"))
    return [result]


def _judge(
    run: Run, name: str, peaks: Peaks, result: GateResult
) -> tuple[BatchSizes, dict[str, str]]:
    """Add what the peaks of ``task`` or ``env`` need to the result: memory and the recommended
    sizes, in which later gates play with ``batch=auto``.

    Returns:
        The sizes in force, and why they are too small, by key as of `find_shortages`.
    """
    cfg = run.cfg
    driven = name == "task"
    sizes = resolve_sizes(cfg, driven=driven)
    native = peaks.sizes is None
    if peaks.loss and not native:  # motion that lost physics sizes nothing
        line = f"{_TITLES[name]}: not known, physics was lost"
        run.print_line(line)
        result.details.append(line)
        return sizes, {"": peaks.loss}
    margin = cfg.gate.capacity.margin
    how = f"batch=auto: gate capacity, {len(peaks.rows)} worlds, times {margin:g}"
    advice = recommend_sizes(peaks, margin, how if cfg.batch.auto else "gate capacity")
    if cfg.batch.auto:
        run.stage.measured[name] = sizes = apply_configured(cfg, advice)
    line = f"{_TITLES[name]}: {advice.as_overrides()}"
    if native and driven:
        line += " (contacts alone: native MuJoCo does not count the pairs that share their pool)"
    run.print_line(line)
    result.details.append(line)
    group = "recommended" if driven else "recommended_env"
    result.figures += figures(group, **configured_sizes(advice))
    if not native:
        from mjstack.sim.usage import data_bytes  # loads Warp, which native runs do not need

        for which, rooms in (("current", sizes), ("recommended", advice)):
            size = data_bytes(run.stage.model, cfg.nworld, rooms)
            result.figures.append(Figure(which, size / 1e6, "MB", f"memory.{name}"))
    return sizes, find_shortages(peaks, sizes, advice)


def find_shortages(peaks: Peaks, sizes: BatchSizes, advice: BatchSizes) -> dict[str, str]:
    """Buffers that are too small for peaks: a sentence for the key of each. Exactly at capacity
    fits.
    """
    shortages = {}
    rooms = configured_sizes(sizes)
    for key, need in peaks.needs.items():
        # Convex pairs are in the contact pool too, so without a size of their own they fit.
        room = rooms.get(key, math.inf)
        if need > room:
            used = {"njmax": peaks.rows, "nconmax": peaks.contacts}.get(key, np.zeros(0))
            worlds = np.flatnonzero(used > room).tolist()
            where = f" in {name_worlds(worlds, len(used))}" if worlds else ""
            fix = f"Raise it: batch.{key}={getattr(advice, key)}"
            problem = (
                f"{_BUFFERS[key]} overflow{where}; room for {room:g} per world, {need:g} needed"
            )
            shortages[key] = f"{problem}. {fix}"
    return shortages
