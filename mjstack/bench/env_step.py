"""What a whole ``env.step`` costs, and its physics and its managers alone: in turns, on one
trajectory.

A turn plays random actions from one state three times: the whole step, then from the same state the
physics under the same commands, then the managers without any physics. The next turn goes on where
the whole step ended. So each ratio is of one turn and one machine's mood. Worlds start at ages
spread over an episode, so that in every step some of them time out and are reset.

The three do not do quite the same work. Physics alone has no resets: a world that ended goes on
from where it was, under the next episode's commands, and may touch more, and so cost more, than the
reset one in the whole step. Then env.step's time over that of physics flatters the managers. The
managers alone work on worlds that stand still, which end for other reasons, and they launch what in
the whole step may run beside something else. Hence both ratios, and what is left when both parts
are taken from the whole: where it is far from 0, the turns differed by more than the managers.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

import torch

from mjstack.bench.power import EnergyMeter
from mjstack.bench.timing import WARM_UP, capture_problem, steps_that_fit, timed
from mjstack.envs import Env
from mjstack.episodes.rollout import restore, snapshot, step_graph
from mjstack.sim import LOST_PHYSICS

_COST = 4.0  # of a turn over that of its whole steps from the start, when fewer things touch
_LOSSES = ("mjstack.mdp.termination.overflow", "mjstack.mdp.termination.non_finite")


class Baseline(Protocol):
    """Something else that plays a turn's physics, to be timed beside it."""

    def begin(self) -> None:
        """Takes the simulation's state as the start."""

    def record(self) -> None:
        """Takes the commands and the state before a step."""

    def play(self) -> None:
        """Plays the steps; this is what is timed."""

    def check(self) -> None:
        """Raises unless it ended where the simulation did."""


@dataclass(kw_only=True, slots=True)
class EnvStepTimes:
    """Times of one backend.

    Attributes:
        backend: Backend and hardware.
        nworld: Number of worlds.
        steps: Steps per turn.
        decimation: Physics steps per step.
        physics_ms: Per step and turn [ms], the physics steps and the poses after them.
        managers_ms: Likewise, everything else of a step, on worlds that stand still.
        env_ms: Likewise, ``env.step``.
        baseline_ms: Likewise, the baseline; empty without one.
        episodes: Episodes that ended, and were reset, within the measured turns.
        warm_up_s: The first step, which runs eagerly [s]; on Warp's CPU device its physics, 0 on
            native MuJoCo.
        capture_s: Capturing it [s], likewise.
        captured: Whether the step and both parts were replayed.
        problem: Why the times are void; empty where they count.
    """

    backend: str
    nworld: int
    steps: int
    decimation: int
    physics_ms: list[float] = field(default_factory=list)
    managers_ms: list[float] = field(default_factory=list)
    env_ms: list[float] = field(default_factory=list)
    baseline_ms: list[float] = field(default_factory=list)
    episodes: float = 0.0
    warm_up_s: float = 0.0
    capture_s: float = 0.0
    captured: bool = False
    problem: str = ""

    @property
    def overheads(self) -> list[float]:
        """env.step's time over physics', less 1, of every turn."""
        return [e / p - 1.0 for e, p in zip(self.env_ms, self.physics_ms, strict=True)]

    @property
    def overhead(self) -> float:
        """Their median. On a busy machine it need not be the ratio of the medians."""
        return statistics.median(self.overheads)

    @property
    def managers_alone(self) -> list[float]:
        """The managers' own time over physics', of every turn."""
        return [m / p for m, p in zip(self.managers_ms, self.physics_ms, strict=True)]

    @property
    def residual_ms(self) -> list[float]:
        """What of env.step neither part explains [ms per step], of every turn; negative where they
        run side by side.
        """
        return [
            e - p - m
            for e, p, m in zip(self.env_ms, self.physics_ms, self.managers_ms, strict=True)
        ]

    @property
    def baseline_ratio(self) -> float | None:
        """Median of the baseline's time over physics': 1 is as fast. None where there was no
        baseline.
        """
        if not self.baseline_ms:
            return None
        return statistics.median(
            r / p for r, p in zip(self.baseline_ms, self.physics_ms, strict=True)
        )

    def world_steps_per_s(self, milliseconds: list[float]) -> float:
        """Physics steps of all worlds per second, median."""
        return 1e3 * self.nworld * self.decimation / statistics.median(milliseconds)


