"""Episodes of an expert for a policy to imitate: what the policy would have seen, and the joint
targets that the expert has given.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import torch
from torch import Tensor

from mjstack.config.schema import CloneJobCfg
from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.batches import Batch, BatchPlan, play_batches
from mjstack.episodes.recorder import Channels, Read, start_and_every_step
from mjstack.episodes.stage import Stage
from mjstack.managers.view import random_uniform
from mjstack.train.trainer import with_observation

NOISE_SECONDS = 0.5  # in which the noise of a joint is forgotten
_STANDS = 1e-4  # of a joint target's range: by less it moves in no step


class LabelDriver(Driver):
    """Base class of drivers that leave an expert's way, and keep what the expert does there.

    Attributes:
        label: The expert's joint targets of the last step, shape ``(nworld, nu)``.
    """

    def __init__(self, expert: Driver, env: Env) -> None:
        """Take the expert, whose phases, errors and retries are those of the driver."""
        super().__init__(env.nworld, expert.steps, env.device, expert.phases)
        self.phase = expert.phase
        self.error = expert.error
        self.retries = expert.retries
        self._expert = expert
        self._env = env
        self.label = torch.zeros((env.nworld, len(env.index.ctrl)), device=env.device)


class NoisyDriver(LabelDriver):
    """An expert whose arm is pushed off its way: a slow random offset is added to the joint targets
    of the arm, and the expert answers to where that leads.
    """

    def __init__(self, expert: Driver, env: Env, noise: float) -> None:
        """Take the expert, and the standard deviation of the offsets [rad]."""
        super().__init__(expert, env)
        self._arm = env.index.n_arm
        self._command = torch.zeros_like(self.label)
        self._offset = torch.zeros((env.nworld, self._arm), device=env.device)
        self._decay = math.exp(-env.cfg.timing.step_dt / NOISE_SECONDS)
        # A uniform number from -1 to 1 has a variance of 1/3.
        self._width = noise * math.sqrt(3.0 * (1.0 - self._decay**2))

    def command(self) -> Tensor:
        """Joint targets of the next step, shape ``(nworld, nu)``."""
        env = self._env
        self.label.copy_(self._expert.command())
        self._command.copy_(self.label)
        if self._width > 0.0:
            draw = random_uniform(env, "train.noise", self._arm, step=env.episode_step).float()
            self._offset.mul_(self._decay).add_(draw, alpha=self._width)
            self._command[:, : self._arm] += self._offset
        return self._command


def demonstration_channels(job: CloneJobCfg) -> list[Channels]:
    """What is recorded of an episode with a driver that has labels: observations before each step,
    positions too where images are rendered from them, and the labels.
    """

    def read_before(env: Env, driver: Driver) -> Read:
        observations = env.observation_manager.groups[job.group]
        if not job.vision.cameras:
            return lambda: {"observation": observations}
        qpos = env.sim.qpos
        return lambda: {"observation": observations, "qpos": qpos.float()}

    def read_label(env: Env, driver: Driver) -> Read:
        label = cast(LabelDriver, driver).label
        return lambda: {"label": label}

    return [Channels(read_before, start_and_every_step), Channels(read_label)]


@dataclass(frozen=True, kw_only=True, slots=True)
class Demonstrations:
    """Accepted episodes of an expert, one after the other.

    Attributes:
        seen: Observations before each step, shape ``(steps of all episodes, inputs)``.
        labels: The expert's joint targets, shape ``(steps of all episodes, nu)``.
        ends: The step after the last one of each episode, shape ``(episodes,)``, int64.
        widths: Numbers of each term of the observation, in order.
        driven: Where the expert drove the step, shape ``(steps of all episodes,)``, int8; None if
            it drove all of them.
        played: Episodes that were played, successful or not.
        source: Where they come from, in words.
        qpos: Positions before each step, from which images are drawn, shape ``(steps of all
            episodes, nq)``, float32; None where there are none.
        fields: Model fields of the episodes' worlds by name, each ``(episodes, ...)``.
    """

    seen: Tensor
    labels: Tensor
    ends: Tensor
    widths: dict[str, int]
    driven: Tensor | None = None
    played: int = 0
    source: str = ""
    qpos: Tensor | None = None
    fields: Mapping[str, Tensor] = field(default_factory=dict)

    @classmethod
    def of(cls, batch: Batch, worlds: Tensor, job: CloneJobCfg) -> "Demonstrations":
        """Those of a batch's worlds with these numbers."""
        rows = {name: batch.select(name, worlds) for name in batch.rows}
        labels = rows.pop("label")
        steps = labels.shape[1]
        before = {name: values[:, :steps].flatten(0, 1) for name, values in rows.items()}
        fields = batch.env.sim.fields if job.vision.cameras else {}
        return cls(
            seen=before["observation"],
            labels=labels.flatten(0, 1),
            ends=steps * torch.arange(1, len(worlds) + 1, device=worlds.device),
            widths=batch.env.observation_manager.term_dims[job.group],
            driven=before.get("driven"),
            qpos=before.get("qpos"),
            fields={name: fields[name][worlds] for name in fields},
        )

    @classmethod
    def join(cls, parts: Sequence["Demonstrations"]) -> "Demonstrations":
        """The episodes of all parts, in their order."""
        first = [0, *itertools.accumulate(len(part.seen) for part in parts)]
        states = [part.qpos for part in parts if part.qpos is not None]
        driven = [part.driven for part in parts if part.driven is not None]
        return cls(
            seen=torch.cat([part.seen for part in parts]),
            labels=torch.cat([part.labels for part in parts]),
            ends=torch.cat([part.ends + at for part, at in zip(parts, first, strict=False)]),
            widths=parts[0].widths,
            driven=torch.cat(driven) if driven else None,
            played=sum(part.played for part in parts),
            source=parts[0].source,
            qpos=torch.cat(states) if states else None,
            fields={
                name: torch.cat([part.fields[name] for part in parts]) for name in parts[0].fields
            },
        )

    def episode(self) -> Tensor:
        """The episode that each step belongs to, shape ``(steps,)``, int64."""
        lengths = self.ends.diff(prepend=self.ends.new_zeros(1))
        return torch.arange(len(lengths), device=lengths.device).repeat_interleave(lengths)


