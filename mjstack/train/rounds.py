"""Rounds of a training: the expert drives, or the policy a part of the time, and the expert's
answers in the states to which that leads are recorded.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import torch
from torch import Tensor

from mjstack.config.schema import CloneJobCfg
from mjstack.drivers.driver import Driver
from mjstack.drivers.policy import PolicyDriver, QueryImages
from mjstack.envs import Env
from mjstack.episodes.batches import BatchPlan, play_batches
from mjstack.episodes.recorder import Channels, Read, start_and_every_step
from mjstack.episodes.stage import Stage
from mjstack.managers.view import random_uniform
from mjstack.policy import Policy
from mjstack.policy.checkpoint import write_state
from mjstack.train.demonstrations import Demonstrations
from mjstack.train.images import ImagePool
from mjstack.train.trainer import earlier_state, made_with, training_config

_FIELD = "field."  # before the name of a model field, in the file of a round


class MixedDriver(Driver):
    """The expert or the policy drives, as a draw for every world and spell says. In some worlds the
    policy drives alone. Phases, errors and retries are the expert's; ``label`` has its joint
    targets of the last step, shape ``(nworld, action_dim)``, and ``driven`` says where it drives
    this step, shape ``(nworld,)``, int8.
    """

    def __init__(
        self, stage: Stage, env: Env, policy: Policy | None, *, beta: float, alone: int
    ) -> None:
        """Make the drivers of worlds that have started. The stage's expert answers in every state,
        and drives a share ``beta`` of the time, or alone without a policy. In the first ``alone``
        worlds the policy drives alone.
        """
        job: CloneJobCfg = stage.cfg.job
        cameras = stage.cfg.scene.cameras
        self._policy = PolicyDriver(env, policy, cameras) if policy else None
        if self._policy:
            self.query_images = self._policy.query_images
        else:  # images that a policy would see
            self.query_images = QueryImages(env, cameras, job.vision.cameras, job.execute)
        expert = stage.driver(env)
        steps = math.ceil(job.length * expert.steps)
        super().__init__(env.nworld, steps, env.device, expert.phases)
        self.phase = expert.phase
        self.error = expert.error
        self.retries = expert.retries
        self._expert = expert
        self._env = env
        self._beta = beta
        # Whole answers: the policy takes over where it is queried.
        self._spell = job.execute * max(1, round(job.spell / env.cfg.timing.step_dt / job.execute))
        self.label = torch.zeros((env.nworld, env.action_manager.action_dim), device=env.device)
        self.driven = torch.ones(env.nworld, dtype=torch.int8, device=env.device)
        self._alone = env.world < alone

    def command(self) -> Tensor:
        """Joint targets of the next step, shape ``(nworld, nu)``."""
        self.label.copy_(self._expert.command())
        if self._policy is None:
            self.query_images.draw()
            return self.label
        action = self._policy.command()
        spell = torch.div(self._env.episode_step, self._spell, rounding_mode="floor")
        draw = random_uniform(self._env, "train.driver", 1, 0.0, 1.0, step=spell)
        drives = (draw < self._beta) & ~self._alone[:, None]
        self.driven.copy_(drives[:, 0])
        return torch.where(drives, self.label, action)


def _channels(job: CloneJobCfg) -> Sequence[Channels]:
    """Channels of an episode: observations before each step, labels, and where the expert drove. A
    policy that sees images adds positions, and the images of the steps in which it is queried.
    """

    def read_before(env: Env, driver: Driver) -> Read:
        rows = {**env.observation_manager.groups}  # what it estimates among them
        rows["observation"] = rows.pop(job.group)
        if job.vision.cameras:
            rows["qpos"] = env.sim.qpos
        return lambda: rows

    def read_answer(env: Env, driver: Driver) -> Read:
        mixed = cast(MixedDriver, driver)
        return lambda: {"label": mixed.label, "driven": mixed.driven}

    def read_images(env: Env, driver: Driver) -> Read:
        images = cast(MixedDriver, driver).query_images.images
        return lambda: images

    return [
        Channels(read_before, start_and_every_step),
        Channels(read_answer),
        Channels(read_images, lambda steps: range(1, steps + 1, job.execute)),
    ]


def round_file(number: object, rank: object) -> str:
    """Name of the file in which a rank keeps its part of a round."""
    return f"round-{number}-{rank}.safetensors"


def make_round(
    stage: Stage, folder: Path, policy: Policy | None, number: int, pool: ImagePool | None
) -> Demonstrations:
    """Play a round, or read it where an earlier call has played it in every rank. Each rank keeps
    its own part in the training's folder; the pool gets the images, which no file has. Without a
    policy the expert drives alone, as in round 0.

    Raises:
        FolderError: It was played on another kind of device or in another number of ranks.
    """
    job: CloneJobCfg = stage.cfg.job
    if not job.rounds:
        return _play_round(stage, policy, number, pool)
    ranks = stage.ranks
    name = round_file(number, ranks.rank)
    if ranks.any(not (folder / name).exists()):
        played = _play_round(stage, policy, number, pool)
        facts = {**vars(played)}
        facts |= {f"{_FIELD}{key}": values for key, values in facts.pop("fields").items()}
        tensors = {key: facts.pop(key) for key in [*facts] if isinstance(facts[key], Tensor)}
        write_state(folder / name, tensors, facts | {"made_with": made_with(stage)})
        return played
    state = earlier_state(stage, folder, name)
    assert state is not None
    tensors, facts = state
    del facts["made_with"]
    values = {key: part.to(stage.backend[1]) for key, part in tensors.items()}
    names = [key for key in values if key.startswith(_FIELD)]
    looks = {key.removeprefix(_FIELD): values.pop(key) for key in names}
    episodes = Demonstrations(**facts | values, fields=looks)
    if pool is not None:
        episodes.render(stage, pool)
    return episodes


def _play_round(
    stage: Stage, policy: Policy | None, number: int, pool: ImagePool | None
) -> Demonstrations:
    """Play a round, each rank in its worlds. Episodes that are not finite are left out; without
    rounds those that the task's check does not accept, too.
    """
    cfg = stage.cfg
    job: CloneJobCfg = cfg.job
    began = time.perf_counter()
    nworld = min(cfg.nworld, job.episodes)
    worlds = stage.ranks.share(nworld)
    beta = job.beta * job.beta_decay ** (number - 1) if policy else 1.0
    alone = math.ceil((1.0 if number in (0, job.rounds) else job.alone) * nworld)
    batches = math.ceil(job.episodes / nworld)
    first = cfg.seed + number * batches

    parts = []
    for batch in play_batches(
        stage,
        [BatchPlan(seed, worlds) for seed in range(first, first + batches)],
        _channels(job),
        cfg=training_config(stage),
        driver=lambda plan, env: MixedDriver(stage, env, policy, beta=beta, alone=alone),
        label=f"steps of round {number} of {job.rounds}" if job.rounds else "steps of the expert",
    ):
        # The last batch may have more worlds than episodes are missing.
        counted = batch.env.world < job.episodes - (batch.plan.seed - first) * nworld
        judged = counted & (batch.env.world < alone)
        usable = counted & batch.finite()
        if not job.rounds:
            usable &= batch.succeeded
        failing = stage.check.rules.failing(batch.episode.failed[judged.cpu().numpy()])
        parts.append(
            replace(
                Demonstrations.of(batch, usable.nonzero()[:, 0], job, pool),
                played=int(counted.sum()),
                judged=int(judged.sum()),
                succeeded=int((judged & batch.succeeded).sum()),
                broken={rule: len(worlds) for rule, worlds in failing.items()},
            )
        )
    source = f"the expert, seeds {first} to {first + batches - 1}"
    played = Demonstrations.join(parts)
    return replace(played, seconds=time.perf_counter() - began, source=source)
