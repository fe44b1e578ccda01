"""Trainer *dagger*: the policy drives more and more of the time, and learns what the expert would
have done in the states to which that leads.
"""

import math
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor
from typing_extensions import override

from mjstack.config.schema import DaggerJobCfg
from mjstack.drivers.driver import Driver
from mjstack.drivers.policy import PolicyDriver
from mjstack.envs import Env
from mjstack.episodes.batches import BatchPlan, play_batches
from mjstack.episodes.recorder import Channels, Read
from mjstack.episodes.rollout import STATE_BASED
from mjstack.episodes.stage import Stage
from mjstack.errors import ConfigError, MjstackError
from mjstack.managers.view import random_uniform
from mjstack.policy import Policy
from mjstack.policy.checkpoint import read_state, write_state
from mjstack.train.clone import check_clone
from mjstack.train.clone_learner import CloneLearner
from mjstack.train.demonstrations import Demonstrations, LabelDriver, demonstration_channels
from mjstack.train.trainer import LAST, Trained, Trainer, earlier_state, with_observation

_TENSORS = ("seen", "labels", "ends", "driven")  # of `Demonstrations`, in the file of a round


class MixedDriver(LabelDriver):
    """The expert or the policy drives, as a draw for every world and spell says. In some worlds the
    policy drives alone.

    Attributes:
        driven: Where the expert drives this step, shape ``(nworld,)``, int8.
    """

    def __init__(
        self,
        expert: Driver,
        policy: Driver | None,
        env: Env,
        *,
        beta: float,
        alone: int,
        spell: int,
    ) -> None:
        """Take the drivers.

        Args:
            expert: Answers in every state.
            policy: None where the expert drives alone.
            env: The environment.
            beta: Share of the time in which the expert drives.
            alone: Number of worlds, the first ones, in which the policy drives alone.
            spell: Control steps for which one of them drives before it is drawn anew.
        """
        super().__init__(expert, env)
        self._policy = policy
        self._beta = beta
        self._spell = spell
        self.driven = torch.ones(env.nworld, dtype=torch.int8, device=env.device)
        self._alone = torch.arange(env.nworld, device=env.device) < alone

    def command(self) -> Tensor:
        """Joint targets of the next step, shape ``(nworld, nu)``."""
        self.label.copy_(self._expert.command())
        if self._policy is None:
            return self.label
        action = self._policy.command()
        spell = torch.div(self._env.episode_step, self._spell, rounding_mode="floor")
        draw = random_uniform(self._env, "train.driver", 1, 0.0, 1.0, step=spell)
        drives = (draw < self._beta) & ~self._alone[:, None]
        self.driven.copy_(drives[:, 0])
        return torch.where(drives, self.label, action)


def _read_driven(env: Env, driver: Driver) -> Read:
    driven = cast(MixedDriver, driver).driven
    return lambda: {"driven": driven}


class RoundLearner(CloneLearner):
    """Fits a network round by round. A row of the curve is a round, with the success of its policy
    in the worlds of the next one. The best policy is the first one with the largest success.
    """

    trainer = "dagger"

    def begin(self, demonstrations: Demonstrations) -> None:
        """Begin a round with the demonstrations of all rounds so far."""
        self.process(demonstrations)
        self._expert["expert_episodes"] = len(demonstrations.ends)

    @override
    def score(self, row: Mapping[str, Any]) -> tuple[float, ...]:
        return row["success"], -row["round"]

    @override
    def _save(self, **figures: Any) -> None:
        """Write the state alone: `conclude` is called when the success is known."""
        self._write_state()

    def conclude(self, number: int, success: float) -> None:
        """End a round, with the success of its policy."""
        super()._save(round=number, success=success)


def check_dagger(stage: Stage) -> range:
    """Check the expert, the observation and the sizes; see `Trainer`."""
    cfg = stage.cfg
    job = cast(DaggerJobCfg, cfg.job)
    if cfg.controller.name != STATE_BASED:
        expected = "state_based, because trainer=dagger asks the expert in the policy's states"
        fix = "Set trainer=clone, which learns from any expert, or controller=state_based"
        raise ConfigError("controller", cfg.controller.name, expected, fix)
    if job.vision.cameras:
        expected = "[], because trainer=dagger learns from numbers"
        raise ConfigError("job.vision.cameras", job.vision.cameras, expected, "Set trainer=pixels")
    if job.dataset is not None:
        expected = "null, because trainer=dagger asks the expert itself"
        raise ConfigError("job.dataset", job.dataset, expected, "Set trainer=clone")
    if (processes := stage.ranks.size) > 1:
        raise MjstackError(
            f"torchrun has started {processes} processes, and trainer=dagger runs in one",
            "Start it without torchrun, or set trainer=clone",
        )
    check_clone(stage)
    if job.episodes < 2:
        expected = "at least 2, because one of them is for validation"
        raise ConfigError("job.episodes", job.episodes, expected)
    return range(cfg.seed, cfg.seed + (job.rounds + 1) * math.ceil(job.episodes / cfg.nworld))


