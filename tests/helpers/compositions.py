"""Configurations for tests: each choice of groups is composed once in a process, and values are set
in a copy of it, as Hydra sets them. A composition takes half a second.
"""

import copy
import re
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import mjstack
from mjstack.config.check import validate
from mjstack.config.explain import parse
from mjstack.config.load import compose, to_config
from mjstack.config.schema import Config
from mjstack.config.session import hydra_session, list_choices, search_path, without_hydra
from mjstack.envs import Env, build_env
from mjstack.errors import MjstackError
from mjstack.tasks.check import make_check

Folders = tuple[Any, ...]
"""Folders of a search path, and their files with what is in them."""


_read_yaml = yaml.load
_texts: dict[str, Any] = {}


def _read_yaml_once(stream: Any, Loader: Any) -> Any:
    """A text of YAML is parsed once in a process."""
    if Loader.__name__ != "OmegaConfLoader" or not hasattr(stream, "read"):
        return _read_yaml(stream, Loader=Loader)
    text = stream.read()
    if text not in _texts:
        stream.seek(0)  # whose name is in the message of an error
        _texts[text] = _read_yaml(stream, Loader=Loader)
    return copy.deepcopy(_texts[text])


yaml.load = _read_yaml_once


@cache
def _choices(groups: tuple[str, ...], folders: Folders) -> DictConfig:
    with hydra_session():
        return without_hydra(compose(groups))


def _is_value(override: str) -> bool:
    """Whether it sets values alone, which nothing else of a composition depends on."""
    others = r"func|gripper_closed|closed_width|file(=|: )(?!/)|hydra\.|policy"
    is_object = override.startswith("+scene.objects.")
    return (is_object or override[0] not in "+~") and not re.search(others, override)


@cache
def _composed(overrides: tuple[str, ...], folders: Folders) -> Config:
    known = list_choices()
    groups = tuple(o for o in overrides if o.partition("=")[0] in known)
    values = [o for o in overrides if o not in groups]
    if not all(map(_is_value, values)):
        return mjstack.load_config(overrides)
    cfg = copy.deepcopy(_choices(groups, folders))
    try:
        for parsed in map(parse, values):
            key = parsed.key_or_group
            if parsed.is_add() and OmegaConf.select(cfg, key) is None:
                OmegaConf.update(cfg, ".".join(key.split(".")[:3]), {}, force_add=True)
            OmegaConf.update(cfg, key, parsed.value(), merge=True)
    except OmegaConfBaseException:
        return mjstack.load_config(overrides)  # with the error that a user sees
    return to_config(cfg)


def load_config(overrides: Sequence[str] = (), config_dir: Path | str | None = None) -> Config:
    """A copy of the result of `mjstack.load_config`."""
    default = ("robot=so101", "task=stack")
    found = [re.fullmatch(r"hydra\.searchpath=\[file://(.*)\]", o) for o in overrides]
    folders = [Path(match[1]) for match in found if match]
    overrides = [o for o, match in zip(overrides, found, strict=True) if not match]
    folders += [] if config_dir is None else [Path(config_dir).resolve()]
    files = [path for folder in folders for path in sorted(folder.rglob("*.yaml"))]
    with search_path(folders):
        rest = tuple(o for o in overrides if o not in default)
        key = (*folders, *((path, path.read_bytes()) for path in files))
        return copy.deepcopy(_composed(rest, key))


def make_env(
    overrides: Sequence[str] = (),
    *,
    nworld: int | None = None,
    seed: int | None = None,
    device: str | None = None,
    config_dir: Path | str | None = None,
) -> Env:
    """The result of `mjstack.make_env`."""
    arguments = {"nworld": nworld, "seed": seed, "sim.device": device}
    values = [f"{key}={value}" for key, value in arguments.items() if value is not None]
    return build_env(load_config([*overrides, *values], config_dir))


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
