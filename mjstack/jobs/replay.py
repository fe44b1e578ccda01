"""Job *replay*: worlds of an earlier run again. One world alone, with its trajectory kept and every
rule explained; or all failing ones, with a table that says whether they fail again.
"""

from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from mjstack.config.schema import Backend, Config
from mjstack.episodes.batches import BatchPlan, play_batches
from mjstack.episodes.failures import FailureMonitor, describe_sign
from mjstack.episodes.replay import WorldTrace, simulate_alone
from mjstack.episodes.rollout import Episode, require_episode
from mjstack.episodes.run import Run
from mjstack.episodes.tally import rate_cells
from mjstack.errors import ConfigError
from mjstack.files import to_csv, write_atomic, write_npz
from mjstack.gates.runner import run_guarded
from mjstack.jobs.gates import check_task
from mjstack.jobs.replay_plan import ReplayPlan, check_start, plan_replay
from mjstack.jobs.runner import VIEWS, CheckedJob, Job, run_provenance
from mjstack.jobs.showing import check_showing
from mjstack.report.record import GateResult, Status
from mjstack.report.table import Table
from mjstack.sim import resolve_device

TABLE = "replayed_worlds.csv"
_TABLE_ROWS = 100  # worlds in report.md
# Besides versions, what arithmetic depends on
_PLACES = {"git_commit": "mjstack's commit", "cpu": "the processor"}


def check_replay(cfg: Config) -> CheckedJob:
    """Raise for what cannot be replayed, before anything is written."""
    plan = plan_replay(cfg)
    stage = plan.stage
    require_episode(stage.cfg)
    check_task(stage)
    check_showing(stage.cfg)
    check_start(plan)
    nworld = stage.cfg.nworld
    title = f"replay of world {plan.world} of {nworld}, seed {plan.seed}, of {plan.run.folder}"
    if plan.failing:
        if cfg.view != "false" or cfg.video:
            expected = "one world, such as 17, which view and video show"
            raise ConfigError("world", cfg.world, expected)
        count = sum(map(len, plan.bits.values()))
        title = f"replay of {count} failing worlds of {plan.run.folder}"
    work = partial(_replay_failing if plan.failing else _replay_one, plan)
    return CheckedJob(stage=stage, title=title, work=work, spreads=plan.failing)


def _replay_one(plan: ReplayPlan, run: Run, folder: Path) -> None:
    """Play the world on its run's backend and, where that was MJWarp, on native MuJoCo too."""
    played = OmegaConf.structured(replace(run.cfg, seed=plan.seed))
    write_atomic(folder / "replayed_config.yaml", OmegaConf.to_yaml(played))
    changes = _changes(plan.run.provenance, run_provenance(run.stage))
    for line in changes:
        run.print_line(line)
    for number, (backend, _) in enumerate(plan.where):
        run_guarded(run, f"replay_{backend}", partial(_replay, plan, number, changes, folder))


def _changes(recorded: dict, current: dict) -> list[str]:
    """Facts that differ from the earlier run's and could change a result, or its last bits."""
    before, now = (
        facts["versions"] | {name: facts.get(key) for key, name in _PLACES.items()}
        for facts in (recorded, current)
    )
    lines = [
        f"{name} was {before[name]} in that run and is {value} now"
        for name, value in now.items()
        if name in before and before[name] != value
    ]
    if recorded.get("policy") != current.get("policy"):
        lines.append("the policy is not the same as in that run: it was written anew")
    if recorded.get("model_sha256") != current["model_sha256"]:
        lines.append("the compiled model is not the same as in that run: this is another physics")
    return lines


