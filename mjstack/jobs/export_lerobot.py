"""Format *lerobot* of job *export*: a policy of ours in a folder that LeRobot loads."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from mjstack.episodes.stage import Stage
from mjstack.errors import FolderError
from mjstack.jobs.export import Format
from mjstack.policy.checkpoint import policy_files
from mjstack.policy.lerobot import IMAGES, SEEN, STATE

_PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
_JOINTS = "mjstack.mdp.observation.joint_pos"  # its terms are computed from the measured joints


def lerobot_files(stage: Stage) -> Mapping[str, str | bytes]:
    """Files by name that make a policy's folder one of LeRobot's, of type ``mjstack``.

    A policy that sees its joint positions and images alone takes what a real arm measures; another
    one takes the environment ``mjstack``'s ``environment_state``. One whose actions are no joint
    targets is a FolderError.
    """
    policy = stage.assets.policy
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
        "joint_range": stage.index.servo_range.tolist(),
    }
    module_file = Path(__file__)
    processors = {
        name: module_file.with_name(name).read_text(encoding="utf-8") for name in _PROCESSORS
    }
    files = policy_files(policy)
    return files | processors | {"config.json": json.dumps(config, indent=2) + "\n"}


FORMAT = Format(lerobot_files)
