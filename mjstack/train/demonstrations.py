"""Episodes of an expert for a policy to imitate: what the policy would have seen, and the joint
targets that the expert has given.
"""

import math
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import cast

import torch
from torch import Tensor

from mjstack.config.schema import CloneJobCfg, CloneSizes, ObservationGroupCfg
from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.context import RunContext
from mjstack.episodes.rollout import Observer, play_episode
from mjstack.managers.observation import ObservationManager
from mjstack.managers.view import random_uniform

NOISE_SECONDS = 0.5  # in which the noise of a joint is forgotten
_STANDS = 1e-4  # of a joint target's range: by less it moves in no step


class NoisyDriver(Driver):
    """An expert whose arm is pushed off its way: a slow random offset is added to the joint targets
    of the arm, and the expert answers to where that leads.

    Attributes:
        label: The expert's joint targets of the last step, shape ``(nworld, nu)``.
    """

    def __init__(self, expert: Driver, env: Env, noise: float) -> None:
        """Take the expert, and the standard deviation of the offsets [rad]."""
        super().__init__(env.nworld, expert.steps, env.device, expert.phases)
        self.phase = expert.phase
        self.error = expert.error
        self.retries = expert.retries
        self._expert = expert
        self._env = env
        self._arm = env.index.n_arm
        shape = (env.nworld, len(env.index.ctrl))
        self.label = torch.zeros(shape, device=env.device)
        self._given = torch.zeros(shape, device=env.device)
        self._offset = torch.zeros((env.nworld, self._arm), device=env.device)
        self._keep = math.exp(-env.cfg.timing.step_dt / NOISE_SECONDS)
        # A uniform number from -1 to 1 has a variance of 1/3.
        self._width = noise * math.sqrt(3.0 * (1.0 - self._keep**2))

    def command(self) -> Tensor:
        """Joint targets of the next step, shape ``(nworld, nu)``."""
        env = self._env
        self.label.copy_(self._expert.command())
        self._given.copy_(self.label)
        if self._width > 0.0:
            draw = random_uniform(env, "train.noise", self._arm, step=env.episode_step).float()
            self._offset.mul_(self._keep).add_(draw, alpha=self._width)
            self._given[:, : self._arm] += self._offset
        return self._given


class DemonstrationRecorder(Observer):
    """Keeps every step of every world on the device.

    Attributes:
        seen: Observations before each step, shape ``(steps, nworld, inputs)``.
        labels: The expert's joint targets of each step, shape ``(steps, nworld, nu)``.
        widths: Numbers of each term of the observation.
        qpos: Positions before each step, shape ``(steps, nworld, nq)``, float32; None if they are
            not kept.
    """

    seen: Tensor
    labels: Tensor
    widths: dict[str, int]
    qpos: Tensor | None = None

    def __init__(self, name: str, group: ObservationGroupCfg, *, keep_states: bool = False) -> None:
        """Take the observation group's name and configuration, and whether positions are kept."""
        self._name = name
        self._group = group
        self._keep_states = keep_states

    def start(self, env: Env, driver: Driver) -> None:
        """See `Observer`."""
        super().start(env, driver)
        self._observations = ObservationManager(env, {self._name: self._group})
        self._now = self._observations.groups[self._name]
        self.widths = self._observations.term_dims[self._name]
        shape = (driver.steps, env.nworld)
        self.seen = torch.zeros((*shape, self._now.shape[1]), device=env.device)
        self.labels = torch.zeros((*shape, len(env.index.ctrl)), device=env.device)
        if self._keep_states:
            self.qpos = torch.zeros((*shape, env.sim.qpos.shape[1]), device=env.device)
            self._last = env.sim.qpos.float().clone()
        self._next = torch.zeros(1, dtype=torch.int64, device=env.device)
        self._observations.refresh(torch.ones(env.nworld, dtype=torch.bool, device=env.device))

    def update(self) -> None:
        """See `Observer`."""
        driver = cast(NoisyDriver, self.driver)
        self.seen.index_copy_(0, self._next, self._now[None])
        self.labels.index_copy_(0, self._next, driver.label[None])
        if self.qpos is not None:
            self.qpos.index_copy_(0, self._next, self._last[None])
            self._last.copy_(self.env.sim.qpos)
        self._next.add_(1)
        self._observations.compute()


