"""Job *play*: worlds with a policy or the expert, one after another in MuJoCo's viewer or side by
side in a video.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import cast

import mujoco
import numpy as np
import torch

from mjstack.config.schema import Config, PlayJobCfg
from mjstack.episodes.context import RunContext, judge_one
from mjstack.episodes.motion import show_world
from mjstack.episodes.replay import simulate_alone
from mjstack.episodes.rollout import POLICY, WorldRecorder, play_episode, rollout
from mjstack.errors import ConfigError
from mjstack.gates.runner import run_guarded
from mjstack.jobs.gates import check_task
from mjstack.jobs.runner import CheckedJob, Job
from mjstack.jobs.showing import check_showing
from mjstack.report.gl import require_offscreen
from mjstack.report.picture import save_video
from mjstack.report.record import GateResult, Status
from mjstack.report.write import safely_write

NAME = "play"
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
    job = cast(PlayJobCfg, cfg.job)
    if job.camera is not None and job.camera not in cfg.scene.cameras:
        there = ", ".join(cfg.scene.cameras) or "there is none"
        expected = f"null, or one of scene.cameras: {there}"
        raise ConfigError("job.camera", job.camera, expected, "Add a camera: cameras=front")
    context = RunContext(cfg)
    check_task(context)
    check_showing(cfg, f".{job.format}")
    if cfg.video and job.camera is None:  # cameras have been checked with the task
        require_offscreen(context.model)
    driver = "a policy" if cfg.controller.name == POLICY else "the expert"
    title = f"task {cfg.task.name}, {cfg.nworld} worlds with {driver}"
    return CheckedJob(
        context=context,
        title=title,
        work=lambda context, folder: run_guarded(context, NAME, play_worlds),
    )


def play_worlds(context: RunContext) -> list[GateResult]:
    """Play each world alone, as it would start in a batch, and show it. Worlds may fail: a gate
    judges a driver.
    """
    cfg = context.cfg
    recorders = []
    fields = []
    details = []
    good = 0
    with closing(simulate_alone(context, *context.backend)) as sim:
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
            fields.append({name: value.clone() for name, value in sim.fields.items()})
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
        _save(context, np.stack([recorder.qpos for recorder in recorders]), fields, result)
    return [result]


def _save(
    context: RunContext,
    qpos: np.ndarray,
    fields: Sequence[Mapping[str, torch.Tensor]],
    result: GateResult,
) -> None:
    """Write the video; without one there is nothing to look at, and the job fails."""
    assert context.folder is not None
    job = cast(PlayJobCfg, context.cfg.job)
    path = context.folder / f"episode.{job.format}"
    write = partial(save_video, fps=job.fps, width=job.width)
    if job.camera is not None:
        write = partial(_save_by_camera, write, context, fields)
    shown = (context.stage.visual_model, qpos, context.cfg.timing.step_dt, context.advance)
    if problem := safely_write(path, write, *shown):
        result.status = Status.failed
        result.reason += f"; {problem}"
    else:
        context.print_line(f"video: {path}")


def _save_by_camera(
    save: Callable[..., None],
    context: RunContext,
    fields: Sequence[Mapping[str, torch.Tensor]],
    path: Path,
    model: mujoco.MjModel,
    qpos: np.ndarray,
    *args: object,
) -> None:
    """Call `save_video` so that a camera of the scene draws, each world in its own looks."""
    name = cast(str, cast(PlayJobCfg, context.cfg.job).camera)
    looks = {field: torch.cat([world[field] for world in fields]) for field in fields[0]}
    renderer = context.stage.color_renderer(len(qpos), list(looks), [name])

    def draw(states: np.ndarray) -> np.ndarray:
        images = renderer.draw(torch.from_numpy(states), looks)
        return images[f"images.{name}"].cpu().numpy()

    with closing(renderer):
        save(path, model, qpos, *args, draw=draw)


JOB = Job(check_play, shows=True, live=True)
