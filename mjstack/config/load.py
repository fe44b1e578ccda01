"""Composes `conf/` into the dataclasses of `schema`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

from hydra import compose
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mjstack.config.explain import CompositionError, explain
from mjstack.config.overrides import check_overrides, parse
from mjstack.config.robot_file import complete_robot
from mjstack.config.schema import JOB_SCHEMAS, Config
from mjstack.config.session import CONFIG_NAME, own_hydra
from mjstack.config.terms import type_terms
from mjstack.config.validate import validate

ConfigStore.instance().store(name="mjstack_schema", node=Config, provider="mjstack")
for _name, _node in JOB_SCHEMAS.items():
    ConfigStore.instance().store(name=f"{_name}_schema", node=_node, provider="mjstack")


def load_config(overrides: Sequence[str] = ()) -> Config:
    """Composes the configuration as the command line does.

    Args:
        overrides: Command-line overrides, such as ``["robot=rebot", "nworld=64"]``.

    Returns:
        The configuration, complete and validated.

    Raises:
        MjstackError: An override does not fit; the message says which and what would.
    """
    return to_config(compose_overrides(overrides), search_folders(overrides))


def search_folders(overrides: Sequence[str]) -> list[Path]:
    """Folders that overrides add to the search path."""
    parsed = [parse(override) for override in overrides if "hydra.searchpath" in override]
    entries = [entry for override in parsed for entry in cast(list, override.value())]
    return [
        Path(entry.removeprefix("file://")) for entry in entries if not entry.startswith("pkg:")
    ]


def compose_overrides(overrides: Sequence[str]) -> DictConfig:
    """Composes without validating values; errors are one line each."""
    check_overrides(overrides)
    with own_hydra():
        return _compose(overrides)


def load_saved(path: Path) -> Config:
    """The configuration that a run left in ``.hydra/config.yaml``, typed and checked as a new one
    is.

    Raises:
        MjstackError: The file cannot be read, or is no configuration of this version.
    """
    try:
        merged = OmegaConf.merge(OmegaConf.structured(Config), OmegaConf.load(path))
        missing = sorted(OmegaConf.missing_keys(merged))
    except OmegaConfBaseException as error:
        raise explain(error) from error
    except Exception as error:  # the YAML parser fails in its own ways
        raise CompositionError(
            f"{path.name} cannot be read ({type(error).__name__}), expected YAML."
        ) from error
    if missing:
        raise CompositionError(f"{missing[0]} is missing, expected every key of this version.")
    return to_config(cast(DictConfig, merged))


def to_config(cfg: DictConfig, folders: Sequence[Path] = ()) -> Config:
    """Turns a composed configuration into dataclasses and checks their values.

    Args:
        cfg: The composition.
        folders: Folders of the search path, which may hold ``robot.file``.
    """
    try:
        config = cast(Config, OmegaConf.to_object(cfg))
    except (OmegaConfBaseException, AttributeError, TypeError) as error:
        raise explain(error) from error
    type_terms(config)
    complete_robot(config.robot, folders)
    validate(config)
    return config


def _compose(overrides: Sequence[str]) -> DictConfig:
    try:
        return compose(CONFIG_NAME, overrides=list(overrides))
    except (HydraException, OmegaConfBaseException, AssertionError, TypeError, ValueError) as error:
        raise explain(error, overrides) from error
