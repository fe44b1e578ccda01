"""Job *replay*: one world of an earlier run's batch again, alone, with its trajectory kept and
every rule explained.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf
from rich.markup import escape

from mjstack.config.schema import Backend, Config, SimCfg
from mjstack.episodes.context import RunContext, judge_one, require_episode
from mjstack.episodes.failures import FailureMonitor, describe_sign
from mjstack.episodes.record import EpisodeRecord
from mjstack.episodes.replay import ReplayedWorld, replay_world, start_of_world
from mjstack.errors import ConfigError, DeviceError, RunError
from mjstack.files import write_atomic
from mjstack.gates.runner import run_guarded
from mjstack.gates.success import success_config
from mjstack.jobs.archived_starts import archived_starts, copy_names
from mjstack.jobs.earlier_run import EarlierRun
from mjstack.jobs.gates import check_task
from mjstack.jobs.job import Job
from mjstack.jobs.progress import ProgressBar
from mjstack.jobs.result import JobResult
from mjstack.jobs.runner import Record, check_showing, run_provenance, run_reported
from mjstack.report.record import GateResult, Status
from mjstack.sim import resolve_backend, resolve_device

KEYS = ("job", "run", "world", "sim", "view", "video")
"""What its command line may set. All else is the earlier run's."""

_PLACES = {
    "git_commit": "mjstack's commit",
    "cpu": "the processor",
}  # besides versions, what arithmetic depends on
_SAME_START = (
    1e-6  # [m, rad], and of quaternions: backends differ by rounding, another start by more
)


@dataclass(frozen=True, kw_only=True, slots=True)
class ReplayPlan:
    """What is to be played.

    Attributes:
        run: The earlier run.
        gate: Whose world it is, ``batch`` or ``success``.
        cfg: The configuration that the gate played under, on the first backend here.
        seed: The seed.
        world: The world's number.
        where: Backend and device, each played once; the first is the earlier run's unless ``sim``
            says otherwise.
        record: What the gate found there, or None.
        notes: What could not be as it was.
        context: Scene and plan of the configuration.
    """

    run: EarlierRun
    gate: str
    cfg: Config
    seed: int
    world: int
    where: list[tuple[Backend, str]]
    record: EpisodeRecord | None
    notes: list[str]
    context: RunContext


def check_replay(cfg: Config) -> ReplayPlan:
    """Raises for what cannot be replayed, before anything is written."""
    plan = _plan(cfg)
    require_episode(plan.cfg)
    check_task(plan.context)
    check_showing(plan.cfg)
    _check_start(plan)
    return plan


def run_replay_job(plan: ReplayPlan, folder: Path, overrides: list[str]) -> JobResult:
    """Plays the world on its run's backend and, where that was MJWarp, on native MuJoCo too; see
    `run_reported`.
    """
    title = (
        f"replay of world {plan.world} of {plan.cfg.nworld}, seed {plan.seed}, of {plan.run.folder}"
    )
    return run_reported(plan.context, folder, overrides, title, partial(_run, plan))


def _plan(cfg: Config) -> ReplayPlan:
    for key, expected in (("run", "the folder of an earlier run"), ("world", "one of its worlds")):
        if getattr(cfg, key) is None:
            fix = "Write job=replay run=outputs/<date>/<time> world=17"
            raise ConfigError(key, "null", f"{expected}, because job=replay plays one again", fix)
    resolve_backend(cfg)  # what this command line asks for must be there
    run = EarlierRun.read(str(cfg.run))
    *heads, tail = str(cfg.world).split(":")
    gate = _whose(
        run.cfg, heads.pop(0) if heads and not heads[0].isdigit() else None, str(cfg.world)
    )
    seed = int(heads[0]) if heads else run.cfg.seed
    world = int(tail)
    last = (
        run.cfg.seed + (run.cfg.gate.success if gate == "success" else run.cfg.gate.batch).seeds - 1
    )
    if not run.cfg.seed <= seed <= last:
        seeds = f"seed {last}" if last == run.cfg.seed else f"a seed from {run.cfg.seed} to {last}"
        raise ConfigError("world", cfg.world, f"{seeds}, as that run has (seed:world)")
    if not world < run.cfg.nworld:
        raise ConfigError(
            "world", cfg.world, f"a world from 0 to {run.cfg.nworld - 1}, as that run has"
        )
    record = run.record(seed, gate)
    kept = archived_starts(run.cfg, run.folder)
    played = success_config(kept) if gate == "success" else kept
    where, notes = _choose(cfg.sim, run, record)
    backend, device = where[0]
    sim = SimCfg(backend=backend, device=device)
    played = replace(played, sim=sim, view=cfg.view, video=cfg.video)
    return ReplayPlan(
        run=run,
        gate=gate,
        cfg=played,
        context=RunContext(played),
        seed=seed,
        world=world,
        where=where,
        record=record,
        notes=notes,
    )


