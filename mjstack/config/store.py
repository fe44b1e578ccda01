"""Composes `conf/` into the dataclasses of `schema`. The library's only contact with Hydra."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import cast

from hydra import compose, initialize_config_module
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.singleton import Singleton
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError, MissingMandatoryValue, OmegaConfBaseException

from mjstack.config.help import list_groups
from mjstack.config.schema import CollectJobCfg, Config, ReachabilityJobCfg, ScalingJobCfg, StudyJobCfg
from mjstack.config.terms import type_terms
from mjstack.config.validate import validate
from mjstack.errors import MjstackError, UnknownName, suggest

CONFIG_MODULE = "mjstack.conf"
CONFIG_NAME = "config"
_TERM_GROUPS = ("action", "observation", "reset", "termination", "reward")
_KINDS = {"Integer": "an integer", "Float": "a number", "Boolean": "true or false"}

ConfigStore.instance().store(name="mjstack_schema", node=Config, provider="mjstack")
_JOBS = {"study": StudyJobCfg, "scaling": ScalingJobCfg, "reachability": ReachabilityJobCfg, "collect": CollectJobCfg}
for _name, _node in _JOBS.items():
    ConfigStore.instance().store(name=f"{_name}_schema", node=_node, provider="mjstack")


class CompositionError(MjstackError):
    """The overrides do not fit the configuration files."""

    exit_code = 2


def load_config(overrides: Sequence[str] = ()) -> Config:
    """Composes the configuration as the command line does.

    Args:
        overrides: Command-line overrides, such as ``["robot=rebot", "nworld=64"]``.

    Returns:
        The configuration, complete and validated.

    Raises:
        MjstackError: An override does not fit; the message says which and what would.
    """
    return to_config(compose_overrides(overrides))


def compose_overrides(overrides: Sequence[str]) -> DictConfig:
    """Composes without validating values; errors are one line each."""
    for override in overrides:
        key, equals, _ = override.partition("=")
        if not key.strip("+~ "):
            raise CompositionError(f"override '{override}' has no key. Write key=value without spaces, such as nworld=64.")
        if not equals and not override.startswith("~"):
            raise CompositionError(f"override '{override}' has no value. Write key=value, such as nworld=64.")
    with own_hydra():
        return _compose(overrides)


@contextmanager
def own_hydra() -> Iterator[None]:
    """Composes from mjstack's files, also inside somebody else's Hydra application, whose state comes back afterwards."""
    outer = Singleton.get_state()
    GlobalHydra.instance().clear()
    try:
        with initialize_config_module(config_module=CONFIG_MODULE, version_base="1.3"):
            yield
    finally:
        Singleton.set_state(outer)


def load_saved(path: Path) -> Config:
    """The configuration that a run left in ``.hydra/config.yaml``, typed and checked as a new one is.

    Raises:
        MjstackError: The file cannot be read, or is no configuration of this version.
    """
    try:
        merged = OmegaConf.merge(OmegaConf.structured(Config), OmegaConf.load(path))
        missing = sorted(OmegaConf.missing_keys(merged))
    except OmegaConfBaseException as error:
        raise _translate(error) from error
    except Exception as error:  # the YAML parser fails in its own ways
        raise CompositionError(f"{path.name} cannot be read ({type(error).__name__}), expected YAML.") from error
    if missing:
        raise CompositionError(f"{missing[0]} is missing, expected every key of this version.")
    return to_config(cast(DictConfig, merged))


def to_config(cfg: DictConfig) -> Config:
    """Turns a composed configuration into dataclasses and checks their values."""
    try:
        config = cast(Config, OmegaConf.to_object(cfg))
    except (OmegaConfBaseException, AttributeError, TypeError) as error:
        raise _translate(error) from error
    type_terms(config)
    validate(config)
    return config


def _compose(overrides: Sequence[str]) -> DictConfig:
    try:
        return compose(CONFIG_NAME, overrides=list(overrides))
    except (HydraException, OmegaConfBaseException) as error:
        raise _translate(error, overrides) from error


def _translate(error: Exception, overrides: Sequence[str] = ()) -> MjstackError:
    """One line from Hydra's and OmegaConf's chained, multi-line errors."""
    if isinstance(error, MissingConfigException) and error.options is not None and error.missing_cfg_file:
        group, _, name = error.missing_cfg_file.rpartition("/")
        return UnknownName(f"{group}={name}:", name, error.options)
    cause = error.__cause__ if isinstance(error, ConfigCompositionException) and error.__cause__ else error
    key = getattr(cause, "full_key", None)
    text = str(cause).splitlines()[0] if str(cause) else type(cause).__name__
    deleted = re.match(r"Could not delete from config\. '([^']+)' does not exist", text)
    if deleted:
        return _unknown_deletion(deleted.group(1), overrides)
    if isinstance(cause, ConfigKeyError | AttributeError) or "not in struct" in text or "not in 'Config'" in text:
        return _unknown_key(error, str(key or getattr(cause, "key", "") or ""), overrides)
    converted = re.search(r"Value '(.*)' of type '\w+' could not be converted to (\w+)", text)
    if converted and key:
        return CompositionError(f"{key}={converted.group(1)}: expected {_KINDS.get(converted.group(2), converted.group(2))}.")
    if isinstance(cause, MissingMandatoryValue) and str(key).startswith("gate."):
        return CompositionError(
            "gate: expected no choice, because the thresholds of all gates are in use. gates=[...] chooses what runs, "
            "gate.batch.seeds=10 sets a value."
        )
    if key and "not a ListConfig" in text:
        return CompositionError(f"{key}: expected a list, such as '{key}=[...]'.")
    if "Ambiguous value for argument" in text:
        return CompositionError(f"{text.rstrip('.')}: several values are a sweep. Add -m, or give one value.")
    match = re.search(r"Could not override '([^']+)'\. No match in the defaults list", str(error))
    if match:
        return UnknownName("configuration group", match.group(1), [group.name for group in list_groups()])
    if isinstance(error, OverrideParseException):
        return CompositionError(f"override '{error.override}' cannot be read: {text.rstrip('.')}.")
    return CompositionError(f"{key}: {text}." if key else f"{text.rstrip('.')}.")


def _unknown_key(error: Exception, key: str, overrides: Sequence[str]) -> MjstackError:
    match = re.search(r"Could not override '([^']+)'", str(error)) or re.search(r"(?:attribute|argument) '(\w+)'", str(error))
    key = match.group(1) if match else key
    with own_hydra():
        # The job that was asked for has keys of its own.
        jobs = [o for o in overrides if re.fullmatch(r"job=\w+", o)]
        try:
            base = OmegaConf.to_container(compose(CONFIG_NAME, overrides=jobs), resolve=False)
        except (HydraException, OmegaConfBaseException):
            base = OmegaConf.to_container(compose(CONFIG_NAME), resolve=False)
    keys = _flat_keys(base)
    leaf = key.rpartition(".")[2]
    if key.startswith("job."):
        owners = [name for name in _JOBS if leaf in {f.name for f in fields(_JOBS[name])} and f"job={name}" not in jobs]
        if owners:
            now = jobs[-1] if jobs else "job=gates"
            return CompositionError(
                f"{key} is a key of job={' and job='.join(owners)}, and this is {now}. Set job={owners[0]}."
            )
    if key.partition(".")[0] in _TERM_GROUPS:
        return _unknown_term_key(key, keys)
    same_leaf = [k for k in keys if k.rpartition(".")[2] == leaf and k != key]
    if same_leaf:
        nearest = max(same_leaf, key=lambda k: difflib.SequenceMatcher(None, key, k).ratio())
        return CompositionError(f"configuration key '{key}' does not exist. Did you mean '{nearest}'?")
    siblings = [k for k in keys if k.rpartition(".")[0] == key.rpartition(".")[0]]
    if "." not in key:
        siblings += [group.name for group in list_groups() if group.name not in siblings]  # not every group is a key
    near = difflib.get_close_matches(leaf, [k.rpartition(".")[2] for k in siblings], n=1, cutoff=0.6)
    if near:
        nearest = key.removesuffix(leaf) + near[0]
        return CompositionError(f"configuration key '{key}' does not exist. Did you mean '{nearest}'?")
    pool = sorted({*siblings, *(k for k in keys if "." not in k)})
    return CompositionError(f"configuration key '{key}' does not exist. {suggest(key, _nearest_first(leaf, pool))}")


def _unknown_deletion(key: str, overrides: Sequence[str]) -> MjstackError:
    """``~key`` of what is not there: what is there, beside it."""
    with own_hydra():
        try:
            base = compose(CONFIG_NAME, overrides=[o for o in overrides if not o.startswith("~")])
        except (HydraException, OmegaConfBaseException) as error:
            return _translate(error)
    parent = key.rpartition(".")[0]
    keys = [k for k in _flat_keys(OmegaConf.to_container(base, resolve=False)) if k.rpartition(".")[0] == parent]
    return CompositionError(f"~{key}: there is none to leave out. {suggest(key, keys)}")


def _unknown_term_key(key: str, keys: Sequence[str]) -> MjstackError:
    """Terms may be added, so the way to do that is part of the answer."""
    group = key.partition(".")[0]
    depth = key.count(".")
    near = difflib.get_close_matches(
        key, [k for k in keys if k.startswith(f"{group}.") and k.count(".") == depth and k != key], n=1, cutoff=0.8
    )
    hint = f" Did you mean '{near[0]}'?" if near else ""
    return CompositionError(f"'{key}' is not in the configuration.{hint} To add it, write +{key}=...")


def _nearest_first(leaf: str, keys: Sequence[str]) -> list[str]:
    by_leaf = {k.rpartition(".")[2]: k for k in keys}
    near = difflib.get_close_matches(leaf, by_leaf, n=1, cutoff=0.6)
    return [by_leaf[near[0]]] if near else list(keys)


def _flat_keys(node: object, prefix: str = "") -> list[str]:
    if not isinstance(node, dict):
        return []
    out: list[str] = []
    for name, value in node.items():
        path = f"{prefix}{name}"
        out += [path, *_flat_keys(value, f"{path}.")]
    return out
