"""Complete a composed configuration: terms as dataclasses, and what follows from other values."""

from dataclasses import asdict, fields
from functools import cache
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mjstack.config.fields import accepted, check_fields
from mjstack.config.schema import (
    CloneJobCfg,
    Config,
    ObservationGroupCfg,
    ObservationTermCfg,
    PpoJobCfg,
    RewardTermCfg,
    RobotCfg,
    SolverCfg,
    StudyJobCfg,
    TermCfg,
    TerminationTermCfg,
)
from mjstack.config.session import config_folders
from mjstack.errors import ConfigError, TermError, UnknownName

# Terms are untyped in the schema: OmegaConf would not let a command line add one to a typed dict.
_TERMS = {
    "action": TermCfg,
    "controller.action": TermCfg,
    "reset": TermCfg,
    "gate.capacity.reset": TermCfg,
    "gate.success.reset": TermCfg,
    "termination": TerminationTermCfg,
    "reward": RewardTermCfg,
    "observation": ObservationGroupCfg,
}


def complete(cfg: Config) -> None:
    """Give every term and every variant of the solver its type, and fill in the robot and the
    phases that gates name, in place. A term that is null is left out.

    Raises:
        MjstackError: A term has an unknown key, lacks one, or a value has the wrong type; or
            ``robot.file`` is in none of the folders.
    """
    cfg.view = cfg.view.lower()  # YAML's false and true
    known = {field.name for field in fields(cfg.gate)}
    for name in vars(cfg.gate).keys() - known:
        cfg.gate.added[name] = vars(cfg.gate).pop(name)
    for key, kind in _TERMS.items():
        parent: Any = cfg
        *path, last = key.split(".")
        for name in path:
            parent = getattr(parent, name)
        setattr(parent, last, _typed_all(key, getattr(parent, last), kind))
    _complete_groups("observation", cfg.observation)
    if isinstance(cfg.job, StudyJobCfg):
        variants = {
            name: asdict(cfg.solver) | node if isinstance(node, dict) else node
            for name, node in cfg.job.variants.items()
        }
        cfg.job.variants = _typed_all("job.variants", variants, SolverCfg)
    if isinstance(cfg.job, CloneJobCfg | PpoJobCfg):
        seen = _typed_all("job.observation", cfg.job.observation, ObservationGroupCfg)
        _complete_groups("job.observation", seen)
        cfg.job.observation = seen
    _complete_robot(cfg.robot)
    for camera in cfg.scene.cameras.values():
        camera.pose = camera.pose or cfg.robot.wrist_camera
    _choose_phases(cfg)


def _typed_all(key: str, nodes: dict[str, Any], kind: type) -> dict[str, Any]:
    return {
        name: typed(f"{key}.{name}", node, kind) for name, node in nodes.items() if node is not None
    }


def _complete_groups(key: str, groups: dict[str, ObservationGroupCfg]) -> None:
    for name, group in groups.items():
        group.terms = _typed_all(f"{key}.{name}.terms", group.terms, ObservationTermCfg)


def typed(key: str, node: Any, kind: type) -> Any:
    """A mapping of a composed configuration, at a dotted key, as a dataclass.

    Raises:
        MjstackError: A key is unknown or missing, or its field does not accept a value.
    """
    items = {field.name: field for field in fields(kind)}
    if not isinstance(node, dict):
        raise ConfigError(key, node, f"a mapping with some of {', '.join(items)}")
    for name in node:
        if name not in items:
            raise UnknownName(f"{key}: key", str(name), items)
    # OmegaConf would copy what has no types, to and fro.
    untyped = {k: v for k, v in node.items() if k in ("params", "terms") and _is_mapping(v)}
    try:
        typed = OmegaConf.merge(_schema(kind), {k: node[k] for k in node if k not in untyped})
    except OmegaConfBaseException as error:
        name = str(error.full_key).partition(".")[0]
        raise ConfigError(f"{key}.{name}", node[name], accepted(kind, items[name])) from error
    missing = sorted(OmegaConf.missing_keys(typed))
    if missing:
        raise TermError(key, f"'{missing[0]}' is missing: set {key}.{missing[0]}")
    found = OmegaConf.to_object(typed)
    for name, mapping in untyped.items():
        setattr(found, name, mapping)
    check_fields(key, found)
    return found


def _is_mapping(value: object) -> bool:
    return isinstance(value, dict) and all(isinstance(name, str) for name in value)


@cache
def _schema(kind: type) -> DictConfig:
    """A dataclass as OmegaConf has it, made once: terms are many."""
    return cast(DictConfig, OmegaConf.structured(kind))


def _complete_robot(robot: RobotCfg) -> None:
    """Fill in what a robot's YAML left out, and find its file: relative to the ``robot`` group of a
    search path, or to the working folder.
    """
    robot.title = robot.title or robot.name
    robot.start = robot.start or list(robot.home)
    robot.ik_joints = robot.ik_joints or [n for n in robot.arm_joints if n not in robot.locked]
    if robot.file is None:
        return
    tried = [*(folder / "robot" / robot.file for folder in config_folders()), Path(robot.file)]
    paths = list(dict.fromkeys(path.resolve() for path in tried))
    found = next((path for path in paths if path.is_file()), None)
    if found is None:
        expected = f"an MJCF file; there is no {' and no '.join(map(str, paths))}"
        raise ConfigError("robot.file", robot.file, expected)
    robot.file = str(found)


def _choose_phases(cfg: Config) -> None:
    """Fill in the phases that gates name, where the task's YAML leaves them open."""
    phases = list(cfg.controller.phases.values())
    if not phases:
        return
    names = list(cfg.controller.phases)
    grasps = [k for k, phase in enumerate(phases) if phase.grasps is not None]
    closed = [k for k, phase in enumerate(phases) if phase.gripper == "closed"]
    # A grasped object is in the hand after its grasp, a pushed one at the jaws until they open.
    held = grasps[0] + 1 if grasps else max(closed, default=0)
    contact = names[min(held, len(names) - 1)]
    loaded = names[min(held if grasps else held + 1, len(names) - 1)]
    parity = cfg.gate.parity
    parity.states = parity.states or {
        "before_contact": names[0],
        "in_contact": contact,
        "at_end": names[-1],
    }
    cfg.gate.throughput.from_phase = cfg.gate.throughput.from_phase or loaded
