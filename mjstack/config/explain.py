"""One line for what is wrong with overrides: what was given, what was expected, what to do.

Some overrides are checked before Hydra sees them, which answers with a traceback or with words
about its own parser; its chained, multi-line errors about the others are turned into one line.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import fields, is_dataclass
from difflib import SequenceMatcher

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig
from omegaconf.errors import ConfigKeyError

from mjstack.config.fields import accepted, find_field
from mjstack.config.schema import JOB_SCHEMAS, TRAINER_SCHEMAS, Config, GateCfg, JobCfg
from mjstack.config.session import (
    CONFIG_NAME,
    compose_raw,
    config_folders,
    list_choices,
    list_items,
)
from mjstack.errors import CompositionError, MjstackError, UnknownName, first_line, suggest

LISTS = ("cameras", "experiment")  # groups of which several may be chosen
TERM_GROUPS = ("action", "observation", "reset", "termination", "reward")


def check_overrides(overrides: Sequence[str]) -> None:
    """Raise a `CompositionError` for the first override that cannot be used alone."""
    for override in overrides:
        if re.match(r"[+~]*hydra([./]job_logging|\.output_subdir)", override):
            raise CompositionError(
                f"{override}: expected Hydra's own, because every run has run.log and .hydra. Leave"
                " it out."
            )
    for override in own_overrides(overrides):
        parsed = parse(override)
        key = parsed.key_or_group
        if parsed.is_sweep_override():
            raise CompositionError(
                f"'{override}': several values are a sweep. Add -m, or give one value; a list has"
                f" brackets: '{key}=[a,b]'."
            )
        if parsed.is_delete():
            if "." not in key and key not in (*TERM_GROUPS, "experiment"):
                raise CompositionError(
                    f"~{key}: expected a term of {', '.join(TERM_GROUPS)}, such as ~reward.success."
                    f" Keys and groups at the top are always there: set {key}=VALUE."
                )
        elif isinstance(parsed.value(), list) and key in list_choices() and key not in LISTS:
            raise CompositionError(f"{override}: expected one choice, no list.")
        elif key == "gate":
            raise CompositionError(
                "gate: expected no choice, because the thresholds of all gates are in use."
                " gates=[...] chooses what runs, gate.batch.seeds=10 sets a value."
            )


def parse(override: str) -> Override:
    """Hydra's reading of an override, or a `CompositionError`."""
    try:
        return OverridesParser.create().parse_override(override)
    except HydraException as error:
        raise CompositionError(
            f"override {override!r} cannot be read: expected key=value without spaces around the"
            " sign, such as nworld=64. A value with a bracket, a quote, a letter beyond ASCII or"
            " one of , : ; # & ! < > ^ ~ ` needs double quotes inside of single ones:"
            " 'starts=\"run(1).csv\"'."
        ) from error


def check_added(section: DictConfig, overrides: Sequence[str], parent: str = "") -> None:
    """Raise a `CompositionError` for a key that a ``+`` has added to a dataclass."""
    owner = section._metadata.object_type
    known = [field.name for field in fields(owner)] if is_dataclass(owner) else []
    for name in section:
        key = parent + str(name)
        if known and name not in known and owner is not GateCfg:  # gates of the search path
            raise _unknown_key(key, known, overrides)
        node = section._get_node(name)
        if isinstance(node, DictConfig) and not node._is_none():
            check_added(node, overrides, f"{key}.")


def own_overrides(overrides: Iterable[str]) -> list[str]:
    """The overrides that are not Hydra's."""
    return [o for o in overrides if not o.lstrip("+~").startswith(("hydra.", "hydra/"))]


def explain(error: Exception, overrides: Sequence[str] = ()) -> MjstackError:
    """The error that a user is shown for one of Hydra's or OmegaConf's, made with these
    overrides; it begins with the file that does not fit, if it is one.
    """
    found = _explain(error, overrides)
    inside = re.match(r"In '([^']+)': ", str(error))
    if inside is None or inside[1] in (CONFIG_NAME, "hydra/config"):  # an override does not fit
        return found
    name = f"{inside[1]}.yaml"
    paths = [folder / name for folder in config_folders() if (folder / name).is_file()]
    return CompositionError(f"{paths[0] if paths else name}: {found}")


