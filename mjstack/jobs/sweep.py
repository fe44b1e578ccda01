"""A sweep: its folder, and its jobs, each in a process with a GPU."""

import json
import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from mjstack.config import spec
from mjstack.config.complete import typed
from mjstack.config.explain import assign
from mjstack.config.session import search_path_args
from mjstack.errors import ConfigError, FolderError
from mjstack.files import check_unused, move_aside, refuse_links, write_atomic
from mjstack.interrupt import interrupted
from mjstack.process import POLL, Child, stop_all
from mjstack.report.record import GateResult, Report, Status
from mjstack.report.table import Console
from mjstack.report.write import read_report

LOG = "job.log"
SWEEP = "sweep.json"
_ENDED = (Status.passed, Status.failed)


@dataclass(frozen=True)
class SweepJob:
    """A job of a sweep: its number, its folder and its overrides."""

    number: int
    folder: Path
    overrides: tuple[str, ...]

    def report(self) -> Report | None:
        """The report that its run has written so far; None if there is none."""
        return read_report(self.folder, self.overrides)

    def result(self) -> Report | None:
        """The report of its run, if that has come to its end."""
        report = self.report()
        return report if report is not None and report.status in _ENDED else None

    def set_aside(self) -> None:
        """Make room for a run: move what an earlier one has left into a folder beside this one,
        unless the job goes on with it.
        """
        earlier = self.report()
        if earlier is not None and not earlier.resumes:  # the run refuses other files
            move_aside(self.folder)


def number_jobs(folder: Path, jobs: Iterable[Sequence[str]], first: int = 0) -> list[SweepJob]:
    """The jobs of a sweep by their overrides, each in a folder that its number names."""
    return [SweepJob(n, folder / str(n), tuple(job)) for n, job in enumerate(jobs, first)]


def add_jobs(folder: Path, jobs: Sequence[SweepJob]) -> None:
    """Add jobs to the list of a sweep's folder.

    Raises:
        FolderError: The list has another job of one of these numbers, or a job's folder has other
            files than those of its run.
    """
    listed = {job.number: job for job in list_jobs(folder)}
    known = set(listed)
    for job in jobs:
        earlier = listed.setdefault(job.number, job).overrides
        if earlier != job.overrides:
            raise FolderError(
                f"{folder} has another sweep, whose job {job.number} is {' '.join(earlier)},"
                f" expected the same jobs, which are in {SWEEP}. Set hydra.sweep.dir to another"
                " folder"
            )
        refuse_links([job.folder], "Remove it, or set hydra.sweep.dir to another folder")
        if job.number not in known or job.report() is None:
            check_unused(job.folder, key="hydra.sweep.dir")
    if len(listed) > len(known) or not (folder / SWEEP).exists():
        folder.mkdir(parents=True, exist_ok=True)
        entries = {number: (job.folder.name, job.overrides) for number, job in listed.items()}
        write_atomic(folder / SWEEP, json.dumps(entries, indent=1) + "\n")


def list_jobs(folder: Path) -> list[SweepJob]:
    """The jobs in the list of a sweep's folder, by their numbers."""
    jobs = []
    with suppress(OSError, ValueError, TypeError, AttributeError):
        for number, (name, overrides) in json.loads((folder / SWEEP).read_text()).items():
            jobs.append(SweepJob(int(number), folder / name, tuple(overrides)))
    return sorted(jobs, key=lambda job: job.number)


