"""A policy's folder: ``policy.json`` and a file of weights. Nothing in it is code.

``policy.json`` is replaced last and names its weights, so that a kill or a full disk leaves the
policy that was there before.
"""

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import mujoco
import torch
from safetensors import safe_open
from safetensors.torch import load, save
from torch import Tensor

from mjstack.config.complete import typed
from mjstack.config.fields import select
from mjstack.config.fingerprint import POLICY_FILE, config_content, policy_folder, shipped_policies
from mjstack.config.schema import Config, ObservationGroupCfg, ObservationTermCfg, TermCfg
from mjstack.config.session import check_term, list_items, search_path
from mjstack.errors import FolderError
from mjstack.files import read_inside, read_json, reading, write_atomic
from mjstack.policy.network import PolicyNetwork, Vision
from mjstack.version import __version__

Facts = dict[str, Any]
"""Values in JSON's types, by name."""
FORMAT = 5  # grows when an older mjstack could not read what is written
_NAME_ANOTHER = ", or ".join(
    ["Name one, such as outputs/mine/last", *shipped_policies(), "LeRobot's: controller=lerobot"]
)
_FLOATS = (torch.float32, torch.float16)  # of weights in a file
_MOST_STEPS = 1_000_000  # between two queries


@dataclass(slots=True)
class Policy:
    """A policy with all that it needs to know.

    Attributes:
        network: Its network, on the CPU in float32.
        group: Name of the observation group that it sees.
        observation: That group's configuration.
        widths: Numbers of each term of the group, in order.
        execute: Control steps between two queries. Of a longer chunk the rest is not used, and the
            last action of a shorter one is repeated.
        config: The configuration of its training, in JSON's types.
        action: Its action terms, by name: of a clone those of joint targets.
        training: Seed and figures of its training, in JSON's types.
        versions: Packages with which it was trained.
        folder: Where it was loaded from; None for a new one.
    """

    network: PolicyNetwork
    group: str
    observation: ObservationGroupCfg
    widths: dict[str, int]
    execute: int
    config: Facts
    action: dict[str, TermCfg]
    training: Facts = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    folder: Path | None = None

    @property
    def joints(self) -> list[str]:
        """Names of the joints that it moves, in order."""
        return [*self.config["robot"]["arm_joints"], *self.config["robot"]["gripper_joints"]]

    def check_fit(self, cfg: Config) -> None:
        """Check that the policy was trained for the robot, task, objects, step and cameras of a
        configuration; a FolderError names the first difference.
        """
        cameras = list(self.network.vision.sizes)
        trained = _requirements(self.config, cameras)
        self._compare(trained, _requirements(config_content(cfg), cameras))

    def check_widths(self, widths: Mapping[str, int], action: int) -> None:
        """Check how many numbers an action and each term of its group have in the worlds that it
        is to drive; another number is a FolderError.
        """
        self._compare({"action.width": self.network.width}, {"action.width": action})
        key = f"observation.{self.group}.terms.{{}}.width"
        self._compare(
            *({key.format(name): terms[name] for name in terms} for terms in (self.widths, widths))
        )

    def _compare(self, trained: Facts, here: Facts) -> None:
        keys = dict.fromkeys([*trained, *here])
        for key in sorted(keys, key=lambda key: not key.endswith(".name")):
            before = trained.get(key, "missing")
            now = here.get(key, "missing")
            if before != now:
                group, _, leaf = key.partition(".")
                back = f"give {group}={before}" if leaf == "name" else "set the key back"
                raise FolderError(
                    f"policy={self.folder}: was trained with {key}={before}, and here it is {now}:"
                    " expected the same",
                    f"Name a policy that was trained for this, or {back}",
                )


def _requirements(config: Facts, cameras: Sequence[str]) -> Facts:
    """The values that a policy with these cameras depends on, by dotted key. Physics, solver and
    starts may differ.
    """
    required = select(config, {"policy"}, Config)
    seen = required["scene"].pop("cameras", {})
    required["scene"]["cameras"] = {name: seen[name] for name in cameras if name in seen}
    return {key: value for key, value in list_items(required) if not isinstance(value, dict)}


