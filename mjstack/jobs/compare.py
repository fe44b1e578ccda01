"""Job *compare*: two policies, drivers or settings play the episodes of gate *success* from equal
starts, and McNemar's test says which is better.
"""

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.config.fingerprint import config_content, differences
from mjstack.config.load import load_config
from mjstack.config.schema import Backend, Config
from mjstack.episodes.batches import BatchPlan, play_batches
from mjstack.episodes.motion import motion_recorder, moving_worlds
from mjstack.episodes.rollout import require_episode
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Stage
from mjstack.episodes.tally import rate_metrics
from mjstack.errors import ConfigError, MjstackError
from mjstack.files import to_csv, write_atomic
from mjstack.gates.episodes import gate_config
from mjstack.gates.runner import run_guarded
from mjstack.jobs.gates import check_machine
from mjstack.jobs.runner import CheckedJob, Job
from mjstack.math import mcnemar_p_value
from mjstack.mdp.starts.starts_file import start_arrays
from mjstack.report.page import World
from mjstack.report.record import GateResult, Status
from mjstack.report.sweep_picture import Plot, save_sweep
from mjstack.report.table import Table

NAME = "compare"
GATE = "success"  # whose episodes are played
TABLE = "compare.csv"
_SIDES = ("a", "b")
_PAGE_WORLDS = 8  # worlds on the page that only one side won, of each side
_LEVEL = 0.05  # of significance
_ENDS = {"min": "low", "max": "high"}  # of the picture's whiskers, in metrics of a rate
_ROUNDING = 1e-6  # [m, rad], by which equal starts on two backends or devices may differ
_PANELS = {
    "success rate, 95 % interval": "success_rate",
    "episodes that only this one won": "only",
}

Sides = Mapping[str, Stage]


def check_compare(cfg: Config, overrides: Sequence[str]) -> CheckedJob:
    """Raise for sides that cannot be played here or do not start alike, before anything is
    written. The overrides are the command line's.
    """
    against = cfg.job.against
    if not against:
        expected = 'what the second side changes, such as ["controller=policy","policy=DIR"]'
        raise ConfigError("job.against", "[]", expected)
    changed = {"job.against", *map(_key, against)}
    unchanged = [override for override in overrides if _key(override) not in changed]
    sides: dict[str, Stage] = {}
    facts = []
    notes = {}
    for name, side in zip(_SIDES, (cfg, load_config([*unchanged, *against])), strict=True):
        content = config_content(side)
        equal = {key: content[key] for key in ("task", "nworld", "seed")}
        seeds = {f"{GATE}.seeds": side.gate.success.seeds}
        facts.append(equal | {"robot": side.robot.name, "gate": seeds})
        if changes := differences(facts[-1], facts[0]):
            expected = f"the same robot, task, worlds and seeds ({changes})"
            raise ConfigError("job.against", against, expected)
        require_episode(side)
        stage = check_machine(replace(side, gates=[GATE]))
        sides[name] = stage.with_config(gate_config(stage.cfg, GATE))
        driver = (sides[name].cfg.controller.name, content["policy"])
        notes[name] = " ".join(filter(None, driver))
    first, second = map(_start_of_first_world, sides.values())
    if first.keys() != second.keys() or any((first[k] != second[k]).any() for k in first):
        raise ConfigError("job.against", against, "equal starts, which these keys change")
    notes["b"] += f", {' '.join(against)}"
    title = f"task {cfg.task.name}, a against b ({' '.join(against)})"
    return CheckedJob(
        stage=sides["a"],
        title=title,
        work=lambda run, folder: run_guarded(run, NAME, partial(_compare, sides, notes, folder)),
    )


def _key(override: str) -> str:
    return override.lstrip("+~").partition("=")[0]


def _start_of_first_world(stage: Stage) -> dict[str, np.ndarray]:
    """How world 0 of the first seed starts on native MuJoCo, by the arrays of a starts file."""
    with closing(stage.simulate_alone(Backend.native, "cpu")) as sim:
        return start_arrays(stage.start(sim, stage.cfg.reset, worlds=[0]))


