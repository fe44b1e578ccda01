"""Policies that LeRobot has trained: its names, and how one is loaded."""

from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from mjstack.errors import FolderError, MissingExtra, MjstackError, first_line

SERIES = "0.6."  # whose interfaces these are
STATE = "observation.state"
SEEN = "observation.environment_state"
IMAGES = "observation.images"


def require_lerobot(what: str) -> None:
    """Refuse what needs LeRobot where that is missing, or of another version."""
    try:
        installed = version("lerobot")
    except PackageNotFoundError as error:
        raise MissingExtra(what, "lerobot", "lerobot") from error
    if not installed.startswith(SERIES):
        problem = f"{what}: LeRobot {installed} is installed, expected {SERIES}x"
        raise MjstackError(problem, f"Run pip install 'lerobot=={SERIES}1'")


@lru_cache(maxsize=1)
def load_lerobot(path: str, device: str) -> tuple[Any, Any, Any]:
    """Load a folder onto a device: LeRobot's policy, and what processes its observations and its
    actions. The folder is trusted code: files of its processors may name classes to import.
    """
    require_lerobot(f"policy={path}")
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    try:
        config = PreTrainedConfig.from_pretrained(path, cli_overrides=[f"--device={device}"])
        policy = get_policy_class(config.type).from_pretrained(path, config=config)
        moved = {"device_processor": {"device": device}}
        return policy, *make_pre_post_processors(config, path, preprocessor_overrides=moved)
    except Exception as error:  # of any of its packages
        reason = f"LeRobot cannot load it ({type(error).__name__}: {first_line(error)})"
        raise FolderError(f"policy={path}: {reason}", "Try it with lerobot-eval") from error
