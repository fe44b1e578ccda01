"""Overrides, read and written, and one line for what is wrong with them: what was given, what was
expected, what to do.

Some overrides are checked before Hydra sees them, which answers with a traceback or with words
about its own parser; its chained, multi-line errors about the others are turned into one line.
"""

import re
import shlex
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from typing import Any

from hydra import compose
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError

from mjstack.config import session
from mjstack.config.fields import accepted, find_field
from mjstack.config.schema import Config, GateCfg
from mjstack.errors import MjstackError, UnknownName, first_line, shorten, suggest

COMMANDS = ("doctor", "list", "new")  # first words of a command line
LISTS = ("cameras", "experiment", "randomization")  # groups of which several may be chosen
TERM_GROUPS = ("action", "observation", "reset", "termination", "reward")


_GONE = {"controller=state_based": "controller=closed_loop controller.clock=false"}


def check_overrides(overrides: Sequence[str]) -> None:
    """Raise a `MjstackError` for the first override that cannot be used alone."""
    for override in overrides:
        if re.match(r"[+~]*hydra([./]job_logging|\.output_subdir)", override):
            problem = f"{override}: expected Hydra's own, because every run has run.log and .hydra"
            raise MjstackError(problem, "Leave it out")
    for override in own_overrides(overrides):
        parsed = parse(override)
        key = parsed.key_or_group
        if parsed.is_sweep_override():
            fix = f"Add -m, or give one value; a list has brackets: '{key}=[a,b]'"
            raise MjstackError(f"'{override}': several values are a sweep", fix)
        if parsed.is_delete():
            if "." not in key and key not in (*TERM_GROUPS, "experiment"):
                expected = f"a term of {', '.join(TERM_GROUPS)}, such as ~reward.success"
                fix = f"Keys and groups at the top are always there: set {key}=VALUE"
                raise MjstackError(f"~{key}: expected {expected}", fix)
        elif (
            isinstance(parsed.value(), list) and key in session.list_choices() and key not in LISTS
        ):
            raise MjstackError(f"{override}: expected one choice, no list.")
        elif key == "gate":
            problem = "gate: expected no choice, because the thresholds of all gates are in use"
            fix = "gates=[...] chooses what runs, gate.batch.seeds=10 sets a value"
            raise MjstackError(problem, fix)


def parse(override: str) -> Override:
    """Hydra's reading of an override, or a `MjstackError`."""
    try:
        return OverridesParser.create().parse_override(override)
    except HydraException as error:
        if override.isidentifier():
            problem = f"override {override!r} cannot be read: expected key=value, or a command"
            advice = suggest(override, COMMANDS)
            for group, names in session.list_choices().items():
                if override in names:
                    advice = f"Write {group}={override}."
            raise MjstackError(f"{problem}. {advice}") from error
        raise MjstackError(
            f"override {shorten(override, 60)!r} cannot be read: expected key=value without spaces"
            " around the sign. A value with a bracket, a quote, a letter beyond ASCII or"
            " one of = , : ; # & ! < > ^ ~ ` needs double quotes inside of single ones:"
            " 'policy=\"run (1)\"'."
        ) from error


def assign(key: str, value: object) -> str:
    """An override that sets a key to a text or a path. It has quotes where Hydra would take the
    text for anything else.
    """
    text = str(value)
    plain = f"{key}={text}"
    with suppress(HydraException):
        if "${" not in text and OverridesParser.create().parse_override(plain).value() == text:
            return plain
    text = re.sub(r"(\\*)\$\{", r"\1\1\\${", text)  # else an interpolation
    text = re.sub(r'(\\*)"', r'\1\1\\"', text)
    text = re.sub(r"(\\+)$", r"\1\1", text)
    return f'{key}="{text}"'


def command(*overrides: str) -> str:
    """A command on the current search path, as a shell takes it."""
    return shlex.join(["mjstack", *session.search_path_args(), *overrides])


def check_added(section: DictConfig, overrides: Sequence[str], parent: str = "") -> None:
    """Raise a `MjstackError` for a key that a ``+`` has added to a dataclass."""
    owner = OmegaConf.get_type(section)
    known = _field_names(owner)
    for name, node in section.items_ex(resolve=False):
        key = f"{parent}{name!s}"
        if known and name not in known and owner is not GateCfg:  # gates of the search path
            raise _unknown_key(key, known, overrides)
        if isinstance(node, DictConfig) and node.keys():
            check_added(node, overrides, f"{key}.")


def own_overrides(overrides: Iterable[str]) -> list[str]:
    """The overrides that are not Hydra's."""
    return [o for o in overrides if not o.lstrip("+~").startswith(("hydra.", "hydra/"))]


