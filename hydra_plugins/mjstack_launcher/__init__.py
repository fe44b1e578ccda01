"""Hydra launcher *gpus*: runs the jobs of a sweep each in a process with a GPU of its own."""

from collections.abc import Sequence
from functools import partial
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class GpuLauncher(Launcher):
    """Leaves the jobs to `mjstack.jobs.sweep`."""

    def __init__(self, **queueing: Any) -> None:
        """Take the attributes of `mjstack.jobs.sweep.Queueing`."""
        self._queueing = queueing

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """See `Launcher`."""
        self._config = config

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """See `Launcher`."""
        # Hydra looks at every plugin, and these load torch.
        from mjstack.cli_sweep import hydra_path
        from mjstack.jobs.sweep import Queueing, number_jobs, run_jobs
        from mjstack.jobs.sweep_table import update_summary

        folder = hydra_path(self._config, "sweep.dir")
        jobs = number_jobs(folder, job_overrides, initial_job_idx)
        finish = partial(update_summary, folder)
        reports = run_jobs(folder, jobs, Queueing.from_launcher(self._queueing), finish)
        return [
            JobReturn(overrides=job.overrides, status=JobStatus.COMPLETED, _return_value=report)
            for job, report in zip(jobs, reports, strict=True)
        ]
