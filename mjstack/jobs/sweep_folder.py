"""The folder of a sweep: its jobs, and what their runs have left in it so far."""

import json
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from mjstack.errors import FolderError
from mjstack.files import check_unused, lock, move_aside, refuse_links, write_atomic
from mjstack.report.record import Report, Status
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

    def set_aside(self) -> bool:
        """Make room for a run: move what an earlier one has left into a folder beside this one,
        unless the job goes on with it. Return whether the job goes on where ``resume`` says so.
        """
        earlier = self.report()  # without one, the run refuses other files
        if earlier is not None and not earlier.resumes:
            move_aside(self.folder)
            return False
        return earlier is not None and earlier.resumes == "gates"


def number_jobs(folder: Path, jobs: Iterable[Sequence[str]], first: int = 0) -> list[SweepJob]:
    """The jobs of a sweep by their overrides, each in a folder that its number names."""
    return [SweepJob(n, folder / str(n), tuple(job)) for n, job in enumerate(jobs, first)]


def add_jobs(folder: Path, jobs: Sequence[SweepJob]) -> None:
    """Add jobs to the list of a sweep's folder.

    Raises:
        FolderError: The list has another job of one of these numbers, or a job's folder has other
            files than those of its run.
    """
    listed = {job.number: _entry(job) for job in list_jobs(folder)}
    before = dict(listed)
    for job in jobs:
        entry = _entry(job)
        if listed.setdefault(job.number, entry) != entry:
            overrides = " ".join(listed[job.number][1])
            raise FolderError(
                f"{folder} has another sweep, whose job {job.number} is {overrides}, expected the"
                f" same jobs, which are in {SWEEP}. Set hydra.sweep.dir to another folder"
            )
        refuse_links([job.folder], "Remove it, or set hydra.sweep.dir to another folder")
        if job.number not in before or job.report() is None:
            check_unused(job.folder, key="hydra.sweep.dir")
    if listed != before or not (folder / SWEEP).exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(folder / SWEEP, json.dumps(listed, indent=1) + "\n")


def _entry(job: SweepJob) -> tuple[str, list[str]]:
    """A job's folder and overrides in the list of a sweep's folder."""
    return job.folder.name, list(job.overrides)


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
