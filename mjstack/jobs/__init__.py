"""The jobs of the command line, by the name in `conf/job/`."""

from mjstack.jobs.job import CheckedJob, Job, JobResult, check_job

__all__ = ["CheckedJob", "Job", "JobResult", "check_job"]
