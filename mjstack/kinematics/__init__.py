"""Inverse kinematics for the grasp point."""

import mjstack.report.gl  # noqa: F401  (before mujoco)
