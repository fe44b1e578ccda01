"""Trainer *dagger*: the policy drives more and more of the time, and learns what the expert would
have done in the states to which that leads.
"""

import math
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from mjstack.config.schema import CloneSizes, DaggerJobCfg
from mjstack.drivers.driver import Driver
from mjstack.drivers.policy import PolicyDriver
from mjstack.envs import Env
from mjstack.episodes.context import RunContext
from mjstack.episodes.rollout import STATE_BASED, play_episode
from mjstack.errors import ConfigError, MjstackError
from mjstack.managers.view import random_uniform
from mjstack.policy import Policy, save_policy
from mjstack.policy.checkpoint import read_state, write_state
from mjstack.train.clone import check_clone, resolve_sizes
from mjstack.train.clone_learner import Learner
from mjstack.train.demonstrations import DemonstrationRecorder, Demonstrations
from mjstack.train.trainer import (
    BEST,
    LAST,
    EventWriter,
    Trained,
    Trainer,
    earlier_state,
    observed_group,
)

_SPELL = 0.5  # s, for which the expert or the policy drives before it is drawn anew


class MixedDriver(Driver):
    """The expert or the policy drives, as a draw for every world and spell says. In some worlds the
    policy drives alone.

    Attributes:
        label: The expert's joint targets of the last step, shape ``(nworld, nu)``.
    """

    def __init__(
        self, expert: Driver, policy: Driver | None, env: Env, beta: float, alone: int
    ) -> None:
        """Take the drivers.

        Args:
            expert: Answers in every state.
            policy: None where the expert drives alone.
            env: The environment.
            beta: Share of the time in which the expert drives.
            alone: Number of worlds, the first ones, in which the policy drives alone.
        """
        super().__init__(env.nworld, expert.steps, env.device)
        self._expert = expert
        self._policy = policy
        self._env = env
        self._beta = beta
        self._spell = max(1, round(_SPELL / env.cfg.timing.step_dt))
        self._alone = torch.arange(env.nworld, device=env.device) < alone
        self.label = torch.zeros((env.nworld, len(env.index.ctrl)), device=env.device)

    def command(self) -> Tensor:
        """Joint targets of the next step, shape ``(nworld, nu)``."""
        self.label.copy_(self._expert.command())
        if self._policy is None:
            return self.label
        answer = self._policy.command()
        spell = torch.div(self._env.episode_step, self._spell, rounding_mode="floor")
        draw = random_uniform(self._env, "train.driver", 1, 0.0, 1.0, step=spell)
        drives = (draw < self._beta) & ~self._alone[:, None]
        return torch.where(drives, self.label, answer)


class RoundLearner(Learner):
    """Fits a network round by round. A row of the curve is a round, with the success of its policy
    in the worlds of the next one.

    Attributes:
        row: The row of a round whose success is not known yet.
    """

    trainer = "dagger"

    def __init__(self, *args: Any) -> None:
        """Take the arguments of `Learner`; the demonstrations are those of the first round."""
        super().__init__(*args)
        self.row: dict[str, Any] | None = None
        self.best = -1.0

    @property
    def policy(self) -> Policy:
        """The policy so far."""
        return self._policy

    def begin(self, demonstrations: Demonstrations) -> None:
        """Begin a round with the demonstrations of all rounds so far."""
        self.take(demonstrations)
        self._expert["expert_episodes"] = len(demonstrations.ends)

    def _open_events(self) -> None:
        """A row is complete when its success is known."""

    def _save(self) -> None:
        self.row = self._new_row()
        save_policy(self._folder / LAST, self._policy)
        self._write_state()

    def conclude(self, number: int, success: float) -> None:
        """Add the row of a round to the curve, with the success of its policy."""
        assert self.row is not None
        row = {"round": number, "success": success, **self.row}
        self.row = None
        self.curve.append(row)
        if success > self.best:
            self.best = success
            self._policy.training |= row
            save_policy(self._folder / BEST, self._policy)
        events = EventWriter(self._folder, self.done - 1, self._context.print_line)
        events.add(row, self.done)
        events.close()
        self._write_state()

    def facts(self) -> dict[str, Any]:
        """See `Learner`."""
        return super().facts() | {"row": self.row}

    def restore(self, state: dict[str, Tensor], facts: dict[str, Any]) -> None:
        """See `Learner`."""
        super().restore(state, facts)
        self.row = facts["row"]


