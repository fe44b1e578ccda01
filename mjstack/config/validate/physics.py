"""Checks the time step."""

from __future__ import annotations

import math

from mjstack.config.schema import Config
from mjstack.config.validate.values import positive, positive_int
from mjstack.errors import ConfigError


def check_timing(cfg: Config) -> None:
    """A control step is a whole number of physics steps, as long as the task's."""
    positive("task.control_hz", cfg.task.control_hz, "Hz")
    positive_int("task.episode_steps", cfg.task.episode_steps)
    wanted = 1.0 / cfg.task.control_hz
    if not math.isclose(cfg.timing.step_dt, wanted, rel_tol=1e-9):
        raise ConfigError(
            "timing.physics_dt x timing.decimation",
            f"{cfg.timing.step_dt:g}",
            f"{wanted:g} s, because task '{cfg.task.name}' is controlled at"
            f" {cfg.task.control_hz:g} Hz",
            "Change both together",
        )
