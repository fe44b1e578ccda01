"""The jobs of the command line, by the name in `conf/job/`."""

from mjstack.jobs.job import CheckedJob, Job, check_job
from mjstack.jobs.result import JobResult

__all__ = ["CheckedJob", "Job", "JobResult", "check_job"]
