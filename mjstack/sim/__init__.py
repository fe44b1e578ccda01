"""Physics backends behind one protocol."""

import mjstack.report.gl  # noqa: F401  (before mujoco)
from mjstack.sim.build import StateRenderer, make_simulation, resolve_backend, resolve_device
from mjstack.sim.simulation import (
    LOST_PHYSICS,
    Overflow,
    Simulation,
    SolverLimit,
    describe_overflow,
)
from mjstack.sim.sizes import BatchSizes, resolve_sizes

__all__ = [
    "LOST_PHYSICS",
    "BatchSizes",
    "Overflow",
    "Simulation",
    "SolverLimit",
    "StateRenderer",
    "describe_overflow",
    "make_simulation",
    "resolve_backend",
    "resolve_device",
    "resolve_sizes",
]
