"""Jobs: how they are checked and run, and the report that is written after each result."""

import gc
import hashlib
import importlib
import logging
import os
import re
import socket
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
import torch
from rich.markup import escape

from mjstack.config.explain import command
from mjstack.config.fingerprint import config_content, config_hash, differences
from mjstack.config.functions import find_instance
from mjstack.config.load import configured
from mjstack.config.schema import Backend, Config
from mjstack.episodes.record import EpisodeRecord
from mjstack.episodes.run import Run
from mjstack.episodes.stage import Progress, Stage
from mjstack.errors import ConfigError, MjstackError
from mjstack.gates.runner import log_error
from mjstack.interrupt import check_interrupt, interrupted
from mjstack.jobs import showing
from mjstack.jobs.progress import STATUS_COLOR, ProgressBar
from mjstack.mdp.starts.placement import SCHEMA
from mjstack.process import available_cores
from mjstack.report.formats import FORMATS, write_formats
from mjstack.report.page import Page
from mjstack.report.provenance import collect_provenance
from mjstack.report.record import GateResult, Provenance, Report, Status
from mjstack.report.sections import summarize
from mjstack.report.table import Console
from mjstack.report.web import EPISODE, lacks_viser
from mjstack.sim import resolve_backend
from mjstack.sim.build import cuda_driver, cuda_uuid

log = logging.getLogger(__name__)

VIEWS = ("view", "video")  # keys of a job that shows worlds


@dataclass(frozen=True)
class Job:
    """One kind of job; ``conf/job/<name>.yaml`` names it.

    Attributes:
        check: Raises a `MjstackError` for what cannot be done here, before anything is written.
            Returns the job ready to run, with the scene and the plan that the check built.
        keys: Top-level keys and groups that its command line may set; None for all.
        views: Keys with which it shows worlds, some of `VIEWS`.
    """

    check: Callable[[Config], "CheckedJob"]
    keys: tuple[str, ...] | None = None
    views: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class CheckedJob:
    """A job that has passed its checks.

    Attributes:
        stage: The configuration, and what its check built.
        title: The work in one line.
        work: Does it in a folder, and hands each result to the run's ``record``.
        folder: The default folder of a job that resumes; None for a folder of the hour.
        resumes: Its name in report.json, by which it knows any folder that it goes on with.
        spreads: Whether ranks share the work: `work` is called in each of them.
    """

    stage: Stage
    title: str
    work: Callable[[Run, Path], None]
    folder: Path | None = None
    resumes: str = ""
    spreads: bool = False

    def assist(self, folder: Path) -> None:
        """Do this rank's part of the work: rank 0 alone writes and prints.

        Raises:
            KeyboardInterrupt: The command was interrupted.
            Exception: The work has failed.
        """
        self.stage.progress = Progress(advance=lambda what, done, total: check_interrupt())
        self.stage.ranks.gather(self._host())
        self.work(Run(self.stage, begin=lambda name: check_interrupt()), folder)
        check_interrupt()

    def _host(self) -> str:
        """Where this rank plays."""
        return f"{socket.gethostname()}, {_device_name(*self.stage.backend)}"

    def run(self, folder: Path, overrides: Sequence[str] = ()) -> Report:
        """Do the work and write its report after each result into the folder.

        Returns:
            How it ended. Ctrl-C is an outcome, not an exception: the finished results are in the
            report.
        """
        console = Console(highlight=False, soft_wrap=True)
        cfg = self.stage.cfg
        page = Page(
            title=f"{cfg.robot.title}, {self.title}",
            command=command(*overrides),
            motion=cfg.web.episode and not lacks_viser(),
        )
        report = Report(
            folder=folder,
            overrides=list(overrides),
            resumes=self.resumes,
            pictures=page.pictures,
        )
        self._load(warp=self.stage.backend[0] is Backend.mjwarp and cfg.gates != ["baseline"])
        # However it ends, the finished results are in the report.
        try:
            self._do(report, page, console)
            check_interrupt()
        except (Exception, SystemExit, KeyboardInterrupt) as error:
            self._end(error, report, console)
        for finish in (partial(write_formats, page=page), partial(_print_summary, console)):
            try:
                finish(report)
            except Exception as error:
                log_error(error)
        gc.unfreeze()
        return report

    def _do(self, report: Report, page: Page, console: Console) -> None:
        """Do the work, and draw what it has left."""
        folder = report.folder
        where = escape(f"{self.title} -> {folder}")
        console.print(f"[bold]{escape(self.stage.cfg.robot.title)}[/], {where}")
        for line in self.stage.cfg.unused_terms:
            console.print(line, markup=False)
            log.warning("%s", line)
        report.provenance = run_provenance(self.stage)
        if self.stage.ranks.size > 1:
            hosts = self.stage.ranks.gather(self._host())
            report.provenance["ranks"] = [f"rank {r}: {p}" for r, p in enumerate(hosts)]
        write_formats(report, page)

        def record(result: GateResult) -> None:
            report.gates.append(result)
            write_formats(report, page)
            log.info("%s: %s %s", result.name, result.status, result.reason)
            bar.finish(result)

        def begin(name: str) -> None:
            bar.start(name)
            self._load(warp=name == "parity")
            if live is not None:
                live.begin(name)

        with ProgressBar(console) as bar, showing.serve_live_view(self.stage, console) as live:
            self.stage.progress = Progress(bar.print_line, bar.advance)
            self.stage.observers = [live] if live else []
            run = Run(
                self.stage,
                folder=folder,
                begin=begin,
                record=record,
                page=page,
            )
            self.work(run, folder)
        report.conclude()
        write_formats(report, page)
        showing.draw_episode(self.stage, folder, run.artifacts.pictured, run.draw)
        showing.save_page(self.stage, folder, page)

    def _load(self, *, warp: bool) -> None:
        """Load MuJoCo Warp, if asked to, and have the collector, which gates call often, pass over
        all that there is: modules and kernels are a million objects.
        """
        gc.disable()
        if warp:
            with suppress(Exception):  # what plays on it says why
                importlib.import_module("mjstack.sim.mjwarp")
        gc.enable()
        gc.collect()
        gc.freeze()

    def _end(self, error: BaseException, report: Report, console: Console) -> None:
        """Say why the work has ended early."""
        cause = self.stage.ranks.cause(error)
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


