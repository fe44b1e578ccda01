"""A sweep: its folder, and its jobs, each in a process with a GPU or a share of the cores."""

import json
import math
import os
import socket
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import torch

from mjstack.config import spec
from mjstack.config.complete import typed
from mjstack.config.explain import assign
from mjstack.config.session import search_path_args
from mjstack.errors import ConfigError, FolderError, first_line
from mjstack.files import check_unused, lock, move_aside, refuse_links, write_atomic
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
    before = set(listed)
    for job in jobs:
        earlier = listed.setdefault(job.number, job).overrides
        if earlier != job.overrides:
            raise FolderError(
                f"{folder} has another sweep, whose job {job.number} is {' '.join(earlier)},"
                f" expected the same jobs, which are in {SWEEP}. Set hydra.sweep.dir to another"
                " folder"
            )
        refuse_links([job.folder], "Remove it, or set hydra.sweep.dir to another folder")
        if job.number not in before or job.report() is None:
            check_unused(job.folder, key="hydra.sweep.dir")
    if len(listed) > len(before) or not (folder / SWEEP).exists():
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


def lock_file(path: Path) -> IO[bytes] | None:
    """The file, open and locked until it is closed and the process that writes it has ended; None
    if another command has it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    file = path.open("ab")
    if lock(file.fileno()):
        return file
    file.close()
    return None


@dataclass(eq=False, slots=True)
class Slot:
    """Where one job at a time runs: its name, its environment, its cores, and the lock of a GPU."""

    name: str
    env: dict[str, str] = field(default_factory=dict)
    cores: list[int] = field(default_factory=list)
    lock: Path | None = None


@dataclass(slots=True)
class Queueing:
    """How the jobs of a sweep run: the keys of ``hydra/launcher=gpus``."""

    jobs: int | None = spec(None, ge=1)
    """How many at once; null: one per GPU, or one where there is none."""
    minutes: float | None = spec(None, unit="min", gt=0.0)
    """A job that takes longer is stopped, and has failed; null: no limit."""
    retry: bool = False
    """Whether jobs that failed are repeated."""

    @classmethod
    def of(cls, launcher: Mapping[str, Any]) -> "Queueing":
        """Read the launcher's keys.

        Raises:
            ConfigError: A value is not accepted.
        """
        keys = {key: value for key, value in launcher.items() if key != "_target_"}
        return typed("hydra.launcher", keys, cls)

    def slots(self) -> list[Slot]:
        """Places for jobs: GPUs, or shares of the cores.

        Raises:
            ConfigError: There are not as many GPUs or cores.
            FolderError: The home folder cannot have the GPUs' locks.
        """
        count = self.jobs
        if gpus := torch.cuda.device_count():
            if (count or 1) > gpus:
                raise ConfigError("hydra.launcher.jobs", count, f"at most {gpus}, a GPU for each")
            visible = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(gpus)))
            # Below the home: in a shared folder, others could hold a lock for ever.
            locks = Path("~/.cache/mjstack/gpus", socket.gethostname())
            try:
                locks = locks.expanduser()
                locks.mkdir(parents=True, exist_ok=True)
            except (OSError, RuntimeError) as error:  # the other one: there is no home folder
                reason = getattr(error, "strerror", None) or first_line(error)
                problem = f"{locks}: {reason}, expected a folder for the GPUs' locks"
                raise FolderError(problem, "Set HOME to a folder of yours") from error
            return [
                Slot(f"GPU {name}", {"CUDA_VISIBLE_DEVICES": name}, lock=locks / name)
                for name in visible.split(",")[: count or gpus]
            ]
        cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
        count = count or 1
        if cores and count > len(cores):
            expected = f"at most {len(cores)}, a core for each job"
            raise ConfigError("hydra.launcher.jobs", count, expected)
        shares = [cores[n::count] for n in range(count)]
        return [Slot(f"cores {','.join(map(str, share))}", cores=share) for share in shares]


@dataclass(eq=False, slots=True)
class _Running:
    job: SweepJob
    child: Child
    logged: int  # bytes of earlier processes
    locks: ExitStack  # of the job, and of its GPU
    late: bool = False

    def conclude(self, code: int) -> Report:
        """Give the locks back, and return the report of a process that has ended."""
        self.locks.close()
        job = self.job
        if (report := job.result()) is not None:
            return report
        path = job.folder / LOG
        lines = path.read_bytes()[self.logged :].decode(errors="replace").splitlines()
        end = f"killed by signal {-code}" if code < 0 else f"exit status {code}"
        if self.late:
            end = f"not done after {self.child.seconds:.0f} s (hydra.launcher.minutes)"
        cause = next((f": {line}" for line in reversed(lines) if line.startswith("mjstack: ")), "")
        return Report(
            folder=job.folder,
            overrides=list(job.overrides),
            status=Status.interrupted if code == 130 and not self.late else Status.failed,
            gates=[GateResult(name="job", status=Status.failed, reason=f"{end}{cause} ({path})")],
        )


def run_jobs(
    folder: Path,
    jobs: Sequence[SweepJob],
    queueing: Queueing | None = None,
    finish: Callable[[dict[int, Report]], None] = lambda reports: None,
) -> list[Report]:
    """Run jobs, as many at once as there are GPUs, and return their reports in order.

    A job that has a result in its folder is not repeated. One that another command is running is
    waited for. One that was stopped goes on, if it is of a kind that can. ``finish`` gets the
    reports so far, by the jobs' numbers, when a job has ended.

    Raises:
        ConfigError: There are not as many GPUs.
        FolderError: The folder has the jobs of another sweep.
        KeyboardInterrupt: The command was interrupted; so were its jobs.
    """
    queueing = queueing or Queueing()
    queue = _Queue(jobs, queueing)
    add_jobs(folder, jobs)
    for job in jobs if queueing.retry else ():
        if (done := job.result()) is not None and done.status is Status.failed:
            move_aside(job.folder)
    try:
        while len(queue.reports) < len(jobs):
            count = len(queue.reports)
            queue.collect()
            if interrupted():
                raise KeyboardInterrupt
            queue.begin()
            if len(queue.reports) > count:
                finish(queue.reports)
            time.sleep(POLL)
    finally:
        stop_all([running.child for running in queue.running.values()])
        for running in queue.running.values():
            running.locks.close()
    return [queue.reports[job.number] for job in jobs]


class _Queue:
    """Jobs that wait for a slot, those that run, and the reports of the rest."""

    def __init__(self, jobs: Sequence[SweepJob], queueing: Queueing) -> None:
        self.running: dict[Slot, _Running] = {}
        self.reports: dict[int, Report] = {}  # by the number of the job
        self._waiting = list(jobs)
        self._slots = queueing.slots()
        self._limit = math.inf if queueing.minutes is None else 60.0 * queueing.minutes
        self._elsewhere: set[int] = set()  # printed that another command runs them
        self._print = Console(highlight=False, soft_wrap=True, markup=False).print

    def collect(self) -> None:
        """Take the reports of processes that have ended, and end those that take too long."""
        for slot, running in list(self.running.items()):
            child = running.child
            seconds = child.seconds
            if child.poll() is None and seconds > self._limit:
                running.late = True
                stop_all([child])
            if (code := child.poll()) is not None:
                del self.running[slot]
                report = self.reports[running.job.number] = running.conclude(code)
                line = f"{report.status} ({seconds:.0f} s, {slot.name})"
                self._print(f"job {running.job.number}: {line}")

    def begin(self) -> None:
        """Start waiting jobs as long as there are slots, and take results that are there."""
        for job in list(self._waiting):
            if (done := job.result()) is not None:
                self._print(f"job {job.number}: {done.status}, done before")
                self.reports[job.number] = done
                self._waiting.remove(job)
                continue
            free = [slot for slot in self._slots if slot not in self.running]
            if not free or not self._start(job, free[0]):
                break

    def _start(self, job: SweepJob, slot: Slot) -> bool:
        """Start a job, unless another command has it; return whether the slot could be had."""
        with ExitStack() as locks:
            if (log := lock_file(job.folder / LOG)) is None:
                if job.number not in self._elsewhere:
                    self._elsewhere.add(job.number)
                    self._print(f"job {job.number}: another command is running it")
                return True
            locks.enter_context(log)
            if job.result() is not None:  # just ended elsewhere
                return True
            if slot.lock is not None:
                if (gpu := lock_file(slot.lock)) is None:  # another sweep's
                    self._slots.append(self._slots.pop(self._slots.index(slot)))
                    return False
                locks.enter_context(gpu)
            job.set_aside()
            args = [*job.overrides, assign("hydra.run.dir", job.folder), *search_path_args()]
            logged = log.tell()
            child = Child(args, log, env=slot.env, cores=slot.cores)
            self.running[slot] = _Running(job, child, logged, locks.pop_all())
        self._waiting.remove(job)
        self._print(f"job {job.number} on {slot.name}: {' '.join(job.overrides)}")
        return True
