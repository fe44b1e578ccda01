"""Trainers *clone* and *dagger*: a policy learns by regression to answer as the expert
does, in the expert's episodes and, with rounds, in states to which the policy itself has led.
"""

import math
from collections import Counter
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import torch

from mjstack.config.functions import find_instance
from mjstack.config.schema import CloneJobCfg
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError, MjstackError, require_names
from mjstack.math import rate_interval
from mjstack.policy.checkpoint import Facts
from mjstack.report.figure import Figure, figures
from mjstack.sim.memory import give_back_memory
from mjstack.train.clone_learner import CloneLearner
from mjstack.train.clone_network import measured_columns, vision_of
from mjstack.train.demonstrations import Demonstrations, Source
from mjstack.train.images import ImagePool, pool_rows
from mjstack.train.rounds import make_round, round_file
from mjstack.train.trainer import (
    FAILED,
    LAST,
    Trained,
    Trainer,
    earlier_state,
    observed_widths,
    with_observation,
)


def check_clone(stage: Stage) -> range:
    """Check the expert, the observation, the sizes and the dataset; see `Trainer`."""
    cfg = stage.cfg
    job: CloneJobCfg = cfg.job
    if job.rounds:
        _check_rounds(stage, job)
    if job.vision.cameras:
        _check_vision(stage, job)
    source = find_instance("job.source", job.source, Source)
    widths = observed_widths(stage)
    if job.relative:
        measured_columns(with_observation(cfg), widths)
    if job.dataset is not None:
        return source.check(stage, widths)
    least = 2 * stage.ranks.size
    if job.episodes < least:
        expected = f"at least {least}, because one of each rank's is for validation"
        raise ConfigError("job.episodes", job.episodes, expected)
    batches = (job.rounds + 1) * math.ceil(job.episodes / cfg.nworld)
    return range(cfg.seed, cfg.seed + batches)


def _check_rounds(stage: Stage, job: CloneJobCfg) -> None:
    """Refuse what cannot be learned in rounds."""
    if not stage.driver_class.stateless:
        expected = "closed_loop, without a clock: trainer=dagger asks it in the policy's states"
        fix = "Set trainer=clone, which learns from any expert, or controller.clock=false too"
        raise ConfigError("controller", stage.cfg.controller.name, expected, fix)
    if job.dataset is not None:
        expected = "null, because trainer=dagger asks the expert itself"
        raise ConfigError("job.dataset", job.dataset, expected, "Set trainer=clone")


def _check_vision(stage: Stage, job: CloneJobCfg) -> None:
    """Refuse images that a policy cannot see, or that do not fit into memory."""
    cameras = stage.cfg.scene.cameras
    require_names("job.vision.cameras: camera", job.vision.cameras, cameras)
    for name in job.vision.cameras:
        if "rgb" not in cameras[name].outputs:
            expected = "rgb among them, which a policy sees"
            raise ConfigError(f"scene.cameras.{name}.outputs", cameras[name].outputs, expected)
    if len(set(job.vision.cameras)) < len(job.vision.cameras):
        raise ConfigError("job.vision.cameras", job.vision.cameras, "names, each once")
    if not job.vision.channels:
        raise ConfigError("job.vision.channels", [], "at least one number")
    if job.dataset is not None:
        expected = "null, because images are rendered in episodes that are played"
        raise ConfigError("job.dataset", job.dataset, expected, "Or set job.vision.cameras=[]")
    pool_rows(stage, stage.cfg.task.episode_steps)


