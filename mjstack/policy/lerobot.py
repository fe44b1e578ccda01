"""Policies in LeRobot's folders: ours, written, and those that LeRobot has trained, loaded."""

import json
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from safetensors.torch import save

from mjstack.errors import FolderError, MissingExtra, MjstackError
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


def lerobot_files(policy: Policy, ctrl_range: np.ndarray) -> dict[str, bytes]:
    """The files of a policy's folder as LeRobot has it, by name, of LeRobot's policy ``mjstack``.

    A policy that sees its joint positions and images alone takes what a real arm measures; another
    one takes the environment ``mjstack``'s ``environment_state``.

    Args:
        policy: The policy.
        ctrl_range: Limits of the joint targets [rad, m], shape ``(joints, 2)``.

    Raises:
        FolderError: Its actions are no joint targets.
    """
    config = policy.config
    targets = config["controller"]["action"]
    if {name: (t.func, t.params) for name, t in policy.action.items()} != {
        name: (term["func"], term["params"]) for name, term in targets.items()
    }:
        raise FolderError(
            f"policy={policy.folder}: its actions are {', '.join(policy.action)}, expected joint"
            " targets, which LeRobot's robots take",
            "Name a policy of trainer=dagger or clone",
        )
    robot = config["robot"]
    network = policy.network
    terms = list(policy.observation.terms.values())
    plain = all((term.history, term.scale, term.clip) == (1, 1.0, None) for term in terms)
    measured = len(terms) == 1 and terms[0].func.startswith(_JOINTS) and plain
    width = len(policy.joints) if measured else sum(policy.widths.values())
    key, kind = (STATE, "STATE") if measured else (SEEN, "ENV")
    inputs = {key: {"type": kind, "shape": [width]}}
    for name, size in network.vision.sizes.items():
        inputs[f"{IMAGES}.{name}"] = {"type": "VISUAL", "shape": [3, *size]}
    relative = measured and terms[0].func.endswith("relative")
    facts = {
        "type": "mjstack",
        "input_features": inputs,
        "output_features": {"action": {"type": "ACTION", "shape": [network.width]}},
        "push_to_hub": False,
        "device": "cpu",
        "chunk": network.chunk,
        "execute": policy.execute,
        "hidden": network.hidden,
        "channels": list(network.vision.channels),
        "features": network.vision.features,
        "joint_range": ctrl_range.tolist(),
        "arm_joints": len(robot["arm_joints"]),
        "home": list(robot["home"]) if relative else [0.0] * network.width,
        "robot_type": robot["lerobot_type"] or robot["name"],
        "task": config["task"]["name"],
        "fps": round(config["task"]["control_hz"]),
    }
    weights = {f"network.{k}": v.contiguous() for k, v in network.state_dict().items()}
    device = {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}}
    steps = {
        "pre": [
            {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}},
            {"registry_name": "to_batch_processor", "config": {}},
            device,
        ],
        "post": [device],
    }
    files: dict[str, Any] = {"config.json": facts}
    for name, chain in steps.items():
        label = f"policy_{name}processor"
        files[f"{label}.json"] = {"name": label, "steps": chain}
    texts = {name: (json.dumps(data, indent=2) + "\n").encode() for name, data in files.items()}
    return {"model.safetensors": save(weights), **texts}
