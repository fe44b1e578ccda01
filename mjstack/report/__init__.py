"""Reports: records, text and pictures."""

import mjstack.report.gl  # noqa: F401  (before mujoco)
