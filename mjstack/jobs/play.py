"""Job *play*: worlds with a policy or the expert, one after another in MuJoCo's viewer or side by
side in a video.
"""

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from mjstack.config.schema import Config
from mjstack.episodes.context import RunContext, judge_one
from mjstack.episodes.motion import show_world
from mjstack.episodes.replay import simulate_one
from mjstack.episodes.rollout import POLICY, WorldRecorder, play_episode, rollout
from mjstack.errors import ConfigError
from mjstack.gates.runner import run_guarded
from mjstack.jobs.gates import check_task
from mjstack.jobs.runner import CheckedJob, Job, check_showing
from mjstack.report.gl import require_offscreen
from mjstack.report.picture import save_video
from mjstack.report.record import GateResult, Status
from mjstack.report.write import safely_write

NAME = "play"
VIDEO = "episode.mp4"
_MOST = 64  # worlds of a video


def check_play(cfg: Config) -> CheckedJob:
    """Raise for what cannot be shown, before anything is written."""
    if cfg.policy is not None:
        cfg = replace(cfg, controller=replace(cfg.controller, name=POLICY))
    cfg = replace(cfg, video=cfg.video or cfg.view == "false")
    if cfg.video and cfg.nworld > _MOST:
        raise ConfigError("nworld", cfg.nworld, f"at most {_MOST} worlds, as a video has room for")
    if not cfg.controller.phases and cfg.controller.name != POLICY:
        expected = "a task with phases, which the expert follows"
        raise ConfigError("task", cfg.task.name, expected, "Name a policy: policy=FOLDER")
    context = RunContext(cfg)
    check_task(context)
    check_showing(cfg)
    if cfg.video:
        require_offscreen(context.model)
    driver = "a policy" if cfg.controller.name == POLICY else "the expert"
    title = f"task {cfg.task.name}, {cfg.nworld} worlds with {driver}"
    return CheckedJob(context=context, title=title, work=_play)


def _play(context: RunContext, folder: Path) -> None:
    run_guarded(context, NAME, play_worlds)


def play_worlds(context: RunContext) -> list[GateResult]:
    """Play each world alone, as it would start in a batch, and show it. Worlds may fail: a gate
    judges a driver.
    """
    cfg = context.cfg
    recorders = []
    details = []
    good = 0
    with closing(simulate_one(context, *context.backend)) as sim:
        for world in range(cfg.nworld):
            env = context.start(sim, cfg.reset, worlds=[world])
            driver = context.driver(env)
            recorder = WorldRecorder()
            looking = [*context.viewers, recorder]
            label = f"steps of world {world}"
            told = "not judged: the task has no check"
            failed = False
            if cfg.task.check is None:
                rollout(env, driver, looking, advance=context.advance, label=label)
            else:
                episode = play_episode(env, driver, looking, advance=context.advance, label=label)
                status, told, metrics = judge_one(context, episode)
                failed = status is Status.failed
                good += not failed
                told = told or f"succeeded, {context.check.headline(metrics)}"
            recorders.append(recorder)
            show_world(context, f"{NAME}_{world}", str(world), recorder, failed=failed)
            details.append(f"world {world}: {told}")
            context.print_line(details[-1])
    result = GateResult(
        name=NAME,
        status=Status.passed,
        reason=f"{good} of {cfg.nworld} worlds succeeded" if cfg.task.check else told,
        metrics={"worlds": cfg.nworld, **({"succeeded": good} if cfg.task.check else {})},
        notes={"backend": sim.description},
        details=details,
    )
    if cfg.video:
        _save(context, np.stack([recorder.qpos for recorder in recorders]), result)
    return [result]


def _save(context: RunContext, qpos: np.ndarray, result: GateResult) -> None:
    """Write the video; without one there is nothing to look at, and the job fails."""
    assert context.folder is not None
    path = context.folder / VIDEO
    shown = (context.stage.visual_model, qpos, context.cfg.timing.step_dt, context.advance)
    if problem := safely_write(path, save_video, *shown):
        result.status = Status.failed
        result.reason += f"; {problem}"
    else:
        context.print_line(f"video: {path}")


JOB = Job(check_play, shows=True, live=True)
