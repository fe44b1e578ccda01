"""Jobs: how they are checked and run, and the report that is written after each result."""

import gc
import hashlib
import logging
import os
import re
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import mujoco
import numpy as np
import torch
from rich.markup import escape

from mjstack.config.fingerprint import config_content, config_hash
from mjstack.config.functions import find_object
from mjstack.config.schema import Backend, Config
from mjstack.episodes.context import Artifacts, RunContext
from mjstack.episodes.live import LiveView
from mjstack.episodes.rollout import Hook, Observer, StepHook
from mjstack.errors import ConfigError, MjstackError
from mjstack.files import write_atomic
from mjstack.gates.runner import log_error
from mjstack.interrupt import check_interrupt, interrupted
from mjstack.jobs.progress import STATUS_COLOR, ProgressBar
from mjstack.mdp.starts.placement import SCHEMA
from mjstack.report.html import PAGE, Page, write_page
from mjstack.report.picture import (
    opens_windows,
    require_video,
    save_scene,
    save_trajectories,
    save_video,
)
from mjstack.report.provenance import collect_provenance
from mjstack.report.record import GateResult, Provenance, Report, Status
from mjstack.report.table import Console, Table, to_document
from mjstack.report.web import (
    EPISODE,
    check_address,
    choose_worlds,
    frame_stride,
    lacks_viser,
    save_episode,
    start_server,
    stop_server,
)
from mjstack.report.write import safely_write, summarize, write_report
from mjstack.sim import Simulation, StateRenderer, resolve_backend
from mjstack.sim.build import cuda_driver, cuda_name, cuda_uuid
from mjstack.sim.cameras import color_cameras
from mjstack.sim.native import available_cores

log = logging.getLogger(__name__)


def check_showing(cfg: Config, ending: str = ".mp4") -> None:
    """Raise if this machine cannot show an episode as ``view`` or ``video`` ask for, the video with
    a name of this ending.
    """
    if cfg.view == "web":
        check_address(cfg.web.host, cfg.web.port)
    elif cfg.view == "true" and not opens_windows():
        shown = os.environ.get("DISPLAY", "not set")
        expected = f"a display that opens windows (DISPLAY={shown})"
        raise ConfigError("view", "true", expected, "Use view=web or video=true instead")
    if cfg.video:
        require_video(ending)


