"""Gate *capacity*: are the buffers large enough for the whole episode, and how large must they be?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mjstack.config.schema import Config
from mjstack.envs.probe import POOL, ROWS, SIZED, Peaks, join_peaks, recommend_sizes
from mjstack.errors import Unreachable, name_worlds
from mjstack.gates.gate import GateContext
from mjstack.gates.sizing import Workload, measure_random, measure_task, play_random, play_task
from mjstack.report.record import GateResult, Status, Value
from mjstack.sim import BatchSizes, Overflow, describe_overflow, resolve_sizes
from mjstack.sim.sizes import apply_configured, resolve_env_sizes

_NATIVE = "native MuJoCo has no fixed buffers"


@dataclass(slots=True)
class _Shortage:
    """Something that does not fit: the keys that limit it, and a sentence."""

    keys: tuple[str, ...]
    text: str


def run_capacity(context: GateContext) -> list[GateResult]:
    """Finds what the scripted task, randomised starts and random actions need, and tries the sizes that it recommends.

    Peaks are over all substeps and all worlds, in worlds with room to spare: one that has lost physics moves differently.
    """
    cfg, margin = context.cfg, context.cfg.gate.capacity.margin
    details: list[str] = []
    randomized: Workload | None = None
    try:  # first, so that the plan of the task is the last one and kept for the runs and gates that follow
        randomized = measure_task(context, cfg.gate.capacity.reset)
    except Unreachable as error:  # somebody's own layout; the other two workloads stand
        details.append(f"randomised starts: not measured: {error}")
    task, random = measure_task(context, cfg.reset), measure_random(context)
    peaks, nworld = task.peaks, task.peaks.nworld
    runs, env_peaks = {"": task, "random_actions.": random}, random.peaks
    if randomized is not None:
        runs["randomized."], env_peaks = randomized, join_peaks(env_peaks, randomized.peaks)

    how = f"batch=auto: gate capacity, {nworld} worlds, times {margin:g}" if cfg.batch.auto else "gate capacity"
    wanted = context.measured = recommend_sizes(peaks, margin, how)
    env_wanted = context.measured_env = recommend_sizes(env_peaks, margin, how)
    sizes, env_sizes = resolve_sizes(cfg), resolve_env_sizes(cfg)
    if cfg.batch.auto:
        sizes, env_sizes = apply_configured(cfg, wanted), apply_configured(cfg, env_wanted)

    problems = [shortage.text for shortage in _shortages(cfg, peaks, sizes, wanted)]
    for shortage in _shortages(cfg, env_peaks, env_sizes, env_wanted):
        # Sizes that were set may be meant for the batch alone; those of the robot's profile should do for both.
        chosen = any(getattr(cfg.batch, key) is not None for key in shortage.keys)
        (details if chosen else problems).append(f"environments: {shortage.text}")

    metrics: dict[str, Value] = {"backend": task.description, "worlds": nworld, "sizes_from": sizes.source}
    for prefix, run in runs.items():
        metrics |= _peak_metrics(prefix, run)
    for prefix, found in (("recommended", wanted), ("recommended_env", env_wanted)):
        metrics |= {f"{prefix}.nconmax": found.nconmax, f"{prefix}.naconmax": found.contact_pool(cfg.nworld)}
        metrics |= {f"{prefix}.njmax": found.njmax, f"{prefix}.nccdmax": found.nccdmax or "not counted: MJWarp's default"}
    paste, env_paste = _overrides(cfg, wanted), _overrides(cfg, env_wanted)
    lines = [f"scripted task: {paste}", f"environments (random actions, randomised starts): {env_paste}"]
    if task.sizes is None:
        lines[0] += " (contacts alone: native MuJoCo does not count the collision pairs that share their pool)"
        metrics["rerun"] = f"sizes were not tried: {_NATIVE}"
        metrics["memory"] = f"not reported: {_NATIVE}"
    elif lost := _lost(*runs.values()):
        metrics["rerun"] = "sizes were not tried: peaks are not known"
        problems.append(lost)
    else:
        problems += _try_sizes(context, metrics, task, random, wanted, env_wanted)
        metrics |= _memory_metrics(context, {"task": (sizes, wanted), "env": (env_sizes, env_wanted)})
    for line in lines:
        context.say(line)
    if nworld < cfg.nworld:
        details.append(f"from {nworld} worlds: more of them meet rarer peaks, above all under random actions")
    share = sizes.contact_pool(cfg.nworld) / cfg.nworld
    summary = "; ".join(problems) or (
        f"{peaks.contacts.max()} of {share:g} contacts, {peaks.rows.max()} of {sizes.njmax} rows, at most, in {nworld} worlds"
    )
    return [
        GateResult(
            name="capacity",
            status=Status.failed if problems else Status.passed,
            reason=summary,
            thresholds={"contacts_per_world": share, "njmax": sizes.njmax, "margin": margin},
            metrics=metrics,
            details=lines + details,
        )
    ]


def _shortages(cfg: Config, peaks: Peaks, sizes: BatchSizes, wanted: BatchSizes) -> list[_Shortage]:
    """What does not fit into some sizes. Exactly at capacity fits."""
    nworld, out = peaks.nworld, []
    over = np.flatnonzero(peaks.rows > sizes.njmax).tolist()
    if over:
        out.append(
            _Shortage(
                ("njmax",),
                f"njmax overflow in {name_worlds(over, nworld)}; njmax={sizes.njmax}, most needed {peaks.rows.max()}. "
                f"Raise it: batch.njmax={wanted.njmax}",
            )
        )
    # MJWarp counts what all worlds hold at once. Fewer worlds than the batch has have fewer peaks to even out.
    share, need = sizes.contact_pool(cfg.nworld) / cfg.nworld, peaks.pool / nworld
    if need > share:
        worlds = np.flatnonzero(peaks.contacts > share).tolist()
        fix = f"batch.nconmax={wanted.nconmax}"
        if sizes.naconmax is not None:
            fix = f"batch.naconmax={wanted.contact_pool(cfg.nworld)}"
        out.append(
            _Shortage(
                ("nconmax", "naconmax"),
                f"contact pool overflow in {name_worlds(worlds, nworld)}; {share:g} per world, {need:.1f} needed. "
                f"Raise it: {fix}",
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
                f"convex pairs overflow; room for {share:g} per world, {convex:.1f} needed. Raise it: {fix}",
            )
        )
    return out


def _lost(*runs: Workload) -> str:
    """Physics that was lost although there was room to spare."""
    bits = np.bitwise_or.reduce([run.peaks.overflow for run in runs])
    worlds = np.flatnonzero(bits).tolist()
    if not worlds:
        return ""
    all_bits, sizes = int(np.bitwise_or.reduce(bits)), runs[0].sizes
    keys = (("njmax", ROWS), ("nconmax", POOL), ("nccdmax", int(Overflow.CCD)))
    raised = " and ".join(f"batch.{key}" for key, flags in keys if all_bits & flags)
    fix = f"Set {raised} higher still" if all_bits & SIZED else "Simplify the model, or run sim=native"
    room = "" if sizes is None else f" even with {sizes.as_overrides()}"
    return f"{describe_overflow(all_bits)} overflow in {name_worlds(worlds, len(bits))}{room}. {fix}"


def _try_sizes(
    context: GateContext,
    metrics: dict[str, Value],
    task: Workload,
    random: Workload,
    wanted: BatchSizes,
    env_wanted: BatchSizes,
) -> list[str]:
    """Plays both again at exactly the recommended sizes: nothing may be lost, and the outcome is to be the same."""
    exact = not context.backend[1].startswith("cuda")
    runs = (
        ("task", task, wanted, lambda: play_task(context, context.cfg.reset, wanted)),
        ("random_actions", random, env_wanted, lambda: play_random(context, env_wanted)),
    )
    problems: list[str] = []
    for name, first, wanted_here, play in runs:
        again = play()
        judged, count = name == "task", len(first.failed)
        lost = np.flatnonzero(again.peaks.overflow).tolist()
        flipped = np.flatnonzero((first.failed == 0) != (again.failed == 0)).tolist()
        moved = np.flatnonzero(~np.isclose(first.final, again.final, rtol=0.0, atol=0.0, equal_nan=True).all(1)).tolist()
        key = f"rerun.{name}"
        metrics[f"{key}.sizes"] = wanted_here.as_overrides()
        metrics[f"{key}.overflow_worlds"] = len(lost)
        metrics[f"{key}.peak_constraint_rows_per_world"] = int(again.peaks.rows.max())
        if judged:
            metrics[f"{key}.accepted"] = again.accepted
            metrics[f"{key}.same_worlds_accepted"] = not flipped
        metrics[f"{key}.same_final_state"] = not moved if exact else "not compared: on CUDA sums have no fixed order"
        if lost:
            problems.append(f"{name} at {wanted_here.as_overrides()}: overflow in {name_worlds(lost, count)}")
        elif judged and flipped:
            problems.append(f"{name} at {wanted_here.as_overrides()}: another verdict in {name_worlds(flipped, count)}")
        elif exact and moved:
            problems.append(f"{name} at {wanted_here.as_overrides()}: another final state in {name_worlds(moved, count)}")
        for part, run in (("measuring", first), ("rerun", again)):
            cost = {"data": run.data_bytes, "borrowed_in_a_step": run.borrowed_bytes, "device": run.device_bytes}
            for what, size in cost.items():
                metrics[f"memory.{name}.{part}.{what}_mb"] = "not known here" if size is None else size / 1e6
    return problems


def _memory_metrics(context: GateContext, pairs: dict[str, tuple[BatchSizes, BatchSizes]]) -> dict[str, Value]:
    """What MJWarp's arrays take for the whole batch, with the sizes in force and with the recommended ones."""
    from mjstack.sim.memory import data_bytes  # loads Warp, which native runs do not need

    out: dict[str, Value] = {}
    for name, (current, wanted) in pairs.items():
        for which, sizes in (("current", current), ("recommended", wanted)):
            out[f"memory.{name}.{which}_mb"] = data_bytes(context.model, context.cfg.nworld, sizes) / 1e6
    return out


def _peak_metrics(prefix: str, run: Workload) -> dict[str, Value]:
    peaks = run.peaks

    def counted(value: int | None) -> Value:
        return ("not counted by native MuJoCo" if run.sizes is None else "not counted") if value is None else value

    return {
        f"{prefix}peak_contacts_per_world": int(peaks.contacts.max()),
        f"{prefix}pool_contacts": peaks.pool_contacts,
        f"{prefix}pool_pairs": counted(peaks.pool_pairs),
        f"{prefix}pool_ccd_pairs": counted(peaks.pool_ccd_pairs),
        f"{prefix}peak_constraint_rows_per_world": int(peaks.rows.max()),
    }


def _overrides(cfg: Config, wanted: BatchSizes) -> str:
    """The overrides to paste. Sizes of whole pools that are set would win over those per world, so they are set anew."""
    if cfg.batch.naconmax is not None:
        wanted = replace(wanted, naconmax=wanted.contact_pool(cfg.nworld))
    if cfg.batch.naccdmax is not None and wanted.nccdmax is not None:
        wanted = replace(wanted, naccdmax=wanted.convex_pool(cfg.nworld))
    return wanted.as_overrides()
