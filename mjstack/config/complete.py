"""Complete a composed configuration: terms as dataclasses, and what follows from other values."""

import copy
import os
import re
from dataclasses import fields
from functools import cache, reduce
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mjstack.config import schema
from mjstack.config.fields import accepted, check_fields
from mjstack.errors import ConfigError, TermError, require_names

# Terms are untyped in the schema: OmegaConf would not let a command line add one to a typed dict.
_TERMS = {
    "action": schema.TermCfg,
    "controller.action": schema.TermCfg,
    "reset": schema.TermCfg,
    "gate.baseline.reset": schema.TermCfg,
    "termination": schema.TerminationTermCfg,
    "reward": schema.RewardTermCfg,
    "observation": schema.ObservationGroupCfg,
    "job.observation": schema.ObservationGroupCfg,
}


_schema = cache(OmegaConf.structured)  # made once: terms are many
_values: dict[tuple[type, str], Any] = {}  # of terms by their content: most are in any composition


def complete(cfg: schema.Config) -> None:
    """Give every term its type, and fill in the robot and the phases that gates name, in place. A
    term that is null is left out. A MjstackError if a term has an unknown key, lacks one, or a
    value has the wrong type; or if there is no such MJCF file.
    """
    cfg.view = cfg.view.lower()  # YAML's false and true
    known = {field.name for field in fields(cfg.gate)}
    for name in [name for name in vars(cfg.gate) if name not in known]:
        node = vars(cfg.gate).pop(name)
        if isinstance(node, dict) and node.get("func") == schema.EPISODES:
            node = typed(f"gate.{name}", node, schema.EpisodesGateCfg)
        cfg.gate.added[name] = node
    for name, gate in cfg.gate.episodes().items():
        gate.reset = _typed_all(f"gate.{name}.reset", gate.reset, schema.TermCfg)
    for key, kind in _TERMS.items():
        *path, last = key.split(".")
        parent = reduce(getattr, path, cfg)
        if hasattr(parent, last):  # not every job has observations
            setattr(parent, last, _typed_all(key, getattr(parent, last), kind))
    robot = cfg.robot
    check_fields("robot", robot)
    robot.title = robot.title or robot.name
    robot.start = robot.start or list(robot.home)
    robot.ik_joints = robot.ik_joints or [n for n in robot.arm_joints if n not in robot.locked]
    robot.file = _find_file("robot.file", robot.file)
    _complete_scene(cfg.scene)
    for camera in cfg.scene.cameras.values():
        camera.pose = camera.pose or robot.wrist_camera
    _choose_phases(cfg)


def _typed_all(key: str, nodes: dict[str, Any], kind: type) -> dict[str, Any]:
    values = {
        name: typed(f"{key}.{name}", node, kind) for name, node in nodes.items() if node is not None
    }
    if kind is schema.ObservationGroupCfg:
        for name, group in values.items():
            group.terms = _typed_all(f"{key}.{name}.terms", group.terms, schema.ObservationTermCfg)
    return values


def typed(key: str, node: Any, kind: type) -> Any:
    """A mapping of a composed configuration, at a dotted key, as a dataclass; a MjstackError if a
    key is unknown or missing, or its field does not accept a value.
    """
    items = {field.name: field for field in fields(kind)}
    if not isinstance(node, dict):
        raise ConfigError(key, node, f"a mapping with some of {', '.join(items)}")
    require_names(f"{key}: key", map(str, node), items)
    if (content := (kind, repr(node))) in _values:
        return copy.deepcopy(_values[content])
    try:
        typed = OmegaConf.merge(_schema(kind), node)
    except OmegaConfBaseException as error:
        name = re.split(r"[.\[]", str(error.full_key))[0]  # of a list, full_key has the number too
        raise ConfigError(f"{key}.{name}", node[name], accepted(kind, items[name])) from error
    missing = sorted(OmegaConf.missing_keys(typed))
    if missing:
        raise TermError(key, f"'{missing[0]}' is missing: set {key}.{missing[0]}")
    value = OmegaConf.to_object(typed)
    check_fields(key, value)
    _values[content] = copy.deepcopy(value)
    return value


def _complete_scene(scene: schema.SceneCfg) -> None:
    """Find and measure the files of objects, and turn all positions into the world's."""
    check_fields("scene", scene)
    origin = [0.0, 0.0, 0.0]
    if scene.frame == "table":
        origin = [*scene.table_center[:2], scene.table_top]
    scene.frame = "world"

    def in_world(at: list[float]) -> list[float]:
        return [a + b for a, b in zip(at, origin, strict=False)]

    if any(object_cfg.file for object_cfg in scene.objects.values()):
        from mjstack.config.mjcf import measure  # loads mujoco

        measure.cache_clear()  # files may have changed
    for name, object_cfg in scene.objects.items():
        key = f"scene.objects.{name}"
        object_cfg.file = _find_file(f"{key}.file", object_cfg.file)
        if object_cfg.parts or object_cfg.file:
            size = [1e-4] * 3  # of no account: its parts are what others meet
            if object_cfg.file and not object_cfg.fixed:
                size = measure(object_cfg.file, fixed=False).half
            if object_cfg.size not in ([], size) and (object_cfg.file or object_cfg.fixed):
                raise ConfigError(
                    f"{key}.size", object_cfg.size, "[], because it has parts or a file"
                )
            object_cfg.shape = "box"
            object_cfg.size = size
        if object_cfg.file is None:
            object_cfg.friction = object_cfg.friction or [1.0, 0.005, 0.0005]
            object_cfg.color = object_cfg.color or [0.6, 0.6, 0.6, 1.0]
        if object_cfg.pos is not None:
            object_cfg.pos = in_world(object_cfg.pos)
            object_cfg.xy = object_cfg.pos[:2]
        elif len(object_cfg.xy) == 2:
            object_cfg.xy = in_world(object_cfg.xy)
        else:
            expected = f"a list of 2 numbers [m], or {key}.pos with 3"
            raise ConfigError(f"{key}.xy", object_cfg.xy, expected)
    for place_cfg in scene.places.values():
        place_cfg.xy = in_world(place_cfg.xy)


def _find_file(key: str, file: str | None) -> str | None:
    """An MJCF file, absolute."""
    if file is not None and not Path(file).is_file():
        raise ConfigError(key, os.path.abspath(file), "an MJCF file; there is no such file")
    return file and os.path.abspath(file)


def _choose_phases(cfg: schema.Config) -> None:
    """Fill in the phases that gates name, where the task's YAML leaves them open."""
    phases = list(cfg.controller.phases.values())
    if not phases:
        return
    names = list(cfg.controller.phases)
    grasps = [k for k, phase in enumerate(phases) if phase.grasps is not None]
    closed = [k for k, phase in enumerate(phases) if phase.gripper == "closed"]
    # A grasped object is in the hand after its grasp, a pushed one at the jaws until they open.
    in_hand = grasps[0] + 1 if grasps else max(closed, default=0)
    contact = names[min(in_hand, len(names) - 1)]
    loaded = names[min(in_hand if grasps else in_hand + 1, len(names) - 1)]
    parity = cfg.gate.parity
    parity.states = parity.states or {
        "before_contact": names[0],
        "in_contact": contact,
        "at_end": names[-1],
    }
    cfg.gate.throughput.from_phase = cfg.gate.throughput.from_phase or loaded
