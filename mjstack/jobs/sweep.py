"""The jobs of a sweep, each in a process with a GPU, or with its cores where there is none."""

import fcntl
import json
import os
import shutil
import signal
import stat
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import torch

from mjstack.config.session import quoted, search_path_args
from mjstack.errors import ConfigError, FolderError
from mjstack.files import write_atomic
from mjstack.interrupt import interrupted
from mjstack.process import own_command
from mjstack.report.record import GateResult, Report, Status
from mjstack.report.table import Console
from mjstack.report.write import read_report

LOG = "job.log"
SWEEP = "sweep.json"
_POLL = 0.1  # s, between two looks at the processes
_GRACE = 30.0  # s, in which an interrupted job must have ended
_ENDED = (Status.passed, Status.failed)


@dataclass(frozen=True, slots=True)
class SweepJob:
    """A job of a sweep: its number, its folder and its overrides."""

    number: int
    folder: Path
    overrides: tuple[str, ...]


@dataclass(eq=False, slots=True)
class Slot:
    """Where one job at a time runs: its name, its environment, its cores, and the lock of a GPU."""

    name: str
    env: dict[str, str] = field(default_factory=dict)
    cores: list[int] = field(default_factory=list)
    lock: Path | None = None


@dataclass(eq=False, slots=True)
class _Running:
    job: SweepJob
    process: subprocess.Popen[bytes]
    log: IO[bytes]
    logged: int  # bytes of earlier processes
    held: IO[bytes] | None
    began: float

    def close(self) -> None:
        """Give the locks of the job and of its GPU back."""
        self.log.close()
        if self.held is not None:
            self.held.close()


@contextmanager
def shared_sweep(folder: Path, jobs: Sequence[SweepJob] = ()) -> Iterator[Path]:
    """A sweep's folder in which several commands work off its jobs.

    Args:
        folder: The folder.
        jobs: The jobs, as far as they are known.

    Raises:
        FolderError: It has something else, or cannot be made.
    """
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    if names and SWEEP not in names:
        raise FolderError(
            f"{folder} has {sorted(names)[0]}, expected a new or an empty folder, or one of"
            " hydra/launcher=gpus. Set hydra.sweep.dir to another"
        )
    _with_those_there(folder, jobs)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FolderError(f"{folder} cannot be written ({error.strerror})") from error
    yield folder


def run_jobs(folder: Path, jobs: Sequence[SweepJob], count: int | None = None) -> list[Report]:
    """Run jobs, as many at once as there are GPUs, and return their reports in order.

    A job that has a result in its folder is not repeated. One that another command is running is
    waited for. One that was stopped goes on, if it is of a kind that can.

    Args:
        folder: The sweep's folder.
        jobs: The jobs, all or some of the sweep's.
        count: How many at once; None for one per GPU, or one where there is none.

    Raises:
        ConfigError: The number is none, or there are not as many GPUs.
        FolderError: The folder has the jobs of another sweep.
        KeyboardInterrupt: The command was interrupted; so were its jobs.
    """
    slots = find_slots(count)
    every = _with_those_there(folder, jobs)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomic(folder / SWEEP, json.dumps(every, indent=1) + "\n")
    queue = _Queue(jobs, slots)
    try:
        while len(queue.reports) < len(jobs):
            queue.collect()
            if interrupted():
                raise KeyboardInterrupt
            queue.begin()
            time.sleep(_POLL)
    finally:
        _stop(queue.running)
    return [queue.reports[job.number] for job in jobs]


class _Queue:
    """Jobs that wait for a slot, those that run, and the reports of the others.

    Attributes:
        running: Processes of jobs, by slot.
        reports: Reports, by the number of the job.
    """

    def __init__(self, jobs: Sequence[SweepJob], slots: list[Slot]) -> None:
        self.running: dict[Slot, _Running] = {}
        self.reports: dict[int, Report] = {}
        self._waiting = list(jobs)
        self._slots = slots
        self._elsewhere: set[int] = set()  # what has been said to run there
        several = len(jobs) > 1
        self._common = set.intersection(*(set(job.overrides) for job in jobs)) if several else set()
        self._say = Console(highlight=False, soft_wrap=True, markup=False).print

    def collect(self) -> None:
        """Take the reports of processes that have ended."""
        for slot, one in list(self.running.items()):
            if (code := one.process.poll()) is not None:
                del self.running[slot]
                report = self.reports[one.job.number] = _conclude(one, code)
                seconds = time.monotonic() - one.began
                self._say(f"job {one.job.number}: {report.status} ({seconds:.0f} s, {slot.name})")

    def begin(self) -> None:
        """Start waiting jobs as long as there are slots, and take results that are there."""
        for job in list(self._waiting):
            if (done := _result(job)) is not None:
                self._say(f"job {job.number}: {done.status}, done before")
                self.reports[job.number] = done
                self._waiting.remove(job)
                continue
            free = [slot for slot in self._slots if slot not in self.running]
            if not free or not self._start(job, free[0]):
                break

    def _start(self, job: SweepJob, slot: Slot) -> bool:
        """Start a job, unless another command has it; return whether the slot could be had."""
        log = _lock(job.folder / LOG)
        if log is None:
            if job.number not in self._elsewhere:
                self._say(f"job {job.number}: another command is running it")
            self._elsewhere.add(job.number)
            return True
        if _result(job) is not None:  # it has just ended elsewhere
            log.close()
            return True
        held = None if slot.lock is None else _lock(slot.lock)
        if slot.lock is not None and held is None:  # another sweep's
            log.close()
            self._slots.append(self._slots.pop(self._slots.index(slot)))
            return False
        self.running[slot] = _start(job, slot, log, held)
        self._waiting.remove(job)
        own = [each for each in job.overrides if each not in self._common]
        self._say(f"job {job.number} on {slot.name}: {' '.join(own)}")
        return True


