"""Policies in LeRobot's folders: ours, written, and those that LeRobot has trained, loaded."""

import json
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from mjstack.errors import FolderError, MissingExtra, MjstackError, first_line
from mjstack.policy.checkpoint import Policy

SERIES = "0.6."  # whose interfaces these are
PREFIX = "lerobot:"  # of such a policy's folder
STATE = "observation.state"
SEEN = "observation.environment_state"
IMAGES = "observation.images"
_JOINTS = "mjstack.mdp.observation.joint_pos"  # its terms are computed from the measured joints


def require_lerobot(what: str) -> None:
    """Refuse what needs LeRobot, before it is imported.

    Raises:
        MjstackError: It is missing, or of another version.
    """
    try:
        installed = version("lerobot")
    except PackageNotFoundError as error:
        raise MissingExtra(what, "lerobot", "lerobot") from error
    if not installed.startswith(SERIES):
        raise MjstackError(
            f"{what}: LeRobot {installed} is installed, expected {SERIES}x",
            f"Run pip install 'lerobot=={SERIES}1'",
        )


def lerobot_files(policy: Policy, ctrl_range: np.ndarray) -> dict[str, str]:
    """What makes a policy's folder one of LeRobot's, of type ``mjstack``: files by name.

    A policy that sees its joint positions and images alone takes what a real arm measures; another
    one takes the environment ``mjstack``'s ``environment_state``.

    Args:
        policy: The policy.
        ctrl_range: Limits of the joint targets [rad, m], shape ``(joints, 2)``.

    Raises:
        FolderError: Its actions are no joint targets.
    """
    targets = policy.config["controller"]["action"].values()
    if [(term.func, term.params) for term in policy.action.values()] != [
        (term["func"], term["params"]) for term in targets
    ]:
        raise FolderError(
            f"policy={policy.folder}: its actions are {', '.join(policy.action)}, expected joint"
            " targets, which LeRobot's robots take",
            "Name a policy of trainer=dagger or clone",
        )
    terms = list(policy.observation.terms.values())
    plain = all((term.history, term.scale, term.clip) == (1, 1.0, None) for term in terms)
    measured = len(terms) == 1 and terms[0].func.startswith(_JOINTS) and plain
    key, kind = (STATE, "STATE") if measured else (SEEN, "ENV")
    inputs = {key: {"type": kind, "shape": [sum(policy.widths.values())]}}
    for name, size in policy.network.vision.sizes.items():
        inputs[f"{IMAGES}.{name}"] = {"type": "VISUAL", "shape": [3, *size]}
    device = {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}}
    rename = {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}}
    batch = {"registry_name": "to_batch_processor", "config": {}}
    files: dict[str, Any] = {
        "config.json": {
            "type": "mjstack",
            "input_features": inputs,
            "output_features": {"action": {"type": "ACTION", "shape": [policy.network.width]}},
            "push_to_hub": False,
            "device": "cpu",
            "joint_range": ctrl_range.tolist(),
        }
    }
    for label, steps in {"pre": [rename, batch, device], "post": [device]}.items():
        name = f"policy_{label}processor"
        files[f"{name}.json"] = {"name": name, "steps": steps}
    return {name: json.dumps(data, indent=2) + "\n" for name, data in files.items()}


def load_lerobot(name: str, device: str) -> tuple[Any, Any, Any]:
    """Load ``lerobot:FOLDER`` onto a device. The folder is trusted code: files of its processors
    may name classes to import.

    Returns:
        LeRobot's policy, and what processes its observations and its actions.

    Raises:
        MjstackError: LeRobot is missing or cannot load it.
    """
    require_lerobot(f"policy={name}")
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    path = name.removeprefix(PREFIX)
    try:
        config = PreTrainedConfig.from_pretrained(path, cli_overrides=[f"--device={device}"])
        policy = get_policy_class(config.type).from_pretrained(path, config=config)
        moved = {"device_processor": {"device": device}}
        return policy, *make_pre_post_processors(config, path, preprocessor_overrides=moved)
    except Exception as error:  # of any of its packages
        reason = f"LeRobot cannot load it ({type(error).__name__}: {first_line(error)})"
        raise FolderError(f"policy={name}: {reason}", "Try it with lerobot-eval") from error