def train_dagger(stage: Stage, folder: Path) -> Trained:
    """Play and learn, round by round; see `Trainer`."""
    # An earlier call's training
    job = cast(DaggerJobCfg, stage.cfg.job)
    earlier = earlier_state(stage, folder)
    if earlier and len(earlier[1]["curve"]) == job.rounds:
        stage.progress.print_line(f"train: {folder} is trained already, and is judged anew")
        return _trained(folder, earlier[1])

    # Rounds: the expert plays the first one, which gives the scale; in the worlds of the next one
    # the policy of a round shows its success.
    first, _ = _round(stage, folder, None, 0)
    parts = [first]
    with closing(RoundLearner(stage, first, folder, {})) as learner:
        if earlier:
            learner.restore(*earlier)
        for number in range(1, job.rounds + 1):
            learner.begin(Demonstrations.join(parts))
            learner.learn((number - 1) * job.batches, number * job.batches)
            part, success = _round(stage, folder, learner.policy, number)
            parts.append(part)
            if len(learner.curve) < number:
                learner.conclude(number, success)
    for path in folder.glob("round-*.safetensors"):
        path.unlink()
    return _trained(folder, learner.facts())


def _trained(folder: Path, facts: dict[str, Any]) -> Trained:
    """The result of a complete training, from the facts of its state."""
    curve = facts["curve"]
    metrics = {
        "rounds": len(curve),
        "episodes": facts["expert"]["expert_episodes"],
        "batches": facts["done"],
        "training_s": facts["seconds"],
        "loss": curve[-1]["loss"],
        "validation_loss": curve[-1]["validation_loss"],
        "best_training_success": max(row["success"] for row in curve),
    }
    notes = {"policy": str(folder / LAST)}
    return Trained(metrics=metrics, notes=notes, curve=curve, abscissa="round")


def _round(
    stage: Stage, folder: Path, policy: Policy | None, number: int
) -> tuple[Demonstrations, float]:
    """Play a round, or read it where an earlier call has played it.

    Returns:
        Its steps with the expert's labels, and the share of successes of the policy alone.
    """
    path = folder / f"round-{number}.safetensors"
    if not path.exists():
        write_state(path, *_play_round(stage, policy, number))
    tensors, facts = read_state(path)
    seen, labels, ends, driven = (tensors[name].to(stage.backend[1]) for name in _TENSORS)
    widths = facts["widths"]
    part = Demonstrations(seen=seen, labels=labels, ends=ends, driven=driven, widths=widths)
    return part, facts["success"]


def _play_round(
    stage: Stage, policy: Policy | None, number: int
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Play a round, with the expert alone where there is no policy yet.

    Returns:
        Steps with the expert's labels, by the names of `Demonstrations`; and ``widths`` of the
        observation's terms and the share of ``success`` of the policy alone, or of the expert.
    """
    cfg = stage.cfg
    job = cast(DaggerJobCfg, cfg.job)
    nworld = min(cfg.nworld, job.episodes)
    beta = job.beta * job.beta_decay ** (number - 1) if policy else 1.0
    share = 1.0 if number in (0, job.rounds) else job.alone
    alone = math.ceil(share * nworld)
    batches = math.ceil(job.episodes / nworld)
    first = cfg.seed + number * batches

    def drive(plan: BatchPlan, env: Env) -> Driver:
        learner = PolicyDriver(env, policy) if policy else None
        # Whole answers: the policy takes over where it is queried.
        spell = job.execute * max(1, round(job.spell / env.cfg.timing.step_dt / job.execute))
        expert = stage.driver(env)
        return MixedDriver(expert, learner, env, beta=beta, alone=alone, spell=spell)

    parts = []
    successes = 0
    for batch in play_batches(
        stage,
        [BatchPlan(seed, range(nworld)) for seed in range(first, first + batches)],
        [*demonstration_channels(job), Channels(_read_driven)],
        cfg=with_observation(stage.driven(cfg.reset)),
        driver=drive,
        label=f"steps of round {number} of {job.rounds}",
    ):
        successes += int(batch.succeeded[:alone].sum())
        # Nothing is learned from a world whose state is not finite
        finite = batch.finite().nonzero()[:, 0]
        parts.append(Demonstrations.of(batch, finite, job))
    who = "the policy alone" if policy else "the expert"
    episodes = alone * batches
    stage.progress.print_line(
        f"train: round {number}: {who} succeeded in {successes} of {episodes} episodes"
    )
    played = Demonstrations.join(parts)
    tensors = {name: getattr(played, name) for name in _TENSORS}
    return tensors, {"widths": played.widths, "success": successes / episodes}


TRAINER = Trainer(check_dagger, train_dagger)