def count_devices(cfg: Config) -> int:
    """How many ranks ``devices`` asks for; one if it is null.

    Raises:
        ConfigError: There are not as many GPUs, or cores where there is no GPU, or fewer worlds.
    """
    if cfg.devices is None:
        return 1
    backend, device = resolve_backend(cfg)
    on_cuda = device.startswith("cuda")
    available = torch.cuda.device_count() if on_cuda else available_cores()
    all_of_them = available if on_cuda else 1  # one process uses all cores
    count = all_of_them if cfg.devices == "all" else int(cfg.devices)
    if count > available:
        kind = "CUDA devices" if on_cuda else "cores"
        expected = f"at most {available}, the {kind} that this machine has for sim={backend}"
        raise ConfigError("devices", cfg.devices, expected)
    _check_share(cfg, count)
    return count


def _check_share(cfg: Config, size: int) -> None:
    """Raise a `ConfigError` if there are fewer worlds than ranks."""
    if cfg.nworld < size:
        raise ConfigError("nworld", cfg.nworld, f"at least {size}, a world for each rank")


def check_ranks(stage: Stage) -> None:
    """Raise if the ranks of a job do not fit together. Called in each of them.

    Raises:
        MjstackError: Versions or configurations differ, two ranks have one GPU, or there are fewer
            worlds than ranks.
    """
    ranks = stage.ranks
    cfg = stage.cfg
    _, device = stage.backend
    host = socket.gethostname()
    provenance = collect_provenance()
    equal = {key: provenance[key] for key in ("versions", "git_commit")} | config_content(cfg)
    gpu = cuda_uuid(device) if device.startswith("cuda") else ""
    gathered = ranks.gather((host, equal, gpu))
    holders: dict[tuple[str, str], int] = {}
    for rank, (host_name, values, unit) in enumerate(gathered):
        if changes := differences(values, gathered[0][1]):
            problem = f"rank {rank} ({host_name}) has {changes} as in rank 0 ({gathered[0][0]})"
            raise MjstackError(problem, "Install and start the same everywhere")
        if unit and (holder := holders.setdefault((host_name, unit), rank)) != rank:
            problem = (
                f"ranks {holder} and {rank} ({host_name}) have one GPU, {unit}, expected one each"
            )
            fix = "Start as many ranks as there are GPUs, with sim.device=auto"
            raise MjstackError(problem, fix)
    _check_share(cfg, ranks.size)