def _replay(
    plan: ReplayPlan, number: int, changes: list[str], folder: Path, run: Run
) -> list[GateResult]:
    """Play the world on one backend, and compare the result with the recorded one."""
    first = number == 0
    backend, device = plan.where[number]
    stage = run.stage
    check = stage.check
    monitors = [FailureMonitor()] if plan.gate == "success" else []
    trace = WorldTrace()
    observers = [trace, *(run.viewers if first else []), *monitors]
    facts = {"seed": plan.seed, "world": plan.world}
    with closing(simulate_alone(stage, backend, device)) as sim:
        episode = stage.play(sim, stage.cfg.reset, observers, seed=plan.seed, worlds=[plan.world])
        lines = trace.explain(episode)
        qpos = trace.arrays["qpos"]
        status, reason, metrics, beyond = run.judge_one(episode)
        title = f"world {plan.world} of seed {plan.seed}, replayed ({backend})" if first else ""
        run.show_world(f"replay_{backend}", f"{plan.world}, {backend}", qpos, status, sim, title)
    agrees, comparison = _compare(plan, number, episode, qpos[-1], changes, run)
    lines += [_first_sign(monitor, episode) for monitor in monitors]
    for line in lines:
        run.print_line(f"  {line}")
    name = "trajectory.npz" if first else f"trajectory_{backend}.npz"
    ends = {"backend": episode.description, "failed": int(episode.failed[0])}
    write_npz(folder / name, facts | ends | trace.arrays)
    recorded = check.rules.describe(plan.bits[plan.seed][plan.world]) or "succeeded"
    return [
        GateResult(
            name=f"replay_{backend}",
            status=status if agrees else Status.failed,
            reason=f"{reason or f'succeeded, {check.headline(metrics)}'}; {comparison}",
            thresholds=check.thresholds(),
            metrics=facts | metrics,
            beyond=beyond,
            notes={"backend": episode.description, "recorded": recorded, "trajectory": name},
            details=lines + changes,
        )
    ]


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
    plan: ReplayPlan, number: int, episode: Episode, end: np.ndarray, changes: list[str], run: Run
) -> tuple[bool, str]:
    """Whether the world did what is promised after its record, and how it compares; ``end`` are its
    positions at the end.
    """
    backend, device = plan.where[number]
    record = plan.record
    rules = run.stage.check.rules
    bits = int(record.failed[plan.world])
    now = int(episode.failed[0])
    same = bits == now
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
        "a world alone shares no contact pool": (bits | now) & rules["OVERFLOW"],
        "not all is as it was in that run": changes,
    }
    reasons = [reason for reason, applies in possible_reasons.items() if applies]
    ends = "it ends bit for bit where it did"
    if not exact:
        apart = end - recorded_end
        most = max(float(np.linalg.norm(apart[a : a + 3])) for a in run.stage.index.object_qpos)
        ends = f"its objects end {1e3 * most:.3g} mm from where they did"
        if not reasons:
            ends += ", expected bit for bit there"
    why = "".join(f", and {reason}" for reason in reasons)
    agrees = "as recorded, but" if same and reasons else f"NOT as recorded ({result}):"
    return bool(reasons), f"{agrees} {ends}{why}"


def _replay_failing(plan: ReplayPlan, run: Run, folder: Path) -> None:
    """Play all failing worlds on each backend, and leave a table; ranks share the seeds."""
    rows: dict[tuple[int, int], dict[str, Any]] = {}
    for number, (backend, _) in enumerate(plan.where):
        play = partial(_play_failing, plan, number, rows, folder)
        run_guarded(run, f"replay_{backend}", play, "worlds")


def _play_failing(
    plan: ReplayPlan, number: int, rows: dict[tuple[int, int], dict], folder: Path, run: Run
) -> list[GateResult]:
    """Play them on one backend: worlds of a seed together, and apart from those that succeeded."""
    backend, device = plan.where[number]
    stage = run.stage
    ranks = stage.ranks
    if ranks.size > 1 and backend is Backend.mjwarp and device.startswith("cuda"):
        device = resolve_device("auto")
    rules = stage.check.rules
    share = list(plan.bits.items())[ranks.rank :: ranks.size]
    batches = play_batches(
        stage,
        [BatchPlan(seed, list(worlds)) for seed, worlds in share],
        simulate=partial(simulate_alone, stage, backend, device),
    )
    played: list[tuple[int, int, int]] = []  # seed, world and bits
    for done, batch in enumerate(batches, 1):
        failed = zip(batch.plan.worlds, batch.episode.failed.tolist(), strict=True)
        played += [(batch.plan.seed, world, bits) for world, bits in failed]
        stage.progress.advance("seeds", done, len(share))
    played = sorted(world for part in ranks.gather(played) for world in part)
    again = sum(bits != 0 for _, _, bits in played)
    same = sum(bits == plan.bits[seed][world] for seed, world, bits in played)
    for seed, world, bits in played:
        row = rows.setdefault((seed, world), {"seed": seed, "world": world})
        row["recorded"] = " ".join(rules.broken(plan.bits[seed][world]))
        row[str(backend)] = " ".join(rules.broken(bits)) or "succeeded"
    if ranks.writes:
        write_atomic(folder / TABLE, to_csv(list(rows.values())))
    rate, interval = rate_cells(again, len(played))
    table_rows = list(rows.values())[:_TABLE_ROWS]
    columns = {name: name for name in table_rows[0]}
    return [
        GateResult(
            name=f"replay_{backend}",
            status=Status.failed if again else Status.passed,
            reason=f"{again} of {len(played)} failing worlds fail again ({rate}, 95 % interval"
            f" {interval}), {same} by the same rules",
            metrics={"worlds": len(played), "fail_again": again, "by_the_same_rules": same},
            notes={"backend": f"{backend} on {device}", "table": TABLE},
            tables=[Table.of(columns, table_rows, f"Failing worlds (all of them: {TABLE})")],
        )
    ]


_KEYS = ("job", "run", "world", "sim", "view", "video", "web", "devices")
JOB = Job(check_replay, keys=_KEYS, views=VIEWS)