def save_policy(folder: str | os.PathLike, policy: Policy) -> None:
    """Write a policy's folder; an earlier policy in it is replaced at once or not at all, such as
    where a FolderError says that it cannot be written.
    """
    folder = Path(folder)
    files = policy_files(policy)
    earlier = {*folder.glob(_weights_name("*"))}
    target = folder / next(iter(files))
    with _writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            for name, content in files.items():
                write_atomic(folder / name, content)
        except OSError:
            if target not in earlier:
                target.unlink(missing_ok=True)
            raise
        for path in earlier - {target}:
            path.unlink(missing_ok=True)


def policy_files(policy: Policy) -> dict[str, str | bytes]:
    """The files of a policy's folder by name, in the order in which they are written."""
    weights = save({k: v.contiguous() for k, v in policy.network.state_dict().items()})
    digest = sha256(weights).hexdigest()
    facts = {
        **policy_facts(policy),
        "versions": {"mjstack": __version__}
        | {module.__name__: module.__version__ for module in (mujoco, torch)},
        "weights_sha256": digest,
        "config": policy.config,
    }
    return {_weights_name(digest): weights, POLICY_FILE: json.dumps(facts, indent=1) + "\n"}


def policy_facts(policy: Policy) -> Facts:
    """Observation, action, network and training of a policy, in JSON's types."""
    vision = policy.network.vision
    images = {name: list(size) for name, size in vision.sizes.items()}
    layers = {"channels": list(vision.channels), "features": vision.features}
    return {
        "format": FORMAT,
        "observation": {
            "group": policy.group,
            "widths": policy.widths,
            **asdict(policy.observation),
            **({"images": images} if images else {}),
        },
        "action": {
            "joints": policy.joints,
            "width": policy.network.width,
            "terms": {k: asdict(term) for k, term in policy.action.items()},
            "chunk": policy.network.chunk,
            "execute": policy.execute,
            "step_dt": 1.0 / policy.config["task"]["control_hz"],
        },
        "network": {
            "hidden": policy.network.hidden,
            "activation": "elu",
            **({"relative": relative} if (relative := policy.network.relative) else {}),
            **(layers if images else {}),
        },
        "training": policy.training,
    }


def load_policy(
    folder: str | os.PathLike, *, config_dir: str | os.PathLike | None = None
) -> Policy:
    """Read a policy's folder, which may be a stranger's, or a shipped policy by its name. Weights
    in float16 become float32.

    Args:
        folder: The folder, such as ``outputs/mine/last``.
        config_dir: A folder as of `mjstack.make_env`: the policy may name terms beside it.

    Raises:
        FolderError: It is no policy, of another version, damaged, or names functions that are not
            in the search path.
    """
    with search_path([] if config_dir is None else [config_dir]):
        folder = policy_folder(Path(folder))
        with suppress(FolderError):
            return _load_policy(folder)
        return _load_policy(folder)  # a training may have saved the next one meanwhile


def _load_policy(folder: Path) -> Policy:
    """The policy of a folder, on the current search path."""
    path = folder / POLICY_FILE
    if not path.is_file():
        reason = f"has no {POLICY_FILE}, expected the folder of a policy"
        raise FolderError(f"policy={folder}: {reason}", _NAME_ANOTHER)
    with reading(path, _NAME_ANOTHER):
        facts = read_json(path)
        if facts["format"] != FORMAT:
            of = " of version 0.1" if facts["format"] in (3, 4) else ""
            raise FolderError(
                f"policy={folder}: has format {facts['format']}{of}, expected {FORMAT}, which"
                f" mjstack {__version__} reads",
                "Use the mjstack that wrote it, or train it again",
            )
        policy = _from_facts(facts, path)
        digest = facts["weights_sha256"]
        if not re.fullmatch("[0-9a-f]{64}", digest):
            raise ValueError("weights_sha256 is no SHA-256")
    weights = folder / _weights_name(digest)
    with reading(weights, "Copy the whole folder again, or train the policy again"):
        content = read_inside(weights)
        if sha256(content).hexdigest() != digest:
            raise ValueError(f"its content is not that of {POLICY_FILE}")
        tensors = load(content)
        for name, value in tensors.items():
            if value.dtype not in _FLOATS or not bool(value.isfinite().all()):
                raise ValueError(f"{name} has other values than finite ones in float32")
        policy.network.load_state_dict(tensors, assign=True)
        policy.network.float()
    policy.network.requires_grad_(False)
    return policy


