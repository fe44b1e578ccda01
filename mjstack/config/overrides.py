"""Checks of overrides before Hydra sees them: what it would answer with a traceback, or with words
about its own parser.
"""

from __future__ import annotations

from collections.abc import Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from mjstack.config.explain import TERM_GROUPS
from mjstack.config.help import list_groups
from mjstack.errors import CompositionError


def check_overrides(overrides: Sequence[str]) -> None:
    """Raises a `CompositionError` for the first override that is none, or asks a group for
    something else than a choice.
    """
    for override in overrides:
        key, equals, _ = override.partition("=")
        if not key.strip("+~ "):
            raise CompositionError(
                f"override '{override}' has no key. Write key=value without spaces, such as"
                " nworld=64."
            )
        if not equals and not override.startswith("~"):
            raise CompositionError(
                f"override '{override}' has no value. Write key=value, such as nworld=64."
            )
    groups = {group.name: group.choices for group in list_groups()}
    for override in overrides:
        parsed = parse(override)
        if parsed.is_sweep_override():
            raise CompositionError(
                f"'{override}': several values are a sweep. Add -m, or give one value; a list has"
                f" brackets: '{parsed.key_or_group}=[a,b]'."
            )
        if parsed.is_delete():
            _check_deletion(parsed)
        elif parsed.key_or_group in groups:
            _check_choice(parsed, override, groups[parsed.key_or_group])


def parse(override: str) -> Override:
    """Hydra's reading of an override, or a `CompositionError`."""
    try:
        return OverridesParser.create().parse_override(override)
    except HydraException as error:
        why = str(error).splitlines()[0].rstrip(".")
        hint = (
            f" ({why})" if " while evaluating " in why else ""
        )  # the rest is the parser's own language
        raise CompositionError(
            f"override {override!r} cannot be read{hint}: expected key=value without spaces around"
            " the sign. A value with brackets, signs or letters beyond ASCII wants quotes of its"
            " own: 'starts=\"run(1).csv\"'."
        ) from error


def _check_deletion(parsed: Override) -> None:
    """At the top only terms, and an experiment, can be left out."""
    key = parsed.key_or_group
    if "." not in key and key not in (*TERM_GROUPS, "experiment"):
        raise CompositionError(
            f"~{key}: expected a term of {', '.join(TERM_GROUPS)}, such as ~reward.lift. Keys and"
            f" groups at the top are always there: set {key}=VALUE, or leave it as it is."
        )


def _check_choice(parsed: Override, override: str, choices: Sequence[str]) -> None:
    """A group takes the name of a choice, or a list of names. A mapping sets keys below it, which
    the schema checks.
    """
    value = parsed.value()
    names = value if isinstance(value, list) else [value]
    if isinstance(value, dict) or all(isinstance(name, str) for name in names):
        return
    raise CompositionError(f"{override}: expected the name of a choice: {', '.join(choices)}.")
