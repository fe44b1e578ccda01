"""What the command line can run, by the name in `conf/job/`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mjstack.config.schema import Config
from mjstack.jobs import gates, study
from mjstack.jobs.outcome import JobOutcome

__all__ = ["JOBS", "JobOutcome", "check_job", "run_job"]


@dataclass(frozen=True, slots=True)
class Job:
    """One kind of job.

    Attributes:
        check: Raises a `MjstackError` for what cannot be done here, before anything is written.
        run: Does it. Gets the configuration, the run's folder and the command line's overrides.
    """

    check: Callable[[Config], None]
    run: Callable[[Config, Path, list[str]], JobOutcome]


JOBS = {
    "gates": Job(gates.check_machine, gates.run_gates_job),
    "study": Job(study.check_study, study.run_study_job),
}


def check_job(cfg: Config) -> None:
    """Raises for what this machine cannot do, before anything is written."""
    JOBS[cfg.job.name].check(cfg)


def run_job(cfg: Config, folder: Path, overrides: list[str]) -> JobOutcome:
    """Runs the job that the configuration names. Ctrl-C is an outcome, not an exception."""
    return JOBS[cfg.job.name].run(cfg, folder, overrides)