def _from_facts(facts: Facts, path: Path) -> Policy:
    """The policy of a file, its weights without memory, so that sizes of a stranger take none."""
    seen = facts["observation"]
    action = facts["action"]
    widths = seen["widths"]
    key = f"observation.{seen['group']}"
    group = typed(key, {"noise": seen["noise"]}, ObservationGroupCfg)
    group.terms = _read_terms(f"{key}.terms", seen["terms"], ObservationTermCfg, path)
    layers = facts["network"]
    vision = Vision()
    if images := seen.get("images"):
        sizes = {name: tuple(size) for name, size in images.items()}
        vision = Vision(sizes=sizes, channels=layers["channels"], features=layers["features"])
    execute = action["execute"]
    if type(execute) is not int or not 1 <= execute <= _MOST_STEPS:
        raise ValueError(f"action.execute is {execute!r}, not a whole number of steps")
    inputs = sum(widths.values())
    relative = layers.get("relative", [])
    columns = all(type(number) is int and 0 <= number < inputs for number in relative)
    if relative and not (columns and len(relative) == action["width"]):
        raise ValueError("network.relative is no column of the observation for each joint")
    shape = (inputs, action["width"], action["chunk"], layers["hidden"])
    with torch.device("meta"):
        network = PolicyNetwork(*shape, vision, relative)
    policy = Policy(
        network=network,
        group=str(seen["group"]),
        observation=group,
        widths=widths,
        execute=execute,
        action=_read_terms("action", action["terms"], TermCfg, path),
        config=facts["config"],
        training=dict(facts["training"]),
        versions=dict(facts["versions"]),
        folder=path.parent,
    )
    if policy.joints != action["joints"] or list(policy.observation.terms) != list(widths):
        raise ValueError("observation, action and config do not fit together")
    required = _requirements(policy.config, list(vision.sizes))
    if "task.control_hz" not in required:  # the others are compared where it drives
        raise ValueError("config has no task.control_hz")
    for name, size in vision.sizes.items():
        if required.get(f"scene.cameras.{name}.size") != list(size):
            raise ValueError(f"images of {name} are not those of config")
    return policy


def _weights_name(digest: str) -> str:
    return f"weights-{digest[:12]}.safetensors"


def _read_terms(key: str, nodes: Facts, model: type, path: Path) -> Facts:
    """Terms of a policy's file at a dotted key, which it may name."""
    kind = "action term" if model is TermCfg else "observation term"
    terms = {}
    for name, node in nodes.items():
        label = f"{path}: {key}.{name}"
        terms[name] = typed(label, node, model)
        check_term(label, terms[name].func, kind, path)
    return terms


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Raise one line for what cannot be written inside, such as on a full disk."""
    try:
        yield
    except OSError as error:
        problem = f"{path}: cannot be written ({error.strerror or error}), and stays as it was"
        raise FolderError(problem, "Make room, and run the same command again") from error


def write_state(path: Path, tensors: Mapping[str, Tensor], facts: Facts) -> None:
    """Write tensors and facts in JSON's types as one file, at once or not at all, such as where a
    FolderError says that it cannot be written.
    """
    plain = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    with _writing(path):
        write_atomic(path, save(plain, metadata={"facts": json.dumps(facts)}))


def read_state(path: Path) -> tuple[dict[str, Tensor], Facts]:
    """Tensors and facts of `write_state`; a FolderError if they cannot be read or a number of a
    tensor is not finite.
    """
    with reading(path, "Remove it to train anew"), safe_open(path, "pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        for name, value in tensors.items():
            if value.is_floating_point() and not bool(value.isfinite().all()):
                raise ValueError(f"{name} has numbers that are not finite")
        return tensors, json.loads(file.metadata()["facts"])
