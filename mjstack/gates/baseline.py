"""Gate *baseline*: one native world stacks the cubes."""

from mjstack.episodes.context import RunContext, judge_one, needs_episode
from mjstack.report.record import GateResult


@needs_episode
def run_baseline(context: RunContext) -> list[GateResult]:
    """Runs the nominal episode on native MuJoCo and judges it."""
    cfg = context.cfg
    nominal = context.nominal
    sim = nominal.sim
    episode = nominal.episode
    timing = episode.timing
    status, reason, metrics = judge_one(context, episode)
    headline = context.check.headline(metrics)
    context.say(f"{cfg.task.name} check: {headline}")
    metrics["episode_s"] = timing.seconds
    metrics["world_steps_per_s"] = timing.steps * cfg.timing.decimation / timing.seconds
    metrics["waypoint_error_m"] = float(episode.waypoint_error.max())
    metrics["path_error_m"] = context.planner.path_error()
    metrics["peak_contacts"] = int(sim.peak_contacts[0])
    metrics["peak_constraint_rows"] = int(sim.peak_constraints[0])
    context.artifacts.shown = nominal.world
    context.artifacts.shown_by = "baseline world"
    thresholds = context.check.thresholds() | {"waypoint_error_m": cfg.controller.ik_tolerance}
    summary = reason or headline
    return [
        GateResult(
            name="baseline",
            status=status,
            reason=summary,
            thresholds=thresholds,
            metrics=metrics,
            notes={"backend": sim.description},
        )
    ]
