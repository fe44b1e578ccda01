"""Gate *capacity*: are the buffers large enough for the whole episode, and how large must
they be?
"""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial, reduce

import numpy as np

from mjstack.config.schema import Backend, Config
from mjstack.envs.buffers import (
    Peaks,
    Workload,
    describe_run_loss,
    join_peaks,
    play_workload,
    random_actions,
    recommend_sizes,
)
from mjstack.episodes.context import RunContext, each_rank, needs_episode
from mjstack.episodes.rollout import FEEDBACK
from mjstack.errors import Unreachable, name_worlds
from mjstack.report.record import GateResult, Status
from mjstack.sim import BatchSizes, resolve_sizes
from mjstack.sim.cameras import image_bytes
from mjstack.sim.sizes import apply_configured, resolve_env_sizes


@dataclass(kw_only=True, slots=True)
class _Group:
    """Workloads whose worlds have the same buffer sizes."""

    name: str  # env or task
    title: str
    runs: dict[str, Workload]  # with room to spare
    peaks: Peaks  # the most that any of them used
    sizes: BatchSizes  # in force
    wanted: BatchSizes  # recommended
    lost: str  # physics that was lost with room to spare; nothing may be sized from it then
    broken: list[str] = field(default_factory=list)  # problems at the recommended sizes


@each_rank
@needs_episode
def run_capacity(context: RunContext) -> list[GateResult]:
    """Find the buffer sizes that the driven task, randomised starts and random actions need, and
    try them.

    Peaks are over all steps and all worlds, in worlds with room to spare: one that has lost physics
    moves differently.
    """
    cfg = context.cfg
    t = cfg.gate.capacity
    nworld = context.measuring_nworld
    result = GateResult(name="capacity", status=Status.passed, metrics={"worlds": nworld})

    # Environments first: each start is planned once, for both of its runs, and the plan of the
    # task's is kept for the gates that follow. Planning processes load during random actions.
    planned = 0 if cfg.controller.name in FEEDBACK else nworld
    with context.planner.processes(planned) if planned else nullcontext():
        env = _measure(
            context,
            result,
            "env",
            "environments (random actions, randomised starts)",
            resolve_env_sizes(cfg),
            random_actions=partial(play_random, context),
            randomized=partial(context.play_task, t.reset),
        )
        task = _measure(
            context,
            result,
            "task",
            "driven task",
            resolve_sizes(cfg),
            task=partial(context.play_task, cfg.reset),
        )
    task_run = task.runs["task"]

    # Problems. Motion that lost physics sizes nothing that follows.
    context.artifacts.sizes = None if task.lost else task.wanted
    context.artifacts.env_sizes = None if env.lost else env.wanted
    problems = [task.lost] if task.lost else [text for _, text in _shortages(cfg, task)]
    if env.lost:
        problems.append(f"environments: {env.lost}")
    for keys, text in [] if env.lost else _shortages(cfg, env):
        # Sizes that were set may be meant for the batch alone; those of the robot's profile should
        # do for both.
        chosen = any(getattr(cfg.batch, key) is not None for key in keys)
        (result.details if chosen else problems).append(f"environments: {text}")
    problems += env.broken + task.broken
    if nworld < cfg.nworld:
        result.details.append(
            f"from {nworld} worlds: more of them meet rarer peaks, above all under random actions"
        )

    # Report
    share = task.sizes.contact_pool(cfg.nworld) / cfg.nworld
    peaks = task.peaks
    used = f"{peaks.contacts.max()} of {share:g} contacts, {peaks.rows.max()} of {task.sizes.njmax}"
    result.reason = "; ".join(problems) or f"{used} rows, at most, in {nworld} worlds"
    result.status = Status.failed if problems else Status.passed
    result.thresholds = {"contacts_per_world": share, "njmax": task.sizes.njmax, "margin": t.margin}
    result.notes |= {"backend": task_run.description, "sizes_from": task.sizes.source}
    for group in (task, env):
        _report(context, group, result)
    cameras = cfg.scene.cameras
    if cameras:
        mjwarp = context.backend[0] is Backend.mjwarp
        size = image_bytes(context.model, cameras, cfg.nworld, mjwarp=mjwarp)
        result.metrics["memory.images_mb"] = size / 1e6
        result.details.append(
            f"environments: images of {', '.join(cameras)} take {size / 1e6:,.0f} MB in"
            f" {cfg.nworld} worlds, beside the buffers"
        )
    if task_run.sizes is None:
        result.notes["rerun"] = "sizes were not tried: native MuJoCo has no fixed buffers"
    elif task.lost or env.lost:
        result.notes["rerun"] = "sizes were not tried where peaks are not known"
    return [result]


