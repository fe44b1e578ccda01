"""The jobs of the command line, by the name in `conf/job/`."""

from mjstack.jobs.runner import CheckedJob, Job, check_job

__all__ = ["CheckedJob", "Job", "check_job"]
