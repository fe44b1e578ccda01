"""Turns the terms of a composed configuration into dataclasses."""

from __future__ import annotations

from dataclasses import asdict, fields
from functools import cache
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mjstack.config.fields import accepted
from mjstack.config.schema import (
    ActionTermCfg,
    Config,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    SolverCfg,
    StudyJobCfg,
    TermCfg,
    TerminationTermCfg,
)
from mjstack.errors import ConfigError, TermError, UnknownName


def type_terms(cfg: Config) -> None:
    """Gives every term and every variant of the solver its type, in place. A term that is null is
    left out.

    Raises:
        MjstackError: A term has an unknown key, lacks one, or a value has the wrong type.
    """
    known = {field.name for field in fields(cfg.gate)}
    for name in [name for name in vars(cfg.gate) if name not in known]:
        cfg.gate.added[name] = vars(cfg.gate).pop(name)
    cfg.action = _terms("action", cfg.action, ActionTermCfg)
    cfg.controller.action = _terms("controller.action", cfg.controller.action, ActionTermCfg)
    cfg.reset = _terms("reset", cfg.reset, TermCfg)
    cfg.gate.capacity.reset = _terms("gate.capacity.reset", cfg.gate.capacity.reset, TermCfg)
    cfg.gate.success.reset = _terms("gate.success.reset", cfg.gate.success.reset, TermCfg)
    cfg.termination = _terms("termination", cfg.termination, TerminationTermCfg)
    cfg.reward = _terms("reward", cfg.reward, RewardTermCfg)
    cfg.observation = _terms("observation", cfg.observation, ObservationGroupCfg)
    for name, group in cfg.observation.items():
        group.terms = _terms(f"observation.{name}.terms", group.terms, ObservationTermCfg)
    if isinstance(cfg.job, StudyJobCfg):
        cfg.job.variants = {
            name: typed(
                f"job.variants.{name}",
                asdict(cfg.solver) | node if isinstance(node, dict) else node,
                SolverCfg,
            )
            for name, node in cfg.job.variants.items()
        }


def _terms(key: str, nodes: dict[str, Any], kind: type) -> dict[str, Any]:
    return {
        name: typed(f"{key}.{name}", node, kind) for name, node in nodes.items() if node is not None
    }


def typed(key: str, node: Any, kind: type) -> Any:
    """A mapping of a composed configuration as a dataclass.

    Args:
        key: Its dotted key, for errors.
        node: The mapping.
        kind: The dataclass.

    Raises:
        MjstackError: A key is unknown or missing, or a value has the wrong type.
    """
    names = [field.name for field in fields(kind)]
    if not isinstance(node, dict):
        raise ConfigError(key, node, f"a mapping with some of {', '.join(names)}")
    for name in node:
        if name not in names:
            raise UnknownName(f"{key}: key", str(name), names)
    try:
        merged = OmegaConf.merge(_schema(kind), node)
    except OmegaConfBaseException:
        _find_misfit(
            key, node, kind
        )  # names the key; where none is to blame alone, the error stays as it is
        raise
    missing = sorted(OmegaConf.missing_keys(merged))
    if missing:
        raise TermError(key, f"'{missing[0]}' is missing: set {key}.{missing[0]}")
    return cast(Any, OmegaConf.to_object(merged))


@cache
def _schema(kind: type) -> DictConfig:
    """A dataclass as OmegaConf has it, made once: terms are many."""
    return OmegaConf.structured(kind)


def _find_misfit(key: str, node: dict[str, Any], kind: type) -> None:
    """Raises a `ConfigError` for the first value whose type does not fit."""
    names = [field.name for field in fields(kind)]
    for name, value in node.items():
        try:
            OmegaConf.merge(_schema(kind), {name: value})
        except OmegaConfBaseException as error:
            item = fields(kind)[names.index(name)]
            raise ConfigError(f"{key}.{name}", value, accepted(kind, item)) from error
