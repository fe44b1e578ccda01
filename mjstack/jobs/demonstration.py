"""Plays one batch of demonstrations: the scripted episode with what was seen, done and earned in
every step.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from mjstack.drivers.driver import Driver
from mjstack.envs import Env, demonstration_config
from mjstack.episodes.context import RunContext
from mjstack.episodes.observers import play_episode
from mjstack.episodes.rollout import Observer, reset_worlds
from mjstack.scene.phases import build_phases
from mjstack.sim import Simulation

STATE = "observation.state"
ACTION = "action"
REWARD = "next.reward"
_CHUNK_BYTES = 128 * 2**20  # copied to the host at once


def column_widths(env: Env) -> dict[str, int]:
    """How many numbers a step has of each kind, in the order in which `StepRecorder` keeps them."""
    n = len(env.index.ctrl)
    groups = {
        f"observation.{name}": dim for name, dim in env.observation_manager.group_dims.items()
    }
    return {STATE: n, **groups, ACTION: n, REWARD: 1}


class StepRecorder(Observer):
    """All steps of all worlds in one block on the device. Fixed shapes, no host read: a captured
    graph may hold it.

    A step is what the policy would have seen before its action, the joint commands that went to the
    actuators, and the reward for where they led.

    Attributes:
        values: The steps, shape ``(steps, nworld, dim)``, float32.
        layout: How many numbers of each kind there are, in order.
    """

    values: torch.Tensor
    layout: dict[str, int]

    def __init__(self, steps: int) -> None:
        """``steps`` is the length of an episode."""
        self._steps = steps

    def start(self, env: Env, driver: Driver) -> None:
        """See `Observer`."""
        self.layout = column_widths(env)
        shape = (self._steps, env.nworld, sum(self.layout.values()))
        self.values = torch.zeros(shape, device=env.device)
        self._env = env
        self._robot = env.index.on(env.device, env.sim.qpos.dtype)
        seen = self.layout[STATE] + sum(env.observation_manager.group_dims.values())
        self._seen = torch.zeros((env.nworld, seen), device=env.device)
        self._next = torch.zeros(1, dtype=torch.int64, device=env.device)
        self._observe()

    def update(self) -> None:
        """See `Observer`."""
        env = self._env
        command = self._robot.ctrl.read(env.sim.ctrl).float()
        step = torch.cat((self._seen, command, env.reward_manager.reward[:, None]), dim=1)
        self.values.index_copy_(0, self._next, step[None])
        self._next.add_(1)
        self._observe()

    def _observe(self) -> None:
        """Keep the state that the next action is for."""
        groups = self._env.observation_manager.groups.values()
        torch.cat(
            [self._robot.qpos.read(self._env.sim.qpos).float(), *groups], dim=1, out=self._seen
        )


@dataclass(eq=False, kw_only=True, slots=True)
class Played:
    """A batch of episodes.

    Attributes:
        seed: What it was played with.
        steps: All steps, on the device.
        failed: Bits of the task's rules, shape ``(worlds,)``, int32.
        retries: Grasps that were tried again, shape ``(worlds,)``.
        seconds: Wall time, from the reset to the result [s].
    """

    seed: int
    steps: StepRecorder
    failed: np.ndarray
    retries: np.ndarray
    seconds: float

    def finite(self, world: int) -> bool:
        """Whether every number of a world's steps is finite."""
        return bool(self.steps.values[:, world].isfinite().all())

    def episodes(self, worlds: Sequence[int]) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        """Some worlds' steps on the host, by kind, each ``(steps, dim)``; copied in chunks."""
        values = self.steps.values
        size = max(1, _CHUNK_BYTES // (values[:, 0].numel() * values.element_size()))
        ends = np.cumsum(list(self.steps.layout.values()))[:-1]
        for first in range(0, len(worlds), size):
            chunk = torch.tensor(worlds[first : first + size], device=values.device)
            rows = values.index_select(1, chunk).transpose(0, 1).contiguous().cpu().numpy()
            for world, row in zip(worlds[first:], rows, strict=False):
                yield world, dict(zip(self.steps.layout, np.split(row, ends, axis=1), strict=True))


def play_demonstrations(context: RunContext, sim: Simulation, seed: int) -> Played:
    """Play the configured driver once from the starts of a seed, and judge it by the task's check.

    Nothing ends an episode: worlds go on to its end, so all have as many steps.

    Args:
        context: Configuration, scene and planner.
        sim: The worlds.
        seed: Seed of the starts.
    """
    began = time.perf_counter()
    cfg = demonstration_config(replace(context.cfg, seed=seed))
    env = Env(sim, context.index, cfg, check_faults=False)  # the check names lost worlds
    reset_worlds(env, seed)
    recorder = StepRecorder(build_phases(cfg)[-1].stop)
    episode = play_episode(
        env,
        context.driver(env),
        [recorder],
        advance=context.advance,
        label=f"steps of seed {seed}",
    )
    return Played(
        seed=seed,
        steps=recorder,
        failed=episode.result.failed.cpu().numpy(),
        retries=episode.retries,
        seconds=time.perf_counter() - began,
    )
