"""Hydra launchers: *local* runs the jobs of a sweep one after another in the command's process,
*gpus* each in a process with a GPU of its own.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn, JobStatus, run_job
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

if TYPE_CHECKING:  # Hydra looks at every plugin
    from mjstack.jobs.sweep_folder import SweepJob
    from mjstack.report.record import Report


class LocalLauncher(Launcher):
    """Goes on with a sweep: jobs with a result are not repeated."""

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """See `Launcher`."""
        self._context = hydra_context
        self._config = config
        self._work = task_function

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """See `Launcher`."""
        from mjstack.jobs.sweep_folder import add_jobs

        jobs = list(self._jobs(job_overrides, initial_job_idx))
        add_jobs(self._folder, [job for job, _ in jobs])
        return [self._run(job, cfg) for job, cfg in jobs]

    @property
    def _folder(self) -> Path:
        return Path(str(self._config.hydra.sweep.dir))

    def _jobs(
        self, job_overrides: Sequence[Sequence[str]], first: int
    ) -> Iterator[tuple["SweepJob", DictConfig]]:
        """The jobs, in folders named as Hydra names them, and their configurations."""
        from mjstack.jobs.sweep_folder import SweepJob

        for number, overrides in enumerate(job_overrides, first):
            cfg = self._context.config_loader.load_sweep_config(self._config, list(overrides))
            with open_dict(cfg):
                cfg.hydra.job.num = number
                cfg.hydra.job.id = str(number)
            HydraConfig.instance().set_config(cfg)  # for what is interpolated
            folder = Path(str(cfg.hydra.sweep.dir)) / str(cfg.hydra.sweep.subdir)
            yield SweepJob(number, folder, tuple(overrides)), cfg

    def _run(self, job: "SweepJob", cfg: DictConfig) -> JobReturn:
        if (done := job.result()) is not None:
            print(f"job {job.number}: {done.status}, done before", flush=True)
            return _finished(job, done)
        job.clear()
        return run_job(
            task_function=self._work,
            config=cfg,
            job_dir_key="hydra.sweep.dir",
            job_subdir_key="hydra.sweep.subdir",
            hydra_context=self._context,
        )


class GpuLauncher(LocalLauncher):
    """Names the folder of each job as Hydra does, and leaves the rest to `mjstack.jobs.sweep`."""

    def __init__(
        self, jobs: int | None = None, minutes: float | None = None, retry: bool = False
    ) -> None:
        """As of `mjstack.jobs.sweep.Queueing`."""
        self._keys = (jobs, minutes, retry)

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """See `Launcher`."""
        from mjstack.jobs.sweep import Queueing, run_jobs
        from mjstack.jobs.sweep_table import sweep_config, update_summary

        jobs = [job for job, _ in self._jobs(job_overrides, initial_job_idx)]
        sweep = sweep_config(self._config)
        reports = run_jobs(
            self._folder,
            jobs,
            Queueing(*self._keys),
            partial(update_summary, self._folder, sweep),
        )
        return [_finished(job, report) for job, report in zip(jobs, reports, strict=True)]


def _finished(job: "SweepJob", report: "Report") -> JobReturn:
    return JobReturn(overrides=job.overrides, status=JobStatus.COMPLETED, _return_value=report)
