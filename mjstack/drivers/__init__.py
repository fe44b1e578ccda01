"""Drivers: they give the actions of every step."""

import mjstack.report.gl  # noqa: F401  (before mujoco)
