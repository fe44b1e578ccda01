"""Rounds of a training: the policy drives a part of the time, and the expert's answers in the
states to which that leads are recorded.
"""

import math
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from mjstack.config.schema import CloneJobCfg
from mjstack.drivers.driver import Driver
from mjstack.drivers.policy import PolicyDriver
from mjstack.envs import Env
from mjstack.episodes.batches import BatchPlan, play_batches
from mjstack.episodes.recorder import Channels, Read
from mjstack.episodes.stage import Stage
from mjstack.managers.view import random_uniform
from mjstack.policy import Policy
from mjstack.policy.checkpoint import read_state, write_state
from mjstack.train.demonstrations import Demonstrations, LabelDriver, demonstration_channels
from mjstack.train.trainer import with_observation

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


def make_round(
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
    part = Demonstrations(
        seen=seen,
        labels=labels,
        ends=ends,
        driven=driven,
        widths=facts["widths"],
        played=facts["played"],
        source="rounds of the expert and the policy",
    )
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
    job = cast(CloneJobCfg, cfg.job)
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
    facts = {"widths": played.widths, "played": batches * nworld, "success": successes / episodes}
    return tensors, facts