def play_random(context: RunContext, sizes: BatchSizes | None = None) -> Workload:
    """Step the task's environment with random actions; worlds end and start anew as its managers
    say. Sizes as in `play_workload`.
    """
    cfg = context.cfg
    steps = cfg.gate.capacity.random_steps or cfg.task.episode_steps
    play = random_actions(cfg, steps, context.advance)
    return play_workload(cfg, context.measuring_simulation, play, sizes)


def _measure(
    context: RunContext,
    result: GateResult,
    group: str,
    title: str,
    configured: BatchSizes,
    **plays: Callable[..., Workload],
) -> _Group:
    """Play some workloads, recommend sizes for them, and try those on MJWarp."""
    cfg = context.cfg
    margin = cfg.gate.capacity.margin
    runs = {}
    for name, play in plays.items():
        try:
            runs[name] = play()
        except Unreachable as error:
            if name != "randomized":
                raise
            # Starts of the user's own; the other workloads stand
            result.details.append(f"randomised starts: not measured: {error}")
    peaks = reduce(join_peaks, (run.peaks for run in runs.values()))
    how = f"batch=auto: gate capacity, {context.measuring_nworld} worlds, times {margin:g}"
    wanted = recommend_sizes(peaks, margin, how if cfg.batch.auto else "gate capacity")
    losses = (describe_run_loss(run) for run in runs.values() if run.sizes)
    done = _Group(
        name=group,
        title=title,
        runs=runs,
        peaks=peaks,
        sizes=apply_configured(cfg, wanted) if cfg.batch.auto else configured,
        wanted=wanted,
        lost="; ".join(filter(None, losses)),
    )
    exact = not context.backend[1].startswith("cuda")
    for name, first in reversed(runs.items()):
        if first.sizes is not None and not done.lost:
            problem = _compare(name, first, plays[name](wanted), result, exact=exact)
            done.broken += [problem] if problem else []
    return done


def _compare(
    name: str, first: Workload, again: Workload, result: GateResult, *, exact: bool
) -> str:
    """Hold a run at exactly the recommended sizes against the first one.

    Nothing may be lost. Where runs repeat bit for bit, the outcome is to be the same too; where
    they do not, a world near a threshold may fall on its other side, which is reported. Returns the
    problem, if any.
    """
    assert again.sizes is not None, "native MuJoCo has no sizes to try"
    sizes = again.sizes.as_overrides()
    judged = name != "random_actions"
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
    if judged:
        metrics |= {"succeeded": int((again.failed == 0).sum()), "flipped_worlds": len(flipped)}
    if exact:
        metrics["same_final_state"] = not moved
    result.metrics |= {f"rerun.{name}.{key}": value for key, value in metrics.items()}
    result.notes[f"rerun.{name}.sizes"] = sizes

    # Problems
    at = f"{name} at {sizes}"
    if lost:
        return f"{at}: overflow in {name_worlds(lost, count)}"
    if judged and flipped:
        flip = f"{at}: another result in {name_worlds(flipped, count)}"
        if exact:
            return flip
        result.details.append(f"{flip}: on CUDA sums have no fixed order")
    elif exact and moved:
        return f"{at}: another final state in {name_worlds(moved, count)}"
    return ""


