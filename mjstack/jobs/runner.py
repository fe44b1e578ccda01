"""Jobs: how they are checked and run, and the report that is written after each result."""

import gc
import hashlib
import logging
import re
import socket
from collections.abc import Callable, Sequence
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
from mjstack.errors import ConfigError, MjstackError
from mjstack.files import write_atomic
from mjstack.gates.runner import log_error
from mjstack.interrupt import check_interrupt, interrupted
from mjstack.jobs.progress import STATUS_COLOR, ProgressBar
from mjstack.jobs.showing import draw_episode, find_viewers, save_page, serve_live_view
from mjstack.mdp.starts.placement import SCHEMA
from mjstack.report.html import PAGE, Page, write_page
from mjstack.report.provenance import collect_provenance
from mjstack.report.record import GateResult, Provenance, Report, Status
from mjstack.report.table import Console, Table, to_document
from mjstack.report.web import EPISODE
from mjstack.report.write import safely_write, summarize, write_report
from mjstack.sim import resolve_backend
from mjstack.sim.build import cuda_driver, cuda_name, cuda_uuid
from mjstack.sim.native import available_cores

log = logging.getLogger(__name__)


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
        report = Report(
            folder=folder, overrides=list(overrides), resumes=self.resumes or self.resumable
        )
        page = Page(title=f"{self.context.cfg.robot.title}, {self.title}")
        # The collector need not look at all that was loaded each time it frees a gate's worlds.
        gc.collect()
        gc.freeze()
        # However it ends, the finished results are in the report.
        try:
            self._do(report, page, console)
            check_interrupt()
        except (Exception, SystemExit, KeyboardInterrupt) as error:
            self._end(error, report, console)
        for finish in (partial(_write, page=page), partial(_print_summary, console)):
            try:
                finish(report)
            except Exception as error:
                log_error(error)
        gc.unfreeze()
        return report

    def _do(self, report: Report, page: Page, console: Console) -> None:
        """Do the work, and draw what it has left."""
        folder = report.folder
        where = f"{escape(self.title)} -> {escape(str(folder))}"
        console.print(f"[bold]{escape(self.context.cfg.robot.title)}[/], {where}")
        report.provenance = run_provenance(self.context)
        if self.earlier:
            report.provenance["earlier_calls"] = list(self.earlier)
        if self.context.ranks.size > 1:
            places = self.context.ranks.gather(self._place())
            report.provenance["ranks"] = [f"rank {r}: {p}" for r, p in enumerate(places)]
        _write(report, page)

        def record(result: GateResult) -> None:
            report.gates.append(result)
            _write(report, page)
            log.info("%s: %s %s", result.name, result.status, result.reason)
            bar.finish(result)

        with ProgressBar(console) as bar, serve_live_view(self.context, console) as live:
            context = replace(
                self.context,
                folder=folder,
                overrides=report.overrides,
                print_line=bar.print_line,
                begin=partial(_begin, bar, live),
                record=record,
                advance=bar.advance,
                viewers=[live] if live else find_viewers(self.context),
                live=live,
                artifacts=Artifacts(),
                page=page,
            )
            self.work(context, folder)
        report.conclude()
        _write(report, page)
        report.pictures = [*draw_episode(context, console), *page.pictures]
        page.note = save_page(context)

    def _end(self, error: BaseException, report: Report, console: Console) -> None:
        """Say why the work has ended early."""
        cause = self.context.ranks.cause(error)
        if interrupted() or isinstance(cause, KeyboardInterrupt):
            report.status = Status.interrupted
            console.print("interrupted; the finished gates are in the report")
            return
        report.status = Status.failed
        if isinstance(cause, OSError):
            problem = f"{report.folder} cannot be written: {cause.strerror}. Free space, or set"
            problem += " hydra.run.dir."
        else:
            problem = log_error(cause)
            log.error("%s", problem)
        Console(stderr=True, soft_wrap=True, markup=False).print(f"mjstack: {problem}")


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


def _begin(bar: ProgressBar, live: LiveView | None, name: str) -> None:
    """Name the part of the run that begins."""
    bar.start(name)
    if live is not None:
        live.begin(name)


def _print_summary(console: Console, report: Report) -> None:
    console.print(summarize(report.gates).to_console(STATUS_COLOR))
    if (report.folder / "report.md").exists():  # the disk may be full
        names = ["report.md", *filter(lambda n: (report.folder / n).exists(), (PAGE, EPISODE))]
        console.print(f"report: {escape(str(report.folder))}/{', '.join(names)}")
    console.print(f"status: [{STATUS_COLOR[report.status]}]{report.status}[/]")
