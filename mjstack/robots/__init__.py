"""Robots: the built-in MJCF files and where else a description can come from."""

from mjstack.robots.source import robot_spec

__all__ = ["robot_spec"]
