"""Job *play*: worlds with a policy or the expert, in a video or in a browser."""

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from mjstack.config.schema import Config, PlayJobCfg
from mjstack.drivers.driver import find_driver
from mjstack.episodes.batches import BatchPlan, play_batches
from mjstack.episodes.motion import world_fields
from mjstack.episodes.recorder import WorldRecorder
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError
from mjstack.gates.runner import run_guarded
from mjstack.jobs.gates import check_task
from mjstack.jobs.runner import VIEWS, CheckedJob, Job
from mjstack.jobs.showing import check_showing
from mjstack.report.figure import figures
from mjstack.report.gl import require_offscreen
from mjstack.report.page import World
from mjstack.report.picture import save_video
from mjstack.report.record import GateResult, Status
from mjstack.report.write import safely_write

NAME = "play"
_MOST = 64  # worlds of a video


def check_play(cfg: Config) -> CheckedJob:
    """Raise for what cannot be shown, before anything is written."""
    cfg = replace(cfg, video=cfg.video or cfg.view == "false")
    if cfg.video and cfg.nworld > _MOST:
        raise ConfigError("nworld", cfg.nworld, f"at most {_MOST} worlds, as a video has room for")
    driver = find_driver(cfg)
    if not cfg.controller.phases and driver.needs_phases:
        expected = "a task with phases, which the expert follows"
        raise ConfigError(
            "task", cfg.task.name, expected, "Or play a policy: controller=policy policy=FOLDER"
        )
    job: PlayJobCfg = cfg.job
    if job.camera is not None and job.camera not in cfg.scene.cameras:
        names = ", ".join(cfg.scene.cameras) or "there is none"
        expected = f"null, or one of scene.cameras: {names}"
        raise ConfigError("job.camera", job.camera, expected, "Add a camera: cameras=front")
    stage = Stage(cfg)
    check_task(stage)
    check_showing(cfg, f".{job.format}")
    if cfg.video and job.camera is None:  # cameras have been checked with the task
        require_offscreen(stage.model)
    return CheckedJob(
        stage=stage,
        title=f"task {cfg.task.name}, {cfg.nworld} worlds with the {driver.noun}",
        work=lambda run, folder: run_guarded(run, NAME, play_worlds),
    )


def play_worlds(run: Run) -> list[GateResult]:
    """Play each world alone, as it would start in a batch, and show it. Worlds may fail: a gate
    judges a driver.
    """
    stage = run.stage
    cfg = stage.cfg
    judged = cfg.task.check is not None
    recorder = WorldRecorder()
    worlds: list[World] = []
    model_fields = []
    result = GateResult(name=NAME, status=Status.passed)
    succeeded = 0
    for batch in play_batches(
        stage,
        [BatchPlan(cfg.seed, [world]) for world in range(cfg.nworld)],
        alone=stage.backend,
        observers=lambda plan: [recorder],
    ):
        world = batch.plan.worlds[0]
        sim = batch.env.sim
        outcome = "not judged: the task has no check"
        if judged:
            played, headline = run.judge_one(NAME, batch.episode)
            succeeded += played.status is Status.passed
            outcome = played.reason or f"succeeded, {headline}"
        qpos = recorder.qpos
        (fields,) = world_fields(stage, batch.env, [0])
        worlds.append(World(label=str(world), qpos=qpos, fields=fields))
        model_fields.append({name: value.clone() for name, value in sim.fields.items()})
        run.show_world(f"{NAME}_{world}", str(world), qpos, batch.episode, batch.env)
        result.details.append(f"world {world}: {outcome}")
        result.notes["backend"] = sim.description
        run.print_line(result.details[-1])
    result.reason = f"{succeeded} of {cfg.nworld} worlds succeeded" if judged else outcome
    result.figures = figures(worlds=cfg.nworld, **({"succeeded": succeeded} if judged else {}))
    if cfg.video:
        _save(run, worlds, model_fields, result)
    return [result]


def _save(
    run: Run,
    worlds: Sequence[World],
    fields: Sequence[Mapping[str, torch.Tensor]],
    result: GateResult,
) -> None:
    """Write the video of worlds with these model fields; without one there is nothing to look at,
    and the job fails.
    """
    assert run.folder is not None
    stage = run.stage
    job: PlayJobCfg = stage.cfg.job
    path = run.folder / f"episode.{job.format}"

    def write(path: Path) -> None:
        """Write it as seen from the side, or by a camera with each world in its own looks."""
        model = stage.assets.visual_model
        scene = (model, worlds, stage.cfg.timing.step_dt, stage.progress.advance)
        save = partial(save_video, path, *scene, fps=job.fps, width=job.width)
        if job.camera is None:
            save()
            return
        model_fields = {field: torch.cat([world[field] for world in fields]) for field in fields[0]}
        name = f"images.{job.camera}"
        with closing(
            stage.color_renderer(len(worlds), list(model_fields), [job.camera])
        ) as renderer:
            save(
                draw=lambda q: renderer.draw(torch.from_numpy(q), model_fields)[name].cpu().numpy()
            )

    if problem := safely_write(path, write):
        result.status = Status.failed
        result.reason += f"; {problem}"
    else:
        run.print_line(f"video: {path}")


JOB = Job(check_play, views=VIEWS)
