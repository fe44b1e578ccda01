"""The folder of a sweep: its jobs, and what their runs have left in it so far."""

import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from mjstack.errors import FolderError
from mjstack.files import lock_folder, write_atomic
from mjstack.report.record import Report, Status
from mjstack.report.write import read_report

LOG = "job.log"
SWEEP = "sweep.json"
_ENDED = (Status.passed, Status.failed)


@dataclass(frozen=True, slots=True)
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

    def clear(self, *, anew: bool = False) -> Report | None:
        """Make room for a run: remove what an earlier one has left beside logs and Hydra's files,
        unless the job goes on with it and shall not begin anew.

        Returns:
            The report of the run with which the job goes on.
        """
        earlier = None if anew else self.report()
        if earlier is not None and earlier.resumes:
            return earlier
        for path in [*self.folder.glob("*")]:
            if path.name != ".hydra" and path.suffix != ".log":  # these may be open
                (shutil.rmtree if path.is_dir() and not path.is_symlink() else os.remove)(path)
        return None


@contextmanager
def shared_sweep(
    folder: Path, jobs: Sequence[SweepJob] = (), *, alone: bool = False
) -> Iterator[Path]:
    """A sweep's folder in which one or several commands work off its jobs.

    Args:
        folder: The folder.
        jobs: The jobs, as far as they are known.
        alone: Whether no other command may work in it meanwhile.

    Raises:
        FolderError: It has something else, cannot be made, or another command has it.
    """
    names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    if names and SWEEP not in names:
        raise FolderError(
            f"{folder} has {min(names)}, expected a new or an empty folder, or one of a sweep that"
            " this command goes on with. Set hydra.sweep.dir to another"
        )
    _all_jobs(folder, jobs)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = lock_folder(folder, shared=not alone)
    except OSError as error:
        raise FolderError(f"{folder} cannot be written ({error.strerror})") from error
    try:
        yield folder
    finally:
        os.close(handle)


def add_jobs(folder: Path, jobs: Sequence[SweepJob]) -> None:
    """Add jobs to the list of a sweep's folder. A sweeper may bring them in several batches.

    Raises:
        FolderError: The list has another job of one of these numbers.
    """
    listed = json.dumps(_all_jobs(folder, jobs), indent=1) + "\n"
    file = folder / SWEEP
    if not file.exists() or file.read_text() != listed:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(file, listed)


def list_jobs(folder: Path) -> list[SweepJob]:
    """The jobs in the list of a sweep's folder, by their numbers."""
    jobs = []
    with suppress(OSError, ValueError, TypeError, AttributeError):
        for number, (name, overrides) in json.loads((folder / SWEEP).read_text()).items():
            path = Path(os.path.normpath(folder / name))
            jobs.append(SweepJob(int(number), path, tuple(overrides)))
    return sorted(jobs, key=lambda job: job.number)


def lock_file(path: Path) -> IO[bytes] | None:
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


def _all_jobs(folder: Path, jobs: Sequence[SweepJob]) -> dict[str, list]:
    """Folders and overrides of the jobs and of those in the sweep's list, by their numbers."""
    listed, added = (
        {
            str(job.number): [os.path.relpath(job.folder, folder), list(job.overrides)]
            for job in sweep
        }
        for sweep in (list_jobs(folder), jobs)
    )
    for number, job in added.items():
        before = listed.get(number, job)
        if before != job:
            raise FolderError(
                f"{folder} has another sweep, whose job {number} is {' '.join(before[1])}, expected"
                f" the same jobs, which are in {SWEEP}. Set hydra.sweep.dir to another folder"
            )
    return listed | added
