"""Checks the gates' thresholds."""

from __future__ import annotations

import math

from mjstack.config.schema import (
    BatchGateCfg,
    CapacityCfg,
    Config,
    ParityCfg,
    ThroughputCfg,
)
from mjstack.config.validate.term import places_objects, reads_starts_file
from mjstack.config.validate.values import length, positive, positive_int
from mjstack.errors import ConfigError, UnknownName

MEASUREMENTS = ("physics", "episode", "env_step")
PARITY_FIELDS = ("qpos", "qvel", "xpos", "xquat", "site_xpos", "qfrc_actuator", "contact_count")


def check_gates(cfg: Config) -> None:
    """The thresholds of every gate but *success*."""
    gate = cfg.gate
    _phase_names(cfg)
    _batch(gate.batch, cfg.seed)
    _parity(gate.parity)
    _capacity(gate.capacity)
    _throughput(gate.throughput)


def _phase_names(cfg: Config) -> None:
    """The phases that thresholds name are there."""
    gate = cfg.gate
    phases = cfg.controller.phases
    named = [("gate.parity.states", name) for name in gate.parity.states.values()]
    named += [("gate.throughput.from_phase", gate.throughput.from_phase)]
    for key, name in named:
        if name not in phases:
            raise UnknownName(f"{key}: phase", name, phases)


def _batch(t: BatchGateCfg, seed: int) -> None:
    positive_int("gate.batch.seeds", t.seeds)
    if seed + t.seeds > 1 << 32:
        raise ConfigError(
            "gate.batch.seeds", t.seeds, f"at most {(1 << 32) - seed}, because seeds are 32-bit"
        )
    if t.failed_worlds < 0:
        raise ConfigError("gate.batch.failed_worlds", t.failed_worlds, "an integer of at least 0")


def _parity(t: ParityCfg) -> None:
    for name in ("step1", "step50"):
        limits = getattr(t, name)
        for field in limits:
            if field not in PARITY_FIELDS:
                raise UnknownName(f"gate.parity.{name}: field", field, PARITY_FIELDS)
        for field in PARITY_FIELDS:
            if not (field in limits and math.isfinite(limits[field]) and limits[field] >= 0.0):
                raise ConfigError(
                    f"gate.parity.{name}.{field}",
                    limits.get(field),
                    "a number that is not negative",
                )


def _capacity(t: CapacityCfg) -> None:
    for name in ("cpu_nworld", "probe_nworld", "probe_steps"):
        positive_int(f"gate.capacity.{name}", getattr(t, name))
    if t.random_steps is not None:
        positive_int("gate.capacity.random_steps", t.random_steps)
    if not (math.isfinite(t.margin) and t.margin >= 1.0):
        raise ConfigError("gate.capacity.margin", t.margin, "a number of at least 1, such as 1.25")


def _throughput(t: ThroughputCfg) -> None:
    for name in ("repetitions", "steps", "env_steps", "start_worlds"):
        positive_int(f"gate.throughput.{name}", getattr(t, name))
    for name in ("max_seconds", "cpu_max_seconds"):
        positive(f"gate.throughput.{name}", getattr(t, name), "s")
    if not t.measurements:
        raise ConfigError(
            "gate.throughput.measurements", "[]", f"at least one of {', '.join(MEASUREMENTS)}"
        )
    for name in t.measurements:
        if name not in MEASUREMENTS:
            raise UnknownName("gate.throughput.measurements: section", name, MEASUREMENTS)


def check_success(cfg: Config) -> None:
    """The success gate."""
    t = cfg.gate.success
    from_file = reads_starts_file(cfg.reset)
    positive_int("gate.success.seeds", t.seeds)
    if cfg.seed + t.seeds > 1 << 32:
        raise ConfigError(
            "gate.success.seeds",
            t.seeds,
            f"at most {(1 << 32) - cfg.seed}, because seeds are 32-bit",
        )
    if from_file and t.seeds > 1:
        raise ConfigError(
            "gate.success.seeds",
            t.seeds,
            "1, because with reset=starts_file worlds start alike under every seed",
        )
    if not 0.0 <= t.rate <= 1.0:
        raise ConfigError("gate.success.rate", t.rate, "a share from 0 to 1")
    positive("gate.success.cell", t.cell, "m")
    if not 0.0 < t.yaw_cell_deg <= 90.0:
        raise ConfigError(
            "gate.success.yaw_cell_deg", t.yaw_cell_deg, "degrees, more than 0 and at most 90"
        )
    for name in ("cell_episodes", "worst_regions"):
        positive_int(f"gate.success.{name}", getattr(t, name))
    if t.region is None:
        return
    length("gate.success.region", t.region, 2)
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