def _report(context: RunContext, group: _Group, result: GateResult) -> None:
    """Add a group's peaks, recommended sizes and memory to the result."""
    cfg = context.cfg
    native = any(run.sizes is None for run in group.runs.values())
    for name, run in group.runs.items():
        prefix = "" if name == "task" else f"{name}."
        peaks = run.peaks
        found = {
            "peak_contacts_per_world": int(peaks.contacts.max()),
            "pool_contacts": peaks.pool_contacts,
            "pool_pairs": peaks.pool_pairs,
            "pool_ccd_pairs": peaks.pool_ccd_pairs,
            "peak_constraint_rows_per_world": int(peaks.rows.max()),
        }
        result.metrics |= {f"{prefix}{key}": n for key, n in found.items() if n is not None}
    wanted = group.wanted
    line = f"{group.title}: {_overrides(cfg, wanted)}"
    if group.lost:
        line = f"{group.title}: not known, physics was lost"
    elif native and group.name == "task":
        line += (
            " (contacts alone: native MuJoCo does not count the collision pairs that share their"
            " pool)"
        )
    context.print_line(line)
    result.details.append(line)
    if group.lost:
        return
    sizes = {
        "nconmax": wanted.nconmax,
        "naconmax": wanted.contact_pool(cfg.nworld),
        "njmax": wanted.njmax,
        "nccdmax": wanted.nccdmax,
    }
    prefix = "recommended" if group.name == "task" else "recommended_env"
    result.metrics |= {f"{prefix}.{key}": n for key, n in sizes.items() if n is not None}
    if not native:
        from mjstack.sim.usage import data_bytes  # loads Warp, which native runs do not need

        for which, some in (("current", group.sizes), ("recommended", wanted)):
            size = data_bytes(context.model, cfg.nworld, some)
            result.metrics[f"memory.{group.name}.{which}_mb"] = size / 1e6


def _shortages(cfg: Config, group: _Group) -> list[tuple[tuple[str, ...], str]]:
    """Buffers in force that are too small for a group's peaks: the keys that limit each, and a
    sentence. Exactly at capacity fits.
    """
    n = cfg.nworld
    peaks = group.peaks
    sizes = group.sizes
    wanted = group.wanted
    # MJWarp counts what all worlds hold at once. Fewer worlds than the batch has have fewer peaks
    # to even out.
    room = sizes.contact_pool(n) / n
    contacts = f"nconmax={wanted.nconmax}"
    if sizes.naconmax is not None:
        contacts = f"naconmax={wanted.contact_pool(n)}"
    convex = f"nccdmax={wanted.nccdmax}"
    if sizes.naccdmax is not None:
        convex = f"naccdmax={wanted.convex_pool(n)}"
    pool = ("nconmax", "naconmax")
    convex_keys = ("nccdmax", "naccdmax", *pool)
    # Buffer, keys, room of a world, most needed, worlds that need more, and the remedy
    crowded = peaks.contacts > room
    rows = peaks.rows.max()
    pairs = (peaks.pool_ccd_pairs or 0) / peaks.nworld
    buffers: list[tuple[str, tuple[str, ...], float, float, np.ndarray, str]] = [
        ("njmax", ("njmax",), sizes.njmax, rows, peaks.rows > sizes.njmax, f"njmax={wanted.njmax}"),
        ("contact pool", pool, room, peaks.pool / peaks.nworld, crowded, contacts),
        ("convex pairs", convex_keys, sizes.convex_pool(n) / n, pairs, np.zeros(0), convex),
    ]
    out = []
    for name, keys, there, need, over, fix in buffers:
        if need > there:
            worlds = np.flatnonzero(over).tolist()
            where = f" in {name_worlds(worlds, peaks.nworld)}" if worlds else ""
            fit = f"room for {there:g} per world, {need:g} needed"
            out.append((keys, f"{name} overflow{where}; {fit}. Raise it: batch.{fix}"))
    return out


def _overrides(cfg: Config, wanted: BatchSizes) -> str:
    """The overrides to paste. Sizes of whole pools that are set would win over those per world, so
    they are set anew.
    """
    if cfg.batch.naconmax is not None:
        wanted = replace(wanted, naconmax=wanted.contact_pool(cfg.nworld))
    if cfg.batch.naccdmax is not None and wanted.nccdmax is not None:
        wanted = replace(wanted, naccdmax=wanted.convex_pool(cfg.nworld))
    return wanted.as_overrides()
