"""The runner of jobs that leave a report, which is written after each result."""

import contextlib
import logging
import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from omegaconf import OmegaConf
from rich.console import Console
from rich.markup import escape

from mjstack.config.schema import Config
from mjstack.episodes.context import Artifacts, RunContext
from mjstack.episodes.observers import StepHook
from mjstack.errors import ConfigError, MjstackError
from mjstack.jobs.job import JobResult
from mjstack.jobs.progress import STATUS_COLOR, ProgressBar
from mjstack.report.picture import require_video, save_scene, save_trajectories, save_video
from mjstack.report.provenance import collect_provenance
from mjstack.report.record import GateResult, Report, Status
from mjstack.report.write import safely_draw, summarize, write_report
from mjstack.sim import Simulation, cuda_driver, cuda_name

log = logging.getLogger(__name__)

Record = Callable[[GateResult], None]
Work = Callable[[RunContext, ProgressBar, Record], None]


def check_showing(cfg: Config) -> None:
    """Raise if this machine cannot show an episode as ``view`` or ``video`` ask for."""
    if (
        cfg.view
        and sys.platform.startswith("linux")
        and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    ):
        raise ConfigError(
            "view", "true", "a display, and DISPLAY is not set", "Use video=true instead"
        )
    if cfg.video:
        require_video()


def run_reported(
    context: RunContext, folder: Path, overrides: list[str], title: str, work: Work
) -> JobResult:
    """Do some work and write its report after each result.

    Args:
        context: The configuration, and what its check built.
        folder: Where report.json, report.md, pictures and logs go.
        overrides: The command line.
        title: The work in one line.
        work: Does it. Hands over each result as soon as there is one.

    Returns:
        How it ended. Ctrl-C is an outcome, not an exception: the finished results are in the
        report.
    """
    console = Console(highlight=False, soft_wrap=True)
    errors = Console(stderr=True, soft_wrap=True, markup=False)
    context = replace(context, folder=folder, artifacts=Artifacts())
    cfg = context.cfg
    report = Report(provenance={})

    def record(result: GateResult) -> None:
        report.gates.append(result)
        write_report(report, folder)
        log.info("%s: %s %s", result.name, result.status.value, result.reason)
        bar.finish(result)

    try:
        console.print(f"[bold]{cfg.robot.title}[/], {escape(title)} -> {escape(str(folder))}")
        report.provenance = run_provenance(cfg, context)
        write_report(report, folder)
        with ProgressBar(console) as bar:
            viewer = _viewer(context) if cfg.view else None
            context = replace(context, say=bar.say, advance=bar.advance, on_step=viewer)
            work(context, bar, record)
        report.conclude()
        write_report(report, folder)
        report.pictures = [*_draw(context, folder, console), *context.artifacts.pictures]
        write_report(report, folder)
    # However it ends, the finished results are in the report.
    except KeyboardInterrupt:
        report.status = Status.interrupted
        console.print("interrupted; the finished gates are in the report")
    except OSError as error:
        report.status = Status.failed
        errors.print(
            f"mjstack: {folder} cannot be written: {error.strerror}. Free space, or set"
            " hydra.run.dir."
        )
    except MjstackError as error:
        report.status = Status.failed
        log.error("%s", error)
        errors.print(f"mjstack: {error}")
    with contextlib.suppress(OSError):
        write_report(report, folder)
    _print_summary(console, report, folder)
    return JobResult(status=report.status, folder=folder, overrides=overrides, gates=report.gates)


def run_provenance(cfg: Config, context: RunContext) -> dict:
    """Versions, device, and hashes of configuration and model."""
    backend, device = context.backend
    name = "Warp's CPU device"
    if device.startswith("cuda"):
        name = cuda_name(device)
    elif backend.value == "native":
        name = f"native MuJoCo on {os.cpu_count()} cores"
    # The compiled model's numbers: what the physics sees, whatever file it came from
    buffer = np.empty(mujoco.mj_sizeModel(context.model), np.uint8)
    mujoco.mj_saveModel(context.model, None, buffer)
    return collect_provenance(
        config_yaml=OmegaConf.to_yaml(OmegaConf.structured(cfg)),
        model_text=buffer.tobytes().hex(),
        device=f"{device}: {name}",
        driver=cuda_driver() if device.startswith("cuda") else "no CUDA device",
    )


def _draw(context: RunContext, folder: Path, console: Console) -> list[str]:
    """Draw the one-world episode, if there was one; return the pictures' file names."""
    episode = context.artifacts.shown
    cfg = context.cfg
    if episode is None:
        return []
    objects = {name: (thing.half, thing.color) for name, thing in cfg.scene.free.items()}
    positions = np.stack([episode.qpos[:, a : a + 3] for a in context.index.object_qpos], axis=1)
    title = f"{cfg.robot.title}, {cfg.task.name}: {context.artifacts.shown_by}"
    model = context.stage.visual_model
    drawn: dict[str, tuple[Callable[..., object], tuple]] = {
        "scene.png": (save_scene, (model, episode.qpos[-1])),
        "trajectories.png": (save_trajectories, (positions, objects, title)),
    }
    if cfg.video:
        drawn["episode.mp4"] = (save_video, (model, episode.qpos, cfg.timing.step_dt))
    problems = {
        name: safely_draw(folder / name, draw, *args) for name, (draw, args) in drawn.items()
    }
    for name, problem in problems.items():
        if problem or name == "episode.mp4":
            console.print(escape(problem or f"video: {folder}/{name}"))
    return [name for name, problem in problems.items() if not problem and name.endswith(".png")]


def _viewer(context: RunContext) -> StepHook:
    """Show a one-world episode in MuJoCo's viewer, in real time; closing the window lets the run
    go on.
    """
    import mujoco.viewer

    model = context.stage.visual_model
    data = mujoco.MjData(model)
    handle = mujoco.viewer.launch_passive(model, data)

    def show(step: int, sim: Simulation) -> None:
        if not handle.is_running():
            return
        began = time.perf_counter()
        data.qpos[:] = sim.qpos[0].cpu().numpy()
        mujoco.mj_forward(model, data)
        handle.sync()
        time.sleep(max(0.0, context.cfg.timing.step_dt - (time.perf_counter() - began)))

    return show


def _print_summary(console: Console, report: Report, folder: Path) -> None:
    colors = {status.value: color for status, color in STATUS_COLOR.items()}
    console.print(summarize(report.gates).to_console(colors))
    console.print(f"report: {escape(str(folder))}/report.md")
    console.print(f"status: [{STATUS_COLOR[report.status]}]{report.status.value}[/]")
