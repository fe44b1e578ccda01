"""Hydra launcher *gpus*: runs the jobs of a sweep each in a process with a GPU of its own."""

from collections.abc import Sequence
from functools import partial
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class GpuLauncher(Launcher):
    """Names the folder of each job as Hydra does, and leaves the rest to `mjstack.jobs.sweep`."""

    def __init__(self, **queueing: Any) -> None:
        """Take the attributes of `mjstack.jobs.sweep.Queueing`."""
        self._queueing = queueing

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """See `Launcher`."""
        self._loader = hydra_context.config_loader
        self._config = config

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """See `Launcher`."""
        # Hydra looks at every plugin, and these load torch.
        from mjstack.cli_sweep import hydra_path, place_job
        from mjstack.jobs.sweep import Queueing, run_jobs
        from mjstack.jobs.sweep_table import update_summary

        jobs = []
        for number, overrides in enumerate(job_overrides, initial_job_idx):
            cfg = self._loader.load_sweep_config(self._config, list(overrides))
            jobs.append(place_job(cfg, number, overrides))
        folder = hydra_path(self._config, "sweep.dir")
        finish = partial(update_summary, folder, self._config)
        reports = run_jobs(folder, jobs, Queueing.of(self._queueing), finish)
        return [
            JobReturn(overrides=job.overrides, status=JobStatus.COMPLETED, _return_value=report)
            for job, report in zip(jobs, reports, strict=True)
        ]