@dataclass(frozen=True, kw_only=True, slots=True)
class Demonstrations:
    """Accepted episodes of an expert, one after the other.

    Attributes:
        seen: Observations before each step, shape ``(steps of all episodes, inputs)``.
        labels: The expert's joint targets, shape ``(steps of all episodes, nu)``.
        ends: The step after the last one of each episode, shape ``(episodes,)``, int64.
        widths: Numbers of each term of the observation, in order.
        played: Episodes that were played.
        source: Where they come from, in words.
        qpos: Positions before each step, from which images are drawn, shape ``(steps of all
            episodes, nq)``, float32; None where there are none.
        fields: Model fields of the episodes' worlds by name, each ``(episodes, ...)``.
    """

    seen: Tensor
    labels: Tensor
    ends: Tensor
    widths: dict[str, int]
    played: int
    source: str
    qpos: Tensor | None = None
    fields: Mapping[str, Tensor] = field(default_factory=dict)

    def episode(self) -> Tensor:
        """The episode that each step belongs to, shape ``(steps,)``, int64."""
        return torch.arange(len(self.ends), device=self.ends.device).repeat_interleave(
            self.lengths()
        )

    def lengths(self) -> Tensor:
        """Steps of each episode, shape ``(episodes,)``, int64."""
        return self.ends.diff(prepend=self.ends.new_zeros(1))

    def last(self) -> Tensor:
        """The last step of the episode that each step belongs to, shape ``(steps,)``, int64."""
        return (self.ends - 1).repeat_interleave(self.lengths())


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


def batches_of(job: CloneJobCfg, sizes: CloneSizes, nworld: int) -> list[tuple[int, float]]:
    """Batches of worlds, each with another seed: how many of their worlds count, and the noise
    [rad] of their commands.
    """
    return [
        (min(nworld, count - first), noise)
        for count, noise in ((sizes.episodes, 0.0), (sizes.noisy_episodes, job.command_noise))
        for first in range(0, count, nworld)
    ]


def play_expert(
    context: RunContext, sizes: CloneSizes, group: ObservationGroupCfg
) -> Demonstrations:
    """Play the expert, and keep the episodes that the task's check accepts.

    Args:
        context: The run; starts and expert are the configured ones. Each rank plays its worlds.
        sizes: How many episodes.
        group: What a policy will see.
    """
    cfg = context.cfg
    job = cast(CloneJobCfg, cfg.job)
    nworld = min(cfg.nworld, max(sizes.episodes, sizes.noisy_episodes))
    batches = list(enumerate(batches_of(job, sizes, nworld), start=cfg.seed))
    worlds = context.ranks.share(nworld)
    most = sum(len(range(worlds.start, min(worlds.stop, count))) for _, (count, _) in batches)
    drawn = bool(job.vision.cameras)
    seen = labels = qpos = torch.zeros(0)
    fields: dict[str, list[Tensor]] = {}
    widths: dict[str, int] = {}
    kept = steps = 0
    with closing(context.batch_simulation(len(worlds))) as sim:
        for seed, (count, noise) in batches:
            env = context.start(sim, cfg.reset, seed=seed, worlds=worlds)
            driver = NoisyDriver(context.driver(env), env, noise)
            recorder = DemonstrationRecorder(job.group, group, keep_states=drawn)
            label = f"steps of the expert, seed {seed}"
            looking = [recorder, *context.spectators]
            episode = play_episode(env, driver, looking, advance=context.advance, label=label)
            if not widths:
                widths = recorder.widths
                steps = driver.steps
                seen = recorder.seen.new_zeros((most, steps, recorder.seen.shape[2]))
                labels = recorder.labels.new_zeros((most, steps, recorder.labels.shape[2]))
                if recorder.qpos is not None:
                    qpos = recorder.qpos.new_zeros((most, steps, recorder.qpos.shape[2]))
            good = (episode.result.failed == 0).nonzero()[:, 0]
            good = good[good < count - worlds.start]
            into = slice(kept, kept + len(good))
            seen[into] = recorder.seen[:, good].transpose(0, 1)
            labels[into] = recorder.labels[:, good].transpose(0, 1)
            if recorder.qpos is not None:
                qpos[into] = recorder.qpos[:, good].transpose(0, 1)
                for name in sim.fields:
                    fields.setdefault(name, []).append(sim.fields[name][good].clone())
            kept += len(good)
            what = f"noise of {noise:g} rad" if noise else "no noise"
            succeeded = sum(context.ranks.gather(len(good)))
            context.print_line(
                f"train: seed {seed}, {what}: {succeeded} of {count} episodes of the expert"
                " succeeded"
            )
    return Demonstrations(
        seen=seen[:kept].flatten(0, 1),
        labels=labels[:kept].flatten(0, 1),
        ends=steps * torch.arange(1, kept + 1, device=seen.device),
        widths=widths,
        played=most,
        source=f"the expert, seeds {batches[0][0]} to {batches[-1][0]}",
        qpos=qpos[:kept].flatten(0, 1) if drawn else None,
        fields={name: torch.cat(parts) for name, parts in fields.items()},
    )
