"""Demonstrations: one batch of the expert's episodes with what was seen, done and earned in every
step, and what a dataset of them holds.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import mujoco
import numpy as np
import torch

from mjstack.config.check import places_objects
from mjstack.config.fingerprint import config_content, config_hash
from mjstack.config.functions import offered
from mjstack.config.schema import CollectJobCfg, Config, ObservationTermCfg
from mjstack.datasets import DatasetSpec, Feature, Video
from mjstack.datasets.spec import term_columns
from mjstack.drivers.driver import Driver
from mjstack.envs import Env, demonstration_config
from mjstack.episodes.context import RunContext
from mjstack.episodes.rollout import Observer, play_episode, reset_worlds
from mjstack.errors import ConfigError
from mjstack.mdp.starts.placement import GAP, SCHEMA, may_meet
from mjstack.sim import Simulation, resolve_backend

STATE = "observation.state"
ACTION = "action"
REWARD = "next.reward"
IMAGES = "observation.images"
_CHUNK_BYTES = 128 * 2**20  # copied to the host at once
# Changing one of these changes no episode. The action terms are the controller's, and nothing ends
# an episode early.
_NO_MATTER = (
    "action",
    "termination",
    "batch",
    "nworld",
    "gates",
    "graph",
    "view",
    "video",
    "run",
    "world",
    "gate",
)


class StepRecorder(Observer):
    """All steps of all worlds in one block on the device. Fixed shapes, no host read: a captured
    graph may hold it.

    A step is what the policy would have seen before its action, the joint commands that went to the
    actuators, and the reward for where they led.

    Attributes:
        values: The steps, shape ``(steps, nworld, dim)``, float32.
        schema: How many numbers of each kind there are, in order.
        states: Positions before each step, from which images are drawn, shape ``(steps, nworld,
            nq)``, float32; None if they are not kept.
    """

    values: torch.Tensor
    schema: dict[str, int]
    states: torch.Tensor | None = None

    def __init__(self, *, keep_states: bool = False) -> None:
        """``keep_states``: keep the positions."""
        self._keep_states = keep_states

    def start(self, env: Env, driver: Driver) -> None:
        """See `Observer`."""
        super().start(env, driver)
        joints = len(env.index.ctrl)
        dims = env.observation_manager.group_dims
        groups = {f"observation.{name}": dim for name, dim in dims.items()}
        self.schema = {STATE: joints, **groups, ACTION: joints, REWARD: 1}
        shape = (driver.steps, env.nworld, sum(self.schema.values()))
        self.values = torch.zeros(shape, device=env.device)
        if self._keep_states:
            self.states = torch.zeros((*shape[:2], env.sim.qpos.shape[1]), device=env.device)
            self._qpos = torch.zeros_like(self.states[0])
        self._robot = env.index.on(env.device, env.sim.qpos.dtype)
        seen = joints + sum(dims.values())
        self._seen = torch.zeros((env.nworld, seen), device=env.device)
        self._next = torch.zeros(1, dtype=torch.int64, device=env.device)
        self._observe()

    def update(self) -> None:
        """See `Observer`."""
        env = self.env
        command = self._robot.ctrl.read(env.sim.ctrl).float()
        step = torch.cat((self._seen, command, env.reward_manager.reward[:, None]), dim=1)
        self.values.index_copy_(0, self._next, step[None])
        if self.states is not None:
            self.states.index_copy_(0, self._next, self._qpos[None])
        self._next.add_(1)
        self._observe()

    def _observe(self) -> None:
        """Keep the state that the next action is for."""
        groups = self.env.observation_manager.groups.values()
        torch.cat(
            [self._robot.qpos.read(self.env.sim.qpos).float(), *groups], dim=1, out=self._seen
        )
        if self.states is not None:
            self._qpos.copy_(self.env.sim.qpos)


@dataclass(eq=False, kw_only=True, slots=True)
class Played:
    """A batch of episodes.

    Attributes:
        seed: Seed of the starts.
        steps: All steps, on the device.
        failed: Bits of the task's rules, shape ``(worlds,)``, int32.
        retries: Grasps that were tried again, shape ``(worlds,)``.
        worlds: Numbers of the worlds, which their starts depend on.
        states: Positions before each step, shape ``(steps, worlds, nq)``; None without cameras.
        fields: Model fields of the worlds by name, each ``(worlds, ...)``.
    """

    seed: int
    steps: StepRecorder
    failed: np.ndarray
    retries: np.ndarray
    worlds: range
    states: torch.Tensor | None = None
    fields: Mapping[str, torch.Tensor] = field(default_factory=dict)

    def finite(self, world: int) -> bool:
        """Whether every number of a world's steps is finite."""
        parts = [self.steps.values] + ([] if self.states is None else [self.states])
        return all(bool(part[:, world].isfinite().all()) for part in parts)

    def to_host(self) -> None:
        """Give the device's memory back."""
        self.steps.values = self.steps.values.cpu()
        if self.states is not None:
            self.states = self.steps.states = self.states.cpu()

    def drop(self) -> None:
        """Give all memory back."""
        del self.steps.values
        self.states = self.steps.states = None

    def episodes(self, worlds: Sequence[int]) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        """Some worlds' steps on the host, by kind, each ``(steps, dim)``; copied in chunks."""
        values = self.steps.values
        size = max(1, _CHUNK_BYTES // (values[:, 0].numel() * values.element_size()))
        ends = np.cumsum(list(self.steps.schema.values()))[:-1]
        for first in range(0, len(worlds), size):
            chunk = torch.tensor(worlds[first : first + size], device=values.device)
            rows = values.index_select(1, chunk).transpose(0, 1).contiguous().cpu().numpy()
            for world, row in zip(worlds[first:], rows, strict=False):
                yield world, dict(zip(self.steps.schema, np.split(row, ends, axis=1), strict=True))


def play_demonstrations(
    context: RunContext, sim: Simulation, seed: int, worlds: range | None = None
) -> Played:
    """Play the configured driver once from the starts of a seed, and judge it by the task's check.
    Worlds are numbered from 0 on if None.

    Nothing ends an episode: worlds go on to its end, so all have as many steps.
    """
    cfg = demonstration_config(replace(context.cfg, seed=seed))
    env = Env(sim, context.index, cfg, check_faults=False)  # the check names lost worlds
    worlds = range(sim.nworld) if worlds is None else worlds
    reset_worlds(env, seed, worlds)
    drawn = bool(context.cfg.scene.cameras)
    recorder = StepRecorder(keep_states=drawn)
    episode = play_episode(
        env, context.driver(env), [recorder], advance=context.advance, label=f"steps of seed {seed}"
    )
    return Played(
        seed=seed,
        steps=recorder,
        failed=episode.result.failed.cpu().numpy(),
        retries=episode.retries,
        worlds=worlds,
        states=recorder.states,
        fields={name: sim.fields[name].clone() for name in sim.fields} if drawn else {},
    )


def episode_config(cfg: Config) -> dict[str, Any]:
    """Everything that episodes depend on, in JSON's types. A starts file counts by its content,
    wherever it is.

    Raises:
        ConfigError: The starts file cannot be read.
    """
    config = config_content(cfg)
    for key in _NO_MATTER:
        del config[key]
    backend, _ = resolve_backend(cfg)
    config["sim"] = {"backend": backend}
    job = cast(CollectJobCfg, cfg.job)
    config["job"] = {"keep_failures": job.keep_failures}
    if cfg.scene.cameras:
        config["job"]["codec"] = job.codec
    placed = [term.params for term in cfg.reset.values() if places_objects(term)]
    if any(may_meet(cfg.scene, params["xy"], params.get("gap", GAP)) for params in placed):
        config["starts_schema"] = SCHEMA  # the others are drawn as ever
    return config


def make_spec(env: Env, cfg: Config, provenance: Mapping[str, Any]) -> DatasetSpec:
    """Describe the dataset of demonstrations in an environment of `demonstration_config`, with any
    number of worlds.

    Raises:
        ConfigError: An observation group has a name that is taken.
    """
    config = episode_config(cfg)
    joints = tuple(cfg.robot.joints)
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
        features[name] = group_feature(env, group, units)
    features |= {
        ACTION: positions,
        REWARD: Feature(dtype="float32", names=("reward",), units=("1",)),
        "next.done": Feature(dtype="bool", names=("done",), units=("1",)),
        "next.success": Feature(dtype="bool", names=("success",), units=("1",)),
    }
    codec = cast(CollectJobCfg, cfg.job).codec
    videos = {
        f"{IMAGES}.{name}": Video(height=camera.size[0], width=camera.size[1], codec=codec)
        for name, camera in cfg.scene.cameras.items()
    }
    return DatasetSpec(
        robot_type=cfg.robot.name,
        fps=round(cfg.task.control_hz),
        features=features,
        videos=videos,
        config_sha256=config_hash(config),
        values={"retries": "int64", "failed_rules": "string", "config_sha256": "string"},
        provenance={**provenance, "config": config},
    )


def joint_units(env: Env) -> tuple[str, ...]:
    """Units of the robot's joints, arm then gripper: rad for hinges, m for slides."""
    model = env.sim.model
    kinds = dict(zip(model.jnt_qposadr.tolist(), model.jnt_type.tolist(), strict=True))
    hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
    return tuple("rad" if kinds[int(address)] == hinge else "m" for address in env.index.robot_qpos)


def group_feature(env: Env, group: str, joints: tuple[str, ...]) -> Feature:
    """Name and unit of each column of an observation group: ``red_pose.2``, and ``red_pose.2.t-1``
    one step before. ``joints`` are the joints' units.
    """
    names: list[str] = []
    units: list[str] = []
    for term, dim in env.observation_manager.term_dims[group].items():
        cfg = cast(ObservationTermCfg, env.cfg.observation[group].terms[term])
        width = dim // cfg.history
        names += term_columns(term, dim, cfg.history)
        units += cfg.history * _scaled(_term_units(cfg.func, width, joints), cfg.scale)
    return Feature(dtype="float32", names=tuple(names), units=tuple(units))


def _term_units(func: str, width: int, joints: tuple[str, ...]) -> Sequence[str]:
    unit = offered(func, "unit") or "unknown"
    if unit == "joint":  # or the actions of a policy, which need not be joint targets
        return joints if width == len(joints) else ["1"] * width
    if unit == "joint/s":
        return [f"{joint}/s" for joint in joints]
    return [unit] * width if isinstance(unit, str) else unit


def _scaled(units: Sequence[str], scale: float) -> list[str]:
    """Units of 1 after the scaling: ``10 rad/s`` where a speed is multiplied by 0.1."""
    if scale == 0.0:
        return ["unknown"] * len(units)
    factor = "" if scale == 1.0 else f"{1.0 / scale:g} "
    return [u if u == "unknown" else f"{factor}{u}".removesuffix(" 1") for u in units]
