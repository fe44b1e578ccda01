"""Gate *capacity*: are the buffers large enough for the whole episode, and how large must
they be?
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from mjstack.config.schema import Config
from mjstack.envs.buffers import Peaks, describe_loss, join_peaks, recommend_sizes
from mjstack.episodes.context import RunContext, needs_episode
from mjstack.episodes.workloads import (
    Workload,
    measure_random,
    measure_task,
    measuring_worlds,
    play_random,
    play_task,
)
from mjstack.errors import Unreachable, name_worlds
from mjstack.report.record import GateResult, Status
from mjstack.sim import BatchSizes, resolve_sizes
from mjstack.sim.sizes import apply_configured, resolve_env_sizes

_NATIVE = "native MuJoCo has no fixed buffers"
_NO_ORDER = "on CUDA sums have no fixed order"


@dataclass(slots=True)
class _Shortage:
    """Something that does not fit: the keys that limit it, and a sentence."""

    keys: tuple[str, ...]
    text: str


@dataclass(slots=True)
class _Trial:
    """What came of a second run, at exactly the recommended sizes: figures, and what was wrong or
    is to be known.
    """

    metrics: dict[str, float]
    notes: dict[str, str]
    problem: str = ""
    remark: str = ""


@dataclass(kw_only=True, slots=True)
class _Group:
    """Workloads whose worlds have the same buffer sizes.

    Attributes:
        title: The workloads in words.
        prefix: Of the metrics of the recommended sizes.
        runs: Each with room to spare, by name.
        peaks: The most that any of them used.
        sizes: In force.
        wanted: Recommended.
        lost: Physics that was lost with room to spare; nothing may be sized from it then.
    """

    title: str
    prefix: str
    runs: dict[str, Workload]
    peaks: Peaks
    sizes: BatchSizes
    wanted: BatchSizes
    lost: str


@needs_episode
def run_capacity(context: RunContext) -> list[GateResult]:
    """Find the buffer sizes that the driven task, randomised starts and random actions need, and
    try them.

    Peaks are over all steps and all worlds, in worlds with room to spare: one that has lost physics
    moves differently.
    """
    cfg = context.cfg
    t = cfg.gate.capacity
    nworld = measuring_worlds(context)
    how = f"batch=auto: gate capacity, {nworld} worlds, times {t.margin:g}"
    how = how if cfg.batch.auto else "gate capacity"
    details: list[str] = []
    problems: list[str] = []

    # Environments. Each start is planned once, for both of its runs, and the task's last: its plan
    # is kept for the gates that follow.
    runs = {"random_actions": measure_random(context)}
    try:
        runs["randomized"] = measure_task(context, t.reset)
    except Unreachable as error:  # starts of the user's own; the other workloads stand
        details.append(f"randomised starts: not measured: {error}")
    title = "environments (random actions, randomised starts)"
    env = _group(cfg, title, "recommended_env", runs, resolve_env_sizes(cfg), how)
    trials = _try(context, env)

    # The driven task
    task_run = measure_task(context, cfg.reset)
    task = _group(cfg, "scripted task", "recommended", {"task": task_run}, resolve_sizes(cfg), how)
    trials += _try(context, task)

    # Problems. Motion that lost physics sizes nothing that follows.
    context.artifacts.sizes = None if task.lost else task.wanted
    context.artifacts.env_sizes = None if env.lost else env.wanted
    problems += [task.lost] if task.lost else [found.text for found in _shortages(cfg, task)]
    problems += [f"environments: {env.lost}"] if env.lost else []
    for shortage in [] if env.lost else _shortages(cfg, env):
        # Sizes that were set may be meant for the batch alone; those of the robot's profile should
        # do for both.
        chosen = any(getattr(cfg.batch, key) is not None for key in shortage.keys)
        (details if chosen else problems).append(f"environments: {shortage.text}")
    problems += [trial.problem for trial in trials if trial.problem]
    details += [trial.remark for trial in trials if trial.remark]
    if nworld < cfg.nworld:
        details.append(
            f"from {nworld} worlds: more of them meet rarer peaks, above all under random actions"
        )

    # Report
    share = task.sizes.contact_pool(cfg.nworld) / cfg.nworld
    peaks = task.peaks
    result = GateResult(
        name="capacity",
        status=Status.failed if problems else Status.passed,
        reason="; ".join(problems)
        or (
            f"{peaks.contacts.max()} of {share:g} contacts, {peaks.rows.max()} of"
            f" {task.sizes.njmax} rows, at most, in {nworld} worlds"
        ),
        thresholds={"contacts_per_world": share, "njmax": task.sizes.njmax, "margin": t.margin},
        metrics={"worlds": nworld},
        notes={"backend": task_run.description, "sizes_from": task.sizes.source},
    )
    for group in (task, env):
        _report(context, group, result)
    for trial in trials:
        result.metrics |= trial.metrics
        result.notes |= trial.notes
    if task_run.sizes is None:
        result.notes["rerun"] = f"sizes were not tried: {_NATIVE}"
        result.notes["memory"] = f"not reported: {_NATIVE}"
    elif task.lost or env.lost:
        result.notes["rerun"] = "sizes were not tried where peaks are not known"
    result.details += details
    return [result]


def _group(
    cfg: Config,
    title: str,
    prefix: str,
    runs: dict[str, Workload],
    configured: BatchSizes,
    source: str,
) -> _Group:
    """Join the peaks of some workloads, and recommend sizes for them."""
    peaks = reduce(join_peaks, (run.peaks for run in runs.values()))
    wanted = recommend_sizes(peaks, cfg.gate.capacity.margin, source)
    losses = [describe_loss(run.peaks.overflow, run.sizes) for run in runs.values() if run.sizes]
    return _Group(
        title=title,
        prefix=prefix,
        runs=runs,
        peaks=peaks,
        sizes=apply_configured(cfg, wanted) if cfg.batch.auto else configured,
        wanted=wanted,
        lost="; ".join(f"{loss}. {fix}" for loss, fix in losses if loss),
    )


def _try(context: RunContext, group: _Group) -> list[_Trial]:
    """Play the workloads again at exactly the recommended sizes, on MJWarp."""
    cfg = context.cfg
    exact = not context.backend[1].startswith("cuda")
    starts = {"task": cfg.reset, "randomized": cfg.gate.capacity.reset}
    trials = []
    for name, first in reversed(group.runs.items()):
        if first.sizes is None or group.lost:
            continue
        if name in starts:
            again = play_task(context, starts[name], group.wanted)
        else:
            again = play_random(context, group.wanted)
        trials.append(_compare(name, first, again, judged=name in starts, exact=exact))
    return trials


def _report(context: RunContext, group: _Group, result: GateResult) -> None:
    """Add a group's peaks, recommended sizes and memory to the result."""
    cfg = context.cfg
    native = any(run.sizes is None for run in group.runs.values())
    for name, run in group.runs.items():
        prefix = "" if name == "task" else f"{name}."
        result.metrics |= _peak_metrics(prefix, run)
        if run.peaks.pool_pairs is None or run.peaks.pool_ccd_pairs is None:
            who = " by native MuJoCo" if native else ""
            result.notes[f"{prefix}pool_pairs"] = f"pairs are not all counted{who}"
    line = f"{group.title}: {_overrides(cfg, group.wanted)}"
    if group.lost:
        line = f"{group.title}: not known, physics was lost"
    elif native and "task" in group.runs:
        line += (
            " (contacts alone: native MuJoCo does not count the collision pairs that share their"
            " pool)"
        )
    context.say(line)
    result.details.append(line)
    if group.lost:
        return
    wanted = group.wanted
    result.metrics |= {
        f"{group.prefix}.nconmax": wanted.nconmax,
        f"{group.prefix}.naconmax": wanted.contact_pool(cfg.nworld),
        f"{group.prefix}.njmax": wanted.njmax,
    }
    if wanted.nccdmax:
        result.metrics[f"{group.prefix}.nccdmax"] = wanted.nccdmax
    else:
        result.notes[f"{group.prefix}.nccdmax"] = "not counted: MJWarp's default"
    if not native:
        from mjstack.sim.usage import data_bytes  # loads Warp, which native runs do not need

        key = "task" if "task" in group.runs else "env"
        for which, sizes in (("current", group.sizes), ("recommended", wanted)):
            size = data_bytes(context.model, cfg.nworld, sizes)
            result.metrics[f"memory.{key}.{which}_mb"] = size / 1e6


