"""Checks the time step, the solver and the batch's buffers."""

from __future__ import annotations

import math

from mjstack.config.schema import Config, SolverCfg
from mjstack.config.validate.values import positive, positive_int
from mjstack.errors import ConfigError

CONDIMS = (1, 3, 4, 6)


def check_timing(cfg: Config) -> None:
    """The step, and that a control interval is a whole number of them."""
    positive("timing.physics_dt", cfg.timing.physics_dt, "s")
    positive_int("timing.decimation", cfg.timing.decimation)
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


def check_solver_and_batch(cfg: Config) -> None:
    """The solver's limits and the buffer sizes."""
    for name in ("nconmax", "naconmax", "njmax", "nccdmax", "naccdmax"):
        value = getattr(cfg.batch, name)
        if value is not None:
            positive_int(f"batch.{name}", value)
    check_solver("solver", cfg.solver)


def check_solver(key: str, solver: SolverCfg) -> None:
    """One solver's limits."""
    for name in ("iterations", "ls_iterations"):
        value = getattr(solver, name)
        if value is not None:
            positive_int(f"{key}.{name}", value)
    for name in ("impratio", "tolerance"):
        value = getattr(solver, name)
        if value is not None:
            positive(f"{key}.{name}", value)
    if solver.gripper_condim is not None and solver.gripper_condim not in CONDIMS:
        raise ConfigError(
            f"{key}.gripper_condim",
            solver.gripper_condim,
            "1, 3, 4, 6, or null for the model's own",
        )
