"""Job *replay*: one world of an earlier run's batch again, alone, with its trajectory kept and
every rule explained.
"""

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from mjstack.config.schema import Backend, Config, SimCfg
from mjstack.envs import driven_config
from mjstack.episodes.context import RunContext, judge_one, require_episode
from mjstack.episodes.earlier_run import EarlierRun, archived_starts, copy_names
from mjstack.episodes.failures import FailureMonitor, describe_sign
from mjstack.episodes.motion import show_world
from mjstack.episodes.record import EpisodeRecord
from mjstack.episodes.replay import ReplayedWorld, replay_world, start_of_world
from mjstack.errors import ConfigError, DeviceError, RunError
from mjstack.files import write_atomic, write_npz
from mjstack.gates.runner import run_guarded
from mjstack.gates.success import success_config
from mjstack.jobs.gates import check_task
from mjstack.jobs.replay_failing import Failing, replay_failing
from mjstack.jobs.runner import CheckedJob, Job, run_provenance
from mjstack.jobs.showing import check_showing
from mjstack.mdp.starts.placement import SCHEMA
from mjstack.report.record import GateResult, Status
from mjstack.sim import resolve_backend, resolve_device

_PLACES = {
    "git_commit": "mjstack's commit",
    "cpu": "the processor",
}  # besides versions, what arithmetic depends on
_SAME_START = (
    1e-6  # [m, rad], and of quaternions: backends differ by rounding, another start by more
)


@dataclass(frozen=True, kw_only=True, slots=True)
class ReplayPlan:
    """One world to be played again.

    Attributes:
        run: The earlier run.
        gate: Whose world it is, ``batch`` or ``success``.
        seed: The seed.
        world: The world's number.
        where: Backend and device, each played once; the first is the earlier run's unless ``sim``
            says otherwise.
        record: The result of the gate.
        context: The configuration that the gate played under, on the first backend here.
    """

    run: EarlierRun
    gate: str
    seed: int
    world: int
    where: list[tuple[Backend, str]]
    record: EpisodeRecord
    context: RunContext


def check_replay(cfg: Config) -> CheckedJob:
    """Raise for what cannot be replayed, before anything is written."""
    failing = _failing(cfg)
    plan = _plan(cfg if failing is None else replace(cfg, world=failing.first))
    context = plan.context
    require_episode(context.cfg)
    check_task(context)
    check_showing(context.cfg)
    _check_start(plan)
    if failing is not None:
        if cfg.view != "false" or cfg.video:
            expected = "one world, such as 17, which view and video show"
            raise ConfigError("world", cfg.world, expected)
        return CheckedJob(
            context=context,
            title=f"replay of {len(failing)} failing worlds of {plan.run.folder}",
            work=partial(replay_failing, failing, plan.where),
            spreads=True,
        )
    nworld = context.cfg.nworld
    title = f"replay of world {plan.world} of {nworld}, seed {plan.seed}, of {plan.run.folder}"
    return CheckedJob(context=context, title=title, work=partial(_replay_all, plan))


def _replay_all(plan: ReplayPlan, context: RunContext, folder: Path) -> None:
    """Play the world on its run's backend and, where that was MJWarp, on native MuJoCo too."""
    played = OmegaConf.structured(replace(context.cfg, seed=plan.seed))
    write_atomic(folder / "replayed_config.yaml", OmegaConf.to_yaml(played))
    changes = _changes(plan.run.provenance, run_provenance(context))
    for line in changes:
        context.print_line(line)
    for number, (backend, _) in enumerate(plan.where):
        run_guarded(context, f"replay_{backend}", partial(_replay, plan, number, changes))


def _failing(cfg: Config) -> Failing | None:
    """The failing worlds, where all of them are asked for."""
    gate, _, which = (cfg.world or "").rpartition(":")
    if which != "failing" or cfg.run is None:
        return None
    run = EarlierRun.read(cfg.run)
    had = [name for name in ("batch", "success") if name in run.cfg.gates]
    if (gate or had[:1]) and (not gate or gate in had):
        return Failing.of(run, gate or had[0])
    expected = f"failing worlds of a gate that run had, {' or '.join(had) or 'but it had none'}"
    raise ConfigError("world", cfg.world, expected)


