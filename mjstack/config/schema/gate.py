"""The gates' thresholds."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING


@dataclass(kw_only=True, slots=True)
class ParityCfg:
    """Tolerances of MJWarp against native MuJoCo: ``step1`` and ``step50`` map a field to its
    largest difference.
    """

    states: dict[str, str] = MISSING
    step1: dict[str, float] = MISSING
    step50: dict[str, float] = MISSING
    object_position: float = MISSING
    object_rotation_deg: float = MISSING


@dataclass(kw_only=True, slots=True)
class CapacityCfg:
    """How buffers are sized.

    ``cpu_nworld`` worlds do where worlds are slow (any CPU backend); on CUDA all nworld do.
    Recommended sizes are ``margin`` times the peaks. Random actions last ``random_steps``, one
    whole episode if null. ``reset`` is how worlds start in the workload of randomised starts. An
    environment with ``batch=auto`` is sized by ``probe_steps`` of random actions, on CUDA in at
    most ``probe_nworld`` worlds.
    """

    cpu_nworld: int = MISSING
    margin: float = MISSING
    random_steps: int | None = None
    probe_nworld: int = MISSING
    probe_steps: int = MISSING
    reset: dict[str, Any] = field(default_factory=dict)


@dataclass(kw_only=True, slots=True)
class BatchGateCfg:
    """The batch gate. It plays ``seeds`` seeds, the configured one and those after it, and judges
    their worlds together.
    """

    seeds: int = MISSING
    failed_worlds: int = MISSING
    distinct_fraction: float = MISSING


@dataclass(kw_only=True, slots=True)
class ThroughputCfg:
    """How throughput is measured."""

    measurements: list[str] = MISSING
    repetitions: int = MISSING
    steps: int = MISSING
    env_steps: int = MISSING
    max_seconds: float = MISSING
    cpu_max_seconds: float = MISSING
    from_phase: str = MISSING
    start_worlds: int = MISSING
    native_baseline: bool = MISSING


@dataclass(kw_only=True, slots=True)
class SuccessGateCfg:
    """The success gate: ``seeds`` seeds of nworld episodes each, of which the share ``rate`` must
    succeed.

    ``reset`` is how worlds start, unless ``reset=starts_file`` names a file. ``region`` sets the
    half-widths of the cubes' region in x and y; null leaves them as ``reset`` has them. Start
    places are counted in cells ``cell`` wide, directions of a cube relative to that of its place as
    seen from the base in bins of ``yaw_cell_deg``. The ``worst_regions`` worst cells with at least
    ``cell_episodes`` episodes are in the report's text.
    """

    seeds: int = MISSING
    rate: float = MISSING
    region: list[float] | None = None
    cell: float = MISSING
    yaw_cell_deg: float = MISSING
    cell_episodes: int = MISSING
    worst_regions: int = MISSING
    reset: dict[str, Any] = field(default_factory=dict)


@dataclass(kw_only=True, slots=True)
class GateCfg:
    """Thresholds of every gate."""

    parity: ParityCfg = field(default_factory=ParityCfg)
    capacity: CapacityCfg = field(default_factory=CapacityCfg)
    batch: BatchGateCfg = field(default_factory=BatchGateCfg)
    throughput: ThroughputCfg = field(default_factory=ThroughputCfg)
    success: SuccessGateCfg = field(default_factory=SuccessGateCfg)
