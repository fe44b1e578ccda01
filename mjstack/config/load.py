"""Composes `conf/` into the dataclasses of `schema`."""

import json
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import cast

from hydra._internal.hydra import Hydra
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError  # type: ignore[import-untyped]

from mjstack.config.check import validate
from mjstack.config.complete import complete
from mjstack.config.explain import check_added, check_overrides, explain, parse
from mjstack.config.fingerprint import MOST_TEXT, POLICY_FILE
from mjstack.config.schema import JOB_SCHEMAS, TRAINER_SCHEMAS, Config
from mjstack.config.session import (
    CONFIG_NAME,
    add_folder,
    check_beside,
    check_trusted,
    hydra_session,
    list_choices,
    read_yaml,
    search_path,
    without_hydra,
)
from mjstack.errors import CompositionError, ConfigError
from mjstack.files import read_inside, reading

_schema = OmegaConf.structured(Config)
_schema.gate._set_flag("struct", False)  # gates of the search path are added to it
ConfigStore.instance().store(name="mjstack_schema", node=_schema, provider="mjstack")
for _name, _node in (JOB_SCHEMAS | TRAINER_SCHEMAS).items():
    ConfigStore.instance().store(name=f"{_name}_schema", node=_node, provider="mjstack")


def _control_steps(seconds: float, *, _root_: DictConfig) -> int:
    """Control steps of a time [s], which ``${steps:SECONDS}`` stands for."""
    step_dt = _root_.timing.physics_dt * _root_.timing.decimation
    return round(seconds / step_dt) if step_dt > 0.0 else 1  # what is wrong is told later


OmegaConf.register_new_resolver("steps", _control_steps)


def load_config(
    overrides: Sequence[str] = (), *, config_dir: str | os.PathLike | None = None
) -> Config:
    """Compose the configuration as the command line does.

    Args:
        overrides: Command-line overrides, such as ``["robot=rebot", "nworld=64"]``.
        config_dir: A folder with more choices, such as ``push/conf`` with ``task/push.yaml``. The
            folder beside it is importable afterwards.

    Returns:
        The configuration, complete and validated.

    Raises:
        MjstackError: An override does not fit; the message says which and what would.
    """
    with extended_search_path(overrides, config_dir) as own, hydra_session() as hydra:
        return to_config(compose(hydra, own))


@contextmanager
def extended_search_path(
    overrides: Sequence[str], config_dir: str | os.PathLike | None
) -> Iterator[list[str]]:
    """Add a folder, and those of overrides of ``hydra.searchpath``, to the search path of every
    composition inside.

    Yields:
        The other overrides, and what the policy that they name was trained for.
    """
    entries = [] if config_dir is None else [str(config_dir)]
    others = []
    for override in overrides:
        if override.lstrip("+").startswith("hydra.searchpath="):
            value = parse(override).value()
            if not isinstance(value, list):
                raise CompositionError(
                    f"{override}: expected a list, such as 'hydra.searchpath=[file://DIR]'."
                )
            entries += map(str, value)
        else:
            others.append(override)
    with search_path(entries):
        yield [*others, *_policy_choices(others)]


def _policy_choices(overrides: Sequence[str]) -> list[str]:
    """Robot, task and cameras of the policy that the overrides name, where they choose none; none
    of a policy that cannot be read, which a check says later.
    """
    keys = {override.partition("=")[0] for override in overrides}
    named = [parse(override).value() for override in overrides if override.startswith("policy=")]
    folder = named[0] if len(named) == 1 and "experiment" not in keys else None
    if not isinstance(folder, str):
        return []
    try:
        facts = json.loads(read_inside(Path(folder) / POLICY_FILE, MOST_TEXT))
        trained = {group: [facts["config"][group]["name"]] for group in ("robot", "task")}
        trained["cameras"] = list(facts["observation"].get("images", {}))
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return []
    choices = list_choices()
    return [
        f"{group}={names[0] if len(names) == 1 else names}".replace("'", "").replace(" ", "")
        for group, names in trained.items()
        if group not in keys and names and all(name in choices[group] for name in names)
    ]


