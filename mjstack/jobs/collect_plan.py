"""The plan of a dataset of demonstrations: its columns, what its episodes depend on, and the record
of the batches that were played.
"""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from mjstack.config.fingerprint import config_content, config_hash
from mjstack.config.schema import CollectJobCfg, Config
from mjstack.datasets.reader import read_begun
from mjstack.datasets.spec import DatasetSpec, Feature, Video
from mjstack.datasets.video import check_encoder
from mjstack.envs import Env, demonstration_config
from mjstack.envs.columns import group_columns, joint_units
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError
from mjstack.files import lock_folder, reading
from mjstack.jobs.runner import run_provenance
from mjstack.mdp.starts.placement import SCHEMA
from mjstack.robots.units import LEROBOT, LerobotUnits
from mjstack.sim import resolve_backend

NAME = "collect"
DATASET = "dataset"  # within the job's folder
BATCHES = "batches.json"  # within it too
STATE = "observation.state"
ACTION = "action"
REWARD = "next.reward"
IMAGES = "observation.images"


@dataclass(frozen=True, kw_only=True)
class CollectPlan:
    """A dataset to be collected.

    Attributes:
        home: The job's folder.
        spec: The dataset's columns and provenance.
        most: Largest number of worlds of a batch: those whose steps fit into the buffers of all
            ranks.
    """

    home: Path
    spec: DatasetSpec
    most: int

    @classmethod
    def from_stage(cls, stage: Stage, home: Path, env: Env) -> "CollectPlan":
        """Plan from an environment of the demonstrations, with any number of worlds.

        Raises:
            ConfigError: The steps of not even one world fit into the buffer, or a column's name is
                taken.
        """
        cfg = stage.cfg
        gib = cfg.job.buffer_gib
        provenance = run_provenance(stage)
        # They differ between calls that make the same episodes.
        for key in ("date", "config_sha256", "files"):
            provenance.pop(key, None)
        spec = make_spec(env, cfg, provenance)
        step = 4 * sum(column.dim for column in spec.features.values() if column.dtype == "float32")
        if spec.videos:
            step += 4 * stage.model.nq
        world = stage.episode_steps * step / 2**30
        if gib < world:
            expected = f"at least {world:.2g}, which the steps of one world take"
            raise ConfigError("job.buffer_gib", gib, expected)
        return cls(home=home, spec=spec, most=min(cfg.nworld, stage.ranks.size * int(gib / world)))


def collect_folder(cfg: Config) -> Path:
    """Where a configuration's dataset is, so that another call finds it."""
    name = config_hash(episode_config(cfg))[:12]
    return Path(cfg.job.folder or f"outputs/collect/{name}")


def plan_collection(stage: Stage) -> CollectPlan:
    """Plan the configured dataset.

    Raises:
        MjstackError: Its episodes would not differ, do not fit into the buffer, or have images that
            cannot be kept or encoded.
    """
    cfg = stage.cfg
    played = demonstration_config(cfg, stage.action)
    with stage.native_env(played, nworld=2) as env:
        if cfg.job.episodes > 1:
            _check_starts(env)
        plan = CollectPlan.from_stage(stage, collect_folder(cfg), env)
    for name, camera in cfg.scene.cameras.items():
        if "rgb" not in camera.outputs:
            expected = "rgb among them, which a dataset keeps"
            raise ConfigError(f"scene.cameras.{name}.outputs", list(camera.outputs), expected)
        if any(side % 2 for side in camera.size):
            expected = "even numbers of pixels, because a video halves the resolution of colour"
            raise ConfigError(f"scene.cameras.{name}.size", list(camera.size), expected)
    if plan.spec.videos:
        check_encoder(plan.spec.videos, plan.spec.fps)
    return plan


