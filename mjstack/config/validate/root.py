"""Checks the whole configuration: the top level, then room by room."""

from __future__ import annotations

import re

from mjstack.config.fields import check_fields
from mjstack.config.schema import Config
from mjstack.config.validate.gate import check_gates, check_success
from mjstack.config.validate.job import check_job_keys
from mjstack.config.validate.physics import check_timing
from mjstack.config.validate.robot import check_robot
from mjstack.config.validate.scene import check_scene
from mjstack.config.validate.task import check_controller
from mjstack.config.validate.term import reads_starts_file
from mjstack.errors import ConfigError, UnknownName

_DEVICE = re.compile(r"auto|cpu|cuda:\d+")
_WORLD = re.compile(r"((batch|success):)?(\d+:)?\d+")


def validate(cfg: Config) -> None:
    """Raises a `ConfigError` or `UnknownName` for the first value that cannot be used."""
    check_fields("", cfg)
    known = cfg.gate.functions()
    if not cfg.gates:
        raise ConfigError("gates", "[]", f"at least one of {', '.join(known)}")
    for name in cfg.gates:
        if name not in known:
            raise UnknownName("gate", name, known)
    for name in cfg.gate.added:
        if name not in known:  # a misspelt one has no function
            raise UnknownName("gate", name, known)
    if cfg.world is not None and not _WORLD.fullmatch(cfg.world):
        raise ConfigError(
            "world", cfg.world, "a world such as 17, or a seed and a world such as 3:17"
        )
    for key in ("run", "world"):
        if getattr(cfg, key) is not None and cfg.job.name != "replay":
            raise ConfigError(
                key, getattr(cfg, key), "null, because it is for job=replay alone", "Add job=replay"
            )
    if cfg.starts is not None and not reads_starts_file(cfg.reset):
        raise ConfigError(
            "starts", cfg.starts, "null, because no reset term reads it", "Add reset=starts_file"
        )
    if not _DEVICE.fullmatch(cfg.sim.device):
        raise ConfigError("sim.device", cfg.sim.device, "auto, cpu or cuda:N, such as cuda:0")
    check_timing(cfg)
    check_robot(cfg)
    check_scene(cfg)
    check_controller(cfg)
    check_gates(cfg)
    check_success(cfg)
    check_job_keys(cfg.job)
