"""Trainer *clone*: a policy learns by regression to answer as the expert does."""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import torch

from mjstack.config.schema import CloneJobCfg, CloneSizes
from mjstack.envs import Env, driven_config
from mjstack.episodes.context import RunContext
from mjstack.errors import ConfigError, MjstackError, UnknownName, renamed_keys
from mjstack.managers.observation import ObservationManager
from mjstack.sim.memory import free_memory
from mjstack.train.clone_learner import Learner
from mjstack.train.dataset import check_dataset, read_demonstrations
from mjstack.train.demonstrations import batches_of, lead_gripper, play_expert
from mjstack.train.trainer import (
    LAST,
    Trained,
    Trainer,
    earlier_state,
    filled,
    observed_group,
    one_world,
)


def check_clone(context: RunContext) -> range:
    """Check the observation, the sizes and the dataset; see `Trainer`."""
    cfg = context.cfg
    job = cast(CloneJobCfg, cfg.job)
    sizes = resolve_sizes(job, context.backend[1])
    group = observed_group(job, sizes.leave_out)
    check_vision(context, job)
    with _started_world(context) as env:
        with renamed_keys({"observation": "job.observation"}):
            widths = ObservationManager(env, {job.group: group}).term_dims[job.group]
        if job.dataset is not None:
            return check_dataset(Path(job.dataset), env, group, widths)
    return range(cfg.seed, cfg.seed + len(batches_of(job, sizes, cfg.nworld)))


def check_vision(context: RunContext, job: CloneJobCfg) -> None:
    """Refuse images that a policy cannot see, or that do not fit into memory.

    Raises:
        MjstackError: Some do not.
    """
    cameras = context.cfg.scene.cameras
    for name in job.vision.cameras:
        if name not in cameras:
            raise UnknownName("job.vision.cameras: camera", name, cameras)
        if "rgb" not in cameras[name].outputs:
            expected = "rgb among them, which a policy sees"
            raise ConfigError(f"scene.cameras.{name}.outputs", cameras[name].outputs, expected)
    if not job.vision.cameras:
        return
    if len(set(job.vision.cameras)) < len(job.vision.cameras):
        raise ConfigError("job.vision.cameras", job.vision.cameras, "names, each once")
    if not job.vision.channels:
        raise ConfigError("job.vision.channels", [], "at least one number")
    if job.dataset is not None:
        expected = "null, because images are drawn from the positions of episodes that are played"
        raise ConfigError("job.dataset", job.dataset, expected, "Or set job.vision.cameras=[]")
    images = 3 * sum(math.prod(cameras[name].size) for name in job.vision.cameras)
    needed = job.vision.pool * images
    free = free_memory(torch.device(context.backend[1]))
    if needed > free:
        expected = (
            f"at most {free // images}, as the device has {free / 2**30:.3g} GiB free and so many"
            f" steps need {needed / 2**30:.3g} GiB"
        )
        raise ConfigError("job.vision.pool", job.vision.pool, expected, "Or make images smaller")


@contextmanager
def _started_world(context: RunContext) -> Iterator[Env]:
    """One started world of the task."""
    with one_world(context, driven_config(context.cfg, reset={})) as env:
        env.reset()
        yield env


def resolve_sizes(job: CloneJobCfg, device: str) -> CloneSizes:
    """The job's sizes, those of the device where they are null."""
    return filled(job, job.sizes["cuda" if device.startswith("cuda") else "cpu"])


def train_clone(context: RunContext, folder: Path) -> Trained:
    """Play the expert or read a dataset, and fit a network to its answers; see `Trainer`."""
    # An earlier call's training, which may be complete
    cfg = context.cfg
    job = cast(CloneJobCfg, cfg.job)
    sizes = resolve_sizes(job, context.backend[1])
    device = context.backend[1].partition(":")[0]
    ranks = context.ranks
    made_with = {"sizes": asdict(sizes), "device": device, "processes": ranks.size}
    earlier = earlier_state(folder, made_with)
    if earlier and earlier[1]["done"] == sizes.batches:
        context.print_line(f"train: {folder} is trained already, and is judged anew")
        return _trained(folder, earlier[1])

    # Demonstrations
    began = time.perf_counter()
    group = observed_group(job, sizes.leave_out)
    cfg = replace(cfg, observation={job.group: group})
    if job.dataset is None:
        demonstrations = play_expert(context, sizes, group)
    else:
        with _started_world(context) as env:
            widths = ObservationManager(env, {job.group: group}).term_dims[job.group]
        demonstrations = read_demonstrations(Path(job.dataset), context, group, widths)
    if len(demonstrations.ends) < 2:
        raise MjstackError(
            f"{demonstrations.source}: {len(demonstrations.ends)} of {demonstrations.played}"
            " episodes succeeded, expected two at least",
            "Ask for more (job.episodes), or look at why with gates=[success]",
        )
    demonstrations = lead_gripper(demonstrations, len(cfg.robot.gripper_joints))
    counts = torch.tensor([len(demonstrations.ends), demonstrations.played], device=device)
    ranks.sum_(counts)
    facts = {
        "expert_episodes": int(counts[0]),
        "expert_episodes_played": int(counts[1]),
        "expert_s": time.perf_counter() - began,
        "source": demonstrations.source,
    }

    # Batches
    learner = Learner(context, cfg, sizes, demonstrations, folder, made_with, facts)
    if earlier:
        learner.restore(*earlier)
    learner.learn()
    return _trained(folder, learner.facts())


def _trained(folder: Path, facts: dict[str, Any]) -> Trained:
    """The result of a complete training, from the facts of its state."""
    last = facts["curve"][-1]
    expert = dict(facts["expert"])
    notes = {"policy": str(folder / LAST), "demonstrations": expert.pop("source")}
    metrics = {
        "batches": facts["done"],
        "training_s": facts["seconds"],
        "loss": last["loss"],
        "validation_loss": last["validation_loss"],
        "best_validation_loss": facts["best"],
    }
    return Trained(
        metrics=expert | metrics,
        notes=notes,
        curve=facts["curve"],
        lines=["loss", "validation_loss"],
    )


TRAINER = Trainer(check_clone, train_clone)
