"""What the command line can run, by the name in `conf/job/`."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjstack.config.schema import Config
from mjstack.errors import ConfigError
from mjstack.jobs import collect, gates, reachability, replay, scaling, study
from mjstack.jobs.result import JobResult

__all__ = ["JOBS", "CheckedJob", "JobResult", "check_job"]


@dataclass(frozen=True, slots=True)
class Job:
    """One kind of job.

    Attributes:
        check: Raises a `MjstackError` for what cannot be done here, before anything is written.
            Returns what `run` needs, such as the scene and the plan that it built; None for the
            configuration.
        run: Does it. Gets what `check` returned, the run's folder and the command line's overrides.
        keys: Top-level keys and groups that its command line may set; None for all.
        folder: Where it goes if nobody says otherwise, for a job that resumes; None for a folder of
            the hour.
    """

    check: Callable[[Config], Any]
    run: Callable[[Any, Path, list[str]], JobResult]
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


@dataclass(frozen=True, slots=True)
class CheckedJob:
    """A job that has passed its checks.

    Attributes:
        job: Its kind.
        context: What its check returned.
        folder: Where it goes if nobody says otherwise, for a job that resumes.
    """

    job: Job
    context: Any
    folder: Path | None

    def run(self, folder: Path, overrides: list[str]) -> JobResult:
        """Runs it. Ctrl-C is an outcome, not an exception."""
        return self.job.run(self.context, folder, overrides)


def check_job(cfg: Config, overrides: Sequence[str] = ()) -> CheckedJob:
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
    context = job.check(cfg)
    folder = None if job.folder is None else job.folder(cfg)
    return CheckedJob(job, cfg if context is None else context, folder)
