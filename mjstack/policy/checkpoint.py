"""A policy's folder: ``policy.json`` and a file of weights. Nothing in it is code.

``policy.json`` is replaced last and names its weights, so that a kill or a full disk leaves the
policy that was there before.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import mujoco
import torch
from safetensors import safe_open
from safetensors.torch import load, save
from torch import Tensor

import mjstack
from mjstack.config.complete import typed
from mjstack.config.fingerprint import MOST_TEXT, POLICY_FILE, config_content
from mjstack.config.schema import Config, ObservationGroupCfg, ObservationTermCfg, TermCfg
from mjstack.config.session import is_trusted_function
from mjstack.errors import PolicyError
from mjstack.files import read_inside, reading, write_atomic
from mjstack.policy.network import PolicyNetwork, Vision

# Grows when an older mjstack could not read what is written
FORMAT = 3
_WITH_IMAGES = 4
_NAME_ANOTHER = "Name a policy that job=train has written, such as outputs/mine/last"
# A stranger's files may ask for more than this.
_MOST_WEIGHTS = 2**32  # bytes
_MOST_COUNT = 1_000_000
_MOST_LAYERS = 100
_MOST_PIXELS = 4096  # along a side
_MOST_HELD = 1000  # control steps between two answers


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
        """Check that the policy was trained for the robot, task, objects, step and cameras of a
        configuration.

        Raises:
            PolicyError: It was trained for something else; names the first difference.
        """
        cameras = list(self.network.vision.sizes)
        trained = _requirements(self.config, cameras)
        self._compare(trained, _requirements(config_content(cfg), cameras))

    def check_widths(self, widths: Mapping[str, int], action: int | None = None) -> None:
        """Check how many numbers an action, if it is given, and each term of its group have in the
        worlds that it is to drive.

        Raises:
            PolicyError: One has another number.
        """
        if action is not None:
            self._compare({"action.width": self.network.joints}, {"action.width": action})
        key = f"observation.{self.group}.terms.{{}}.width"
        trained, here = (
            {key.format(name): width for name, width in one.items()}
            for one in (self.widths, widths)
        )
        self._compare(trained, here)

    def _compare(self, trained: Mapping[str, Any], here: Mapping[str, Any]) -> None:
        for key in dict.fromkeys([*trained, *here]):
            before = trained.get(key, "missing")
            now = here.get(key, "missing")
            if before != now:
                group, _, leaf = key.partition(".")
                back = f"give {group}={before}" if leaf == "name" else "set the key back"
                raise PolicyError(
                    f"policy={self.folder}: was trained with {key}={before}, and here it is {now}:"
                    " expected the same",
                    f"Name a policy that was trained for this, or {back}",
                )


def _requirements(config: Mapping[str, Any], cameras: Sequence[str]) -> dict[str, Any]:
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
        ("timing", "command_delay"),
        ("task", "params"),
    ]
    found = {f"{group}.{key}": config[group][key] for group, key in keys}
    for name, thing in config["scene"]["objects"].items():
        found[f"scene.objects.{name}"] = f"{thing['shape']} {thing['size']}"
    for name in cameras:
        camera = config["scene"]["cameras"].get(name)
        if camera is not None:
            for key in ("size", "fovy", "pose"):
                found[f"scene.cameras.{name}.{key}"] = camera[key]
    return found


def save_policy(folder: Path, policy: Policy) -> None:
    """Write a policy's folder; an earlier policy in it is replaced at once or not at all.

    Raises:
        PolicyError: It cannot be written; an earlier policy is intact.
    """
    weights = save({k: v.contiguous() for k, v in policy.network.state_dict().items()})
    digest = sha256(weights).hexdigest()
    facts = {
        **policy_facts(policy),
        "versions": {each.__name__: each.__version__ for each in (mjstack, mujoco, torch)},
        "weights_sha256": digest,
        "config": policy.config,
    }
    kept = {*folder.glob(_weights_name("*"))}
    own = folder / _weights_name(digest)
    with _writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            write_atomic(own, weights)
            write_atomic(folder / POLICY_FILE, json.dumps(facts, indent=1) + "\n")
        except OSError:
            if own not in kept:
                own.unlink(missing_ok=True)
            raise
        for path in kept - {own}:
            path.unlink(missing_ok=True)


def policy_facts(policy: Policy) -> dict[str, Any]:
    """Observation, action, network and training of a policy, in JSON's types."""
    vision = policy.network.vision
    images = {"images": {name: list(size) for name, size in vision.sizes.items()}}
    layers = {"channels": list(vision.channels), "features": vision.features}
    return {
        "format": _WITH_IMAGES if vision.sizes else FORMAT,
        "observation": {
            "group": policy.group,
            "widths": policy.widths,
            **asdict(policy.observation),
            **(images if vision.sizes else {}),
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
        "network": {
            "hidden": policy.hidden,
            "activation": "elu",
            **(layers if vision.sizes else {}),
        },
        "training": policy.training,
    }


def load_policy(folder: Path) -> Policy:
    """Read a policy's folder, which may be a stranger's.

    Raises:
        PolicyError: It is no policy, of another version, damaged, or names functions that are not
            in the search path.
    """
    path = folder / POLICY_FILE
    if not path.is_file():
        expected = "expected the folder of a policy"
        raise PolicyError(f"policy={folder}: has no {POLICY_FILE}, {expected}", _NAME_ANOTHER)
    with reading(path, PolicyError, _NAME_ANOTHER):
        facts = json.loads(read_inside(path, MOST_TEXT))
        if facts["format"] not in (FORMAT, _WITH_IMAGES):
            raise PolicyError(
                f"policy={folder}: has format {facts['format']}, expected {FORMAT} or"
                f" {_WITH_IMAGES}, which this mjstack reads",
                "Use the mjstack that wrote it, or train it again",
            )
        policy = _from_facts(facts, path)
        digest = facts["weights_sha256"]
        if not re.fullmatch("[0-9a-f]{64}", digest):
            raise ValueError("weights_sha256 is no SHA-256")
    weights = folder / _weights_name(digest)
    with reading(weights, PolicyError, "Copy the whole folder again, or train the policy again"):
        content = read_inside(weights, _MOST_WEIGHTS)
        if sha256(content).hexdigest() != digest:
            raise ValueError(f"its content is not that of {POLICY_FILE}")
        found = load(content)
        for name, value in found.items():
            if value.dtype != torch.float32 or not bool(value.isfinite().all()):
                raise ValueError(f"{name} has other values than finite ones in float32")
        policy.network.load_state_dict(found, assign=True)
    policy.network.requires_grad_(False)
    return policy


def _from_facts(facts: Mapping[str, Any], path: Path) -> Policy:
    """The policy of a file, its weights without memory, so that sizes of a stranger take none."""
    seen = facts["observation"]
    action = facts["action"]
    hidden = [_whole("network.hidden", width) for width in facts["network"]["hidden"]]
    if len(hidden) > _MOST_LAYERS:
        raise ValueError(f"network.hidden has {len(hidden)} layers, more than {_MOST_LAYERS}")
    # A term may have no numbers here, such as headings where nothing is a box.
    widths = {name: _whole(name, width, least=0) for name, width in seen["widths"].items()}
    vision = _read_vision(facts)
    with torch.device("meta"):
        network = PolicyNetwork(
            sum(widths.values()),
            _whole("action.width", action["width"]),
            _whole("action.chunk", action["chunk"]),
            hidden,
            vision,
        )
    policy = Policy(
        network=network,
        group=str(seen["group"]),
        observation=_read_group(seen, path),
        widths=widths,
        execute=_whole("action.execute", action["execute"], most=_MOST_HELD),
        action=_read_terms("action", action["terms"], TermCfg, path) or None,
        hidden=hidden,
        config=facts["config"],
        training=dict(facts["training"]),
        versions=dict(facts["versions"]),
        folder=path.parent,
    )
    if policy.joints != action["joints"] or list(policy.observation.terms) != list(widths):
        raise ValueError("observation, action and config do not fit together")
    required = _requirements(policy.config, list(vision.sizes))  # they are all there
    for name, size in vision.sizes.items():
        if required.get(f"scene.cameras.{name}.size") != list(size):
            raise ValueError(f"images of {name} are not those of config")
    return policy


def _read_vision(facts: Mapping[str, Any]) -> Vision:
    """The images that the policy of a file sees."""
    images = facts["observation"].get("images", {})
    if not images:
        return Vision()
    network = facts["network"]
    channels = [_whole("network.channels", width) for width in network["channels"]]
    if not 1 <= len(channels) <= _MOST_LAYERS:
        raise ValueError(f"network.channels has {len(channels)} layers")
    sizes = {}
    for name, (height, width) in images.items():
        sides = [_whole("observation.images", side, most=_MOST_PIXELS) for side in (height, width)]
        sizes[str(name)] = (sides[0], sides[1])
    features = _whole("network.features", network["features"])
    return Vision(sizes=sizes, channels=channels, features=features)


def _whole(name: str, value: object, least: int = 1, most: int = _MOST_COUNT) -> int:
    if type(value) is not int or not least <= value <= most:
        raise ValueError(f"{name} is {value!r}, not a whole number from {least} to {most}")
    return value


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


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Raise one line for what cannot be written inside, such as on a full disk."""
    try:
        yield
    except OSError as error:
        raise PolicyError(
            f"{path}: cannot be written ({error.strerror or error}), and stays as it was",
            "Make room, and run the same command again",
        ) from error


def write_state(path: Path, tensors: Mapping[str, Tensor], facts: Mapping[str, Any]) -> None:
    """Write tensors and facts in JSON's types as one file, at once or not at all.

    Raises:
        PolicyError: It cannot be written; an earlier file is intact.
    """
    plain = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    with _writing(path):
        write_atomic(path, save(plain, metadata={"facts": json.dumps(facts)}))


def read_state(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and facts of `write_state`.

    Raises:
        PolicyError: The file cannot be read.
    """
    with reading(path, PolicyError, "Remove it to train anew"), safe_open(path, "pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return tensors, json.loads(file.metadata()["facts"])
