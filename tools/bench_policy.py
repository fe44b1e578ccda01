"""Time what a policy's inference adds to ``env.step``.

    python tools/bench_policy.py controller=policy policy=FOLDER nworld=2048

A repetition plays the same steps from the same starts twice, in turns: the policy drives, or the
actions that it gave are played again. On CUDA a step is one captured graph. The environment is
that of a judged episode, without observations and rewards, then the task's with all its managers.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import torch
from common import count, make_parser, run, spread

from mjstack.bench.timing import timed
from mjstack.config.schema import Config
from mjstack.drivers.driver import Driver
from mjstack.envs import Env
from mjstack.envs.buffers import Advance
from mjstack.episodes.rollout import reset_worlds
from mjstack.episodes.stage import Progress, Stage
from mjstack.report.table import Table
from mjstack.sim.graph import StepGraph


class Recorded(Driver):
    """Plays recorded actions, shape ``(steps, nworld, action_dim)``, from number `next` on."""

    def __init__(self, actions: torch.Tensor) -> None:
        super().__init__(actions.shape[1], len(actions), actions.device)
        self._actions = actions
        self.next = torch.zeros(1, dtype=torch.int64, device=actions.device)

    def command(self) -> torch.Tensor:
        """The next step's actions."""
        out = self._actions.index_select(0, self.next)[0]
        self.next.add_(1).remainder_(self.steps)
        return out


def measure(args: argparse.Namespace, cfg: Config, advance: Advance) -> Iterator[Table]:
    """Time both drivers in both environments."""
    stage = Stage(cfg, progress=Progress(advance=advance))
    sim = stage.batch_simulation(cfg.nworld)
    everything = replace(cfg, action=stage.action)
    rows = []
    for name, made in (("episode", stage.driven(cfg.reset)), ("env.step", everything)):
        env = Env(sim, stage.index, made, check_faults=False)
        policy, played = _times(stage, env, args, advance)
        over = [100.0 * (p / a - 1.0) for p, a in zip(policy, played, strict=True)]
        rows.append([name, spread(policy), spread(played), spread(over)])
    sim.close()
    yield Table(
        title=f"{cfg.nworld:,} worlds, {sim.description}",
        header=["step of", "with the policy, ms", "with its actions, ms", "policy adds, %"],
        rows=rows,
    )


def _times(
    stage: Stage, env: Env, args: argparse.Namespace, advance: Advance
) -> tuple[list[float], list[float]]:
    """Milliseconds per step with the policy and with its actions, one number per repetition."""
    reset_worlds(env, env.cfg.seed)
    policy = stage.driver(env)
    shape = (args.steps, env.nworld, env.action_manager.action_dim)
    actions = torch.zeros(shape, device=env.device)
    for step in range(args.steps):
        actions[step] = policy.command()
        env.step(actions[step])
    recorded = Recorded(actions)
    drivers = (policy, recorded)
    graphs = [env.captured(partial(_step, env, driver), "a step") for driver in drivers]
    times: list[list[float]] = [[], []]
    for repetition in range(args.repetitions + 1):
        for which in (0, 1) if repetition % 2 else (1, 0):
            env.reset(seed=env.cfg.seed)
            recorded.next.zero_()
            for _ in range(3):  # eager, captured, replayed
                graphs[which]()
            work = partial(_repeat, graphs[which], args.steps - 3)
            seconds = timed(env.sim, work)
            if repetition:  # the first one warms up
                times[which].append(1e3 * seconds / (args.steps - 3))
        advance("repetitions", repetition, args.repetitions)
    for graph in graphs:
        graph.drop()
    return times[0], times[1]


def _repeat(graph: StepGraph, steps: int) -> None:
    for _ in range(steps):
        graph()


def _step(env: Env, driver: Driver) -> None:
    env.action_manager.process(driver.command())
    env.advance()


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("--steps", type=count, default=600, help="in a repetition")
    parser.add_argument("--repetitions", type=count, default=10)
    run(parser, measure)