def _plan(cfg: Config) -> ReplayPlan:
    for key, expected in (("run", "the folder of an earlier run"), ("world", "one of its worlds")):
        if getattr(cfg, key) is None:
            fix = "Write job=replay run=outputs/<date>/<time> world=17"
            raise ConfigError(key, "null", f"{expected}, because job=replay plays one again", fix)
    resolve_backend(cfg)  # what this command line asks for must be there
    run = EarlierRun.read(str(cfg.run))

    # The world: [gate:][seed:]number
    *heads, tail = str(cfg.world).split(":")
    world = int(tail)
    had = [gate for gate in ("batch", "success") if gate in run.cfg.gates]
    gate = heads.pop(0) if heads and not heads[0].isdigit() else (had or ["batch"])[0]
    first = run.cfg.seed
    last = first + run.cfg.gate[gate].seeds - 1
    seed = int(heads[0]) if heads else first
    expected = ""
    if gate not in had:
        expected = f"a world of a gate that run had, {' or '.join(had) or 'but it had none'}"
    elif not first <= seed <= last:
        expected = f"a seed from {first} to {last}, as that run has (seed:world)"
    elif world >= run.cfg.nworld:
        expected = f"a world from 0 to {run.cfg.nworld - 1}, as that run has"
    if expected:
        raise ConfigError("world", cfg.world, expected)
    record = run.record(seed, gate)

    # How it is played here
    played = archived_starts(run.cfg, run.folder)
    if gate == "success":
        played = success_config(played)
    where = _choose(cfg.sim, record)
    backend, device = where[0]
    sim = SimCfg(backend=backend, device=device, step=cfg.sim.step)
    return ReplayPlan(
        run=run,
        gate=gate,
        # The folder may be a stranger's: what a replay does not play is not built.
        context=RunContext(
            replace(driven_config(played), sim=sim, view=cfg.view, video=cfg.video, web=cfg.web)
        ),
        seed=seed,
        world=world,
        where=where,
        record=record,
    )


def _choose(asked: SimCfg, record: EpisodeRecord) -> list[tuple[Backend, str]]:
    """Backends and devices to play on."""
    native = (Backend.native, "cpu")
    backend = Backend(record.backend) if asked.backend is Backend.auto else asked.backend
    if backend is Backend.native:
        return [native]
    device = resolve_device(asked.device)
    if asked.device == "auto" and record.backend == "mjwarp":
        with suppress(DeviceError):  # it is not here
            device = resolve_device(record.device)
    return [(backend, device), *([native] if asked.backend is Backend.auto else [])]


def _check_start(plan: ReplayPlan) -> None:
    """Raise if the world would start elsewhere than it did in that run."""
    then = plan.record.start[plan.world]
    off = math.inf
    # MJWarp takes longer to load than the native start does to compute, and rounding may have it
    # draw otherwise.
    for backend, device in dict.fromkeys([(Backend.native, "cpu"), plan.where[0]]):
        now = start_of_world(
            plan.context, seed=plan.seed, world=plan.world, backend=backend, device=device
        )
        off = float(np.abs(now - then).max()) if now.shape == then.shape else math.inf
        if off <= _SAME_START:
            return
    copies = ", ".join(copy_names(plan.run.cfg).values())
    commit = plan.run.provenance.get("git_commit")
    fix = f"Put back what it started from, as {copies}" if copies else f"Use mjstack at {commit}"
    if not copies and (then_drawn := plan.run.provenance.get("starts_schema", 1)) != SCHEMA:
        fix = f"Random starts are drawn otherwise now (schema {SCHEMA}, not {then_drawn}). {fix}"
    raise RunError(
        f"run={plan.run.folder}: world {plan.world} of seed {plan.seed} would start up to {off:.3g}"
        f" (m, rad) from where it did, expected its own start. {fix}."
    )


def _changes(then: dict, now: dict) -> list[str]:
    """Facts that differ from the earlier run's and could change a result, or its last bits."""
    before, here = (
        one["versions"] | {name: one.get(key) for key, name in _PLACES.items()}
        for one in (then, now)
    )
    lines = [
        f"{name} was {before[name]} in that run and is {value} now"
        for name, value in here.items()
        if name in before and before[name] != value
    ]
    if then.get("policy") != now.get("policy"):
        lines.append("the policy is not the same as in that run: it was written anew")
    if then.get("model_sha256") != now["model_sha256"]:
        lines.append("the compiled model is not the same as in that run: this is another physics")
    return lines


