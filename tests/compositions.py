"""Configurations for tests: each choice of groups is composed once in a process, and values are set
in a copy of it, as Hydra sets them. A composition takes half a second.
"""

import copy
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import mjstack
from mjstack.config.check import validate
from mjstack.config.explain import parse
from mjstack.config.load import compose, to_config
from mjstack.config.schema import Config
from mjstack.config.session import hydra_session, list_choices, without_hydra
from mjstack.envs import Env, build_env
from mjstack.errors import MjstackError
from mjstack.tasks.check import make_check


@cache
def _choices(groups: tuple[str, ...]) -> DictConfig:
    with hydra_session():
        return without_hydra(compose(groups))


@cache
def _composed(overrides: tuple[str, ...]) -> Config:
    known = list_choices()
    groups = tuple(o for o in overrides if o.partition("=")[0] in known)
    values = [o for o in overrides if o not in groups]
    if any(o[0] in "+~" or "func" in o for o in values):
        return mjstack.load_config(overrides)
    cfg = copy.deepcopy(_choices(groups))
    try:
        for parsed in map(parse, values):
            OmegaConf.update(cfg, parsed.key_or_group, parsed.value(), merge=True)
    except OmegaConfBaseException:
        return mjstack.load_config(overrides)  # with the error that a user sees
    return to_config(cfg)


def load_config(overrides: Sequence[str] = ()) -> Config:
    """A copy of the result of `mjstack.load_config`."""
    default = ("robot=so101", "task=stack")
    return copy.deepcopy(_composed(tuple(o for o in overrides if o not in default)))


def make_env(
    overrides: Sequence[str] = (),
    *,
    nworld: int | None = None,
    seed: int | None = None,
    device: str | None = None,
) -> Env:
    """The result of `mjstack.make_env`."""
    arguments = {"nworld": nworld, "seed": seed, "sim.device": device}
    values = [f"{key}={value}" for key, value in arguments.items() if value is not None]
    return build_env(load_config([*overrides, *values]))


def refusal(
    check: Callable[[], object], *words: str, kind: type[MjstackError] = MjstackError
) -> str:
    """The line in which something is refused before anything is written; it has some words."""
    with pytest.raises(kind) as caught:
        check()
    assert caught.value.exit_code == 2
    message = str(caught.value)
    assert "\n" not in message
    assert [word for word in words if word not in message] == [], message
    return message


def put(cfg: Config, *overrides: str) -> Config:
    """Put the values of overrides into a configuration, without composing it anew."""
    for override in overrides:
        parsed = parse(override.lstrip("+"))
        *path, last = parsed.key_or_group.split(".")
        node: Any = cfg
        for name in path:
            node = node[name] if isinstance(node, dict) else getattr(node, name)
        if isinstance(node, dict):
            node[last] = parsed.value()
        else:
            setattr(node, last, parsed.value())
    return cfg


def checked(*overrides: str, task: str = "stack") -> None:
    """Check a configuration of a task with the values of some overrides, as composing it would."""
    cfg = put(load_config([f"task={task}"]), *overrides)
    validate(cfg)
    make_check(cfg)
