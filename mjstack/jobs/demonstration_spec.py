"""What a dataset of demonstrations holds: columns with names and units, and the configuration that
episodes depend on.
"""

from collections.abc import Iterator, Mapping, Sequence
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


def differences(theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> list[str]:
    """Keys in which two configurations differ, such as ``seed=1, expected 2``."""
    before = dict(_flat(theirs))
    now = dict(_flat(ours))
    return [
        f"{key}={before.get(key, 'missing')}, expected {now.get(key, 'none')}"
        for key in before | now
        if before.get(key) != now.get(key)
    ]


def _flat(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and their values."""
    if isinstance(node, Mapping) and node:
        for name, value in node.items():
            yield from _flat(value, f"{key}.{name}" if key else name)
    else:
        yield key, node


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
