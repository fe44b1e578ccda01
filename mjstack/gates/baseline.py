"""Gate *baseline*: one native world stacks the cubes."""

from __future__ import annotations

import numpy as np

from mjstack.gates.gate import GateContext, acceptance_thresholds, judge_one
from mjstack.report.record import GateResult


def run_baseline(context: GateContext) -> list[GateResult]:
    """Runs the nominal episode on native MuJoCo and judges it."""
    cfg = context.cfg
    sim, episode = context.nominal
    status, reason, metrics = judge_one(episode.verdict)
    context.say(f"stack check: xy_err={metrics['xy_err_m']:.4f} dz={metrics['dz_m']:.4f}")
    metrics["episode_s"] = episode.seconds
    metrics["world_steps_per_s"] = episode.tape.frames * cfg.timing.substeps / episode.seconds
    metrics["waypoint_error_m"] = float(episode.tape.waypoint_error.max())
    metrics["path_error_m"] = context.planner.path_error(np.array([*cfg.scene.red_xy, *cfg.scene.blue_xy]))
    metrics["peak_contacts"] = int(sim.peak_contacts[0])
    metrics["peak_constraint_rows"] = int(sim.peak_constraints[0])
    metrics["backend"] = sim.description
    context.shown, context.shown_by = episode, "baseline world"
    thresholds = acceptance_thresholds(cfg) | {"waypoint_error_m": cfg.controller.ik_tolerance}
    summary = reason or f"xy_err {1e3 * metrics['xy_err_m']:.1f} mm, dz {1e3 * metrics['dz_m']:.1f} mm"
    return [GateResult(name="baseline", status=status, reason=summary, thresholds=thresholds, metrics=metrics)]
