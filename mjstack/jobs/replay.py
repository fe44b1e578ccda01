"""Job *replay*: one world of an earlier run again, rule by rule."""

import math
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from mjstack.config.schema import Backend, Config, SimCfg
from mjstack.envs import driven_config
from mjstack.episodes.batches import BatchPlan, play_batches
from mjstack.episodes.earlier_run import EarlierRun, archived_starts
from mjstack.episodes.failures import FailureMonitor, describe_sign
from mjstack.episodes.record import EpisodeRecord
from mjstack.episodes.replay import WorldTrace
from mjstack.episodes.rollout import Episode, require_episode
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError, DeviceError, FolderError, shorten
from mjstack.files import write_atomic, write_npz
from mjstack.gates.episodes import gate_config
from mjstack.gates.runner import run_guarded
from mjstack.jobs.gates import check_task
from mjstack.jobs.runner import VIEWS, CheckedJob, Job, run_provenance
from mjstack.jobs.showing import check_showing
from mjstack.report.figure import figures
from mjstack.report.record import GateResult, Status
from mjstack.sim import resolve_backend, resolve_device

_COMPARED = {  # besides versions, on which a result or its last bits depend
    "git_commit": "mjstack's commit",
    "cpu": "the processor",
    "policy": "the policy",
    "model_sha256": "the compiled model",
}
# [m, rad], and of quaternions: backends differ by rounding, another start by more
_SAME_START = 1e-6
_NATIVE = (Backend.native, "cpu")


@dataclass(frozen=True, kw_only=True)
class _Plan:
    """A world to be played again."""

    run: EarlierRun
    gate: str  # whose world it is
    seed: int
    world: int
    record: EpisodeRecord  # of the seed
    # Backend and device, each played once; the first is the run's unless ``sim`` says otherwise.
    where: list[tuple[Backend, str]]
    stage: Stage  # with the configuration that the gate played under, on the first backend here


def _plan_replay(cfg: Config) -> _Plan:
    """Read what ``run`` and ``world`` name.

    Raises:
        ConfigError: The run has no such world.
        FolderError: The run, or its record, cannot be read.
    """
    for key, expected in (("run", "the folder of an earlier run"), ("world", "one of its worlds")):
        if getattr(cfg, key) is None:
            fix = "Write mjstack job=replay run=outputs/DATE/TIME world=17"
            raise ConfigError(key, "null", f"{expected}, because job=replay plays one again", fix)
    resolve_backend(cfg)  # what this command line asks for must be there
    run = EarlierRun.read(str(cfg.run))

    # The world: [gate:][seed:]number
    *heads, tail = str(cfg.world).split(":")
    gates = run.cfg.episode_gates
    gate = heads.pop(0) if heads and not heads[0].isdigit() else gates[0] if gates else ""
    seeds = range(run.cfg.seed, run.cfg.seed + (run.cfg.gate[gate].seeds if gate in gates else 0))
    seed = int(heads[0]) if heads else run.cfg.seed
    world = int(tail)
    expected = ""
    if gate not in gates:
        expected = f"a world of a gate that run had, {' or '.join(gates) or 'but it had none'}"
    elif seed not in seeds:
        expected = f"a seed from {seeds[0]} to {seeds[-1]}, as that run has (seed:world)"
    elif world >= run.cfg.nworld:
        expected = f"a world from 0 to {run.cfg.nworld - 1}, as that run has"
    if expected:
        raise ConfigError("world", cfg.world, expected)
    record = run.record(seed, gate)

    # How it is played here
    played = gate_config(archived_starts(run.cfg, run.folder), gate)
    where = _choose(cfg.sim, record)
    backend, device = where[0]
    sim = SimCfg(backend=backend, device=device, step=cfg.sim.step)
    # The folder may be a stranger's: what a replay does not play is not built.
    played = replace(driven_config(played), sim=sim, view=cfg.view, video=cfg.video, web=cfg.web)
    return _Plan(
        run=run,
        gate=gate,
        seed=seed,
        world=world,
        record=record,
        where=where,
        stage=Stage(played),
    )


def _choose(requested: SimCfg, record: EpisodeRecord) -> list[tuple[Backend, str]]:
    """Backends and devices to play on."""
    auto = requested.backend is Backend.auto
    backend = Backend(record.backend) if auto else requested.backend
    if backend is Backend.native:
        return [_NATIVE]
    device = resolve_device(requested.device)
    if requested.device == "auto" and record.backend == "mjwarp":
        with suppress(DeviceError):  # it is not here
            device = resolve_device(record.device)
    return [(backend, device), *([_NATIVE] if auto else [])]


def _check_start(plan: _Plan) -> None:
    """Check that the world would start where it did in that run.

    Raises:
        FolderError: It would start elsewhere.
    """
    stage = plan.stage
    recorded = plan.record.worlds["start_qpos"][plan.world]
    # Native first, which takes less time to load. Rounding may have MJWarp draw otherwise.
    for backend, device in dict.fromkeys([_NATIVE, plan.where[0]]):
        with closing(stage.simulate_alone(backend, device)) as sim:
            stage.start(sim, stage.cfg.reset, seed=plan.seed, worlds=[plan.world])
            start = sim.qpos[0].cpu().numpy()
            same = start.shape == recorded.shape
            distance = float(np.abs(start - recorded).max()) if same else math.inf
        if distance <= _SAME_START:
            return
    raise FolderError(
        f"run={plan.run.folder}: world {plan.world} of seed {plan.seed} would start up to"
        f" {distance:.3g} (m, rad) from where it did, expected its own start",
        f"Use mjstack at {plan.run.provenance.get('git_commit')}",
    )


