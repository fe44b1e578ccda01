"""Terms: plain functions on batched views."""

import mjstack.report.gl  # noqa: F401  (before mujoco)