@dataclass(frozen=True, slots=True)
class Job:
    """One kind of job; ``conf/job/<name>.yaml`` names it.

    Attributes:
        check: Raises a `MjstackError` for what cannot be done here, before anything is written.
            Returns the job ready to run, with the scene and the plan that the check built.
        keys: Top-level keys and groups that its command line may set; None for all.
        shows: Whether it can show a world (``view=true``, ``video``).
        live: Whether the live view can show its worlds (``view=web``).
    """

    check: Callable[[Config], "CheckedJob"]
    keys: tuple[str, ...] | None = None
    shows: bool = False
    live: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class CheckedJob:
    """A job that has passed its checks.

    Attributes:
        context: The configuration, and what its check built.
        title: The work in one line.
        work: Does it in a folder, and hands each result to the context's ``record``.
        folder: The default folder of a job that resumes; None for a folder of the hour.
        own: A file by which it knows that folder.
        resumes: Its name in report.json, by which it knows any folder that it goes on with.
        resumable: Its name there if it goes on only where the command line says so.
        earlier: The calls that the run goes on with, in words.
        spreads: Whether ranks share the work: `work` is called in each of them.
    """

    context: RunContext
    title: str
    work: Callable[[RunContext, Path], None]
    folder: Path | None = None
    own: str = ""
    resumes: str = ""
    resumable: str = ""
    earlier: Sequence[str] = ()
    spreads: bool = False

    def assist(self, folder: Path) -> None:
        """Do this rank's part of the work: rank 0 alone writes and prints.

        Raises:
            KeyboardInterrupt: The command was interrupted.
            Exception: The work has failed.
        """
        quiet = replace(
            self.context,
            print_line=lambda line: None,
            begin=lambda name: check_interrupt(),
            advance=lambda what, done, total: check_interrupt(),
            artifacts=Artifacts(),
        )
        quiet.ranks.gather(self._place())
        self.work(quiet, folder)
        check_interrupt()

    def _place(self) -> str:
        """Where this rank plays."""
        return f"{socket.gethostname()}, {_device_name(*self.context.backend)}"

    def run(self, folder: Path, overrides: Sequence[str] = ()) -> Report:
        """Do the work and write its report after each result into the folder.

        Returns:
            How it ended. Ctrl-C is an outcome, not an exception: the finished results are in the
            report.
        """
        console = Console(highlight=False, soft_wrap=True)
        errors = Console(stderr=True, soft_wrap=True, markup=False)
        report = Report(
            folder=folder, overrides=list(overrides), resumes=self.resumes or self.resumable
        )
        cfg = self.context.cfg
        page = Page(title=f"{cfg.robot.title}, {self.title}")
        # The collector need not look at all that was loaded each time it frees a gate's worlds.
        gc.collect()
        gc.freeze()

        def record(result: GateResult) -> None:
            report.gates.append(result)
            _write(report, page)
            log.info("%s: %s %s", result.name, result.status, result.reason)
            bar.finish(result)

        # The work, and the pictures of its artifacts
        try:
            where = f"{escape(self.title)} -> {escape(str(folder))}"
            console.print(f"[bold]{escape(cfg.robot.title)}[/], {where}")
            report.provenance = run_provenance(self.context)
            if self.earlier:
                report.provenance["earlier_calls"] = list(self.earlier)
            if self.context.ranks.size > 1:
                places = self.context.ranks.gather(self._place())
                report.provenance["ranks"] = [f"rank {r}: {p}" for r, p in enumerate(places)]
            _write(report, page)
            with ProgressBar(console) as bar, _live_view(self.context, console) as live:
                context = replace(
                    self.context,
                    folder=folder,
                    overrides=overrides,
                    print_line=bar.print_line,
                    begin=partial(_begin, bar, live),
                    record=record,
                    advance=bar.advance,
                    viewers=[live] if live else _viewers(self.context),
                    live=live,
                    artifacts=Artifacts(),
                    page=page,
                )
                self.work(context, folder)
            report.conclude()
            _write(report, page)
            report.pictures = [*_draw(context, console), *page.pictures]
            page.note = _save_episode(context)
            check_interrupt()
        # However it ends, the finished results are in the report.
        except (Exception, SystemExit, KeyboardInterrupt) as error:
            cause = self.context.ranks.cause(error)
            if interrupted() or isinstance(cause, KeyboardInterrupt):
                report.status = Status.interrupted
                console.print("interrupted; the finished gates are in the report")
            else:
                report.status = Status.failed
                if isinstance(cause, OSError):
                    problem = f"{folder} cannot be written: {cause.strerror}. Free space, or set"
                    problem += " hydra.run.dir."
                else:
                    problem = log_error(cause)
                    log.error("%s", problem)
                errors.print(f"mjstack: {problem}")
        for finish in (partial(_write, page=page), partial(_print_summary, console)):
            try:
                finish(report)
            except Exception as error:
                log_error(error)
        gc.unfreeze()
        return report


def _write(report: Report, page: Page) -> None:
    """Write the report, and its page, whose failure takes no result back."""
    write_report(report)
    safely_write(report.folder / PAGE, write_page, report, page, stops=False)


def count_devices(cfg: Config) -> int:
    """How many ranks ``devices`` asks for; one if it is null.

    Raises:
        ConfigError: There are not as many GPUs, or cores where there is no GPU.
    """
    if cfg.devices is None:
        return 1
    backend, device = resolve_backend(cfg)
    on_cuda = device.startswith("cuda")
    there = torch.cuda.device_count() if on_cuda else available_cores()
    if cfg.devices == "all":
        return there if on_cuda else 1  # one process uses all cores
    if int(cfg.devices) > there:
        kind = "CUDA device" if on_cuda else "core"
        have = f"{there} {kind}{'s' * (there != 1)}"
        expected = f"at most {there}, as this machine has {have} for sim={backend}"
        raise ConfigError("devices", cfg.devices, expected)
    return int(cfg.devices)


def check_share(cfg: Config, size: int) -> None:
    """Raise a `ConfigError` if there are fewer worlds than ranks."""
    if cfg.nworld < size:
        expected = f"at least {size}, a world for each rank"
        raise ConfigError("nworld", cfg.nworld, expected)


