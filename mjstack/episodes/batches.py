"""Batches of episodes: the only loop over seeds. Gates, datasets and trainings choose what is
recorded, and what they keep of each batch.
"""

from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mjstack.config.schema import Backend, Config
from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.episodes.recorder import Channels, Recorder
from mjstack.episodes.rollout import Episode, Observer, play_episode, reset_worlds
from mjstack.episodes.stage import Stage
from mjstack.sim import Simulation


@dataclass(frozen=True)
class BatchPlan:
    """A batch to be played.

    Attributes:
        seed: Seed of its starts.
        worlds: Numbers of its worlds, on which their starts depend.
    """

    seed: int
    worlds: Sequence[int]


@dataclass(frozen=True, eq=False)
class Batch:
    """A batch that was played and judged. Its environment's worlds stand where the episode ended.

    Attributes:
        plan: Its plan.
        env: The environment.
        episode: The judged episode of every world.
        rows: The recorded channels by name, each ``(rows, nworld, ...)``, on the device; empty as
            soon as the next batch begins, which needs the memory.
    """

    plan: BatchPlan
    env: Env
    episode: Episode
    rows: dict[str, Tensor]

    @property
    def succeeded(self) -> Tensor:
        """Whether each world broke no rule, shape ``(nworld,)``, bool."""
        return self.episode.result.failed == 0

    def finite(self) -> Tensor:
        """Whether all that was recorded of each world is finite, shape ``(nworld,)``, bool."""
        finite_rows = [
            rows.isfinite().reshape(*rows.shape[:2], -1).all(2).all(0)
            for rows in self.rows.values()
            if rows.is_floating_point()
        ]
        return torch.stack(finite_rows).all(0)

    def select(self, name: str, worlds: Tensor) -> Tensor:
        """A channel's rows in some worlds, shape ``(worlds, rows, ...)``; ``worlds`` are numbers or
        a mask of rows of the batch.
        """
        return self.rows[name][:, worlds].transpose(0, 1)


def play_batches(
    stage: Stage,
    plans: Iterable[BatchPlan],
    channels: Sequence[Channels] = (),
    *,
    cfg: Config | None = None,
    alone: tuple[Backend, str] | None = None,
    driver: Callable[[BatchPlan, Env], Driver] | None = None,
    observers: Callable[[BatchPlan], Sequence[Observer]] = lambda plan: (),
    label: str = "steps",
) -> Generator[Batch, None, None]:
    """Play and judge batch after batch. A plan is taken when the batch before it has been used, so
    it may depend on that. Close the iterator to give the worlds back early.

    Args:
        stage: The stage.
        plans: The batches.
        channels: What is recorded.
        cfg: Configuration of the environment, if not that of a driven episode.
        alone: Backend and device on which single worlds play without the rest of their batch.
        driver: Makes the driver of worlds that have started, if not the configured one.
        observers: More observers of a batch.
        label: Name of the steps in the progress, before the seed.
    """
    cfg = cfg or stage.driven(stage.cfg.reset)
    sim: Simulation | None = None
    try:
        for plan in plans:
            if sim is None or sim.nworld != len(plan.worlds):
                if sim is not None:
                    sim.close()
                sim = (
                    stage.simulate_alone(*alone)
                    if alone is not None
                    else stage.batch_simulation(len(plan.worlds))
                )
            env = Env(sim, stage.index, cfg, check_faults=False)  # the check names lost worlds
            reset_worlds(env, plan.seed, plan.worlds)
            recorder = Recorder(*channels)
            episode = play_episode(
                env,
                driver(plan, env) if driver else stage.driver(env),
                [recorder, *observers(plan), *stage.observers],
                advance=stage.progress.advance,
                label=f"{label}, seed {plan.seed}",
            )
            yield Batch(plan, env, episode, recorder.rows)
            recorder.rows.clear()
    finally:
        if sim is not None:
            sim.close()
