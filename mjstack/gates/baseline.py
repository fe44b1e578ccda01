"""Gate *baseline*: one native world does the task."""

from mjstack.episodes.run import Run, needs_episode
from mjstack.gates.scene_physics import scene_faults
from mjstack.gates.tracking import find_cause, start_contacts, waypoint_errors
from mjstack.report.record import GateResult, Status
from mjstack.robots import read_robot
from mjstack.robots.guest import SAG, gravity_note, left_behind
from mjstack.scene.build import scene_names


@needs_episode
def run_baseline(run: Run) -> list[GateResult]:
    """Hold the scene against its configuration; then run the nominal episode on native MuJoCo and
    judge it, and where the arm went.
    """
    cfg = run.cfg
    if faults := scene_faults(cfg, run.stage.model):
        reason = f"the compiled scene is not as configured: {'; '.join(faults[:3])}"
        result = GateResult(name="baseline", status=Status.failed, reason=reason)
        result.details = faults
        return [result]
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
    causes = list(start_contacts(run))
    if errors := waypoint_errors(run):
        worst = max(errors, key=errors.__getitem__)
        metrics["waypoint_error_m"] = errors[worst]
        metrics["ik_error_m"] = float(episode.ik_error.max())
        metrics["path_error_m"] = run.stage.planner.path_error()
        # Beyond half of it a hand over an object and one at it cannot be told apart
        thresholds["waypoint_error_m"] = 0.5 * cfg.robot.approach_height
        thresholds["ik_error_m"] = cfg.controller.ik_tolerance
        if errors[worst] > SAG:
            cause = find_cause(run, run.nominal.states[run.stage.phase(worst).stop - 1])
            miss = f"the arm misses its target by {1e3 * errors[worst]:.1f} mm at the end of {worst}"
            causes.insert(0, f"{miss}: {cause}")
        if not errors[worst] <= thresholds["waypoint_error_m"]:
            status = Status.failed
            reason = reason or "failed"
            beyond.append("waypoint_error_m")
    if status is Status.failed:
        reason = "; ".join((reason, *causes))
    world = run.nominal.world
    label = "baseline, native"
    run.show_world("baseline", label, world.qpos, status, world.env, "baseline world")
    result = GateResult(name="baseline", status=status, reason=reason or headline)
    result.thresholds = thresholds
    result.metrics = metrics
    result.beyond = beyond
    result.notes["backend"] = sim.description
    spec = read_robot(cfg.robot, cfg.model)
    lines = left_behind(spec, cfg.robot, run.stage.model, scene_names(cfg.scene))
    result.details += [f"robot's file: {line}" for line in lines]
    result.details += [*filter(None, [gravity_note(spec, cfg.robot, run.stage.model)]), *causes]
    return [result]
