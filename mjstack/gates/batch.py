"""Gate *batch*: every world stacks, or is named with the rule it broke."""

from __future__ import annotations

import numpy as np

from mjstack.errors import name_worlds
from mjstack.gates.gate import GateContext, acceptance_thresholds, failing_rules
from mjstack.report.record import GateResult, Status, Value
from mjstack.tasks.stack import RULE_TEXT


def run_batch(context: GateContext) -> list[GateResult]:
    """Plays the task in nworld worlds that start differently, and judges each."""
    cfg = context.cfg
    sim = context.batch_simulation(cfg.nworld)
    last = context.phase_start(cfg.gate.throughput.from_phase) - 1
    episode = context.run(sim, cfg.reset, snapshots=frozenset([last]))
    context.carry_start = episode.states.get(last)
    verdict = episode.verdict
    failed = verdict.failed.cpu().numpy()
    final = sim.qpos.cpu().numpy()
    bad = np.flatnonzero(failed).tolist()
    # Rounded: on CUDA even identical worlds differ in the last digits.
    distinct = len(np.unique(np.round(final, 4), axis=0))
    steps = cfg.nworld * episode.tape.frames * cfg.timing.substeps
    sizes = getattr(sim, "sizes", None)
    metrics: dict[str, Value] = {
        "backend": sim.description,
        "worlds": cfg.nworld,
        "accepted": cfg.nworld - len(bad),
        "success_rate": 1.0 - len(bad) / cfg.nworld,
        "distinct_final_states": distinct,
        "xy_err_max_m": float(verdict.xy_err.max()),
        "dz_min_m": float(verdict.dz.min()),
        "dz_max_m": float(verdict.dz.max()),
        "peak_speed_max_m_per_s": float(verdict.peak_speed.max()),
        "rest_speed_max_m_per_s": float(verdict.rest_speed.max()),
        "rest_position_max_m": float(verdict.rest_position.max()),
        "rest_rotation_max_deg": float(np.degrees(float(verdict.rest_rotation.max()))),
        "waypoint_error_max_m": float(episode.tape.waypoint_error.max()),
        "peak_contacts_per_world": int(sim.peak_contacts.max()),
        "peak_constraint_rows_per_world": int(sim.peak_constraints.max()),
        "sizes": f"{sizes.as_overrides()} ({sizes.source})" if sizes else "native MuJoCo has no fixed buffers",
        "episode_s": episode.seconds,
        "world_steps_per_s": steps / episode.seconds,
    }
    problems: list[str] = []
    broken = failing_rules(failed)
    for rule, worlds in broken.items():
        metrics[f"failed.{rule.name}"] = len(worlds)
    details = [f"{RULE_TEXT[rule]}: {name_worlds(worlds, cfg.nworld, len(worlds))}" for rule, worlds in broken.items()]
    counts = "; ".join(f"{RULE_TEXT[rule]} in {len(worlds)}" for rule, worlds in broken.items())
    summary = f"{cfg.nworld - len(bad)} of {cfg.nworld} worlds accepted, {distinct} distinct"
    if bad:
        summary += f"; failed: {name_worlds(bad, cfg.nworld)}: {counts}"
    if len(bad) > cfg.gate.batch.failed_worlds:
        problems.append(f"{name_worlds(bad, cfg.nworld)} failed: {counts}")
    if cfg.nworld > 1 and distinct < cfg.gate.batch.distinct_fraction * cfg.nworld:
        problems.append(
            f"only {distinct} distinct final states of {cfg.nworld} worlds: identical worlds prove nothing, use reset=jitter"
        )
    sim.close()
    summary = "; ".join(problems) or summary
    thresholds = acceptance_thresholds(cfg)
    thresholds |= {"failed_worlds": cfg.gate.batch.failed_worlds, "distinct_fraction": cfg.gate.batch.distinct_fraction}
    return [
        GateResult(
            name="batch",
            status=Status.failed if problems else Status.passed,
            reason=summary,
            thresholds=thresholds,
            metrics=metrics,
            details=details,
        )
    ]