def _replay(
    plan: ReplayPlan, number: int, changes: list[str], context: RunContext
) -> list[GateResult]:
    """Play the world on one backend, and compare the result with the recorded one."""
    first = number == 0
    backend, device = plan.where[number]
    monitors = [FailureMonitor()] if plan.gate == "success" else []
    done = replay_world(
        context,
        seed=plan.seed,
        world=plan.world,
        backend=backend,
        device=device,
        observers=[*(context.viewers if first else []), *monitors],
    )
    rules = context.check.rules
    status, reason, metrics = judge_one(context, done.episode)
    kept, compared = _compare(plan, done, backend, device, changes, context)
    reason = f"{reason or f'succeeded, {context.check.headline(metrics)}'}; {compared}"
    bad = status is Status.failed
    if not kept:
        status = Status.failed
    show_world(context, f"replay_{backend}", f"{plan.world}, {backend}", done.recorder, failed=bad)
    if first:
        title = f"world {plan.world} of seed {plan.seed}, replayed ({backend})"
        context.artifacts.shown = (title, done.recorder)
    told = [*done.findings, *(_first_sign(monitor, done, context) for monitor in monitors)]
    for line in told:
        context.print_line(f"  {line}")
    name = "trajectory.npz" if first else f"trajectory_{backend}.npz"
    assert context.folder is not None
    write_npz(context.folder / name, done.arrays)
    recorded = rules.describe(int(plan.record.failed[plan.world])) or "succeeded"
    return [
        GateResult(
            name=f"replay_{backend}",
            status=status,
            reason=reason,
            thresholds=context.check.thresholds(),
            metrics={"seed": plan.seed, "world": plan.world, **metrics},
            notes={"backend": done.episode.description, "recorded": recorded, "trajectory": name},
            details=told + changes,
        )
    ]


def _first_sign(monitor: FailureMonitor, done: ReplayedWorld, context: RunContext) -> str:
    """The first sign of failure, as the success gate reports it."""
    sign = int(monitor.sign[0])
    seen = "none"
    if sign:
        names = [phase.name for phase in monitor.driver.phases] or [""]
        phase = names[int(monitor.phase[0])]
        seen = f"{describe_sign(sign, phase)}, seen in step {int(monitor.step[0])}"
    retries = int(done.episode.retries[0])
    return f"first sign of failure: {seen}; grasps tried again: {retries}"


def _compare(
    plan: ReplayPlan,
    done: ReplayedWorld,
    backend: Backend,
    device: str,
    changes: list[str],
    context: RunContext,
) -> tuple[bool, str]:
    """Whether the world did what is promised after its record, and how it compares."""
    record = plan.record
    rules = context.check.rules
    bits = int(record.failed[plan.world])
    now = int(done.episode.failed[0])
    same = bits == now
    result = "the same result" if same else rules.describe(bits) or "succeeded"
    if record.backend != backend:
        another = "" if same else "another result: "
        return True, f"that run's {record.backend} world had {another}{result}"
    ours = done.recorder.qpos[-1]
    theirs = record.qpos[plan.world]
    exact = np.array_equal(ours, theirs, equal_nan=True)
    if same and exact:
        return True, "as recorded, and it ends bit for bit where it did"

    # Why it need not end bit for bit where it did
    reasons = []
    if "cuda" in device + record.device:
        reasons.append("runs on CUDA agree to rounding only")
    if (bits | now) & rules["OVERFLOW"]:
        reasons.append("a world alone shares no contact pool")
    if changes:
        reasons.append("not all is as it was in that run")
    ends = "it ends bit for bit where it did"
    if not exact:
        objects = [slice(a, a + 3) for a in context.index.object_qpos]
        apart = max(float(np.linalg.norm(ours[at] - theirs[at])) for at in objects)
        ends = f"its objects end {1e3 * apart:.3g} mm from where they did"
        if not reasons:
            ends += ", expected bit for bit there"
    why = "".join(f", and {reason}" for reason in reasons)
    agrees = "as recorded, but" if same and reasons else f"NOT as recorded ({result}):"
    return bool(reasons), f"{agrees} {ends}{why}"


JOB = Job(
    check_replay,
    keys=("job", "run", "world", "sim", "view", "video", "web", "devices"),
    shows=True,
    live=True,
)
