"""The managers' terms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mjstack.config.fields import spec


@dataclass(kw_only=True, slots=True)
class TermCfg:
    """A function or class, and the values of its keyword parameters."""

    func: str = spec()
    """Dotted name of the function or class."""
    params: dict[str, Any] = spec(factory=dict, finite=False)
    """Keyword parameters."""


@dataclass(kw_only=True, slots=True)
class ActionTermCfg(TermCfg):
    """A part of the action vector; ``func`` names a subclass of ``ActionTerm``."""


@dataclass(kw_only=True, slots=True)
class ObservationTermCfg(TermCfg):
    """A part of an observation group: value, plus noise, clipped, times scale."""

    scale: float = spec(1.0)
    """Factor, applied last."""
    clip: list[float] | None = spec(None, unit="the term's", length=2, finite=False)
    """Smallest and largest value."""
    noise: float = spec(0.0, unit="the term's", ge=0.0)
    """Half-width of uniform noise, added first."""
    history: int = spec(1, unit="steps", ge=1)
    """Steps that are kept, oldest first."""


@dataclass(kw_only=True, slots=True)
class ObservationGroupCfg:
    """Terms that are concatenated into one tensor."""

    noise: bool = True
    """Whether its terms have their noise."""
    terms: dict[str, Any] = spec(factory=dict)
    """Its terms, by name."""


@dataclass(kw_only=True, slots=True)
class RewardTermCfg(TermCfg):
    """A reward per second of simulated time."""

    weight: float = spec()
    """Each step adds weight x value x step_dt."""


@dataclass(kw_only=True, slots=True)
class TerminationTermCfg(TermCfg):
    """A reason for which an episode ends."""

    time_out: bool = False
    """Whether the episode is truncated then, not terminated."""
