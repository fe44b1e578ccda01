"""Checks the gates' thresholds."""

from __future__ import annotations

from mjstack.config.fields import MOST_SEEDS
from mjstack.config.schema import (
    Config,
    ParityCfg,
)
from mjstack.config.validate.term import places_objects, reads_starts_file
from mjstack.errors import ConfigError, UnknownName

PARITY_FIELDS = ("qpos", "qvel", "xpos", "xquat", "site_xpos", "qfrc_actuator", "contact_count")


def check_gates(cfg: Config) -> None:
    """The thresholds of every gate but *success*."""
    gate = cfg.gate
    _phase_names(cfg)
    _parity(gate.parity)
    if not gate.throughput.measurements:
        raise ConfigError("gate.throughput.measurements", "[]", "at least one")
    for name in ("batch", "success"):
        seeds = getattr(gate, name).seeds
        if cfg.seed + seeds > MOST_SEEDS:
            raise ConfigError(
                f"gate.{name}.seeds",
                seeds,
                f"at most {MOST_SEEDS - cfg.seed}, because seeds are 32-bit",
            )


def _phase_names(cfg: Config) -> None:
    """The phases that thresholds name are there."""
    gate = cfg.gate
    phases = cfg.controller.phases
    named = [("gate.parity.states", name) for name in gate.parity.states.values()]
    named += [("gate.throughput.from_phase", gate.throughput.from_phase)]
    for key, name in named:
        if name not in phases:
            raise UnknownName(f"{key}: phase", name, phases)


def _parity(t: ParityCfg) -> None:
    for name in ("step1", "step50"):
        limits = getattr(t, name)
        for field in limits:
            if field not in PARITY_FIELDS:
                raise UnknownName(f"gate.parity.{name}: field", field, PARITY_FIELDS)
        for field in PARITY_FIELDS:
            if field not in limits:
                raise ConfigError(f"gate.parity.{name}.{field}", "null", "a number")


def check_success(cfg: Config) -> None:
    """The success gate."""
    t = cfg.gate.success
    from_file = reads_starts_file(cfg.reset)
    if from_file and t.seeds > 1:
        raise ConfigError(
            "gate.success.seeds",
            t.seeds,
            "1, because with reset=starts_file worlds start alike under every seed",
        )
    if t.region is None:
        return
    if from_file:
        raise ConfigError(
            "gate.success.region",
            t.region,
            "null, because reset=starts_file says where objects start",
        )
    if not any(places_objects(term) for term in t.reset.values()):
        raise ConfigError(
            "gate.success.region",
            t.region,
            "null, because no term of gate.success.reset has a region",
        )
    scene = cfg.scene
    for axis in (0, 1):
        # An object of any yaw is a disc.
        most = min(
            scene.table_half[axis]
            - thing.footprint
            - abs(thing.xy[axis] - scene.table_center[axis])
            for thing in scene.free.values()
        )
        if not 0.0 <= t.region[axis] <= most:
            raise ConfigError(
                "gate.success.region",
                t.region,
                f"half-widths that leave every object on the table, {'xy'[axis]} from 0 to"
                f" {max(most, 0.0):.3f} m",
            )