def _whose(cfg: Config, named: str | None, world: str) -> str:
    """The gate whose world is meant: the one that is named, else the one that the run had, *batch*
    if both.
    """
    had = [gate for gate in ("batch", "success") if gate in cfg.gates]
    if named is not None and named not in had:
        raise ConfigError(
            "world",
            world,
            f"a world of a gate that run had, {' or '.join(had) or 'neither batch nor success'}",
        )
    return named or (had[0] if had else "batch")


def _choose(
    asked: SimCfg, run: EarlierRun, record: EpisodeRecord | None
) -> tuple[list[tuple[Backend, str]], list[str]]:
    """Backends and devices to play on, and what could not be as it was."""
    ran = _ran_on(run, record)
    backend = ran[0] if asked.backend is Backend.auto else asked.backend
    if backend is Backend.native:
        return [(Backend.native, "cpu")], []
    device = resolve_device(asked.device)
    notes = []
    if asked.device == "auto" and ran[0] is Backend.mjwarp:
        try:
            device = resolve_device(ran[1])
        except DeviceError:
            notes = [f"that run was on {ran[1]}, which is not here: replayed on {device}"]
    where = [(Backend.mjwarp, device)]
    return where + [(Backend.native, "cpu")] * (asked.backend is Backend.auto), notes


def _check_start(plan: ReplayPlan) -> None:
    """Raises if the world would start elsewhere than it did in that run."""
    if plan.record is None or plan.record.start is None:
        return
    context = plan.context
    then = plan.record.start[plan.world]
    # MJWarp takes longer to load than the native start does to compute, and rounding may have it
    # draw otherwise.
    for backend, device in dict.fromkeys([(Backend.native, "cpu"), plan.where[0]]):
        now = start_of_world(
            context, seed=plan.seed, world=plan.world, backend=backend, device=device
        )
        off = float(np.abs(now - then).max()) if now.shape == then.shape else math.inf
        if off <= _SAME_START:
            return
    fix = f"Use the mjstack that ran it ({plan.run.provenance.get('git_commit')})"
    copies = ", ".join(copy_names(plan.run.cfg).values())
    if copies:
        fix = f"Put back what it started from, as {copies}"
    raise RunError(
        f"run={plan.run.folder}: world {plan.world} of seed {plan.seed} would start up to {off:.3g}"
        f" (m, rad) from where it did, expected its own start. {fix}."
    )


def _ran_on(run: EarlierRun, record: EpisodeRecord | None) -> tuple[Backend, str]:
    """Backend and device of the earlier batch: as recorded, else what its configuration means on
    its machine.
    """
    if record is not None:
        return Backend(record.backend), record.device
    device = str(run.provenance.get("device", "")).rpartition(": ")[0]
    backend = run.cfg.sim.backend
    if backend is Backend.auto:
        backend = Backend.mjwarp if device.startswith("cuda") else Backend.native
    return backend, device if device.startswith("cuda") else "cpu"


def _run(plan: ReplayPlan, context: RunContext, bar: ProgressBar, record: Record) -> None:
    assert context.folder is not None
    played = replace(plan.cfg, seed=plan.seed)
    write_atomic(
        context.folder / "replayed_config.yaml", OmegaConf.to_yaml(OmegaConf.structured(played))
    )
    changes = _changes(plan.run.provenance, run_provenance(plan.cfg, context))
    for line in plan.notes + changes:
        bar.say(escape(line))
    for number, (backend, device) in enumerate(plan.where):
        name = f"replay_{backend.value}"
        bar.start(name)
        run_guarded(context, name, partial(_replay, plan, number, backend, device, changes), record)


def _changes(then: dict, now: dict) -> list[str]:
    """What is not as it was in the earlier run and could change a result, or its last bits."""
    was = then.get("versions")
    pairs = [
        (name, was[name], version)
        for name, version in now["versions"].items()
        if isinstance(was, dict) and name in was
    ]
    pairs += [(what, then[key], now[key]) for key, what in _PLACES.items() if key in then]
    lines = [
        f"{what} was {before} in that run and is {here} now"
        for what, before, here in pairs
        if before != here
    ]
    if then.get("model_sha256") != now["model_sha256"]:
        lines.append("the compiled model is not the same as in that run: this is another physics")
    return lines


