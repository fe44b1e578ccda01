"""One line from Hydra's and OmegaConf's chained, multi-line errors: what is wrong, what was
expected, what to do.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields

from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException
from omegaconf import OmegaConf
from omegaconf.errors import ConfigKeyError, MissingMandatoryValue, OmegaConfBaseException

from mjstack.config.help import list_groups
from mjstack.config.schema import JOB_SCHEMAS
from mjstack.config.session import compose_raw
from mjstack.errors import CompositionError, MjstackError, UnknownName, suggest

TERM_GROUPS = ("action", "observation", "reset", "termination", "reward")
_KINDS = {
    "Integer": "an integer",
    "Float": "a number",
    "Boolean": "true or false",
    "bool": "true or false",
    "string": "text",
}
# What OmegaConf says of a value that has not its key's type, and what was expected.
_MISFITS = (
    (r"Value '(?P<value>.*)' of type '\w+' could not be converted to (?P<kind>\w+)", "{}"),
    (r"Value '(?P<value>.*)' is not a valid (?P<kind>bool)", "{}"),
    (r"Invalid value '(?P<value>.*)', expected one of \[(?P<kind>.*)\]", "one of {}"),
    (r"Cannot convert '\w+' to (?P<kind>string): '(?P<value>.*)'", "{}"),
)


def explain(error: Exception, overrides: Sequence[str] = ()) -> MjstackError:
    """The error that a user is shown for one of Hydra's or OmegaConf's, made with these
    overrides.
    """
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, name = error.missing_cfg_file.rpartition("/")
        choices = error.options or next((g.choices for g in list_groups() if g.name == group), ())
        return UnknownName(f"{group}={name}:", name, choices)
    cause = (
        error.__cause__
        if isinstance(error, ConfigCompositionException) and error.__cause__
        else error
    )
    key = getattr(cause, "full_key", None)
    text = str(cause).splitlines()[0] if str(cause) else type(cause).__name__
    deleted = re.match(r"Could not delete from config\. '([^']+)' does not exist", text)
    if deleted:
        return _unknown_deletion(deleted.group(1), overrides)
    if (
        isinstance(cause, ConfigKeyError | AttributeError)
        or "not in struct" in text
        or "not in 'Config'" in text
    ):
        return _unknown_key(error, str(key or getattr(cause, "key", "") or ""), overrides)
    if isinstance(cause, MissingMandatoryValue) and str(key).startswith("gate."):
        return CompositionError(
            "gate: expected no choice, because the thresholds of all gates are in use. gates=[...]"
            " chooses what runs, gate.batch.seeds=10 sets a value."
        )
    wrong = _wrong_value(str(key), text, overrides) if key else None
    if wrong is not None:
        return wrong
    there = re.match(r"Could not append to config\. An item is already at '([^']+)'", text)
    if there:
        return CompositionError(
            f"+{there.group(1)}: there is one already. Write {there.group(1)}=VALUE without the"
            " plus sign."
        )
    match = re.search(r"Could not override '([^']+)'\. No match in the defaults list", str(error))
    if match:
        return UnknownName(
            "configuration group", match.group(1), [group.name for group in list_groups()]
        )
    if isinstance(cause, AssertionError | TypeError | ValueError) and not isinstance(
        cause, OmegaConfBaseException
    ):
        where = f"{' '.join(overrides)}: this does" if overrides else "the values do"
        return _below_null(overrides) or CompositionError(
            f"{where} not fit the configuration files ({type(cause).__name__}: {text.rstrip('.')})."
        )
    return CompositionError(f"{key}: {text}." if key else f"{text.rstrip('.')}.")


def _wrong_value(key: str, text: str, overrides: Sequence[str]) -> CompositionError | None:
    """What OmegaConf says of a value that has not its key's type, if this is one of those
    messages.
    """
    for pattern, expected in _MISFITS:
        found = re.search(pattern, text)
        if found:
            kind = found["kind"]
            return CompositionError(
                f"{key}={found['value']}: expected {expected.format(_KINDS.get(kind, kind))}."
            )
    if re.search(r"is not Optional|NoneType is not a subclass", text):
        return CompositionError(f"{key}=null: expected a value.")
    if "does not support deletion" in text:
        return CompositionError(
            f"~{key}: it needs a value and cannot be left out. Write {key}=VALUE."
        )
    if "Cannot merge DictConfig with ListConfig" in text and any(
        o.lstrip("+").startswith(f"{key}=[") for o in overrides
    ):
        return CompositionError(
            f"{key}: expected keys and values, not a list. Set a key below it, such as"
            f" {key}.KEY=VALUE."
        )
    if "not a ListConfig" in text or "Cannot merge DictConfig with ListConfig" in text:
        return CompositionError(f"{key}: expected a list, such as '{key}=[...]'.")
    return None


def _below_null(overrides: Sequence[str]) -> CompositionError | None:
    """The first override of a key below one that is null, such as a box's size in a scene that has
    no box.
    """
    choices = {group.name for group in list_groups()}
    try:
        base = OmegaConf.to_container(
            compose_raw([o for o in overrides if o.partition("=")[0] in choices]), resolve=False
        )
    except (HydraException, OmegaConfBaseException):
        return None
    for override in overrides:
        node: object = base
        path: list[str] = []
        for name in override.partition("=")[0].lstrip("+").split("."):
            if path and node is None:
                null = ".".join(path)
                return CompositionError(
                    f"{override}: {null} is null here and has no keys. Choose a scene or another"
                    " group that sets it."
                )
            node = node.get(name, {}) if isinstance(node, Mapping) else {}
            path.append(name)
    return None


def _unknown_key(error: Exception, key: str, overrides: Sequence[str]) -> MjstackError:
    match = re.search(r"Could not override '([^']+)'", str(error)) or re.search(
        r"(?:attribute|argument) '(\w+)'", str(error)
    )
    if match and not key.startswith(
        f"{match.group(1)}."
    ):  # the key inside a mapping says more than the mapping's
        key = match.group(1)
    # The job that was asked for has keys of its own.
    jobs = [o for o in overrides if re.fullmatch(r"job=\w+", o)]
    try:
        base = OmegaConf.to_container(compose_raw(jobs), resolve=False)
    except (HydraException, OmegaConfBaseException):
        base = OmegaConf.to_container(compose_raw([]), resolve=False)
    keys = _flat_keys(base)
    leaf = key.rpartition(".")[2]
    if key.startswith("job."):
        owners = [
            name
            for name in JOB_SCHEMAS
            if leaf in {f.name for f in fields(JOB_SCHEMAS[name])} and f"job={name}" not in jobs
        ]
        if owners:
            now = jobs[-1] if jobs else "job=gates"
            return CompositionError(
                f"{key} is a key of job={' and job='.join(owners)}, and this is {now}. Set"
                f" job={owners[0]}."
            )
    if key.partition(".")[0] in TERM_GROUPS:
        return _unknown_term_key(key, keys)
    same_leaf = [k for k in keys if k.rpartition(".")[2] == leaf and k != key]
    if same_leaf:
        nearest = max(same_leaf, key=lambda k: difflib.SequenceMatcher(None, key, k).ratio())
        return CompositionError(
            f"configuration key '{key}' does not exist. Did you mean '{nearest}'?"
        )
    siblings = [k for k in keys if k.rpartition(".")[0] == key.rpartition(".")[0]]
    if "." not in key:
        siblings += [
            group.name for group in list_groups() if group.name not in siblings
        ]  # not every group is a key
    near = difflib.get_close_matches(
        leaf, [k.rpartition(".")[2] for k in siblings], n=1, cutoff=0.6
    )
    if near:
        nearest = key.removesuffix(leaf) + near[0]
        return CompositionError(
            f"configuration key '{key}' does not exist. Did you mean '{nearest}'?"
        )
    pool = sorted({*siblings, *(k for k in keys if "." not in k)})
    return CompositionError(
        f"configuration key '{key}' does not exist. {suggest(key, _nearest_first(leaf, pool))}"
    )


def _unknown_deletion(key: str, overrides: Sequence[str]) -> MjstackError:
    """``~key`` of what is not there: what is there, beside it."""
    try:
        base = compose_raw([o for o in overrides if not o.startswith("~")])
    except (HydraException, OmegaConfBaseException) as error:
        return explain(error)
    parent = key.rpartition(".")[0]
    keys = [
        k
        for k in _flat_keys(OmegaConf.to_container(base, resolve=False))
        if k.rpartition(".")[0] == parent
    ]
    if key in keys:  # Hydra takes a null for nothing
        return CompositionError(
            f"~{key}: it is null, so there is nothing to leave out. Write {key}=VALUE, or nothing."
        )
    return CompositionError(f"~{key}: there is none to leave out. {suggest(key, keys)}")


def _unknown_term_key(key: str, keys: Sequence[str]) -> MjstackError:
    """Terms may be added, so the way to do that is part of the answer."""
    group = key.partition(".")[0]
    depth = key.count(".")
    near = difflib.get_close_matches(
        key,
        [k for k in keys if k.startswith(f"{group}.") and k.count(".") == depth and k != key],
        n=1,
        cutoff=0.8,
    )
    hint = f" Did you mean '{near[0]}'?" if near else ""
    return CompositionError(
        f"'{key}' is not in the configuration.{hint} To add it, write +{key}=..."
    )


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