def _shortages(cfg: Config, group: _Group) -> list[_Shortage]:
    """Buffers in force that are too small for a group's peaks. Exactly at capacity fits."""
    peaks = group.peaks
    sizes = group.sizes
    wanted = group.wanted
    nworld = peaks.nworld
    out = []
    over = np.flatnonzero(peaks.rows > sizes.njmax).tolist()
    if over:
        out.append(
            _Shortage(
                ("njmax",),
                f"njmax overflow in {name_worlds(over, nworld)}; njmax={sizes.njmax}, most needed"
                f" {peaks.rows.max()}. Raise it: batch.njmax={wanted.njmax}",
            )
        )
    # MJWarp counts what all worlds hold at once. Fewer worlds than the batch has have fewer peaks
    # to even out.
    share = sizes.contact_pool(cfg.nworld) / cfg.nworld
    need = peaks.pool / nworld
    if need > share:
        worlds = np.flatnonzero(peaks.contacts > share).tolist()
        fix = f"batch.nconmax={wanted.nconmax}"
        if sizes.naconmax is not None:
            fix = f"batch.naconmax={wanted.contact_pool(cfg.nworld)}"
        out.append(
            _Shortage(
                ("nconmax", "naconmax"),
                f"contact pool overflow in {name_worlds(worlds, nworld)}; {share:g} per world,"
                f" {need:.1f} needed. Raise it: {fix}",
            )
        )
    convex = None if peaks.pool_ccd_pairs is None else peaks.pool_ccd_pairs / nworld
    share = sizes.convex_pool(cfg.nworld) / cfg.nworld
    if convex is not None and convex > share:
        fix = f"batch.nccdmax={wanted.nccdmax}"
        if sizes.naccdmax is not None:
            fix = f"batch.naccdmax={wanted.convex_pool(cfg.nworld)}"
        out.append(
            _Shortage(
                ("nccdmax", "naccdmax", "nconmax", "naconmax"),
                f"convex pairs overflow; room for {share:g} per world, {convex:.1f} needed. Raise"
                f" it: {fix}",
            )
        )
    return out


