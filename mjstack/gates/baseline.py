"""Gate *baseline*: one native world does the task."""

from mjstack.episodes.context import RunContext, judge_one, needs_episode
from mjstack.episodes.motion import show_world
from mjstack.report.record import GateResult, Status


@needs_episode
def run_baseline(context: RunContext) -> list[GateResult]:
    """Run the nominal episode on native MuJoCo and judge it."""
    cfg = context.cfg
    nominal = context.nominal
    sim = nominal.sim
    episode = nominal.episode
    timing = episode.timing
    status, reason, metrics = judge_one(context, episode)
    headline = context.check.headline(metrics)
    context.print_line(f"{cfg.task.name} check: {headline}")
    metrics |= {
        "episode_s": timing.seconds,
        "world_steps_per_s": timing.steps * cfg.timing.decimation / timing.seconds,
        "peak_contacts": int(sim.peak_contacts[0]),
        "peak_constraint_rows": int(sim.peak_constraints[0]),
    }
    thresholds = context.check.thresholds()
    if context.phases:
        metrics["waypoint_error_m"] = float(episode.waypoint_error.max())
        metrics["path_error_m"] = context.planner.path_error()
        thresholds["waypoint_error_m"] = cfg.controller.ik_tolerance
    context.artifacts.shown = ("baseline world", nominal.world)
    show_world(
        context, "baseline", "baseline, native", nominal.world, failed=status is Status.failed
    )
    return [
        GateResult(
            name="baseline",
            status=status,
            reason=reason or headline,
            thresholds=thresholds,
            metrics=metrics,
            notes={"backend": sim.description},
        )
    ]