def check_dagger(context: RunContext) -> range:
    """Check the expert, the observation and the sizes; see `Trainer`."""
    cfg = context.cfg
    job = cast(DaggerJobCfg, cfg.job)
    if cfg.controller.name != STATE_BASED:
        expected = "state_based, because trainer=dagger asks the expert in the policy's states"
        raise ConfigError("controller", cfg.controller.name, expected)
    if job.vision.cameras:
        expected = "[], because trainer=dagger learns from numbers"
        raise ConfigError("job.vision.cameras", job.vision.cameras, expected, "Set trainer=pixels")
    if job.dataset is not None:
        expected = "null, because trainer=dagger asks the expert itself"
        raise ConfigError("job.dataset", job.dataset, expected, "Set trainer=clone")
    if (processes := context.ranks.size) > 1:
        raise MjstackError(
            f"torchrun has started {processes} processes, and trainer=dagger runs in one",
            "Start it without torchrun, or set trainer=clone",
        )
    check_clone(context)
    sizes = resolve_sizes(job, context.backend[1])
    if sizes.episodes < 2:
        expected = "at least 2, because one of them is for validation"
        raise ConfigError("job.episodes", sizes.episodes, expected)
    return range(cfg.seed, cfg.seed + (job.rounds + 1) * _batches(sizes, cfg.nworld))


def _batches(sizes: CloneSizes, nworld: int) -> int:
    """Batches of worlds of a round."""
    return math.ceil(sizes.episodes / nworld)


def train_dagger(context: RunContext, folder: Path) -> Trained:
    """Play and learn, round by round; see `Trainer`."""
    # An earlier call's training
    job = cast(DaggerJobCfg, context.cfg.job)
    device = context.backend[1].partition(":")[0]
    sizes = resolve_sizes(job, device)
    made_with = {"sizes": asdict(sizes), "device": device}
    earlier = earlier_state(folder, made_with)
    if earlier and len(earlier[1]["curve"]) == job.rounds:
        context.print_line(f"train: {folder} is trained already, and is judged anew")
        return _trained(folder, earlier[1])

    # Rounds: the last one shows the success of the policy alone
    learner = None
    parts: list[Demonstrations] = []
    for number in range(job.rounds + 1):
        policy = learner.policy if learner else None
        part, success = _round(context, folder, sizes, policy, number)
        parts.append(part)
        if learner is None:
            learner = _make_learner(context, folder, sizes, part, made_with)
            if earlier:
                learner.restore(*earlier)
        elif learner.row is not None and learner.done == number * sizes.batches:
            learner.conclude(number, success)
        if number < job.rounds:
            learner.begin(_join(parts))
            learner.learn(number * sizes.batches, (number + 1) * sizes.batches)
    assert learner is not None
    for number in range(job.rounds + 1):
        _round_file(folder, number).unlink(missing_ok=True)
    return _trained(folder, learner.facts())


def _make_learner(
    context: RunContext,
    folder: Path,
    sizes: CloneSizes,
    first: Demonstrations,
    made_with: dict[str, Any],
) -> RoundLearner:
    """The learner, its scale that of the first round."""
    job = cast(DaggerJobCfg, context.cfg.job)
    cfg = replace(context.cfg, observation={job.group: observed_group(job, sizes.leave_out)})
    total = replace(sizes, batches=job.rounds * sizes.batches)
    return RoundLearner(context, cfg, total, first, folder, made_with, {})


def _trained(folder: Path, facts: dict[str, Any]) -> Trained:
    """The result of a complete training, from the facts of its state."""
    curve = facts["curve"]
    return Trained(
        metrics={
            "rounds": len(curve),
            "episodes": facts["expert"]["expert_episodes"],
            "batches": facts["done"],
            "training_s": facts["seconds"],
            "loss": curve[-1]["loss"],
            "validation_loss": curve[-1]["validation_loss"],
            "best_training_success": facts["best"],
        },
        notes={"policy": str(folder / LAST)},
        curve=curve,
        lines=["success"],
        abscissa="round",
        scale="linear",
    )


