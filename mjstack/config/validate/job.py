"""Checks the jobs' values against each other."""

from __future__ import annotations

from mjstack.config.schema import CollectJobCfg, JobCfg, ScalingJobCfg, StudyJobCfg
from mjstack.errors import ConfigError


def check_job_keys(job: JobCfg) -> None:
    """The keys of the job that was chosen."""
    if isinstance(job, ScalingJobCfg):
        if not job.nworlds or len(set(job.nworlds)) < len(job.nworlds):
            raise ConfigError(
                "job.nworlds", job.nworlds, "at least one number of worlds, each once"
            )
        if job.backends is not None and not job.backends:
            raise ConfigError("job.backends", "[]", "null, or at least one of mjwarp, native")
    if isinstance(job, StudyJobCfg) and not job.variants:
        raise ConfigError("job.variants", "{}", "at least one variant of the solver")
    if isinstance(job, CollectJobCfg) and job.folder is not None and not job.folder.strip():
        raise ConfigError("job.folder", "''", "a folder, or null for outputs/collect/<hash>")