def measure_env_step(
    env: Env,
    *,
    steps: int,
    turns: int,
    max_seconds: float | None = None,
    baseline: Baseline | None = None,
    meter: EnergyMeter | None = None,
    progress: Callable[[int], None] | None = None,
) -> EnvStepTimes:
    """Plays random actions, uniform over their whole range, in turns.

    Args:
        env: The environment.
        steps: Steps per turn.
        turns: Measured turns; one before them warms up.
        max_seconds: Shortens the turns so that all of them take about this long [s].
        baseline: Timed beside the physics.
        meter: Takes in the energy of the whole steps.
        progress: Told the turns done.

    Raises:
        FaultError: Physics was lost.
    """
    sim = env.sim
    manager = env.action_manager
    decimation = env.cfg.timing.decimation
    generator = torch.Generator().manual_seed(0)
    low = manager.low.float().cpu()
    high = manager.high.float().cpu()

    def random_actions(count: int) -> list[torch.Tensor]:
        span = (high - low) * torch.rand(
            (count, env.nworld, manager.action_dim), generator=generator
        )
        return list((low + span).to(env.device).unbind())

    env.reset(seed=env.cfg.seed)
    env.episode_step.copy_(torch.randint(env.max_episode_steps, (env.nworld,), generator=generator))
    seconds = [timed(sim, partial(env.step, action)) for action in random_actions(WARM_UP)]
    parts = env.parts()
    on_cuda = env.device.type == "cuda"
    if on_cuda:  # a turn may be too short to warm them up
        for part in (parts.physics, parts.managers):
            for _ in range(WARM_UP):
                part()
    if max_seconds is not None:
        steps = steps_that_fit(steps, max_seconds, _COST * (turns + 1) * seconds[-1])
    result = EnvStepTimes(
        backend=sim.description, nworld=env.nworld, steps=steps, decimation=decimation
    )
    graph = env.graph if on_cuda else step_graph(sim, decimation, kinematics=True)
    if graph is not None:
        result.warm_up_s = graph.warm_up_seconds
        result.capture_s = graph.capture_seconds
    commands = [torch.empty_like(sim.ctrl) for _ in range(steps)]
    bad = torch.zeros(sim.nworld, dtype=torch.bool, device=sim.device)

    def whole() -> None:
        for action, command in zip(actions, commands, strict=True):
            env.step(action)
            command.copy_(
                sim.ctrl
            )  # one small copy; where a world was reset it is the new episode's

    def physics() -> None:
        for command in commands:
            sim.ctrl.copy_(command)
            parts.physics()

    def managers() -> None:
        for action in actions:
            manager.process(action)
            parts.managers()

    def set_ages(step: torch.Tensor, episode: torch.Tensor) -> None:
        env.episode_step.copy_(step)
        env.episode.copy_(episode)

    def per_step(work: Callable[[], None], meter: EnergyMeter | None = None) -> float:
        return 1e3 * timed(sim, work, meter) / steps

    if meter is not None:
        meter.clear()
    start = snapshot(sim)
    for turn in range(turns + 1):
        actions = random_actions(steps)
        ages = env.episode_step.clone(), env.episode.clone()
        restore(sim, start)
        env.read_statistics()
        env_ms = per_step(whole, meter if turn else None)
        counted = env.read_statistics()
        losses = [name for name, cfg in env.cfg.termination.items() if cfg.func in _LOSSES]
        lost = [name for name in losses if counted.get(f"termination/{name}", 0.0) > 0.0]
        if lost:
            result.problem = (
                f"worlds ended by {', '.join(lost)}: raise batch.nconmax or batch.njmax, or act"
                " more gently"
            )
        end = snapshot(sim)
        later_ages = (env.episode_step.clone(), env.episode.clone())
        restore(sim, start)
        baseline_ms = (
            [] if baseline is None else [_play_baseline(env, baseline, commands, per_step)]
        )
        restore(sim, start)
        physics_ms = per_step(physics)
        bad |= (sim.overflow & LOST_PHYSICS) != 0
        bad |= ~(torch.isfinite(sim.qpos).all(1) & torch.isfinite(sim.qvel).all(1))
        bad |= sim.step_count != steps * decimation
        restore(sim, start)
        set_ages(*ages)
        managers_ms = per_step(managers)
        env.raise_faults()
        set_ages(*later_ages)
        start = end
        if turn:  # the first one warms up
            result.env_ms.append(env_ms)
            result.physics_ms.append(physics_ms)
            result.managers_ms.append(managers_ms)
            result.baseline_ms.extend(baseline_ms)
            result.episodes += counted["episodes"]
            if progress is not None:
                progress(turn)
    result.captured = env.graph.captured and parts.physics.captured and parts.managers.captured
    result.problem = result.problem or capture_problem(sim, env.cfg.graph, result.captured)
    if bool(bad.any()):
        result.problem = (
            f"{int(bad.sum())} of {env.nworld} worlds overflowed, diverged or were not stepped"
        )
    return result


def _play_baseline(
    env: Env,
    baseline: Baseline,
    commands: list[torch.Tensor],
    per_step: Callable[[Callable[[], None]], float],
) -> float:
    """The baseline's time [ms per step], on the commands of this turn."""
    baseline.begin()
    for command in commands:
        env.sim.ctrl.copy_(command)
        baseline.record()
        env.sim.step(env.cfg.timing.decimation)
    milliseconds = per_step(baseline.play)
    baseline.check()
    return milliseconds
