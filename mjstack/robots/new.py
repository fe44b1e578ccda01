"""``mjstack new``: the folder of a task or robot of one's own."""

import math
import os
import re
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from mjstack.config.load import load_config
from mjstack.config.session import CONFIG_FOLDER, list_choices
from mjstack.errors import MjstackError
from mjstack.files import check_regular
from mjstack.robots.profile import Guess, guess_profile

_GROUPS = {"task": "task", "robot": "robot", "driver": "controller", "action": "action"}
_PLAIN = re.compile("[A-Za-z][A-Za-z0-9_]+")  # needs no quotation marks, unless it is a value


def write_new(args: Sequence[str], arm: str = "") -> tuple[list[Path], list[Guess]]:
    """Write the files of ``task``, ``driver`` or ``action NAME``, or of ``robot NAME FILE.xml``,
    into a new folder NAME; a MjstackError if the arguments are others, NAME exists, or the file has
    no arm that can be used. Returns the paths, and what was guessed of a robot; ``arm`` is a part
    of the names of the arm that counts.
    """
    kind, name = (*args, "", "")[:2]
    if (
        len(args) != (3 if kind == "robot" else 2)
        or kind not in _GROUPS
        or (arm and kind != "robot")
    ):
        expected = "task, driver or action NAME, or robot NAME FILE.xml, such as new task lift"
        raise MjstackError(f"new {' '.join(args)}: expected {expected}.")
    folder = Path(name)
    valid = re.fullmatch(r"[a-z][a-z0-9_]{0,63}", name)
    choices = list_choices()[_GROUPS[kind]]
    if not valid or name in choices or folder.exists() or find_spec(name) is not None:
        raise MjstackError(
            f"new {kind} {name}: expected small letters, digits and _, and no folder, {kind} or"
            " Python module of that name. Choose another name."
        )
    text = (CONFIG_FOLDER / "new" / f"{kind}.txt").read_text(encoding="utf-8")
    _, *parts = re.split(r"(?m)^=== (.+)\n", text.replace("@NAME@", name))
    contents = dict(zip(parts[::2], parts[1::2], strict=True))
    profile: list[Guess] = []
    if kind == "robot":
        file = Path(args[2])
        try:
            check_regular(file)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise MjstackError(f"{file}: expected an MJCF file or a URDF: {reason}.") from error
        profile = guess_profile(file, load_config([]).scene, arm)
        path = f"conf/robot/{name}.yaml"
        source = os.path.relpath(file, folder / "conf" / "robot")
        lines = [("file", source, "relative to this YAML"), *profile]
        contents[path] += "".join(_line(*line) for line in lines)
    paths = [folder / path for path in contents]
    for target, content in zip(paths, contents.values(), strict=True):
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(content, encoding="utf-8")
    return paths, profile


def _line(key: str, value: Any, comment: str) -> str:
    """A key with its value in one line of YAML that reads as the same, whatever the names in it.

    Raises:
        MjstackError: The configuration takes a name for another value.
    """
    plain = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in comment)  # on this line
    return f"{key}: {_to_yaml(value)}{plain and f' # {plain}'}\n"


def _to_yaml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_to_yaml(k)}: {_to_yaml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(_to_yaml, value))}]"
    if not isinstance(value, str):
        return str(value)
    if value in ("", "???") or "${" in value:
        problem = f"the name {value!r} in it means something else in the configuration, or nothing"
        raise MjstackError(f"{problem}, expected another one. Rename it in the file.")
    try:
        value.encode()
    except UnicodeError as error:
        raise MjstackError(
            f"the name {value!r} in it is no text. Rename it in the file."
        ) from error
    if _PLAIN.fullmatch(value) and yaml.safe_load(value) == value:
        return value
    return yaml.safe_dump(value, default_style='"', allow_unicode=True, width=math.inf).rstrip()
