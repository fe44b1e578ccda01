"""What the command line can run, by the name in `conf/job/`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mjstack.config.schema import Config
from mjstack.jobs import gates, scaling
from mjstack.jobs.outcome import JobOutcome

__all__ = ["JOBS", "JobOutcome", "check_job", "job_folder", "run_job"]


@dataclass(frozen=True, slots=True)
class Job:
    """One kind of job.

    Attributes:
        check: Raises a `MjstackError` for what cannot be done here, before anything is written.
        run: Does it. Gets the configuration, the run's folder and the command line's overrides.
        folder: Where it goes if nobody says otherwise, for a job that resumes; None for a folder of the hour.
    """

    check: Callable[[Config], None]
    run: Callable[[Config, Path, list[str]], JobOutcome]
    folder: Callable[[Config], Path] | None = None


JOBS = {
    "gates": Job(gates.check_machine, gates.run_gates_job),
    "scaling": Job(scaling.check_scaling, scaling.run_scaling_job, scaling.scaling_folder),
}


def check_job(cfg: Config) -> None:
    """Raises for what this machine cannot do, before anything is written."""
    JOBS[cfg.job.name].check(cfg)


def job_folder(cfg: Config) -> Path | None:
    """The folder of a job that resumes, None for others."""
    find = JOBS[cfg.job.name].folder
    return None if find is None else find(cfg)


def run_job(cfg: Config, folder: Path, overrides: list[str]) -> JobOutcome:
    """Runs the job that the configuration names. Ctrl-C is an outcome, not an exception."""
    return JOBS[cfg.job.name].run(cfg, folder, overrides)