def check_job(cfg: Config, overrides: Sequence[str] = ()) -> CheckedJob:
    """Raise for what this machine cannot do, before anything is written. The overrides are those of
    the command line without Hydra's own.
    """
    job = find_instance("job.func", cfg.job.func, Job)
    for override in overrides:
        key, _, value = override.lstrip("+~").partition("=")
        if key in ("job.name", "job.func"):  # reports and replays go by them
            raise ConfigError(key, value, "the one of a job's file", "Choose the job: job=NAME")
        if job.keys is not None and re.split(r"[.@/]", key)[0] not in job.keys:
            expected = f"only {', '.join(job.keys[1:])} beside job={cfg.job.name}"
            raise ConfigError(key, value, expected, "Leave it out")
    for key in VIEWS:
        if (value := str(getattr(cfg, key)).lower()) != "false" and key not in job.views:
            raise ConfigError(key, value, f"false with job={cfg.job.name}", "Leave it out")
    return job.check(cfg)


@dataclass(frozen=True, kw_only=True, slots=True)
class Verification:
    """Results of the gates.

    Attributes:
        status: ``pass`` if no gate failed and one passed, else ``fail``.
        gates: The results in their order: each with ``status``, ``reason``, ``metrics`` and
            ``thresholds``.
        records: The episodes of *batch* and *success*, by gate, a record for each seed.
    """

    status: Status
    gates: dict[str, GateResult]
    records: dict[str, list[EpisodeRecord]]

    @property
    def messages(self) -> list[str]:
        """The gates' lines, as the command line prints them."""
        return [f"{gate.status} {gate.name}: {gate.reason}" for gate in self.gates.values()]


def verify(
    overrides: Sequence[str] = (), *, config_dir: str | os.PathLike | None = None
) -> Verification:
    """Run the gates as the command line would. Nothing is printed, and no file is left.

    Args:
        overrides: Such as ``["task=lift", "nworld=64", "gates=[baseline,batch]"]``.
        config_dir: A folder with more choices, as of `make_env`.

    Raises:
        MjstackError: An override cannot be used, or this machine cannot do what is asked for.
    """
    report = Report(folder=Path())
    # A file of starts is copied into a folder before it is read.
    with configured(overrides, config_dir) as cfg, tempfile.TemporaryDirectory() as folder:
        checked = check_job(cfg)
        run = Run(checked.stage, record=report.gates.append)
        checked.work(run, Path(folder))
    report.conclude()
    gates = {gate.name: gate for gate in report.gates}
    return Verification(status=report.status, gates=gates, records=run.records)


def run_provenance(stage: Stage) -> Provenance:
    """Versions, machine, device, and hashes of configuration and model."""
    backend, device = stage.backend
    config = config_content(stage.cfg)
    return collect_provenance() | {
        "device": _device_name(backend, device),
        "driver": cuda_driver() if device.startswith("cuda") else "no CUDA device",
        "config_sha256": config_hash(config),
        "model_sha256": hashlib.sha256(model_bytes(stage.model).hex().encode()).hexdigest(),
        "starts_schema": SCHEMA,
        **({"files": stage.cfg.files} if stage.cfg.files else {}),
        **({"unused_terms": stage.cfg.unused_terms} if stage.cfg.unused_terms else {}),
        **({"policy": config["policy"]} if stage.cfg.policy else {}),
    }


def model_bytes(model: mujoco.MjModel) -> bytes:
    """The compiled model as MuJoCo saves it: every number as physics has it, meshes included."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def _device_name(backend: Backend, device: str) -> str:
    name = "Warp's CPU device"
    if device.startswith("cuda"):
        name = torch.cuda.get_device_name(device)
    elif backend is Backend.native:
        name = f"native MuJoCo on {available_cores()} cores"
    return f"{device}: {name}"


def _print_summary(console: Console, report: Report) -> None:
    console.print(summarize(report.gates).to_console(STATUS_COLOR))
    if (report.folder / "report.md").exists():  # the disk may be full
        names = [name for name in (*FORMATS, EPISODE) if (report.folder / name).exists()]
        console.print(f"report: {escape(str(report.folder))}/{', '.join(names)}")
    console.print(f"status: [{STATUS_COLOR[report.status]}]{report.status}[/]")
