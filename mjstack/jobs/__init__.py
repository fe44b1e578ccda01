"""What the command line can run, by the name in `conf/job/`."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mjstack.config.schema import Config
from mjstack.errors import ConfigError
from mjstack.jobs import collect, gates, reachability, replay, scaling, study
from mjstack.jobs.result import JobResult

__all__ = ["JOBS", "JobResult", "check_job", "job_folder", "run_job"]


@dataclass(frozen=True, slots=True)
class Job:
    """One kind of job.

    Attributes:
        check: Raises a `MjstackError` for what cannot be done here, before anything is written.
        run: Does it. Gets the configuration, the run's folder and the command line's overrides.
        keys: Top-level keys and groups that its command line may set; None for all.
        folder: Where it goes if nobody says otherwise, for a job that resumes; None for a folder of
            the hour.
    """

    check: Callable[[Config], None]
    run: Callable[[Config, Path, list[str]], JobResult]
    keys: tuple[str, ...] | None = None
    folder: Callable[[Config], Path] | None = None


JOBS = {
    "gates": Job(gates.check_machine, gates.run_gates_job),
    "replay": Job(replay.check_replay, replay.run_replay_job, keys=replay.KEYS),
    "scaling": Job(scaling.check_scaling, scaling.run_scaling_job, folder=scaling.scaling_folder),
    "reachability": Job(reachability.check_reachability, reachability.run_reachability_job),
    "collect": Job(collect.check_collect, collect.run_collect_job, folder=collect.collect_folder),
    "study": Job(study.check_study, study.run_study_job),
}


def check_job(cfg: Config, overrides: Sequence[str] = ()) -> None:
    """Raises for what this machine cannot do, before anything is written.

    Args:
        cfg: The configuration.
        overrides: Its command line, without Hydra's own keys.
    """
    job = JOBS[cfg.job.name]
    for override in overrides:
        key, _, value = override.lstrip("+~").partition("=")
        if job.keys is not None and re.split(r"[.@/]", key)[0] not in job.keys:
            expected = f"only {', '.join(job.keys[1:])} beside job={cfg.job.name}"
            raise ConfigError(key, value, expected, "Leave it out")
    job.check(cfg)


def job_folder(cfg: Config) -> Path | None:
    """The folder of a job that resumes, None for others."""
    find = JOBS[cfg.job.name].folder
    return None if find is None else find(cfg)


def run_job(cfg: Config, folder: Path, overrides: list[str]) -> JobResult:
    """Runs the job that the configuration names. Ctrl-C is an outcome, not an exception."""
    return JOBS[cfg.job.name].run(cfg, folder, overrides)
