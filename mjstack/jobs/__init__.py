"""The jobs of the command line, by the name in `conf/job/`."""

import mjstack.report.gl  # noqa: F401  (before mujoco)
from mjstack.jobs.runner import CheckedJob, Job, check_job, check_ranks, count_devices

__all__ = ["CheckedJob", "Job", "check_job", "check_ranks", "count_devices"]
