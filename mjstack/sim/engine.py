"""MuJoCo Warp, imported in one place: Warp starts on import and would greet on every run."""

import warp as wp

wp.config.log_level = wp.LOG_ERROR
import mujoco_warp as mjw  # noqa: E402

__all__ = ["mjw"]