def train_clone(stage: Stage, folder: Path) -> Trained:
    """Fit a network to the expert's answers; see `Trainer`."""
    # An earlier call's training, which may be complete
    job: CloneJobCfg = stage.cfg.job
    if earlier := earlier_state(stage, folder):
        _, facts = earlier
        if len(facts["curve"]) == job.rounds if job.rounds else facts["done"] == job.batches:
            stage.progress.print_line(f"train: {folder} is trained already, and is judged anew")
            return _trained(job, folder, facts)

    # The first episodes give the scale
    pool = None
    if sizes := vision_of(stage.cfg, job).sizes:
        rows = min(stage.ranks.gather(pool_rows(stage, stage.episode_steps)))
        pool = ImagePool(sizes, earlier[1]["pool"] if earlier else rows, stage.backend[1])
    if job.dataset is None:
        first = make_round(stage, folder, None, 0, pool)
        figures = _judge(stage, "round 0: the expert" if job.rounds else "the expert", first)
        rules = {k.removeprefix(FAILED): n for k, n in figures.items() if k.startswith(FAILED)}
        broken = "".join(f", {rule} broken in {count}" for rule, count in rules.items())
        words = f"{first.source}: success {figures['success']:.4g}{broken}"
        first = replace(first, source=words)
    else:
        source = find_instance("job.source", job.source, Source)
        first = source.read(stage, observed_widths(stage))
    if len(first.ends) < 2:
        counts = f"{len(first.ends)} of {first.played} episodes succeeded, expected two at least"
        fix = "Ask for more (job.episodes), or look at why with gates=[success]"
        raise MjstackError(f"{first.source}: {counts}", fix)

    # Rounds: in the worlds of the next one the policy of a round shows its success.
    parts = [first]
    with closing(CloneLearner(stage, first, folder, pool)) as learner:
        if earlier:
            learner.restore(*earlier)
        if not job.rounds:
            learner.learn()
        for number in range(1, job.rounds + 1):
            learner.process(Demonstrations.join(parts))
            learner.learn(number)
            give_back_memory(torch.device(stage.backend[1]))  # a round's images are large blocks
            part = make_round(stage, folder, learner.policy, number, pool)
            parts.append(part)
            figures = _judge(stage, f"round {number}: the policy alone", part)
            if len(learner.curve) < number:
                learner.conclude(number, figures)
    if stage.ranks.writes:  # the others have read theirs
        for number in range(job.rounds + 1):
            for rank in range(stage.ranks.size):
                (folder / round_file(number, rank)).unlink(missing_ok=True)
    return _trained(job, folder, learner.facts())


def _judge(stage: Stage, who: str, episodes: Demonstrations) -> dict[str, float]:
    """Print how many judged episodes of all ranks succeeded. Returns ``success``, their share, with
    its 95 % interval; ``judged``, their number; ``played_s``, the time in which the slowest rank
    played the round [s]; and how many broke each rule, ``failed.<rule>``.
    """
    facts = (episodes.succeeded, episodes.judged, episodes.seconds, Counter(episodes.broken))
    successes, numbers, seconds, broken = zip(*stage.ranks.gather(facts), strict=True)
    succeeded = sum(successes)
    judged = sum(numbers)
    stage.progress.print_line(f"train: {who} succeeded in {succeeded} of {judged} episodes")
    rules: Counter[str] = sum(broken, Counter())
    return {
        **rate_interval("success", succeeded, judged),
        "judged": judged,
        "played_s": max(seconds),
        **{f"{FAILED}{rule}": count for rule, count in rules.items()},
    }


def _trained(job: CloneJobCfg, folder: Path, facts: Facts) -> Trained:
    """The result of a complete training, from the facts of its state."""
    curve = facts["curve"]
    expert = dict(facts["expert"])
    notes = {"policy": str(folder / LAST), "demonstrations": expert.pop("source")}
    seconds = expert.pop("expert_s")
    numbers = expert | {
        "batches": facts["done"],
        "loss": curve[-1]["loss"],
        "validation_loss": curve[-1]["validation_loss"],
        "best_validation_loss": min(row["validation_loss"] for row in curve),
    }
    if job.rounds:
        best = max(row["success"] for row in curve)
        numbers |= {"rounds": job.rounds, "best_training_success": best}
        seconds += curve[-1].get("played_s", 0.0)  # the round of the last policy
    times = [Figure("expert", seconds, "s"), Figure("training", facts["seconds"], "s")]
    measured = [*figures(**numbers), *times]
    if job.rounds:
        # A row has the rules that were broken in its round
        rules = {name: 0 for row in curve for name in row if name.startswith(FAILED)}
        curve = [{k: v for k, v in row.items() if k not in rules} | rules | row for row in curve]
        return Trained(figures=measured, notes=notes, curve=curve, abscissa="round")
    lines = ["loss", "validation_loss"]
    return Trained(figures=measured, notes=notes, curve=curve, lines=lines, log=True)


TRAINER = Trainer(check_clone, train_clone)