def check_replay(cfg: Config) -> CheckedJob:
    """Raise for what cannot be replayed, before anything is written."""
    plan = _plan_replay(cfg)
    stage = plan.stage
    require_episode(stage.cfg)
    check_task(stage)
    check_showing(stage.cfg)
    _check_start(plan)
    title = f"replay of world {plan.world} of seed {plan.seed} of {plan.run.folder}"
    return CheckedJob(stage=stage, title=title, work=partial(_replay_all, plan))


def _replay_all(plan: _Plan, run: Run, folder: Path) -> None:
    """Play on the run's backend and, where that was MJWarp, on native MuJoCo too."""
    played = OmegaConf.structured(replace(run.cfg, seed=plan.seed))
    write_atomic(folder / "replayed_config.yaml", OmegaConf.to_yaml(played))
    changes = _changes(plan.run.provenance, run_provenance(run.stage))
    for line in changes:
        run.print_line(line)
    for number, (backend, _) in enumerate(plan.where):
        run_guarded(run, f"replay_{backend}", partial(_replay, plan, number, changes, folder))


def _changes(recorded: dict, current: dict) -> list[str]:
    """Facts that differ from the earlier run's and could change a result, or its last bits."""
    original, replayed = (
        identity["versions"] | {meaning: identity.get(key) for key, meaning in _COMPARED.items()}
        for identity in (recorded, current)
    )
    return [
        f"{name} was {shorten(str(original[name]), 100)} in that run and is {value} now"
        for name, value in replayed.items()
        if name in original and original[name] != value
    ]


def _replay(
    plan: _Plan, number: int, changes: list[str], folder: Path, run: Run
) -> list[GateResult]:
    """Play the world on one backend, and compare the result with the recorded one."""
    first = number == 0
    backend, device = plan.where[number]
    stage = run.stage
    check = stage.check
    monitors = [FailureMonitor()] if stage.cfg.gate[plan.gate].reset else []
    trace = WorldTrace()
    observers = [trace, *monitors]
    identity = {"seed": plan.seed, "world": plan.world}
    plans = [BatchPlan(plan.seed, [plan.world])]
    batches = play_batches(stage, plans, alone=(backend, device), observers=lambda _: observers)
    with closing(batches):
        episode = next(batches).episode
        lines = trace.explain(episode)
        qpos = trace.arrays["qpos"]
        result, headline = run.judge_one(f"replay_{backend}", episode)
        title = f"world {plan.world} of seed {plan.seed}, replayed ({backend})" if first else ""
        label = f"{plan.world}, {backend}"
        run.show_world(f"replay_{backend}", label, qpos, episode, trace.env, title)
    agrees, comparison = _compare(plan, number, episode, qpos[-1], changes, run)
    lines += [_first_sign(monitor, episode) for monitor in monitors]
    for line in lines:
        run.print_line(f"  {line}")
    name = "trajectory.npz" if first else f"trajectory_{backend}.npz"
    ends = {"backend": episode.description, "failed": int(episode.failed[0])}
    write_npz(folder / name, identity | ends | trace.arrays)
    recorded = check.rules.describe(int(plan.record.failed[plan.world])) or "succeeded"
    result.status = result.status if agrees else Status.failed
    result.reason = f"{result.reason or f'succeeded, {headline}'}; {comparison}"
    result.figures = figures(**identity) + result.figures
    result.notes = {"backend": episode.description, "recorded": recorded, "trajectory": name}
    result.details = lines + changes
    return [result]


def _first_sign(monitor: FailureMonitor, episode: Episode) -> str:
    """The first sign of failure, as the success gate reports it."""
    sign = int(monitor.sign[0])
    text = "none"
    if sign:
        phases = monitor.driver.phases
        phase = phases[int(monitor.phase[0])].name if phases else ""
        text = f"{describe_sign(sign, phase)}, seen in step {int(monitor.step[0])}"
    return f"first sign of failure: {text}; grasps tried again: {int(episode.retries[0])}"


def _compare(
    plan: _Plan, number: int, episode: Episode, end: np.ndarray, changes: list[str], run: Run
) -> tuple[bool, str]:
    """Whether the world did as promised, and how it, at ``end``, compares with its record."""
    backend, device = plan.where[number]
    record = plan.record
    rules = run.stage.check.rules
    bits = int(record.failed[plan.world])
    replayed = int(episode.failed[0])
    same = bits == replayed
    result = "the same result" if same else rules.describe(bits) or "succeeded"
    if record.backend != backend:
        prefix = "" if same else "another result: "
        return True, f"that run's {record.backend} world had {prefix}{result}"
    recorded_end = record.qpos[plan.world]
    exact = np.array_equal(end, recorded_end, equal_nan=True)
    if same and exact:
        return True, "as recorded, and it ends bit for bit where it did"

    possible_reasons = {  # why it need not end bit for bit where it did
        "runs on CUDA agree to rounding only": "cuda" in device + record.device,
        "a world alone shares no contact pool": (bits | replayed) & rules["OVERFLOW"],
        "not all is as it was in that run": changes,
    }
    reasons = [reason for reason, applies in possible_reasons.items() if applies]
    ends = "it ends bit for bit where it did"
    if not exact:
        offset = end - recorded_end
        most = max(float(np.linalg.norm(offset[a : a + 3])) for a in run.stage.index.object_qpos)
        ends = f"its objects end {1e3 * most:.3g} mm from where they did"
        if not reasons:
            ends += ", expected bit for bit there"
    why = "".join(f", and {reason}" for reason in reasons)
    agrees = "as recorded, but" if same and reasons else f"NOT as recorded ({result}):"
    return bool(reasons), f"{agrees} {ends}{why}"


_KEYS = ("job", "run", "world", "sim", "view", "video", "web")
JOB = Job(check_replay, keys=_KEYS, views=VIEWS)
