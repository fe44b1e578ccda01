"""Scenes: a robot, a table and objects as one MjModel, and where each name lies in it."""

import mjstack.report.gl  # noqa: F401  (before mujoco)
from mjstack.scene.build import build_model
from mjstack.scene.index import SceneIndex

__all__ = ["SceneIndex", "build_model"]
