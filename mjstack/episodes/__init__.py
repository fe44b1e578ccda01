"""Episodes: the rollout that every gate and job plays, and what is kept of it."""

import mjstack.report.gl  # noqa: F401  (before mujoco)
