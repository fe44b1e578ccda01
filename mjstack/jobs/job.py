"""A job: its check, its run, and its result."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mjstack.config.functions import find_object
from mjstack.config.schema import Config
from mjstack.errors import ConfigError
from mjstack.report.record import GateResult, Status


@dataclass(kw_only=True, slots=True)
class JobResult:
    """How a job ended."""

    status: Status
    folder: Path
    overrides: list[str]
    gates: list[GateResult] = field(default_factory=list)

    @property
    def exit_code(self) -> int:
        """0 pass, 1 a gate failed, 130 interrupted."""
        return {Status.passed: 0, Status.interrupted: 130}.get(self.status, 1)


@dataclass(frozen=True, slots=True)
class Job:
    """One kind of job; ``conf/job/<name>.yaml`` names it.

    Attributes:
        check: Raises a `MjstackError` for what cannot be done here, before anything is written.
            Returns what `run` needs, such as the scene and the plan that it built.
        run: Does it. Gets what `check` returned, the run's folder and the command line's overrides.
        keys: Top-level keys and groups that its command line may set; None for all.
        folder: The default folder of a job that resumes; None for a folder of the hour.
        shows: Whether it can show a world (``view``, ``video``).
    """

    check: Callable[[Config], Any]
    run: Callable[[Any, Path, list[str]], JobResult]
    keys: tuple[str, ...] | None = None
    folder: Callable[[Config], Path] | None = None
    shows: bool = False


@dataclass(frozen=True, slots=True)
class CheckedJob:
    """A job that has passed its checks.

    Attributes:
        job: Its kind.
        context: The product of its check.
        folder: The default folder of a job that resumes.
    """

    job: Job
    context: Any
    folder: Path | None

    def run(self, folder: Path, overrides: list[str]) -> JobResult:
        """Run it. Ctrl-C is an outcome, not an exception."""
        return self.job.run(self.context, folder, overrides)


def check_job(cfg: Config, overrides: Sequence[str] = ()) -> CheckedJob:
    """Raise for what this machine cannot do, before anything is written.

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
    for key in ("view", "video"):
        if getattr(cfg, key) and not job.shows:
            expected = f"false with job={cfg.job.name}, which shows no world"
            raise ConfigError(key, "true", expected, "Leave it out")
    context = job.check(cfg)
    return CheckedJob(job, context, None if job.folder is None else job.folder(cfg))