def lead_gripper(demonstrations: Demonstrations, fingers: int) -> Demonstrations:
    """Demonstrations whose jaws are led to where they will stand, in place of along the way there.

    An expert closes and opens its jaws in a ramp. A policy that copies the ramp reads from the
    measured jaws how far it is on it. Where an object stops them early it would wait for ever.

    Args:
        demonstrations: Episodes of an expert.
        fingers: How many of the joint targets, the last ones, are the gripper's.
    """
    labels = demonstrations.labels.clone()
    jaws = labels[:, -fingers:]
    steps = torch.arange(len(jaws), device=jaws.device)
    least = _STANDS * (jaws.amax(0) - jaws.amin(0))
    stands = torch.ones_like(steps, dtype=torch.bool)
    stands[:-1] = (jaws.diff(dim=0).abs() <= least).all(1)
    stands[demonstrations.ends - 1] = True
    next_stand = torch.where(stands, steps, len(steps)).flip(0).cummin(0).values.flip(0)
    labels[:, -fingers:] = jaws[next_stand]
    return replace(demonstrations, labels=labels)


def batches_of(job: CloneJobCfg, nworld: int) -> list[tuple[int, float]]:
    """Batches of worlds, each with another seed: how many of their worlds count, and the noise
    [rad] of their commands.
    """
    return [
        (min(nworld, count - first), noise)
        for count, noise in ((job.episodes, 0.0), (job.noisy_episodes, job.command_noise))
        for first in range(0, count, nworld)
    ]


def play_expert(stage: Stage) -> Demonstrations:
    """Play the configured expert, each rank in its worlds, and keep the episodes that the task's
    check accepts and whose observations are finite.
    """
    cfg = stage.cfg
    job = cast(CloneJobCfg, cfg.job)
    nworld = min(cfg.nworld, max(job.episodes, job.noisy_episodes))
    worlds = stage.ranks.share(nworld)
    batches = dict(enumerate(batches_of(job, nworld), start=cfg.seed))
    source = f"the expert, seeds {min(batches)} to {max(batches)}"
    parts = []
    for batch in play_batches(
        stage,
        [BatchPlan(seed, worlds) for seed in batches],
        demonstration_channels(job),
        cfg=with_observation(stage.driven(cfg.reset)),
        driver=lambda plan, env: NoisyDriver(stage.driver(env), env, batches[plan.seed][1]),
        label="steps of the expert",
    ):
        count, noise = batches[batch.plan.seed]
        counted = range(worlds.start, min(worlds.stop, count))
        accepted = (batch.succeeded & batch.finite())[: len(counted)].nonzero()[:, 0]
        part = Demonstrations.of(batch, accepted, job)
        parts.append(replace(part, played=len(counted), source=source))
        condition = f"noise of {noise:g} rad" if noise else "no noise"
        succeeded = sum(stage.ranks.gather(len(accepted)))
        stage.progress.print_line(
            f"train: seed {batch.plan.seed}, {condition}: {succeeded} of {count} episodes of the"
            " expert succeeded"
        )
    return Demonstrations.join(parts)
