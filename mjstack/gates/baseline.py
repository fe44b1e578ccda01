"""Gate *baseline*: one native world does the task."""

from mjstack.episodes.run import Run, needs_episode
from mjstack.report.record import GateResult
from mjstack.robots import read_robot
from mjstack.robots.guest import left_behind, object_left_behind
from mjstack.scene.build import scene_names


@needs_episode
def run_baseline(run: Run) -> list[GateResult]:
    """Run the nominal episode on native MuJoCo and judge it."""
    cfg = run.cfg
    sim = run.nominal.sim
    episode = run.nominal.episode
    status, reason, metrics, beyond = run.judge_one(episode)
    headline = run.stage.check.headline(metrics)
    run.print_line(f"{cfg.task.name} check: {headline}")
    timing = episode.timing
    metrics |= {
        "episode_s": timing.seconds,
        "world_steps_per_s": timing.steps * cfg.timing.decimation / timing.seconds,
        "peak_contacts": int(sim.peak_contacts[0]),
        "peak_constraint_rows": int(sim.peak_constraints[0]),
    }
    thresholds = run.stage.check.thresholds()
    if run.stage.phases:
        metrics["waypoint_error_m"] = float(episode.waypoint_error.max())
        metrics["path_error_m"] = run.stage.planner.path_error()
        thresholds["waypoint_error_m"] = cfg.controller.ik_tolerance
    world = run.nominal.world
    label = "baseline, native"
    run.show_world("baseline", label, world.qpos, status, world.env, "baseline world")
    result = GateResult(name="baseline", status=status, reason=reason or headline)
    result.thresholds = thresholds
    result.metrics = metrics
    result.beyond = beyond
    result.notes["backend"] = sim.description
    names = scene_names(cfg.scene)
    lines = left_behind(read_robot(cfg.robot, cfg.model), cfg.robot, run.stage.model, names)
    result.details += [f"robot's file: {line}" for line in lines]
    for name, thing in cfg.scene.objects.items():
        if thing.file is not None:
            lines = object_left_behind(thing.file, run.stage.model, fixed=thing.fixed)
            result.details += [f"file of {name}: {line}" for line in lines]
    return [result]
