"""Configures Warp, in one place and before its first use: it would greet on every run."""

import warp as wp

__all__ = ["wp"]

wp.config.log_level = wp.LOG_ERROR
