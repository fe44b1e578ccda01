"""Policies in LeRobot's folders: ours, written, and those that LeRobot has trained, loaded."""

import json
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from mjstack.errors import FolderError, MissingExtra, MjstackError, first_line
from mjstack.policy.checkpoint import Policy

SERIES = "0.6."  # whose interfaces these are
PREFIX = "lerobot:"  # of such a policy's folder
STATE = "observation.state"
SEEN = "observation.environment_state"
IMAGES = "observation.images"
_PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")  # beside this module
_JOINTS = "mjstack.mdp.observation.joint_pos"  # its terms are computed from the measured joints


def require_lerobot(what: str) -> None:
    """Refuse what needs LeRobot where that is missing, or of another version."""
    try:
        installed = version("lerobot")
    except PackageNotFoundError as error:
        raise MissingExtra(what, "lerobot", "lerobot") from error
    if not installed.startswith(SERIES):
        problem = f"{what}: LeRobot {installed} is installed, expected {SERIES}x"
        raise MjstackError(problem, f"Run pip install 'lerobot=={SERIES}1'")


def lerobot_files(policy: Policy, servo_range: np.ndarray) -> dict[str, str]:
    """Files by name that make a policy's folder one of LeRobot's, of type ``mjstack``.
    ``servo_range`` is as of `SceneIndex`.

    A policy that sees its joint positions and images alone takes what a real arm measures; another
    one takes the environment ``mjstack``'s ``environment_state``. One whose actions are no joint
    targets is a FolderError.
    """
    targets = policy.config["controller"]["action"]
    if [asdict(term) for term in policy.action.values()] != [*targets.values()]:
        actions = f"its actions are {', '.join(policy.action)}, expected joint targets, which"
        problem = f"policy={policy.folder}: {actions} LeRobot's robots take"
        raise FolderError(problem, "Name a policy of trainer=dagger or clone")
    terms = list(policy.observation.terms.values())
    plain = all((term.history, term.scale, term.clip) == (1, 1.0, None) for term in terms)
    measured = len(terms) == 1 and terms[0].func.startswith(_JOINTS) and plain
    key, kind = (STATE, "STATE") if measured else (SEEN, "ENV")
    inputs = {key: {"type": kind, "shape": [sum(policy.widths.values())]}}
    for name, size in policy.network.vision.sizes.items():
        inputs[f"{IMAGES}.{name}"] = {"type": "VISUAL", "shape": [3, *size]}
    config = {
        "type": "mjstack",
        "input_features": inputs,
        "output_features": {"action": {"type": "ACTION", "shape": [policy.network.width]}},
        "push_to_hub": False,
        "device": "cpu",
        "joint_range": servo_range.tolist(),
    }
    here = Path(__file__)
    files = {name: here.with_name(name).read_text(encoding="utf-8") for name in _PROCESSORS}
    return {"config.json": json.dumps(config, indent=2) + "\n"} | files


def load_lerobot(name: str, device: str) -> tuple[Any, Any, Any]:
    """Load ``lerobot:FOLDER`` onto a device: LeRobot's policy, and what processes its observations
    and its actions. The folder is trusted code: files of its processors may name classes to import.
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
