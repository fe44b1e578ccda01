"""What a dataset of demonstrations holds: columns with names and units, and the configuration that
episodes depend on.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import mujoco

from mjstack.config.fingerprint import config_content, config_hash
from mjstack.config.schema import CollectJobCfg, Config, ObservationTermCfg
from mjstack.datasets import DatasetSpec, Feature
from mjstack.envs import Env
from mjstack.errors import ConfigError
from mjstack.jobs.demonstration import ACTION, REWARD, STATE
from mjstack.managers.term import resolve_func
from mjstack.sim import resolve_backend

# Changing one of these changes no episode. The action terms are the controller's, and nothing ends
# an episode early.
_NO_MATTER = (
    "action",
    "termination",
    "batch",
    "sim",
    "job",
    "nworld",
    "gates",
    "graph",
    "view",
    "video",
    "run",
    "world",
    "gate",
)


def episode_config(cfg: Config) -> dict[str, Any]:
    """Everything that episodes depend on, in JSON's types. A layout file counts by its content,
    wherever it is.

    Raises:
        ConfigError: The layout file cannot be read.
    """
    config = config_content(cfg)
    for key in _NO_MATTER:
        del config[key]
    backend, _ = resolve_backend(cfg)
    config["sim"] = {"backend": backend.value}
    config["job"] = {"keep_failures": cast(CollectJobCfg, cfg.job).keep_failures}
    return config


@dataclass(frozen=True, kw_only=True, slots=True)
class Difference:
    """Where two configurations differ first. Its text is ``key=found, expected value``, or the
    names that a group has.

    Attributes:
        key: What differs.
        found: What the one has: a value, or a group with other names in it.
        expected: What the other has.
        alone: Whether it is one value, and nothing else differs.
    """

    key: str
    found: Any
    expected: Any
    alone: bool

    def __str__(self) -> str:
        if isinstance(self.found, Mapping) and isinstance(self.expected, Mapping):
            found, expected = (
                ", ".join(map(str, group)) or "nothing" for group in (self.found, self.expected)
            )
            return f"{self.key or 'the configuration'} has {found}, expected {expected}"
        return f"{self.key}={as_override(self.found)}, expected {as_override(self.expected)}"


def first_difference(theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> Difference | None:
    """Where two configurations differ first; None if they are the same."""
    all_of_them = list(_differences(theirs, ours))
    if not all_of_them:
        return None
    key, found, expected = all_of_them[0]
    alone = len(all_of_them) == 1 and not isinstance(found, Mapping)
    return Difference(key=key, found=found, expected=expected, alone=alone)


def as_override(value: Any) -> str:
    """A value of a configuration as one types it."""
    return value if isinstance(value, str) else json.dumps(value)


def _differences(theirs: Any, ours: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """The keys whose values differ, and the groups that have other names in them, with what each
    side has.
    """
    if not (isinstance(theirs, Mapping) and isinstance(ours, Mapping)):
        if theirs != ours:
            yield key, theirs, ours
    elif theirs.keys() != ours.keys():
        yield key, theirs, ours
    else:
        for name in ours:
            yield from _differences(theirs[name], ours[name], f"{key}.{name}" if key else name)


def make_spec(env: Env, cfg: Config, provenance: Mapping[str, Any]) -> DatasetSpec:
    """Describes the dataset of an environment's demonstrations.

    Args:
        env: An environment of `demonstration_config`, with any number of worlds.
        cfg: The job's configuration.
        provenance: Versions and hardware.

    Raises:
        ConfigError: An observation group has a name that is taken.
    """
    config = episode_config(cfg)
    joints = (*cfg.robot.arm_joints, *cfg.robot.gripper_joints)
    units = joint_units(env)
    positions = Feature(dtype="float32", names=tuple(f"{name}.pos" for name in joints), units=units)
    features = {STATE: positions}
    for group in cfg.observation:
        name = f"observation.{group}"
        if name in features:
            raise ConfigError(
                f"observation.{group}",
                "a group",
                f"another name, because {name} are the measured joints",
            )
        features[name] = _group_feature(env, group, units)
    features |= {
        ACTION: positions,
        REWARD: Feature(dtype="float32", names=("reward",), units=("1",)),
        "next.done": Feature(dtype="bool", names=("done",), units=("1",)),
        "next.success": Feature(dtype="bool", names=("success",), units=("1",)),
    }
    return DatasetSpec(
        robot_type=cfg.robot.name,
        fps=round(cfg.task.control_hz),
        features=features,
        config_sha256=config_hash(config),
        values={"retries": "int64", "failed_rules": "string", "config_sha256": "string"},
        provenance={**provenance, "config": config},
    )


def joint_units(env: Env) -> tuple[str, ...]:
    """Units of the robot's joints, arm then gripper: rad for hinges, m for slides."""
    model = env.sim.model
    kinds = {
        int(address): int(kind)
        for address, kind in zip(model.jnt_qposadr, model.jnt_type, strict=True)
    }
    hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
    return tuple("rad" if kinds[int(address)] == hinge else "m" for address in env.index.robot_qpos)


def _group_feature(env: Env, group: str, joints: tuple[str, ...]) -> Feature:
    """A column for each number of an observation group: ``red_pose.2``, and ``red_pose.2.t-1`` one
    step before.
    """
    names: list[str] = []
    units: list[str] = []
    for term, dim in env.observation_manager.term_dims[group].items():
        cfg = cast(ObservationTermCfg, env.cfg.observation[group].terms[term])
        width = dim // cfg.history
        own = _scaled(_term_units(cfg.func, width, joints), cfg.scale)
        for age in range(cfg.history - 1, -1, -1):
            names += [
                f"{term}{f'.{i}' if width > 1 else ''}{f'.t-{age}' if age else ''}"
                for i in range(width)
            ]
            units += own
    return Feature(dtype="float32", names=tuple(names), units=tuple(units))


def _term_units(func: str, width: int, joints: tuple[str, ...]) -> Sequence[str]:
    unit = getattr(resolve_func("observation", func), "unit", "unknown")
    if unit == "joint":
        return joints
    if unit == "joint/s":
        return [f"{joint}/s" for joint in joints]
    return [unit] * width if isinstance(unit, str) else unit


def _scaled(units: Sequence[str], scale: float) -> list[str]:
    """What 1 stands for after the scaling: ``10 rad/s`` where a speed is multiplied by 0.1."""
    if scale == 1.0:
        return list(units)
    if scale == 0.0:
        return ["unknown"] * len(units)
    return [
        unit if unit == "unknown" else f"{1.0 / scale:g} {unit}".removesuffix(" 1")
        for unit in units
    ]