def _check_starts(env: Env) -> None:
    """Refuse starts that repeat over worlds or seeds: an episode would be there twice."""
    starts = []
    seed = env.cfg.seed
    for start_seed in (seed, seed - 1 if seed else 1):
        env.reset(seed=start_seed)
        arrays = (env.sim.qpos, env.sim.qvel, *env.sim.fields.values())
        rows = torch.cat([array.double().flatten(1) for array in arrays], dim=1)
        starts += [row.numpy().tobytes() for row in rows]
    if len(set(starts)) < len(starts):
        expected = "starts that differ between worlds and seeds, so that no episode is there twice"
        fix = "Use reset=randomized or reset=jitter"
        raise ConfigError("reset", f"[{', '.join(env.cfg.reset)}]", expected, fix)


def check_folder(dataset: Path, spec: DatasetSpec) -> None:
    """Refuse a dataset that cannot be gone on with.

    Raises:
        FolderError: It is of another configuration or damaged, or another process is writing it.
    """
    if dataset.is_dir():
        os.close(lock_folder(dataset))
        read_begun(dataset, spec)
        read_batches(dataset.parent / BATCHES)


@dataclass(kw_only=True, slots=True)
class BatchRecord:
    """One seed, played in some worlds.

    Attributes:
        seed: The seed.
        worlds: Number of worlds.
        succeeded: Number of worlds that the check passed.
        episodes: Number of its episodes in the dataset.
        retries: Grasps that were tried again, in all worlds.
        broken: How many worlds broke each rule, by its words; among them those that are left out
            only because a number in them is not finite.
    """

    seed: int
    worlds: int
    succeeded: int
    episodes: int
    retries: int
    broken: dict[str, int]


def read_batches(path: Path) -> list[BatchRecord]:
    """The batches of earlier calls.

    Raises:
        FolderError: The file cannot be read.
    """
    if not path.exists():
        return []
    with reading(path, f"Remove {BATCHES}: the expert's success rate is counted anew"):
        return [BatchRecord(**batch) for batch in json.loads(path.read_text())]


def episode_config(cfg: Config) -> dict[str, Any]:
    """Everything that episodes depend on, in JSON's types. A starts file counts by its content,
    wherever it is.

    Raises:
        ConfigError: The starts file cannot be read.
    """
    config = config_content(cfg, "episodes")
    config["sim"]["backend"] = resolve_backend(cfg)[0]
    return config | {"starts_schema": SCHEMA}


def make_spec(env: Env, cfg: Config, provenance: Mapping[str, Any]) -> DatasetSpec:
    """Describe the dataset of demonstrations in an environment of `demonstration_config`, with any
    number of worlds.

    Raises:
        ConfigError: An observation group has a name that is taken.
    """
    config = episode_config(cfg)
    job: CollectJobCfg = cfg.job
    units = joint_units(env)
    lerobot = LerobotUnits(env.index.n_arm, env.index.servo_range).units
    positions = Feature(
        dtype="float32",
        names=tuple(f"{name}.pos" for name in cfg.robot.joints),
        units=lerobot if job.units == LEROBOT else units,
    )
    videos = {
        f"{IMAGES}.{name}": Video(height=camera.size[0], width=camera.size[1], codec=job.codec)
        for name, camera in cfg.scene.cameras.items()
    }
    features = {STATE: positions}
    for group in cfg.observation:
        name = f"observation.{group}"
        if name in features or name in videos or "/" in name:
            expected = "a name without / that is neither state nor a camera's"
            raise ConfigError(f"observation.{group}", "a group", expected)
        features[name] = Feature("float32", *group_columns(env, group))
    features |= {
        ACTION: positions,
        REWARD: Feature(dtype="float32", names=("reward",), units=("1",)),
        "next.done": Feature(dtype="bool", names=("done",), units=("1",)),
        "next.success": Feature(dtype="bool", names=("success",), units=("1",)),
    }
    if job.units == LEROBOT:  # a recording of the real arm has no others
        features = {STATE: positions, ACTION: positions}
    return DatasetSpec(
        robot_type=(job.units == LEROBOT and cfg.robot.lerobot_type) or cfg.robot.name,
        fps=round(cfg.task.control_hz),
        task=cfg.task.words,
        features=features,
        videos=videos,
        config_sha256=config_hash(config),
        values={"retries": "int64", "failed_rules": "string", "config_sha256": "string"},
        provenance={**provenance, "config": config},
    )