def _compare(name: str, first: Workload, again: Workload, *, judged: bool, exact: bool) -> _Trial:
    """Holds a run at exactly the recommended sizes against the first one.

    Nothing may be lost. Where runs repeat bit for bit, the outcome is to be the same too; where
    they do not, a world near a threshold may fall on its other side, which is reported.

    Args:
        name: The workload.
        first: The run with room to spare.
        again: The second one.
        judged: Whether the check judges it.
        exact: Whether runs repeat bit for bit, as they do on any CPU.
    """
    assert again.sizes is not None, "native MuJoCo has no sizes to try"
    at = f"{name} at {again.sizes.as_overrides()}"
    count = len(first.failed)
    key = f"rerun.{name}"
    lost = np.flatnonzero(again.peaks.overflow).tolist()
    flipped = np.flatnonzero((first.failed == 0) != (again.failed == 0)).tolist()
    moved = np.flatnonzero(
        ~np.isclose(first.final, again.final, rtol=0.0, atol=0.0, equal_nan=True).all(1)
    ).tolist()
    trial = _Trial(
        {
            f"{key}.overflow_worlds": len(lost),
            f"{key}.peak_constraint_rows_per_world": int(again.peaks.rows.max()),
        },
        {f"{key}.sizes": again.sizes.as_overrides()},
    )
    if judged:
        trial.metrics |= {
            f"{key}.succeeded": again.succeeded,
            f"{key}.flipped_worlds": len(flipped),
        }
    if exact:
        trial.metrics[f"{key}.same_final_state"] = not moved
    else:
        trial.notes[f"{key}.same_final_state"] = f"not compared: {_NO_ORDER}"
    flip = f"{at}: another result in {name_worlds(flipped, count)}" if judged and flipped else ""
    if lost:
        trial.problem = f"{at}: overflow in {name_worlds(lost, count)}"
    elif exact and flip:
        trial.problem = flip
    elif exact and moved:
        trial.problem = f"{at}: another final state in {name_worlds(moved, count)}"
    if flip and not exact:
        trial.remark = f"{flip}: {_NO_ORDER}"
    for part, run in (("measuring", first), ("rerun", again)):
        cost = {
            "data": run.data_bytes,
            "device": run.device_bytes,
        }
        for what, size in cost.items():
            if size is not None:
                trial.metrics[f"memory.{name}.{part}.{what}_mb"] = size / 1e6
    return trial


def _peak_metrics(prefix: str, run: Workload) -> dict[str, float]:
    """The peaks that were counted; native MuJoCo counts no pairs."""
    peaks = run.peaks
    found = {
        "peak_contacts_per_world": int(peaks.contacts.max()),
        "pool_contacts": peaks.pool_contacts,
        "pool_pairs": peaks.pool_pairs,
        "pool_ccd_pairs": peaks.pool_ccd_pairs,
        "peak_constraint_rows_per_world": int(peaks.rows.max()),
    }
    return {f"{prefix}{name}": value for name, value in found.items() if value is not None}


def _overrides(cfg: Config, wanted: BatchSizes) -> str:
    """The overrides to paste. Sizes of whole pools that are set would win over those per world, so
    they are set anew.
    """
    if cfg.batch.naconmax is not None:
        wanted = replace(wanted, naconmax=wanted.contact_pool(cfg.nworld))
    if cfg.batch.naccdmax is not None and wanted.nccdmax is not None:
        wanted = replace(wanted, naccdmax=wanted.convex_pool(cfg.nworld))
    return wanted.as_overrides()