@dataclass(slots=True)
class Queueing:
    """How the jobs of a sweep run: the keys of ``hydra/launcher=gpus``."""

    jobs: int | None = spec(None, ge=1)
    """How many at once; null: one per GPU, or one where there is none."""
    minutes: float | None = spec(None, unit="min", gt=0.0)
    """A job that takes longer is stopped, and has failed; null: no limit."""

    @classmethod
    def from_launcher(cls, launcher: Mapping[str, Any]) -> "Queueing":
        """Read the launcher's keys; a ConfigError if a value is not accepted."""
        keys = {key: value for key, value in launcher.items() if key != "_target_"}
        return typed("hydra.launcher", keys, cls)

    def gpus(self) -> list[str]:
        """The GPU of each job at a time, by its name in CUDA_VISIBLE_DEVICES; an empty one if there
        is none. A ConfigError if there are not as many.
        """
        count = torch.cuda.device_count()
        if (self.jobs or 1) > max(1, count):
            expected = f"at most {max(1, count)}, a GPU for each"
            raise ConfigError("hydra.launcher.jobs", self.jobs, expected)
        visible = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(count)))
        return visible.split(",")[: self.jobs or count] if count else [""]


def run_jobs(
    folder: Path,
    jobs: Sequence[SweepJob],
    queueing: Queueing,
    finish: Callable[[dict[int, Report]], None],
) -> list[Report]:
    """Run jobs, each in a process, as many at once as there are GPUs, and return their reports in
    order.

    A job that has a result in its folder is not repeated. One that was stopped goes on, if it is of
    a kind that can. ``finish`` gets the reports so far, by the jobs' numbers, when a job has ended.

    Raises:
        ConfigError: There are not as many GPUs.
        FolderError: The folder has the jobs of another sweep.
        KeyboardInterrupt: The command was interrupted; so were its jobs.
    """
    gpus = queueing.gpus()
    add_jobs(folder, jobs)
    limit = math.inf if queueing.minutes is None else 60.0 * queueing.minutes
    show = Console(highlight=False, soft_wrap=True, markup=False).print
    reports: dict[int, Report] = {}
    waiting = deque(jobs)
    running: dict[str, tuple[SweepJob, Child]] = {}  # by GPU
    try:
        while waiting or running:
            if interrupted():
                raise KeyboardInterrupt
            for gpu in gpus:
                while waiting and gpu not in running:
                    job = waiting.popleft()
                    if (done := job.result()) is not None:
                        show(f"job {job.number}: {done.status}, done before")
                        reports[job.number] = done
                        continue
                    running[gpu] = (job, _start(job, gpu))
                    device = f" on GPU {gpu}" if gpu else ""
                    show(f"job {job.number}{device}: {' '.join(job.overrides)}")
            for gpu, (job, child) in list(running.items()):
                timed_out = child.poll() is None and child.seconds > limit
                if timed_out:
                    stop_all([child])
                if (code := child.poll()) is not None:
                    del running[gpu]
                    report = reports[job.number] = _conclude(job, child, code, timed_out=timed_out)
                    show(f"job {job.number}: {report.status} ({child.seconds:.0f} s)")
                    finish(reports)
            time.sleep(POLL)
    finally:
        stop_all([child for _, child in running.values()])
    return [reports[job.number] for job in jobs]


def _start(job: SweepJob, gpu: str) -> Child:
    """Start the process of a job."""
    job.set_aside()
    job.folder.mkdir(parents=True, exist_ok=True)
    args = [*job.overrides, assign("hydra.run.dir", job.folder), *search_path_args()]
    with (job.folder / LOG).open("wb") as log:
        return Child(args, log, env={"CUDA_VISIBLE_DEVICES": gpu} if gpu else {})


def _conclude(job: SweepJob, child: Child, code: int, *, timed_out: bool) -> Report:
    """The report of a job whose process has ended."""
    if (report := job.result()) is not None:
        return report
    path = job.folder / LOG
    lines = path.read_text(errors="replace").splitlines()
    end = f"killed by signal {-code}" if code < 0 else f"exit status {code}"
    if timed_out:
        end = f"not done after {child.seconds:.0f} s (hydra.launcher.minutes)"
    cause = next((f": {line}" for line in reversed(lines) if line.startswith("mjstack: ")), "")
    return Report(
        folder=job.folder,
        overrides=list(job.overrides),
        status=Status.interrupted if code == 130 and not timed_out else Status.failed,
        gates=[GateResult(name="job", status=Status.failed, reason=f"{end}{cause} ({path})")],
    )
