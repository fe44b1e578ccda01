"""Checks the jobs' own values."""

from __future__ import annotations

from mjstack.config.schema import (
    CollectJobCfg,
    JobCfg,
    ReachabilityJobCfg,
    ScalingJobCfg,
    StudyJobCfg,
)
from mjstack.config.validate.physics import check_solver
from mjstack.config.validate.values import not_negative, positive, positive_int, world_count
from mjstack.errors import ConfigError, UnknownName

SCALING_BACKENDS = ("mjwarp", "native")


def check_job_keys(job: JobCfg) -> None:
    """The keys of the job that was chosen."""
    if isinstance(job, ScalingJobCfg):
        _scaling(job)
    if isinstance(job, StudyJobCfg):
        _study(job)
    if isinstance(job, ReachabilityJobCfg):
        _reachability(job)
    if isinstance(job, CollectJobCfg):
        _collect(job)


def _scaling(job: ScalingJobCfg) -> None:
    if not job.nworlds or len(set(job.nworlds)) < len(job.nworlds):
        raise ConfigError("job.nworlds", job.nworlds, "at least one number of worlds, each once")
    for nworld in job.nworlds:
        world_count("job.nworlds", nworld)
    for name in job.backends or ():
        if name not in SCALING_BACKENDS:
            raise UnknownName("job.backends: backend", name, SCALING_BACKENDS)
    if job.backends is not None and not job.backends:
        raise ConfigError(
            "job.backends", "[]", f"null, or at least one of {', '.join(SCALING_BACKENDS)}"
        )
    for key in ("repetitions", "large", "repetitions_large", "native_steps", "native_env_steps"):
        positive_int(f"job.{key}", getattr(job, key))
    positive("job.run_minutes", job.run_minutes, "min")
    if job.max_minutes is not None:
        positive("job.max_minutes", job.max_minutes, "min")


def _study(job: StudyJobCfg) -> None:
    positive_int("job.repetitions", job.repetitions)
    positive_int("job.steps", job.steps)
    positive("job.max_seconds", job.max_seconds, "s")
    if not job.variants:
        raise ConfigError("job.variants", "{}", "at least one variant of the solver")
    for name, variant in job.variants.items():
        check_solver(f"job.variants.{name}", variant)


def _reachability(job: ReachabilityJobCfg) -> None:
    positive("job.step", job.step, "m")
    not_negative("job.margin", job.margin, "m")


def _collect(job: CollectJobCfg) -> None:
    positive_int("job.episodes", job.episodes)
    positive("job.buffer_gib", job.buffer_gib, "GiB")
    if job.folder is not None and not job.folder.strip():
        raise ConfigError("job.folder", "''", "a folder, or null for outputs/collect/<hash>")