def explain(error: Exception, overrides: Sequence[str] = ()) -> MjstackError:
    """The error that a user is shown for one of Hydra's or OmegaConf's, made with these
    overrides; it begins with the file that does not fit, if it is one.
    """
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, name = error.missing_cfg_file.rpartition("/")
        # Of a list of choices Hydra names none.
        choices = error.options or session.list_choices().get(group, [])
        problem: MjstackError = UnknownName(f"{group}={name}:", name, choices)
        if cure := _GONE.get(f"{group}={name}"):
            problem = MjstackError(f"{problem}", f"Write {cure}")
        elif not session.config_folders() and not group.startswith("hydra/"):
            advice = "A choice of your own needs --config-dir DIR (Python: config_dir)."
            problem = MjstackError(f"{problem} {advice}")
    else:
        problem = _explain(error, overrides)
    inside = re.match(r"In '([^']+)': ", str(error))
    if inside is None or inside[1] in (session.CONFIG_NAME, "hydra/config"):  # an override's
        return problem
    name = f"{inside[1]}.yaml"
    paths = [folder / name for folder in session.config_folders() if (folder / name).is_file()]
    return MjstackError(f"{paths[0] if paths else name}: {problem}")


def _explain(error: Exception, overrides: Sequence[str]) -> MjstackError:
    # Hydra raises its own inside of the handler of one of OmegaConf's, which knows the key.
    inner = error.__context__ if str(error).startswith("In '") else None
    cause: Any = error.__cause__ or inner or error
    text = first_line(cause)
    key = getattr(cause, "full_key", None) or ""
    if deleted := re.match(r"Could not delete from config\. '([^']+)'", text):
        key = deleted[1]
        siblings = _siblings(key, _keys(o for o in overrides if not o.startswith("~")))
        return MjstackError(f"~{key}: there is none to leave out. {suggest(key, siblings)}")
    if key and isinstance(cause, ConfigKeyError | AttributeError):
        return _unknown_key(key, _field_names(getattr(cause, "object_type", None)), overrides)
    value = re.match("Value '(.*)' of type", text)
    settings = [f"{key}={value[1]}"] if value else []  # in a file
    settings += [o for o in overrides if o.lstrip("+~").partition("=")[0] == key]
    field = find_field(Config, re.sub(r"\[\d+\]$", "", key))
    if settings and field and (error.__cause__ or value):
        names = session.list_choices().get(key.rpartition(".")[2], ())
        fix = f"Write {key.rpartition('.')[2]}@{settings[-1]}"
        chosen = settings[-1].partition("=")[2] in names
        expected = f"{settings[-1]}: expected {accepted(*field)}"
        return MjstackError(expected, fix if chosen else "")
    return MjstackError(f"{key or ' '.join(overrides) or 'the values'}: {text}.")


def _unknown_key(key: str, known: Iterable[str], overrides: Sequence[str]) -> MjstackError:
    """A key that does not exist, with the nearest one, beside it (*known*) or not."""
    parent = key.rpartition(".")[0]
    groups = session.list_choices()
    keys = [*_keys(o for o in overrides if o.partition("=")[0] in groups), *groups]
    keys += [f"{parent}.{name}".lstrip(".") for name in known]
    if parent == "robot.servos":  # others are no joints
        keys = [name for name in keys if name.startswith(f"{parent}.")]
    near = get_close_matches(key, [n for n in keys if not f"{key}.".startswith(f"{n}.")], 1)
    hint = f" Did you mean '{near[0]}'?" if near else ""
    if key.partition(".")[0] in TERM_GROUPS or parent == "robot.servos":
        problem = f"'{key}' is not in the configuration.{hint} To add it, write +{key}=..."
        return MjstackError(problem)
    hint = hint or f" {suggest(key, _siblings(key, keys))}"
    return MjstackError(f"configuration key '{key}' does not exist.{hint}")


def _siblings(key: str, keys: Iterable[str]) -> set[str]:
    return {name for name in keys if name.rpartition(".")[0] == key.rpartition(".")[0]}


def _field_names(owner: Any) -> list[str]:
    return [field.name for field in fields(owner)] if is_dataclass(owner) else []


def _keys(overrides: Iterable[str]) -> list[str]:
    """Dotted keys of a composition, mappings included."""
    with session.hydra_session():
        try:
            cfg = compose(session.CONFIG_NAME, list(overrides))
        except HydraException:
            cfg = compose(session.CONFIG_NAME)
    return [key for key, _ in session.list_items(cfg)]
