"""Trainers: how policies come about."""

import mjstack.report.gl  # noqa: F401  (before mujoco)
