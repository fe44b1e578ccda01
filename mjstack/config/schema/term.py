"""The managers' terms."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING


@dataclass(kw_only=True, slots=True)
class TermCfg:
    """A function or class by its dotted name, and the values of its keyword parameters."""

    func: str = MISSING
    params: dict[str, Any] = field(default_factory=dict)


@dataclass(kw_only=True, slots=True)
class ActionTermCfg(TermCfg):
    """A part of the action vector; ``func`` names a subclass of ``ActionTerm``."""


@dataclass(kw_only=True, slots=True)
class ObservationTermCfg(TermCfg):
    """A part of an observation group.

    ``noise`` is the half-width of uniform noise in the term's own unit, added first; then values
    are clipped to ``clip`` (low, high) and multiplied by ``scale``. ``history`` steps are kept,
    oldest first.
    """

    scale: float = 1.0
    clip: list[float] | None = None
    noise: float = 0.0
    history: int = 1


@dataclass(kw_only=True, slots=True)
class ObservationGroupCfg:
    """Terms that are concatenated into one tensor; ``noise: false`` switches the noise of all of
    them off.
    """

    noise: bool = True
    terms: dict[str, Any] = field(default_factory=dict)


@dataclass(kw_only=True, slots=True)
class RewardTermCfg(TermCfg):
    """A reward per second of simulated time: each step adds weight x value x step_dt."""

    weight: float = MISSING


@dataclass(kw_only=True, slots=True)
class TerminationTermCfg(TermCfg):
    """Ends an episode; with ``time_out`` it is truncated, otherwise terminated."""

    time_out: bool = False