def find_slots(count: int | None) -> list[Slot]:
    """Places for jobs: GPUs, or shares of the cores.

    Raises:
        ConfigError: The number is none, or there are not as many.
        FolderError: Another user has the folder of the GPUs' locks.
    """
    if count is not None and (type(count) is not int or count < 1):
        raise ConfigError("hydra.launcher.jobs", count, "null, or an integer of at least 1")
    gpus = torch.cuda.device_count()
    if gpus:
        if (count or 1) > gpus:
            raise ConfigError("hydra.launcher.jobs", count, f"at most {gpus}, a GPU for each")
        visible = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(gpus)))
        locks = _lock_folder()
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


def _lock_folder() -> Path:
    """This user's folder with a lock for each GPU, on this machine. Others may not write there:
    they could hold a lock for ever, or put a link in its place.

    Raises:
        FolderError: Another user has made it.
    """
    folder = Path(tempfile.gettempdir()) / f"mjstack-gpus-{os.getuid()}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        raise FolderError(
            f"{folder} is another user's or no folder, expected one of yours, for locks of GPUs",
            "Set TMPDIR to a folder of yours",
        )
    folder.chmod(0o700)
    return folder


def _with_those_there(folder: Path, jobs: Sequence[SweepJob]) -> dict[str, Any]:
    """Folders and overrides of the jobs and of those in the sweep's list, by their numbers. A
    sweeper may bring them in several batches.

    Raises:
        FolderError: The list has another job of one of these numbers.
    """
    theirs: dict[str, Any] = {}
    with suppress(OSError, ValueError):
        theirs = dict(json.loads((folder / SWEEP).read_text()))
    ours = {
        str(job.number): [os.path.relpath(job.folder, folder), list(job.overrides)] for job in jobs
    }
    for number, job in ours.items():
        if theirs.get(number, job) != job:
            raise FolderError(
                f"{folder} has another sweep, whose job {number} is"
                f" {' '.join(theirs[number][1])}, expected the same jobs, which are in {SWEEP}. Set"
                " hydra.sweep.dir to another folder"
            )
    return theirs | ours


def _result(job: SweepJob) -> Report | None:
    report = read_report(job.folder, job.overrides)
    return report if report is not None and report.status in _ENDED else None


def _lock(path: Path) -> IO[bytes] | None:
    """The file, open and locked until it is closed and the process that writes it has ended; None
    if another command has it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    file = path.open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return None
    return file


def _start(job: SweepJob, slot: Slot, log: IO[bytes], held: IO[bytes] | None) -> _Running:
    """Start the process of a job, which goes on with what an earlier one has left."""
    earlier = read_report(job.folder, job.overrides)
    args = list(job.overrides)
    if earlier is not None and earlier.resumes == "gates":
        args.append(f"resume={quoted(job.folder)}")
    else:
        args.append(f"hydra.run.dir={quoted(job.folder)}")
        if earlier is None or not earlier.resumes:  # nothing that another process can use
            for path in [path for path in job.folder.iterdir() if path.name != LOG]:
                (shutil.rmtree if path.is_dir() and not path.is_symlink() else os.remove)(path)
    logged = log.tell()
    process = subprocess.Popen(
        own_command([*args, *search_path_args()]),
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=subprocess.STDOUT,
        env=os.environ | slot.env,
        start_new_session=True,  # Ctrl-C of the terminal comes through this process
    )
    if slot.cores:
        with suppress(OSError):  # it may have ended
            os.sched_setaffinity(process.pid, slot.cores)
    return _Running(job, process, log, logged, held, time.monotonic())


def _conclude(one: _Running, code: int) -> Report:
    """The report of a job whose process has ended."""
    one.close()
    if (done := _result(one.job)) is not None:
        return done
    with (one.job.folder / LOG).open("rb") as log:
        log.seek(one.logged)
        lines = log.read().decode(errors="replace").splitlines()
    how = f"killed by signal {-code}" if code < 0 else f"exit status {code}"
    why = next((line for line in reversed(lines) if line.startswith("mjstack: ")), "")
    reason = f"{how}{f': {why}' if why else ''} ({one.job.folder / LOG})"
    report = Report(folder=one.job.folder, overrides=list(one.job.overrides))
    report.status = Status.interrupted if code == 130 else Status.failed
    report.gates = [GateResult(name="job", status=Status.failed, reason=reason)]
    return report


def _stop(running: dict[Slot, _Running]) -> None:
    """Interrupt the jobs that run, and wait for them."""
    for one in running.values():
        with suppress(OSError):
            one.process.send_signal(signal.SIGINT)
    until = time.monotonic() + _GRACE
    for one in running.values():
        try:
            one.process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            one.process.kill()
            one.process.wait()
        one.close()
