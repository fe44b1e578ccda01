"""Scenes: a robot, a table and objects as one MjModel, and where each name lies in it."""

from mjstack.scene.build import build_model, build_scene, table_top
from mjstack.scene.index import LowestPoint, SceneIndex

__all__ = ["LowestPoint", "SceneIndex", "build_model", "build_scene", "table_top"]
