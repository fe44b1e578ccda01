"""Hydra launcher *gpus*: each job of a sweep in a process with a GPU of its own."""

from collections.abc import Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict


class GpuLauncher(Launcher):
    """Names the folder of each job as Hydra does, and leaves the rest to `mjstack.jobs.sweep`."""

    def __init__(self, jobs: int | None = None) -> None:
        """``jobs`` at once; None for one per GPU, or one where there is none."""
        self._jobs = jobs

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """See `Launcher`."""
        self._context = hydra_context
        self._config = config

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """See `Launcher`."""
        from mjstack.jobs.sweep import SweepJob, run_jobs  # Hydra looks at every plugin

        jobs = []
        for number, overrides in enumerate(job_overrides, initial_job_idx):
            cfg = self._context.config_loader.load_sweep_config(self._config, list(overrides))
            with open_dict(cfg):
                cfg.hydra.job.num = number
                cfg.hydra.job.id = str(number)
            HydraConfig.instance().set_config(cfg)  # for what is interpolated
            folder = Path(str(cfg.hydra.sweep.dir)) / str(cfg.hydra.sweep.subdir)
            jobs.append(SweepJob(number, folder, tuple(overrides)))
        reports = run_jobs(Path(str(self._config.hydra.sweep.dir)), jobs, self._jobs)
        return [
            JobReturn(overrides=job.overrides, status=JobStatus.COMPLETED, _return_value=report)
            for job, report in zip(jobs, reports, strict=True)
        ]
