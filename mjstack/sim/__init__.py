"""Physics backends behind one protocol."""

from mjstack.sim.build import (
    cuda_driver,
    cuda_name,
    cuda_uuid,
    device_memory,
    make_simulation,
    resolve_backend,
    resolve_device,
)
from mjstack.sim.model_fields import Fields
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
    "Fields",
    "Overflow",
    "Simulation",
    "SolverLimit",
    "cuda_driver",
    "cuda_name",
    "cuda_uuid",
    "describe_overflow",
    "device_memory",
    "make_simulation",
    "resolve_backend",
    "resolve_device",
    "resolve_sizes",
]
