"""Trainer *clone*: a policy learns by regression to answer as the expert does."""

import math
import time
from contextlib import closing
from pathlib import Path
from typing import Any, cast

import torch

from mjstack.config.schema import CloneJobCfg
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError, MjstackError, UnknownName
from mjstack.sim.memory import free_memory
from mjstack.train.clone_learner import CloneLearner
from mjstack.train.dataset import check_dataset, read_demonstrations
from mjstack.train.demonstrations import batches_of, lead_gripper, play_expert
from mjstack.train.trainer import LAST, Trained, Trainer, earlier_state, observed_widths


def check_clone(stage: Stage) -> range:
    """Check the observation, the sizes and the dataset; see `Trainer`."""
    cfg = stage.cfg
    job = cast(CloneJobCfg, cfg.job)
    _check_vision(stage, job)
    widths = observed_widths(stage)
    if job.dataset is not None:
        return check_dataset(stage, widths)
    return range(cfg.seed, cfg.seed + len(batches_of(job, cfg.nworld)))


def _check_vision(stage: Stage, job: CloneJobCfg) -> None:
    """Refuse images that a policy cannot see, or that do not fit into memory."""
    cameras = stage.cfg.scene.cameras
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
    free = free_memory(torch.device(stage.backend[1]))
    if needed > free:
        expected = f"at most {free // images}, as the device has {free / 2**30:.3g} GiB free and so"
        expected += f" many steps need {needed / 2**30:.3g} GiB"
        raise ConfigError("job.vision.pool", job.vision.pool, expected, "Or make images smaller")


def train_clone(stage: Stage, folder: Path) -> Trained:
    """Play the expert or read a dataset, and fit a network to its answers; see `Trainer`."""
    # An earlier call's training, which may be complete
    job = cast(CloneJobCfg, stage.cfg.job)
    earlier = earlier_state(stage, folder)
    if earlier and earlier[1]["done"] == job.batches:
        stage.progress.print_line(f"train: {folder} is trained already, and is judged anew")
        return _trained(folder, earlier[1])

    # Demonstrations
    began = time.perf_counter()
    if job.dataset is None:
        demonstrations = play_expert(stage)
    else:
        demonstrations = read_demonstrations(stage, observed_widths(stage))
    if len(demonstrations.ends) < 2:
        raise MjstackError(
            f"{demonstrations.source}: {len(demonstrations.ends)} of {demonstrations.played}"
            " episodes succeeded, expected two at least",
            "Ask for more (job.episodes), or look at why with gates=[success]",
        )
    demonstrations = lead_gripper(demonstrations, len(stage.cfg.robot.gripper_joints))
    counts = demonstrations.ends.new_tensor([len(demonstrations.ends), demonstrations.played])
    stage.ranks.sum_(counts)
    facts = {
        "expert_episodes": int(counts[0]),
        "expert_episodes_played": int(counts[1]),
        "expert_s": time.perf_counter() - began,
        "source": demonstrations.source,
    }

    # Batches
    with closing(CloneLearner(stage, demonstrations, folder, facts)) as learner:
        if earlier:
            learner.restore(*earlier)
        learner.learn()
    return _trained(folder, learner.facts())


def _trained(folder: Path, facts: dict[str, Any]) -> Trained:
    """The result of a complete training, from the facts of its state."""
    last = facts["curve"][-1]
    expert = dict(facts["expert"])
    notes = {"policy": str(folder / LAST), "demonstrations": expert.pop("source")}
    metrics = expert | {
        "batches": facts["done"],
        "training_s": facts["seconds"],
        "loss": last["loss"],
        "validation_loss": last["validation_loss"],
        "best_validation_loss": min(row["validation_loss"] for row in facts["curve"]),
    }
    lines = ["loss", "validation_loss"]
    return Trained(metrics=metrics, notes=notes, curve=facts["curve"], lines=lines, scale="log")


TRAINER = Trainer(check_clone, train_clone)