def _explain(error: Exception, overrides: Sequence[str]) -> MjstackError:
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, name = error.missing_cfg_file.rpartition("/")
        # Of a list of choices Hydra names none.
        options = error.options or list_choices().get(group, [])
        unknown = UnknownName(f"{group}={name}:", name, options)
        own = "" if config_folders() else " A choice of your own needs --config-dir DIR."
        if group.startswith("hydra/"):
            own = " Others are plugins of Hydra, which pip installs, such as hydra-joblib-launcher."
        return CompositionError(f"{unknown}{own}")
    # Hydra raises its own inside of the handler of one of OmegaConf's, which knows the key.
    cause = error.__cause__ or (error.__context__ if str(error).startswith("In '") else None)
    cause = cause or error
    text = first_line(cause)
    key = getattr(cause, "full_key", None) or ""
    deleted = re.match(r"Could not delete from config\. '([^']+)'", text)
    if deleted:
        key = deleted[1]
        there = _keys([override for override in overrides if not override.startswith("~")])
        beside = [name for name in there if name.rpartition(".")[0] == key.rpartition(".")[0]]
        return CompositionError(f"~{key}: there is none to leave out. {suggest(key, beside)}")
    if key and isinstance(cause, ConfigKeyError | AttributeError):
        owner = getattr(cause, "object_type", None)
        known = [field.name for field in fields(owner)] if is_dataclass(owner) else []
        return _unknown_key(key, known, overrides)
    schema = TRAINER_SCHEMAS.get(_chosen("trainer", overrides)) or JOB_SCHEMAS.get(
        _chosen("job", overrides, "gates"), JobCfg
    )
    field = (
        find_field(schema, key.removeprefix("job."))
        if key.startswith("job.")
        else find_field(Config, re.sub(r"\[\d+\]$", "", key))
    )
    given = [override for override in overrides if override.lstrip("+~").partition("=")[0] == key]
    value = re.match("Value '(.*)' of type", text)
    if value and not given:  # of a file
        given = [f"{key}={value[1]}"]
    if (error.__cause__ or value) and field and given:
        return CompositionError(f"{given[-1]}: expected {accepted(*field)}.")
    where = key or " ".join(overrides) or "the values"
    return CompositionError(f"{where}: {text}.")


def _unknown_key(key: str, known: Sequence[str], overrides: Sequence[str]) -> CompositionError:
    """A key that does not exist, with the one that may have been meant: one beside it (*known*), or
    one elsewhere.
    """
    job = _chosen("job", overrides, "gates")
    parent, _, leaf = key.rpartition(".")
    owners = [
        f"job={n}" for n, schema in JOB_SCHEMAS.items() if n != job and find_field(schema, leaf)
    ]
    if parent == "job" and owners:
        return CompositionError(
            f"{key} is a key of {' and '.join(owners)}, and this is job={job}. Set {owners[0]}."
        )
    groups = list_choices()
    chosen = _keys([o for o in overrides if o.partition("=")[0] in groups])
    keys = [*chosen, *groups, *(f"{parent}.{name}".lstrip(".") for name in known)]
    keys = [name for name in keys if not f"{key}.".startswith(f"{name}.")]

    def likeness(name: str) -> tuple[float, float]:
        group, _, last = name.rpartition(".")
        alike = SequenceMatcher(None, leaf, last).ratio()
        # A key beside this one is likelier meant than its namesake elsewhere.
        beside = 0.25 if group == parent and alike >= 0.6 else 0.0
        return alike + beside, SequenceMatcher(None, key, name).ratio()

    nearest = max(keys, key=likeness)
    near = likeness(nearest)[0] >= 0.6
    hint = f" Did you mean '{nearest}'?" if near else ""
    if key.partition(".")[0] in TERM_GROUPS:
        return CompositionError(
            f"'{key}' is not in the configuration.{hint} To add it, write +{key}=..."
        )
    beside = {name for name in keys if name.rpartition(".")[0] == parent}
    return CompositionError(
        f"configuration key '{key}' does not exist.{hint or ' ' + suggest(key, beside)}"
    )


def _chosen(group: str, overrides: Sequence[str], default: str = "") -> str:
    """The choice of a group that overrides make."""
    chosen = [override for override in overrides if override.startswith(f"{group}=")]
    return chosen[-1].removeprefix(f"{group}=") if chosen else default


def _keys(overrides: Iterable[str]) -> list[str]:
    """Dotted keys of a composition, mappings included."""
    try:
        cfg = compose_raw(list(overrides))
    except HydraException:
        cfg = compose_raw([])
    return [key for key, _ in list_items(cfg)]