def compose(
    hydra: Hydra,
    overrides: Sequence[str],
    run_mode: RunMode = RunMode.RUN,
    sweep: DictConfig | None = None,
) -> DictConfig:
    """Compose without validating values, as a job of a sweep if there is one; Hydra's part is in
    it, and errors are one line each.
    """
    if run_mode is RunMode.RUN:
        check_overrides(overrides)
    try:
        if sweep is None:
            cfg = hydra.compose_config(CONFIG_NAME, list(overrides), run_mode, from_shell=False)
        else:
            cfg = hydra.config_loader.load_sweep_config(sweep, list(overrides))
        if run_mode is RunMode.RUN:
            check_added(without_hydra(cfg), overrides)
            _drop_inherited(hydra, cfg, overrides)
    except (HydraException, OmegaConfBaseException, AssertionError, TypeError, ValueError) as error:
        raise explain(error, overrides) from error
    except YAMLError as error:
        raise CompositionError(f"{' '.join(str(error).split())}.") from error
    return cfg


def _drop_inherited(hydra: Hydra, cfg: DictConfig, overrides: Sequence[str]) -> None:
    """Leave a term whose ``func`` an override swaps with the parameters that overrides give it:
    those of the other function are not its own.
    """
    swapped = {}
    for override in overrides:
        key, _, value = override.lstrip("+").partition("=")
        # Other keys of a job or a gate are no parameters of its function.
        if "func" not in override or re.match(r"job\.|gate\.(?!.*\.reset\.)", key):
            continue
        if key.endswith(".func"):
            swapped[override] = key.removesuffix(".func")
        elif value.startswith("{") and "func" in cast(dict, parse(override).value()):
            swapped[override] = key
    if not swapped:
        return
    others = [override for override in overrides if override not in swapped]
    before = hydra.compose_config(CONFIG_NAME, others, RunMode.RUN, from_shell=False)
    for term in swapped.values():
        old = OmegaConf.select(before, f"{term}.func")
        if old is None or old == OmegaConf.select(cfg, f"{term}.func"):
            continue
        section = term if term == "task.check" else f"{term}.params"
        given = OmegaConf.create()
        for override in overrides:
            name = override.lstrip("+").partition("=")[0]
            if f"{name}.".startswith(f"{term}."):
                OmegaConf.update(given, name, parse(override).value())
        kept = {"func", *(OmegaConf.select(given, section) or ())}
        node = OmegaConf.select(cfg, section) or {}
        with open_dict(cfg):
            for name in [name for name in node if name not in kept]:
                del node[name]


def load_saved(path: Path) -> Config:
    """The configuration that a run left in ``.hydra/config.yaml``, typed and checked as a new one
    is.

    Raises:
        MjstackError: The file cannot be read, is no configuration of this version, or names
            functions or a robot that are not in the search path.
    """
    with reading(path, CompositionError, "Name another folder"):
        plain = read_yaml(path)
        if "${" in str(plain):
            raise ValueError("it has ${...}")
        merged = cast(DictConfig, OmegaConf.merge(_schema, plain))
        if missing := sorted(OmegaConf.missing_keys(merged)):
            raise CompositionError(f"{missing[0]} is missing, expected every key of this version.")
        check_trusted(merged, path)
        try:
            cfg = to_config(merged)
        except ConfigError as error:
            if error.key != "robot.file":
                raise
            raise CompositionError(f"{error} {add_folder(path)}") from error
        check_beside(cfg.robot.file)
    return cfg


def to_config(cfg: DictConfig) -> Config:
    """Turn a composed configuration into dataclasses and check their values."""
    try:
        config = cast(Config, OmegaConf.to_object(without_hydra(cfg)))
    except (OmegaConfBaseException, AttributeError, TypeError) as error:
        raise explain(error) from error
    complete(config)
    validate(config)
    return config
