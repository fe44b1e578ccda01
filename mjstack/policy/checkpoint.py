"""A policy's folder: ``policy.json`` and a file of weights. Nothing in it is code.

``policy.json`` is replaced last and names its weights, so that a kill or a full disk leaves the
policy that was there before.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

from safetensors import safe_open
from safetensors.torch import load, save
from torch import Tensor

from mjstack.config.complete import typed
from mjstack.config.fingerprint import POLICY_FILE, config_content
from mjstack.config.schema import Config, ObservationGroupCfg, ObservationTermCfg, TermCfg
from mjstack.config.session import is_trusted_function
from mjstack.errors import PolicyError
from mjstack.files import reading, write_atomic
from mjstack.policy.network import PolicyNetwork

FORMAT = 1  # grows when an older mjstack could not read what is written


@dataclass(kw_only=True, slots=True)
class Policy:
    """A policy with all that it needs to know.

    Attributes:
        network: Its network, on the CPU in float32.
        group: Name of the observation group that it sees.
        observation: That group's configuration.
        widths: Numbers of each term of the group, in order.
        execute: Control steps between two answers. Of a longer chunk the rest is not used, and the
            last action of a shorter one holds.
        hidden: Widths of the network's hidden layers.
        config: The configuration of its training, in JSON's types.
        action: The action terms of its training, by name; None where its actions are absolute joint
            targets.
        training: Seed and figures of its training, in JSON's types.
        versions: Packages with which it was trained.
        folder: Where it was loaded from; None for a new one.
    """

    network: PolicyNetwork
    group: str
    observation: ObservationGroupCfg
    widths: dict[str, int]
    execute: int
    hidden: list[int]
    config: dict[str, Any]
    action: dict[str, TermCfg] | None = None
    training: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    folder: Path | None = None

    @property
    def joints(self) -> list[str]:
        """Names of the joints that it moves, in order."""
        return [*self.config["robot"]["arm_joints"], *self.config["robot"]["gripper_joints"]]

    def check_fit(self, cfg: Config) -> None:
        """Check that the policy was trained for the robot, task, objects and step of a
        configuration.

        Raises:
            PolicyError: It was trained for something else; names the first difference.
        """
        self._compare(_requirements(self.config), _requirements(config_content(cfg)))

    def check_widths(self, widths: Mapping[str, int]) -> None:
        """Check how many numbers each term of its group has in the worlds that it is to drive.

        Raises:
            PolicyError: One has another number.
        """
        key = f"observation.{self.group}.terms.{{}}.width"
        trained, here = (
            {key.format(name): width for name, width in one.items()}
            for one in (self.widths, widths)
        )
        self._compare(trained, here)

    def check_action_width(self, width: int) -> None:
        """Check how many numbers an action has in the worlds that it is to drive.

        Raises:
            PolicyError: It has another number.
        """
        self._compare({"action.width": self.network.joints}, {"action.width": width})

    def _compare(self, trained: Mapping[str, Any], here: Mapping[str, Any]) -> None:
        for key in dict.fromkeys([*trained, *here]):
            before = trained.get(key, "missing")
            now = here.get(key, "missing")
            if before != now:
                raise PolicyError(
                    f"policy={self.folder}: was trained with {key}={before}, and here it is {now}:"
                    " expected the same",
                    "Name a policy that was trained for this, or set the key back",
                )


def _requirements(config: Mapping[str, Any]) -> dict[str, Any]:
    """The values that a policy depends on, by dotted key. Physics, solver and starts may differ."""
    keys = [
        ("robot", "name"),
        ("task", "name"),
        ("robot", "arm_joints"),
        ("robot", "gripper_joints"),
        ("robot", "home"),
        ("robot", "gripper_open"),
        ("robot", "gripper_closed"),
        ("task", "control_hz"),
        ("task", "params"),
    ]
    found = {f"{group}.{key}": config[group][key] for group, key in keys}
    for name, thing in config["scene"]["objects"].items():
        found[f"scene.objects.{name}"] = f"{thing['shape']} {thing['size']}"
    return found


def save_policy(folder: Path, policy: Policy) -> None:
    """Write a policy's folder; an earlier policy in it is replaced at once or not at all.

    Raises:
        OSError: It cannot be written; an earlier policy is intact.
    """
    folder.mkdir(parents=True, exist_ok=True)
    weights = save({k: v.contiguous() for k, v in policy.network.state_dict().items()})
    digest = sha256(weights).hexdigest()
    facts = {
        "format": FORMAT,
        "versions": {name: version(name) for name in ("mjstack", "mujoco", "torch")},
        "weights_sha256": digest,
        "observation": {
            "group": policy.group,
            "widths": policy.widths,
            **policy.config["observation"][policy.group],
        },
        "action": {
            "joints": policy.joints,
            "kind": "action terms" if policy.action else "absolute joint targets",
            "width": policy.network.joints,
            "terms": {k: asdict(term) for k, term in (policy.action or {}).items()},
            "chunk": policy.network.chunk,
            "execute": policy.execute,
            "step_dt": 1.0 / policy.config["task"]["control_hz"],
        },
        "network": {"hidden": policy.hidden, "activation": "elu"},
        "training": policy.training,
        "config": policy.config,
    }
    write_atomic(folder / _weights_name(digest), weights)
    write_atomic(folder / POLICY_FILE, json.dumps(facts, indent=1) + "\n")
    for path in folder.glob(_weights_name("*")):
        if path.name != _weights_name(digest):
            path.unlink(missing_ok=True)


def load_policy(folder: Path) -> Policy:
    """Read a policy's folder, which may be a stranger's.

    Raises:
        PolicyError: It is no policy, of another version, damaged, or names functions that are not
            in the search path.
    """
    path = folder / POLICY_FILE
    fix = "Name a folder that job=train has written"
    if not path.is_file():
        raise PolicyError(
            f"policy={folder}: has no {POLICY_FILE}, expected the folder of a policy", fix
        )
    with reading(path, PolicyError, fix):
        facts = json.loads(path.read_text())
        found = facts["format"]
        if found != FORMAT:
            raise PolicyError(
                f"policy={folder}: has format {found}, expected {FORMAT}, which this mjstack reads",
                "Use the mjstack that wrote it, or train it again",
            )
        seen = facts["observation"]
        action = facts["action"]
        digest = facts["weights_sha256"]
        policy = Policy(
            network=PolicyNetwork(
                sum(seen["widths"].values()),
                action["width"],
                action["chunk"],
                facts["network"]["hidden"],
            ),
            group=seen["group"],
            observation=_read_group(seen, path),
            widths=seen["widths"],
            execute=action["execute"],
            action=_read_terms("action", action["terms"], TermCfg, path) or None,
            hidden=facts["network"]["hidden"],
            config=facts["config"],
            training=facts["training"],
            versions=facts["versions"],
            folder=folder,
        )
        if policy.joints != action["joints"] or policy.execute < 1:
            raise ValueError("action does not fit config")
        _requirements(policy.config)  # they are all there
    weights = folder / _weights_name(digest)
    with reading(weights, PolicyError, "Copy the whole folder again, or train the policy again"):
        content = weights.read_bytes()
        if sha256(content).hexdigest() != digest:
            raise ValueError(f"its content is not that of {POLICY_FILE}")
        policy.network.load_state_dict(load(content))
    policy.network.requires_grad_(False)
    return policy


def _weights_name(digest: str) -> str:
    return f"weights-{digest[:12]}.safetensors"


def _read_group(seen: Mapping[str, Any], path: Path) -> ObservationGroupCfg:
    """The observation group of a policy's file, its functions trusted."""
    key = f"observation.{seen['group']}"
    group = typed(key, {"noise": seen["noise"]}, ObservationGroupCfg)
    group.terms = _read_terms(f"{key}.terms", seen["terms"], ObservationTermCfg, path)
    return group


def _read_terms(key: str, nodes: Mapping[str, Any], kind: type, path: Path) -> dict[str, Any]:
    """Terms of a policy's file at a dotted key, their functions trusted."""
    terms = {}
    for name, node in nodes.items():
        term = typed(f"{key}.{name}", node, kind)
        if not is_trusted_function(f"{key}.{name}", term.func, path):
            raise PolicyError(
                f"{path}: {key}.{name}.func={term.func}: expected a name of mjstack, of a"
                " registered package, or beside a folder of the search path",
                "Add the policy's --config-dir",
            )
        terms[name] = term
    return terms


def write_state(path: Path, tensors: Mapping[str, Tensor], facts: Mapping[str, Any]) -> None:
    """Write tensors and facts in JSON's types as one file, at once or not at all.

    Raises:
        OSError: It cannot be written; an earlier file is intact.
    """
    plain = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    write_atomic(path, save(plain, metadata={"facts": json.dumps(facts)}))


def read_state(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and facts of `write_state`.

    Raises:
        PolicyError: The file cannot be read.
    """
    with reading(path, PolicyError, "Remove it to train anew"), safe_open(path, "pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return tensors, json.loads(file.metadata()["facts"])
