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


@needs_episode
def run_capacity(context: RunContext) -> list[GateResult]:
    """Finds what the scripted task, randomised starts and random actions need, and tries the sizes
    that it recommends.

    Peaks are over all decimation and all worlds, in worlds with room to spare: one that has lost
    physics moves differently.
    """
    cfg = context.cfg
    margin = context.cfg.gate.capacity.margin
    exact = not context.backend[1].startswith("cuda")
    nworld = measuring_worlds(context)
    how = (
        f"batch=auto: gate capacity, {nworld} worlds, times {margin:g}"
        if cfg.batch.auto
        else "gate capacity"
    )
    details: list[str] = []
    trials: list[_Trial] = []

    # Each start is planned once, for both of its runs, and the task last: its plan is kept for the
    # gates that follow.
    random = measure_random(context)
    randomized = None
    try:
        randomized = measure_task(context, cfg.gate.capacity.reset)
    except Unreachable as error:  # somebody's own layout; the other two workloads stand
        details.append(f"randomised starts: not measured: {error}")
    env_runs = [random] if randomized is None else [random, randomized]
    env_peaks = reduce(join_peaks, (run.peaks for run in env_runs))
    env_wanted = recommend_sizes(env_peaks, margin, how)
    env_lost = _lost(*env_runs)
    if random.sizes is not None and not env_lost:
        if randomized is not None:
            again = play_task(context, cfg.gate.capacity.reset, env_wanted)
            trials.append(_compare("randomized", randomized, again, judged=True, exact=exact))
        again = play_random(context, env_wanted)
        trials.append(_compare("random_actions", random, again, judged=False, exact=exact))

    task = measure_task(context, cfg.reset)
    peaks = task.peaks
    wanted = recommend_sizes(peaks, margin, how)
    task_lost = _lost(task)
    if task.sizes is not None and not task_lost:
        trials.append(
            _compare("task", task, play_task(context, cfg.reset, wanted), judged=True, exact=exact)
        )
    runs = {"": task, "random_actions.": random} | (
        {} if randomized is None else {"randomized.": randomized}
    )

    # Motion that lost physics sizes nothing that follows.
    context.artifacts.sizes = None if task_lost else wanted
    context.artifacts.env_sizes = None if env_lost else env_wanted
    sizes = resolve_sizes(cfg)
    env_sizes = resolve_env_sizes(cfg)
    if cfg.batch.auto:
        sizes = apply_configured(cfg, wanted)
        env_sizes = apply_configured(cfg, env_wanted)

    problems = (
        [task_lost]
        if task_lost
        else [shortage.text for shortage in _shortages(cfg, peaks, sizes, wanted)]
    )
    if env_lost:
        problems.append(f"environments: {env_lost}")
    for shortage in [] if env_lost else _shortages(cfg, env_peaks, env_sizes, env_wanted):
        # Sizes that were set may be meant for the batch alone; those of the robot's profile should
        # do for both.
        chosen = any(getattr(cfg.batch, key) is not None for key in shortage.keys)
        (details if chosen else problems).append(f"environments: {shortage.text}")
    problems += [trial.problem for trial in trials if trial.problem]
    details += [trial.remark for trial in trials if trial.remark]

    metrics: dict[str, float] = {"worlds": nworld}
    notes = {"backend": task.description, "sizes_from": sizes.source}
    for prefix, run in runs.items():
        metrics |= _peak_metrics(prefix, run)
        if run.peaks.pool_pairs is None or run.peaks.pool_ccd_pairs is None:
            who = " by native MuJoCo" if run.sizes is None else ""
            notes[f"{prefix}pool_pairs"] = f"pairs are not all counted{who}"
    known = {
        name: (current, found)
        for name, current, found, lost in (
            ("task", sizes, wanted, task_lost),
            ("env", env_sizes, env_wanted, env_lost),
        )
        if not lost
    }
    for name, (_, found) in known.items():
        prefix = "recommended" if name == "task" else f"recommended_{name}"
        metrics |= {
            f"{prefix}.nconmax": found.nconmax,
            f"{prefix}.naconmax": found.contact_pool(cfg.nworld),
        }
        metrics |= {
            f"{prefix}.njmax": found.njmax,
        }
        if found.nccdmax:
            metrics[f"{prefix}.nccdmax"] = found.nccdmax
        else:
            notes[f"{prefix}.nccdmax"] = "not counted: MJWarp's default"
    lines = []
    for name, title in (
        ("task", "scripted task"),
        ("env", "environments (random actions, randomised starts)"),
    ):
        sizes_text = (
            _overrides(cfg, known[name][1]) if name in known else "not known, physics was lost"
        )
        lines.append(f"{title}: {sizes_text}")
    if task.sizes is None:
        lines[0] += (
            " (contacts alone: native MuJoCo does not count the collision pairs that share their"
            " pool)"
        )
        notes["rerun"] = f"sizes were not tried: {_NATIVE}"
        notes["memory"] = f"not reported: {_NATIVE}"
    else:
        if len(known) < 2:
            notes["rerun"] = "sizes were not tried where peaks are not known"
        for trial in trials:
            metrics |= trial.metrics
            notes |= trial.notes
        metrics |= _memory_metrics(context, known)
    for line in lines:
        context.say(line)
    if nworld < cfg.nworld:
        details.append(
            f"from {nworld} worlds: more of them meet rarer peaks, above all under random actions"
        )
    share = sizes.contact_pool(cfg.nworld) / cfg.nworld
    summary = "; ".join(problems) or (
        f"{peaks.contacts.max()} of {share:g} contacts, {peaks.rows.max()} of {sizes.njmax} rows,"
        f" at most, in {nworld} worlds"
    )
    return [
        GateResult(
            name="capacity",
            status=Status.failed if problems else Status.passed,
            reason=summary,
            thresholds={"contacts_per_world": share, "njmax": sizes.njmax, "margin": margin},
            metrics=metrics,
            notes=notes,
            details=lines + details,
        )
    ]


def _shortages(cfg: Config, peaks: Peaks, sizes: BatchSizes, wanted: BatchSizes) -> list[_Shortage]:
    """What does not fit into some sizes. Exactly at capacity fits."""
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


def _lost(*runs: Workload) -> str:
    """Physics that was lost although there was room to spare. Native MuJoCo has no such room."""
    if runs[0].sizes is None:
        return ""
    losses = [describe_loss(run.peaks.overflow, run.sizes) for run in runs]
    return "; ".join(f"{loss}. {fix}" for loss, fix in losses if loss)


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
            "borrowed_in_a_step": run.borrowed_bytes,
            "device": run.device_bytes,
        }
        for what, size in cost.items():
            if size is not None:
                trial.metrics[f"memory.{name}.{part}.{what}_mb"] = size / 1e6
    return trial


def _memory_metrics(
    context: RunContext, pairs: dict[str, tuple[BatchSizes, BatchSizes]]
) -> dict[str, float]:
    """What MJWarp's arrays take for the whole batch, with the sizes in force and with the
    recommended ones.
    """
    from mjstack.sim.memory import data_bytes  # loads Warp, which native runs do not need

    out: dict[str, float] = {}
    for name, (current, wanted) in pairs.items():
        for which, sizes in (("current", current), ("recommended", wanted)):
            out[f"memory.{name}.{which}_mb"] = (
                data_bytes(context.model, context.cfg.nworld, sizes) / 1e6
            )
    return out


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
