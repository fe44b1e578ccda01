"""Gate *baseline*: one native world does the task."""

from mjstack.episodes.run import Run, needs_episode
from mjstack.gates.scene_physics import scene_faults
from mjstack.gates.tracking import find_cause, loose_grips, start_contacts, waypoint_errors
from mjstack.report.figure import Figure
from mjstack.report.record import GateResult, Status
from mjstack.robots import read_robot
from mjstack.robots.guest import SAG, left_behind, object_left_behind
from mjstack.scene.build import scene_names


@needs_episode
def run_baseline(run: Run) -> list[GateResult]:
    """Hold the scene against its configuration; then run the nominal episode on native MuJoCo and
    judge it, and where the arm went.
    """
    cfg = run.cfg
    if faults := list(scene_faults(cfg, run.stage.model)):
        reason = f"the compiled scene is not as configured: {'; '.join(faults[:3])}"
        failed = GateResult(name="baseline", status=Status.failed, reason=reason, details=faults)
        return [failed]
    sim = run.nominal.sim
    episode = run.nominal.episode
    result, headline = run.judge_one("baseline", episode)
    run.print_line(f"{cfg.task.name} check: {headline}")
    timing = episode.timing
    result.notes["backend"] = sim.description
    result.figures += [
        Figure("episode", timing.seconds, "s"),
        Figure("world_steps", timing.steps * cfg.timing.decimation / timing.seconds, "/s"),
        Figure("peak_contacts", int(sim.peak_contacts[0])),
        Figure("peak_constraint_rows", int(sim.peak_constraints[0])),
    ]
    causes: list[str] = []
    loose = [*loose_grips(run.stage)]
    if errors := waypoint_errors(run.stage, run.nominal.states, run.nominal.targets):
        worst = max(errors, key=errors.__getitem__)
        # Beyond half of it a hand over an object and one at it cannot be told apart
        most = 0.5 * cfg.robot.approach_height
        ik_error = float(episode.ik_error.max())
        result.figures += [
            Figure("waypoint_error", errors[worst], "m", high=most),
            Figure("ik_error", ik_error, "m", high=cfg.controller.ik_tolerance),
        ]
        if errors[worst] > SAG:
            end = run.stage.phase(worst).stop - 1
            cause = find_cause(run.stage, run.nominal.states[end], run.nominal.targets[end])
            miss = f"the arm is {1e3 * errors[worst]:.1f} mm off its target as {worst} ends"
            causes = [f"{miss}: {cause}"]
        if not errors[worst] <= most:
            result.status = Status.failed
            result.beyond.append("waypoint_error_m")
    if result.status is Status.failed:
        contacts = [*start_contacts(run.stage, episode.start[0])]
        reasons = (result.reason, *causes, *loose, *(contacts if causes else ()))
        result.reason = "; ".join(filter(None, reasons))
        causes += contacts
    result.reason = result.reason or headline
    world = run.nominal.world
    label = "baseline, native"
    run.show_world("baseline", label, world.qpos, episode, world.env, "baseline world")
    names = scene_names(cfg.scene)
    lines = left_behind(read_robot(cfg.robot, cfg.model), cfg.robot, run.stage.model, names)
    result.details += [f"robot's file: {line}" for line in lines]
    for name, object_cfg in cfg.scene.objects.items():
        if object_cfg.file is not None:
            lines = object_left_behind(object_cfg.file, run.stage.model, fixed=object_cfg.fixed)
            result.details += [f"file of {name}: {line}" for line in lines]
    result.details += [*loose, *causes]
    return [result]
