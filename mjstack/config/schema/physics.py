"""The physics: engine and device, time step, solver, and sizes of the batch."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from omegaconf import MISSING

from mjstack.config.fields import spec


class Backend(Enum):
    """Which physics engine steps the worlds of batch and throughput."""

    auto = "auto"
    native = "native"
    mjwarp = "mjwarp"


class GraphMode(Enum):
    """Whether MJWarp's decimation are captured into a graph and replayed."""

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
    """Constraint solver. ``null`` keeps the model file's own value.

    ``gripper_condim`` is the contact dimension of the geoms of ``robot.jaw_bodies``.
    """

    iterations: int | None = None
    ls_iterations: int | None = None
    impratio: float | None = None
    tolerance: float | None = None
    cone: Cone = Cone.elliptic
    gripper_condim: int | None = None


@dataclass(kw_only=True, slots=True)
class BatchCfg:
    """MJWarp's buffer sizes. ``null`` takes the default of this robot and scene (nconmax, njmax) or
    of MJWarp.

    With ``auto``, what is null is measured first, as `CapacityCfg` says.
    """

    auto: bool = False
    nconmax: int | None = None
    naconmax: int | None = None
    njmax: int | None = None
    nccdmax: int | None = None
    naccdmax: int | None = None


@dataclass(kw_only=True, slots=True)
class SimCfg:
    """Backend and device."""

    backend: Backend = MISSING
    device: str = MISSING
