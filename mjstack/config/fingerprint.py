"""A configuration as plain values, in which files count by their content, wherever they are."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

from mjstack.config.check import reads_starts_file
from mjstack.config.fields import CHANGES, select
from mjstack.config.schema import Config
from mjstack.config.session import list_items
from mjstack.errors import ConfigError
from mjstack.files import check_regular

CONTENT = "sha256:"  # in front of what stands for a file
_RESULTS = CHANGES.keys() - {"nothing"}
_LEROBOT_FILE = "model.safetensors"  # the weights of a LeRobot policy
POLICY_FILE = "policy.json"  # of a policy's folder; it names the weights by their SHA-256
SHIPPED = Path(__file__).parents[1] / "policies"  # verified policies that come with mjstack


def config_content(cfg: Config, *changes: str) -> dict[str, Any]:
    """The keys that change some of `CHANGES`, or any result, in JSON's types, with the SHA-256 of
    each MJCF file, of each starts file and of the policy in place of its path; a ConfigError if one
    cannot be read.
    """
    config: dict[str, Any] = json.loads(json.dumps(asdict(cfg)))
    for key, file in cfg.files.items():
        *path, last = key.split(".")
        reduce(getitem, path, config)[last] = _content(key, file)
    if cfg.policy is not None:
        folder = policy_folder(cfg.policy)
        name = POLICY_FILE if (folder / POLICY_FILE).exists() else _LEROBOT_FILE
        config["policy"] = _content("policy", str(folder / name))
    for name, term in cfg.reset.items():
        path = term.params.get("path")
        params = config["reset"][name]["params"]
        if reads_starts_file({name: term}) and path is not None:
            if path == cfg.starts:
                params["path"] = "${starts}"
                config["starts"] = _content("starts", path)
            else:
                params["path"] = _content(f"reset.{name}.params.path", path)
    return select(config, changes or _RESULTS, Config)


def policy_folder(name: str | Path) -> Path:
    """The policy's folder of that name; if there is none, that of the shipped policy."""
    shipped = SHIPPED / name
    is_shipped = shipped.parent == SHIPPED and shipped.is_dir() and not Path(name).exists()
    return shipped if is_shipped else Path(name)


def shipped_policies() -> dict[str, str]:
    """The policies that come with mjstack: the first sentence of each card, by name."""
    cards = {path.parent.name: path.read_text() for path in sorted(SHIPPED.glob("*/card.md"))}
    return {name: text.splitlines()[2] for name, text in cards.items()}


def config_hash(config: Mapping[str, Any]) -> str:
    """SHA-256 of a configuration in JSON's types."""
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()


def differences(earlier: Mapping[str, Any], current: Mapping[str, Any]) -> str:
    """The first keys in which two configurations differ, such as ``seed=1, expected 2``, and how
    many more do; empty if they are equal.
    """
    old_values, new_values = (
        {k: value for k, value in list_items(config) if value == {} or not isinstance(value, dict)}
        for config in (earlier, current)
    )
    different = [
        f"{key}={old_values.get(key, 'missing')}, expected {new_values.get(key, 'none')}"
        for key in old_values | new_values
        if old_values.get(key) != new_values.get(key)
    ]
    more = f", and {len(different) - 3} more keys" if len(different) > 3 else ""
    return "; ".join(different[:3]) + more


def _content(key: str, path: str) -> str:
    try:
        check_regular(Path(path))
        return CONTENT + hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", error)
        raise ConfigError(key, path, f"a file that can be read ({reason})") from error