def check_ranks(context: RunContext) -> None:
    """Raise if the ranks of a job do not fit together. Called in each of them.

    Raises:
        MjstackError: Versions or configurations differ, two ranks have one GPU, or there are fewer
            worlds than ranks.
    """
    ranks = context.ranks
    cfg = context.cfg
    _, device = context.backend
    host = socket.gethostname()
    facts = collect_provenance()
    own: dict[str, Any] = {**cast(dict, facts["versions"]), "mjstack's commit": facts["git_commit"]}
    own["configuration"] = config_hash(config_content(cfg))[:12]
    gpu = cuda_uuid(device) if device.startswith("cuda") else ""
    each = ranks.gather((host, own, gpu))
    for rank, (there, found, _) in enumerate(each):
        for name, value in each[0][1].items():
            if found.get(name) != value:
                raise MjstackError(
                    f"rank {rank} ({there}) has {name} {found.get(name)} and rank 0"
                    f" ({each[0][0]}) {value}, expected the same in all ranks",
                    "Install and start the same everywhere",
                )
    if gpu:
        holders: dict[tuple[str, str], int] = {}
        for rank, (there, _, which) in enumerate(each):
            if (other := holders.setdefault((there, which), rank)) != rank:
                raise MjstackError(
                    f"ranks {other} and {rank} ({there}) have one GPU, {which}, expected one each",
                    "Start as many ranks as there are GPUs, with sim.device=auto",
                )
    check_share(cfg, ranks.size)


def check_job(cfg: Config, overrides: Sequence[str] = ()) -> CheckedJob:
    """Raise for what this machine cannot do, before anything is written. The overrides are those of
    the command line without Hydra's own.
    """
    job = find_object("job.func", cfg.job.func)
    if not isinstance(job, Job):
        raise ConfigError("job.func", cfg.job.func, "a mjstack.jobs.Job")
    for override in overrides:
        key, _, value = override.lstrip("+~").partition("=")
        if job.keys is not None and re.split(r"[.@/]", key)[0] not in job.keys:
            expected = f"only {', '.join(job.keys[1:])} beside job={cfg.job.name}"
            raise ConfigError(key, value, expected, "Leave it out")
    for key, asked in (("view", cfg.view != "false"), ("video", cfg.video)):
        if asked and not (job.live if cfg.view == "web" and key == "view" else job.shows):
            expected = f"false with job={cfg.job.name}, which shows no world"
            if key == "view" and job.live:
                expected = f"web or false with job={cfg.job.name}"
            raise ConfigError(key, cfg.view if key == "view" else "true", expected, "Leave it out")
    return job.check(cfg)


def write_tables(
    context: RunContext,
    name: str,
    title: str,
    table: Table,
    notes: Sequence[str],
    csv: str,
    draw: Callable[[Path], object] | None = None,
) -> None:
    """Replace ``name.csv``, ``name.md`` and, where ``draw`` is given, ``name.png`` of a run. A
    picture that fails is a printed line.

    Raises:
        OSError: A file cannot be written.
    """
    folder = cast(Path, context.folder)
    picture = folder / f"{name}.png"
    if draw is not None:
        if problem := safely_write(picture, draw):
            context.print_line(problem)
        else:
            context.page.pictures.append(picture.name)
    context.page.tables.append(replace(table, title=table.title or title))
    write_atomic(folder / f"{name}.csv", csv)
    shown = [picture.name] if picture.exists() else []
    write_atomic(folder / f"{name}.md", to_document(title, [table], notes, shown))


def run_provenance(context: RunContext) -> Provenance:
    """Versions, machine, device, and hashes of configuration and model."""
    backend, device = context.backend
    # The numbers of the compiled model: the physics sees these, not the files
    buffer = np.empty(mujoco.mj_sizeModel(context.model), np.uint8)
    mujoco.mj_saveModel(context.model, None, buffer)
    config = config_content(context.cfg)
    return collect_provenance() | {
        "device": _device_name(backend, device),
        "driver": cuda_driver() if device.startswith("cuda") else "no CUDA device",
        "config_sha256": config_hash(config),
        "model_sha256": hashlib.sha256(buffer.tobytes().hex().encode()).hexdigest(),
        "starts_schema": SCHEMA,
        **({"policy": config["policy"]} if context.cfg.policy else {}),
    }