def _round_file(folder: Path, number: int) -> Path:
    return folder / f"round-{number}.safetensors"


def _round(
    context: RunContext, folder: Path, sizes: CloneSizes, policy: Policy | None, number: int
) -> tuple[Demonstrations, float]:
    """States of a round with the expert's answers, and the share of successes of the policy where
    it drove alone. They are played once: a later call reads them.
    """
    path = _round_file(folder, number)
    device = context.backend[1]
    if not path.exists():
        seen, labels, widths, success = _play_round(context, sizes, policy, number)
        found = {"widths": widths, "success": success}
        write_state(path, {"seen": seen, "labels": labels}, found)
    tensors, facts = read_state(path)
    seen = tensors["seen"].to(device)
    episodes, steps = seen.shape[:2]
    demonstrations = Demonstrations(
        seen=seen.flatten(0, 1),
        labels=tensors["labels"].to(device).flatten(0, 1),
        ends=steps * torch.arange(1, episodes + 1, device=device),
        widths=facts["widths"],
        played=episodes,
        source=f"round {number}",
    )
    return demonstrations, facts["success"]


def _join(parts: list[Demonstrations]) -> Demonstrations:
    """The demonstrations of all rounds so far."""
    first = torch.tensor([0, *(len(part.seen) for part in parts[:-1])]).cumsum(0).tolist()
    return Demonstrations(
        seen=torch.cat([part.seen for part in parts]),
        labels=torch.cat([part.labels for part in parts]),
        ends=torch.cat([part.ends + at for part, at in zip(parts, first, strict=True)]),
        widths=parts[0].widths,
        played=sum(part.played for part in parts),
        source="all rounds",
    )


def _play_round(
    context: RunContext, sizes: CloneSizes, policy: Policy | None, number: int
) -> tuple[Tensor, Tensor, dict[str, int], float]:
    """Observations, shape ``(episodes, steps, inputs)``, the expert's joint targets, widths of the
    observation's terms, and the share of successes of the policy alone, or of the expert.
    """
    cfg = context.cfg
    job = cast(DaggerJobCfg, cfg.job)
    group = observed_group(job, sizes.leave_out)
    nworld = min(cfg.nworld, sizes.episodes)
    beta = job.beta * job.beta_decay ** (number - 1) if policy else 1.0
    share = 1.0 if number in (0, job.rounds) else job.alone
    alone = math.ceil(share * nworld)
    batches = _batches(sizes, nworld)
    first = cfg.seed + number * batches
    seen: list[Tensor] = []
    labels: list[Tensor] = []
    widths: dict[str, int] = {}
    accepted = 0
    with closing(context.batch_simulation(nworld)) as sim:
        for seed in range(first, first + batches):
            env = context.start(sim, cfg.reset, seed=seed)
            own = PolicyDriver(env, policy) if policy else None
            driver = MixedDriver(context.driver(env), own, env, beta, alone)
            recorder = DemonstrationRecorder(job.group, group)
            label = f"steps of round {number} of {job.rounds}, seed {seed}"
            looking = [recorder, *context.spectators]
            episode = play_episode(env, driver, looking, advance=context.advance, label=label)
            widths = recorder.widths
            accepted += int((episode.result.failed[:alone] == 0).sum())
            # A world whose state is not finite has nothing to say
            finite = [each.isfinite().all(2).all(0) for each in (recorder.seen, recorder.labels)]
            good = finite[0] & finite[1]
            seen.append(recorder.seen[:, good].transpose(0, 1))
            labels.append(recorder.labels[:, good].transpose(0, 1))
    success = accepted / (alone * batches)
    who = "the policy alone" if policy else "the expert"
    context.print_line(
        f"train: round {number}: {who} succeeded in {accepted} of {alone * batches} episodes"
    )
    return torch.cat(seen), torch.cat(labels), widths, success


TRAINER = Trainer(check_dagger, train_dagger)
