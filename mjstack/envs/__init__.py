"""The environment over both backends, and how it is built."""

import mjstack.report.gl  # noqa: F401  (before mujoco)
from mjstack.envs.build import (
    build_env,
    decided_every_step,
    demonstration_config,
    driven_config,
    make_env,
)
from mjstack.envs.camera_schedule import without_images
from mjstack.envs.env import Env

__all__ = [
    "Env",
    "build_env",
    "decided_every_step",
    "demonstration_config",
    "driven_config",
    "make_env",
    "without_images",
]