def _replay(
    plan: ReplayPlan,
    number: int,
    backend: Backend,
    device: str,
    changes: list[str],
    context: RunContext,
) -> list[GateResult]:
    """Plays the world on one backend and says how it went, and whether that is what was
    recorded.
    """
    first = number == 0
    monitor = FailureMonitor(plan.cfg) if plan.gate == "success" else None
    done = replay_world(
        context,
        seed=plan.seed,
        world=plan.world,
        backend=backend,
        device=device,
        observers=[*(context.viewers if first else []), *([] if monitor is None else [monitor])],
    )
    status, reason, metrics = judge_one(context.check.rules, done.episode.result)
    reason = reason or f"succeeded, {context.check.headline(metrics)}"
    kept, compared = _compare(plan, done, backend, device, changes, context)
    reason += f"; {compared}"
    if not kept:
        status = Status.failed
    if first:
        context.artifacts.shown = done.recorder
        context.artifacts.shown_by = (
            f"world {plan.world} of seed {plan.seed}, replayed ({backend.value})"
        )
    told = [str(finding) for finding in done.findings] + (
        [] if monitor is None else [_first_sign(monitor, done, context)]
    )
    for line in told:
        context.say(escape(f"  {line}"))
    notes = {"backend": done.description}
    if plan.record is not None:
        notes["recorded"] = (
            context.check.rules.describe(int(plan.record.failed[plan.world])) or "succeeded"
        )
    name = "trajectory.npz" if first else f"trajectory_{backend.value}.npz"
    assert context.folder is not None
    try:
        done.write(context.folder / name, seed=plan.seed, world=plan.world)
        notes["trajectory"] = name
    except OSError as error:
        status = Status.failed
        reason = f"{reason}; {name} cannot be written ({error.strerror})"
    return [
        GateResult(
            name=f"replay_{backend.value}",
            status=status,
            reason=reason,
            thresholds=context.check.thresholds(),
            metrics={"seed": plan.seed, "world": plan.world, **metrics},
            notes=notes,
            details=told + plan.notes + changes,
        )
    ]


def _first_sign(monitor: FailureMonitor, done: ReplayedWorld, context: RunContext) -> str:
    """What the success gate would say of where the world went wrong."""
    sign = int(monitor.sign[0])
    step = int(monitor.step[0])
    retries = int(done.episode.retries[0])
    name = context.planner.phases[int(monitor.phase[0])].name if sign else ""
    when = f", seen in step {step}" if sign else ""
    return (
        f"first sign of failure: {describe_sign(sign, name) if sign else 'none'}{when}; grasps"
        f" tried again: {retries}"
    )


def _compare(
    plan: ReplayPlan,
    done: ReplayedWorld,
    backend: Backend,
    device: str,
    changes: list[str],
    context: RunContext,
) -> tuple[bool, str]:
    """What the gate recorded of this world against what happened now, and whether that keeps what
    is promised.
    """
    record = plan.record
    if record is None:
        return True, f"that run recorded no result, because its {plan.gate} gate did not get there"
    bits = int(record.failed[plan.world])
    rules = context.check.rules
    told = rules.describe(bits) or "succeeded"
    same = bits == done.failed
    if record.backend != backend.value:
        return (
            True,
            (
                f"that run's {record.backend} world had"
                f" {'the same result' if same else f'another result: {told}'}"
            ),
        )
    ours = done.qpos_end
    theirs = record.qpos[plan.world]
    exact = np.array_equal(ours, theirs, equal_nan=True)
    if same and exact:
        return True, "as recorded, and it ends bit for bit where it did"
    apart = max(
        float(np.linalg.norm(ours[a : a + 3] - theirs[a : a + 3]))
        for a in context.index.object_qpos
    )
    ends = (
        "it ends bit for bit where it did"
        if exact
        else f"its cubes end {1e3 * apart:.3g} mm from where they did"
    )
    reasons = []  # why it need not end bit for bit where it did
    if device.startswith("cuda") or record.device.startswith("cuda"):
        reasons.append("runs on CUDA agree to rounding only")
    if (bits | done.failed) & rules["OVERFLOW"]:
        reasons.append("a world alone shares no contact pool")
    if changes:
        reasons.append("not all is as it was in that run")
    if not reasons:
        wanted = "" if exact else ", expected bit for bit there"
        return False, f"NOT as recorded ({'the same result' if same else told}): {ends}{wanted}"
    why = ", and ".join(["", *reasons])
    return True, (
        f"as recorded, but {ends}{why}" if same else f"NOT as recorded ({told}): {ends}{why}"
    )


JOB = Job(check_replay, run_replay_job, keys=KEYS)