def _device_name(backend: Backend, device: str) -> str:
    name = "Warp's CPU device"
    if device.startswith("cuda"):
        name = cuda_name(device)
    elif backend is Backend.native:
        name = f"native MuJoCo on {available_cores()} cores"
    return f"{device}: {name}"


def _draw(context: RunContext, console: Console) -> list[str]:
    """Draw the one-world episode, if there was one; return the pictures' file names."""
    if context.artifacts.shown is None:
        return []
    world, episode = context.artifacts.shown
    cfg = context.cfg
    folder = cast(Path, context.folder)
    objects = {name: (thing.half, thing.color) for name, thing in cfg.scene.free.items()}
    positions = np.stack([episode.qpos[:, a : a + 3] for a in context.index.object_qpos], axis=1)
    title = f"{cfg.robot.title}, {cfg.task.name}: {world}"
    model = context.stage.visual_model
    drawn: dict[str, tuple[Callable[..., object], tuple]] = {
        "scene.png": (save_scene, (model, episode.qpos[-1])),
        "trajectories.png": (save_trajectories, (positions, objects, title)),
    }
    if cfg.video:
        drawn["episode.mp4"] = (save_video, (model, episode.qpos[None], cfg.timing.step_dt))
    pictures = []
    for name, (draw, args) in drawn.items():
        if problem := safely_write(folder / name, draw, *args):
            console.print(escape(problem))
        elif name.endswith(".png"):
            pictures.append(name)
        else:
            console.print(escape(f"video: {folder}/{name}"))
    return pictures


def _save_episode(context: RunContext) -> str:
    """Write the 3-D page of the run's worlds, if there were any; return why there is none."""
    cfg = context.cfg
    page = context.page
    folder = cast(Path, context.folder)
    if not cfg.web.episode:
        return "web.episode=false: no 3-D page"
    worlds = choose_worlds(page.worlds3d)
    problem = lacks_viser()
    if worlds and not problem:
        frame_dt = frame_stride(cfg.timing.step_dt) * cfg.timing.step_dt
        shown = (context.stage.visual_model, worlds, frame_dt)
        problem = safely_write(folder / EPISODE, save_episode, *shown)
    if (folder / EPISODE).exists():  # perhaps an earlier call's, of seeds that were read back
        page.episode = EPISODE
    if problem:
        context.print_line(problem)
    return problem


def _begin(bar: ProgressBar, live: LiveView | None, name: str) -> None:
    """Name the part of the run that begins."""
    bar.start(name)
    if live is not None:
        live.begin(name)


@contextmanager
def _live_view(context: RunContext, console: Console) -> Iterator[LiveView | None]:
    """Serve the live view inside, if it is asked for."""
    cfg = context.cfg
    if cfg.view != "web":
        yield None
        return
    check_address(cfg.web.host, cfg.web.port)  # another program may have come first
    server = start_server(cfg.web.host, cfg.web.port)
    try:
        console.print(f"live view: http://{cfg.web.host}:{server.get_port()}")
        with closing(
            LiveView(
                server,
                lambda: context.stage.visual_model,
                renderer=partial(_camera_renderer, context) if cfg.scene.cameras else None,
                pausable=context.ranks.size == 1,
                print_line=console.print,
            )
        ) as live:
            yield live
    finally:
        stop_server(server)


def _camera_renderer(context: RunContext, fields: Sequence[str]) -> StateRenderer:
    """What draws the cameras of one world for the live view, on the backend of the batch."""
    cfg = context.cfg
    colors = replace(cfg, scene=replace(cfg.scene, cameras=color_cameras(cfg.scene.cameras)))
    backend, device = context.backend
    return StateRenderer(context.model, colors, 1, backend=backend, device=device, fields=fields)


def _viewers(context: RunContext) -> list[Observer]:
    """MuJoCo's viewer, if it is asked for."""
    return [Hook(_viewer(context))] if context.cfg.view == "true" else []


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


def _print_summary(console: Console, report: Report) -> None:
    console.print(summarize(report.gates).to_console(STATUS_COLOR))
    if (report.folder / "report.md").exists():  # the disk may be full
        names = ["report.md", *filter(lambda n: (report.folder / n).exists(), (PAGE, EPISODE))]
        console.print(f"report: {escape(str(report.folder))}/{', '.join(names)}")
    console.print(f"status: [{STATUS_COLOR[report.status]}]{report.status}[/]")
