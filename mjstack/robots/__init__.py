"""Robots: the built-in MJCF files and where else a description can come from."""

import mjstack.report.gl  # noqa: F401  (before mujoco)
from mjstack.robots.source import read_robot, robot_spec

__all__ = ["read_robot", "robot_spec"]
