"""Policies in LeRobot's folders: ours, written, and those that LeRobot has trained, loaded."""

import json
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save

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


class LerobotPolicy:
    """A policy that LeRobot has trained, in its units. The folder is trusted code: the files of its
    processors may name classes to import.

    Attributes:
        folder: Where it is, as the user named it.
        inputs: Shape of each observation that it takes, by LeRobot's names.
        period: Control steps between two observations that it looks at.
    """

    def __init__(self, name: str, device: str, joints: int) -> None:
        """Load it.

        Args:
            name: ``lerobot:`` and its folder.
            device: Where it computes.
            joints: How many joint targets its actions are to be.

        Raises:
            MjstackError: LeRobot is missing or cannot load it, or its actions are others.
        """
        self.folder = name
        path = name.removeprefix(PREFIX)
        require_lerobot(f"policy={name}")
        if not (Path(path) / "config.json").is_file():
            expected = "has no config.json, expected a folder pretrained_model of LeRobot's"
            raise FolderError(f"policy={name}: {expected}", "Name a local folder")
        from lerobot.configs.policies import PreTrainedConfig
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors

        try:
            config = PreTrainedConfig.from_pretrained(path, cli_overrides=[f"--device={device}"])
            self._policy = get_policy_class(config.type).from_pretrained(path, config=config)
            self._before, self._after = make_pre_post_processors(
                config, path, preprocessor_overrides={"device_processor": {"device": device}}
            )
        except Exception as error:  # of any of its packages
            reason = f"LeRobot cannot load it ({type(error).__name__}: {first_line(error)})"
            raise FolderError(f"policy={name}: {reason}", "Try it with lerobot-eval") from error
        self.inputs = {key: tuple(part.shape) for key, part in config.input_features.items()}
        width = config.action_feature.shape[0]
        if width != joints:
            problem = (
                f"its actions have {width} numbers, expected {joints}, a target for each joint"
            )
            raise FolderError(f"policy={name}: {problem}", "Name a policy of this robot")
        self.period = getattr(config, "n_action_steps", 1) if config.n_obs_steps == 1 else 1

    def reset(self) -> None:
        """Begin an episode."""
        self._policy.reset()

    def act(self, seen: Mapping[str, Any], task: str) -> np.ndarray:
        """Joint targets of the next step, shape ``(worlds, joints)``, float32.

        Args:
            seen: Observations by LeRobot's names: images ``(worlds, height, width, 3)``, uint8, the
                rest ``(worlds, width)``, float32.
            task: The task in words.
        """
        batch: dict[str, Any] = {"task": [task] * len(next(iter(seen.values())))}
        for key, value in seen.items():
            part = torch.as_tensor(value)
            batch[key] = part.permute(0, 3, 1, 2) / 255 if key.startswith(IMAGES) else part
        with torch.inference_mode():
            actions = self._after(self._policy.select_action(self._before(batch)))
        return actions.cpu().numpy()