def _compare(sides: Sides, notes: Mapping[str, str], folder: Path, run: Run) -> list[GateResult]:
    """Play both sides and compare them: it passes if the comparison was made."""
    for stage in sides.values():
        stage.progress = run.stage.progress
    (failed_a, starts_a), (failed_b, starts_b) = (_play(*side) for side in sides.items())
    rounding = _ROUNDING if sides["a"].backend != sides["b"].backend else 0.0
    if not np.abs(starts_a - starts_b).max() <= rounding:
        raise MjstackError("a and b did not start alike", "Leave what worlds start from unchanged")

    # Episodes that only one side won, and the rules that the other one broke there
    rules = run.stage.check.rules
    m: dict[str, float] = {"episodes": failed_a.size}
    bars = []
    rows: list[dict[str, Any]] = []
    moving: list[dict[str, Any]] = []
    for name, bits, lost in (("a", failed_a, failed_b), ("b", failed_b, failed_a)):
        alone = (bits == 0) & (lost != 0)
        rate = rate_metrics(int((bits == 0).sum()), bits.size)
        m |= {f"only_{name}": int(alone.sum()), **{f"{name}.{key}": v for key, v in rate.items()}}
        broken = rules.failing(lost[alone])
        m |= {f"only_{name}.failed.{rule}": len(worlds) for rule, worlds in broken.items()}
        ends = {f"success_rate_{end}": rate[f"success_rate_{at}95"] for end, at in _ENDS.items()}
        bars.append({"side": name, "status": "pass", "only": m[f"only_{name}"]} | rate | ends)
        won = [
            {"seed": run.cfg.seed + seed, "world": world, "succeeded": name}
            | {"rules": " ".join(rules.broken(lost[seed, world]))}
            for seed, world in np.argwhere(alone).tolist()
        ]
        rows += won
        moving += won[:_PAGE_WORLDS]
    write_atomic(folder / TABLE, to_csv(rows, ("seed", "world", "succeeded", "rules")))
    if run.page.motion:
        run.page.worlds3d[NAME] = _replay(sides, moving)

    # The result
    m["both"] = m["a.succeeded"] - m["only_a"]
    m["neither"] = m["episodes"] - m["a.succeeded"] - m["only_b"]
    m["p_value"] = p_value = mcnemar_p_value(int(m["only_a"]), int(m["only_b"]))
    verdict = "no difference is shown"
    if p_value < _LEVEL:
        verdict = f"{'a' if m['only_a'] > m['only_b'] else 'b'} is better"
    plot = Plot(title=f"{run.page.title}: {verdict}", over="side", lines=[], panels=_PANELS)
    run.draw(f"{NAME}.png", save_sweep, plot, bars)
    counts = {rule: [int(m.get(f"only_{s}.failed.{rule}", 0)) for s in _SIDES] for rule in rules}
    table = Table(
        title="Episodes that only one side won, by the rules that the other one broke",
        header=["rule", "meaning", "only a", "only b"],
        rows=[[rule, rules.texts[rule], *map(str, n)] for rule, n in counts.items() if any(n)],
    )
    return [
        GateResult(
            name=NAME,
            status=Status.passed,
            reason=f"{verdict} (McNemar's exact test, p = {p_value:.3g}): of {m['episodes']}"
            f" episodes a succeeded in {m['a.succeeded']} and b in {m['b.succeeded']}, only a in"
            f" {m['only_a']}, only b in {m['only_b']}",
            metrics=m,
            notes={**notes, "table": TABLE},
            tables=[table] if table.rows else [],
        )
    ]


def _play(name: str, stage: Stage) -> tuple[np.ndarray, np.ndarray]:
    """Play a side: the bits of the rules that each episode broke, shape ``(seeds, nworld)``, and
    positions at the starts, shape ``(seeds, nworld, nq)``.
    """
    cfg = stage.cfg
    seeds = range(cfg.seed, cfg.seed + cfg.gate.success.seeds)
    plans = [BatchPlan(seed, range(cfg.nworld)) for seed in seeds]
    played = []
    for batch in play_batches(stage, plans, label=f"steps of {name}"):
        played.append((batch.episode.failed, batch.episode.start))
        count = f"{int(batch.succeeded.sum())} of {cfg.nworld} worlds succeeded"
        stage.progress.print_line(f"{name}, seed {batch.plan.seed}: {count}")
    failed, starts = zip(*played, strict=True)
    return np.stack(failed), np.stack(starts)


def _replay(sides: Sides, rows: Sequence[Mapping[str, Any]]) -> list[World]:
    """Some worlds in motion, each as a plays it and as b does."""
    episodes = sorted((row["seed"], row["world"]) for row in rows)
    groups = groupby(episodes, key=itemgetter(0))
    plans = [BatchPlan(seed, [world for _, world in group]) for seed, group in groups]
    moving: dict[str, list[World]] = {name: [] for name in sides}
    for name, stage in sides.items():
        channels = motion_recorder(stage.cfg.timing.step_dt).channels
        for batch in play_batches(stage, plans, channels, alone=stage.backend):
            labels = [f"{batch.plan.seed}:{world} {name}" for world in batch.plan.worlds]
            failed, qpos = batch.episode.failed, batch.rows["qpos"]
            moving[name] += moving_worlds(stage, batch.env, qpos, failed, dict(enumerate(labels)))
    return [world for pair in zip(*moving.values(), strict=True) for world in pair]


JOB = Job(check_compare, overrides=True)
