"""The physics: engine and device, time step, solver, and sizes of the batch."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from mjstack.config.fields import spec


class Backend(Enum):
    """Which physics engine steps the worlds of batch and throughput."""

    auto = "auto"
    native = "native"
    mjwarp = "mjwarp"


class GraphMode(Enum):
    """Whether control steps are captured into a graph and replayed."""

    auto = "auto"
    require = "require"
    off = "off"


class Cone(Enum):
    """Shape of the friction cone."""

    elliptic = "elliptic"
    pyramidal = "pyramidal"


@dataclass(kw_only=True, slots=True)
class TimingCfg:
    """Physics step and control interval."""

    physics_dt: float = spec(unit="s", gt=0.0)
    """Duration of one physics step."""
    decimation: int = spec(unit="physics steps", ge=1)
    """Physics steps of one control step."""

    @property
    def step_dt(self) -> float:
        """Time between two commands [s]."""
        return self.physics_dt * self.decimation


@dataclass(kw_only=True, slots=True)
class SolverCfg:
    """Constraint solver. null keeps the model file's own value."""

    iterations: int | None = spec(None, ge=1)
    """Most iterations of the solver."""
    ls_iterations: int | None = spec(None, ge=1)
    """Most iterations of its line search."""
    impratio: float | None = spec(None, gt=0.0)
    """Ratio of frictional to normal constraint impedance."""
    tolerance: float | None = spec(None, gt=0.0)
    """Improvement below which the solver stops."""
    cone: Cone = Cone.elliptic
    """Shape of the friction cone."""
    gripper_condim: int | None = spec(None, choices=(1, 3, 4, 6))
    """Contact dimension of the geoms of ``robot.jaw_bodies``."""


@dataclass(kw_only=True, slots=True)
class BatchCfg:
    """MJWarp's buffer sizes. null takes the default of this robot and scene (nconmax, njmax) or of
    MJWarp.
    """

    auto: bool = False
    """Whether sizes that are null are measured first, as ``gate.capacity`` says."""
    nconmax: int | None = spec(None, unit="contacts per world", ge=1)
    """Contacts, as a mean over the worlds."""
    naconmax: int | None = spec(None, unit="contacts", ge=1)
    """Contacts of all worlds; takes precedence over nconmax."""
    njmax: int | None = spec(None, unit="rows per world", ge=1)
    """Constraint rows."""
    nccdmax: int | None = spec(None, unit="pairs per world", ge=1)
    """Pairs of convex geoms in collision, as a mean over the worlds."""
    naccdmax: int | None = spec(None, unit="pairs", ge=1)
    """Such pairs of all worlds; takes precedence over nccdmax."""


@dataclass(kw_only=True, slots=True)
class SimCfg:
    """Backend and device."""

    backend: Backend = spec()
    """Physics engine of batch and throughput: auto is MJWarp where there is CUDA."""
    device: str = spec()
    """auto, cpu or cuda:N."""
