"""A job: its check, and its run."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjstack.config.schema import Config
from mjstack.errors import ConfigError
from mjstack.jobs.result import JobResult
from mjstack.managers.term import find_object


@dataclass(frozen=True, slots=True)
class Job:
    """One kind of job; ``conf/job/<name>.yaml`` names it.

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
    job = find_object("job.func", cfg.job.func)
    if not isinstance(job, Job):
        raise ConfigError("job.func", cfg.job.func, "a mjstack.jobs.Job")
    for override in overrides:
        key, _, value = override.lstrip("+~").partition("=")
        if job.keys is not None and re.split(r"[.@/]", key)[0] not in job.keys:
            expected = f"only {', '.join(job.keys[1:])} beside job={cfg.job.name}"
            raise ConfigError(key, value, expected, "Leave it out")
    context = job.check(cfg)
    folder = None if job.folder is None else job.folder(cfg)
    return CheckedJob(job, cfg if context is None else context, folder)
