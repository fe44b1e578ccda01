"""The three things that the throughput gate measures: physics steps, the validated episode, and
``env.step``.
"""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

import numpy as np
import torch

from mjstack.bench.env_step import measure_env_step
from mjstack.bench.power import EnergyMeter, EnergyObserver
from mjstack.bench.timing import (
    WARM_UP,
    Timing,
    capture_problem,
    spread,
    steps_that_fit,
    timed,
)
from mjstack.config.schema import Backend, GraphMode
from mjstack.drivers.driver import Recorded
from mjstack.envs import Env
from mjstack.episodes.context import GateContext, TimedEpisode, play_to
from mjstack.episodes.observers import CommandRecorder
from mjstack.episodes.rollout import CLOSED_LOOP, Observer, State, restore, rollout, step_graph
from mjstack.errors import name_worlds
from mjstack.math import not_finite
from mjstack.mdp.geometry import objects_in_hand
from mjstack.scene.phases import carried_objects
from mjstack.sim import LOST_PHYSICS, BatchSizes, Simulation, device_memory

if TYPE_CHECKING:
    from mjstack.sim.mjwarp import MjwarpSimulation


@dataclass(kw_only=True, slots=True)
class Section:
    """A part of the measurement.

    Attributes:
        name: physics, episode or env_step.
        figures: Speeds: void where there is a problem.
        facts: What else is worth knowing, with or without figures.
        notes: Facts in words.
        problem: Why the figures do not count; empty where they do.
        headline: The section in a few words.
        missing: Why there are no figures, which is no failure; empty where there are.
        rejected: Whether worlds failed the task, so that no figure of these worlds counts.
        step_seconds: How long a step took [s], for what comes next.
    """

    name: str
    figures: dict[str, float] = field(default_factory=dict)
    facts: dict[str, float] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    problem: str = ""
    headline: str = ""
    missing: str = ""
    rejected: bool = False
    step_seconds: float | None = None

    def metrics(self) -> dict[str, float]:
        """Everything that may be shown, under the section's name."""
        shown = self.facts if self.problem else self.figures | self.facts
        return {f"{self.name}.{key}": value for key, value in shown.items()}

    def named_notes(self) -> dict[str, str]:
        """The notes, under the section's name."""
        missing = {"status": f"not measured: {self.missing}"} if self.missing else {}
        return {f"{self.name}.{key}": text for key, text in (self.notes | missing).items()}


@dataclass(slots=True)
class TimeBudget:
    """How long a section may take, and how many repetitions it is to make.

    Attributes:
        seconds: Time for the whole section [s].
        repetitions: Wanted repetitions.
    """

    seconds: float
    repetitions: int


def measure_physics(
    context: GateContext, sim: Simulation, watch: TimeBudget, meter: EnergyMeter
) -> Section:
    """Physics steps under a held command: every repetition starts from the same states, the cube in
    hand.

    A grasp may be empty there, about to be tried again; the figure says in how many worlds, and is
    none if in more than half. Whatever else is in a step of the simulation (counting contacts,
    latching overflow) is in the figure.
    """
    t = context.cfg.gate.throughput
    decimation = context.cfg.timing.decimation

    def play(steps: int) -> None:
        for _ in range(steps):
            sim.step(decimation)

    state = _carry_start(context, sim)
    restore(sim, state)
    section = Section(name="physics")
    bad = _lost(sim)
    held = _in_hand(context, sim)
    if held is not None:
        section.facts["worlds_with_cube_in_hand"] = held
        if 2 * held < sim.nworld:
            where = f"as {t.from_phase} begins (gate.throughput.from_phase)"
            section.problem = f"only {held} of {sim.nworld} worlds have the cube in hand {where}"
            return section
    graph = step_graph(sim, decimation)
    first = [timed(sim, lambda: play(1)) for _ in range(2 if graph is None else WARM_UP)]
    steps = steps_that_fit(t.steps, watch.seconds, watch.repetitions * first[-1])
    timing = Timing(nworld=sim.nworld, steps=steps, decimation=decimation)
    meter.clear()
    for repetition in range(watch.repetitions):
        restore(sim, state)
        timing.seconds.append(timed(sim, lambda: play(steps), meter))
        bad |= _lost(sim) | (sim.step_count != steps * decimation)
        context.tell("physics, repetitions", repetition + 1, watch.repetitions)
    captured = graph is not None and graph.captured
    section.step_seconds = timing.median / steps
    section.figures = timing.step_metrics() | meter.metrics()
    section.notes |= meter.notes()
    section.facts |= {
        "steps_per_repetition": steps,
        "repetitions": watch.repetitions,
        "warm_up_s": 0.0 if graph is None else graph.warm_up_seconds,
        "capture_s": 0.0 if graph is None else graph.capture_seconds,
        "captured": captured,
        "peak_contacts_per_world": int(sim.peak_contacts.max()),
        "peak_constraint_rows_per_world": int(sim.peak_constraints.max()),
    }
    section.facts |= _memory(sim)
    section.problem = capture_problem(sim, context.cfg.graph, captured)
    if bad.any():
        section.problem = f"{int(bad.sum())} worlds overflowed, diverged or were not stepped"
    step_ms = 1e3 * timing.median / (steps * decimation)
    section.headline = (
        f"{timing.world_steps_per_s:,.0f} world-steps/s, {step_ms:.3g} ms per step of {sim.nworld}"
        " worlds"
    )
    if held is not None and held < sim.nworld:
        section.headline += f" ({sim.nworld - held} of them with an empty grasp)"
    return section


def measure_episode(
    context: GateContext,
    sim: Simulation,
    watch: TimeBudget,
    meter: EnergyMeter,
    step_seconds: float | None,
) -> Section:
    """The whole scripted episode with its acceptance; on MJWarp alternating with bare steps of the
    same commands.

    Native MuJoCo takes the batch gate's episode as its first repetition. There an episode of
    thousands of worlds lasts minutes, so it is played only as often as the time allows, and not at
    all where even one would not fit.

    Args:
        context: Scene and planner.
        sim: The worlds.
        watch: Time and repetitions.
        meter: Measures the energy.
        step_seconds: About how long a step takes [s], if it is known.
    """
    cfg = context.cfg
    section = Section(name="episode")
    mjwarp = sim.backend == "mjwarp"
    before = context.timed_episode
    if before is not None and (before.description, before.nworld) != (sim.description, sim.nworld):
        before = None
    steps = context.planner.phases[-1].stop
    timing = Timing(nworld=sim.nworld, steps=steps, decimation=cfg.timing.decimation)
    played: list[TimedEpisode] = [before] if before is not None and not mjwarp else []
    bare: list[float] = []
    ratios: list[float] = []
    controlled: list[float] = []  # what the controller adds to steps that only repeat its commands
    estimate = 0.0 if step_seconds is None else step_seconds * steps
    if before is not None:
        estimate = max(estimate, before.seconds)
    if mjwarp:
        estimate *= 2
    began = time.perf_counter()
    meter.clear()
    while (
        len(played) < watch.repetitions and time.perf_counter() - began + estimate <= watch.seconds
    ):
        turn_began = time.perf_counter()
        # A plan can be evaluated again; what a controller that watches did has to be kept.
        keep = mjwarp and cfg.controller.name == CLOSED_LOOP
        commands = CommandRecorder()
        recorders: list[Observer] = [commands] if keep else []
        episode = context.play(sim, cfg.reset, [*recorders, EnergyObserver(meter)])
        took = episode.timing.seconds
        played.append(TimedEpisode.of(episode, sim))
        if mjwarp:
            tape = commands.recorded if keep else None
            seconds, problem = _play_bare(context, cast("MjwarpSimulation", sim), tape)
            section.problem = section.problem or problem
            bare.append(seconds)
            ratios.append(took / seconds)
        if keep:
            # Both record, so that they differ by the controller alone.
            again = context.play(sim, cfg.reset, [CommandRecorder()], repeat=commands.recorded)
            lost = int((again.result.failed != 0).sum())
            if lost:
                section.problem = (
                    section.problem or f"{lost} worlds failed when their commands were repeated"
                )
            controlled.append(took / again.timing.seconds - 1.0)
        del commands, recorders  # before the next turn records as many
        estimate = time.perf_counter() - turn_began
        context.tell("episode, repetitions", len(played), watch.repetitions)
    if not played and before is not None:
        played = [before]
    if not played:
        section.missing = (
            f"an episode would take about {estimate:.0f} s, and a section has {watch.seconds:g} s "
            f"(gate.throughput.{'max_seconds' if sim.device.type == 'cuda' else 'cpu_max_seconds'})"
        )
        return section
    timing.seconds = [p.seconds for p in played]
    captured = all(p.captured for p in played)
    failed = sorted({w for p in played for w in p.failed})
    section.facts = {
        "repetitions": len(played),
        "of_the_batch_gate": sum(p is before for p in played),
        "steps": steps,
        "succeeded": sim.nworld - len(failed),
        # The most of all: where physics alone is captured, on Warp's CPU device, one episode does
        # it for all.
        "warm_up_s": max(p.warm_up_seconds for p in played),
        "capture_s": max(p.capture_seconds for p in played),
        "captured": captured,
    }
    section.facts |= _physics_captured(sim, cfg.timing.decimation)
    section.problem = section.problem or capture_problem(sim, cfg.graph, captured)
    section.figures = (
        spread("seconds", timing.seconds) | timing.step_metrics() | timing.env_step_metrics()
    )
    section.headline = f"{timing.median:.3g} s"
    if ratios:
        section.figures |= spread("bare_seconds", bare) | spread("bare_ratio", ratios)
        section.headline += f" ({statistics.median(ratios):.3f} x bare steps)"
        if controlled:
            section.figures |= spread("controller_over_step", controlled)
            section.headline += f", controller {100.0 * statistics.median(controlled):+.1f} %"
    elif mjwarp:
        section.notes["bare_ratio"] = "not measured: no time for an episode and as many bare steps"
    if len(played) > sum(p is before for p in played):
        section.figures |= meter.metrics()
        section.notes |= meter.notes()
        section.facts |= _memory(sim)
    if failed:
        section.rejected = True
        section.problem = f"{name_worlds(failed, sim.nworld)} failed the check"
    return section


def measure_env_steps(
    context: GateContext, env: Env, watch: TimeBudget, meter: EnergyMeter
) -> Section:
    """``env.step`` with the configured managers, random actions, and resets as they come."""
    t = context.cfg.gate.throughput
    section = Section(name="env_step")
    times = measure_env_step(
        env,
        steps=t.env_steps,
        turns=watch.repetitions,
        max_seconds=watch.seconds,
        meter=meter,
        progress=lambda turn: context.tell("env.step, turns", turn, watch.repetitions),
    )
    sim = env.sim
    timing = Timing(nworld=env.nworld, steps=times.steps, decimation=times.decimation)
    timing.seconds = [1e-3 * times.steps * ms for ms in times.env_ms]
    section.figures = timing.env_step_metrics() | timing.step_metrics()
    section.figures |= spread("physics_ms_per_step", times.physics_ms) | spread(
        "managers_ms_per_step", times.managers_ms
    )
    section.figures |= spread("managers_over_physics", times.overheads)
    section.figures |= spread("managers_alone_over_physics", times.managers_alone)
    section.figures |= spread("residual_ms_per_step", times.residual_ms)
    section.facts = {
        "steps_per_turn": times.steps,
        "turns": watch.repetitions,
        "episodes_ended": int(times.episodes),
        "warm_up_s": times.warm_up_s,
        "capture_s": times.capture_s,
        "captured": times.captured,
    }
    section.facts |= _physics_captured(sim, times.decimation)
    sizes: BatchSizes | None = getattr(sim, "sizes", None)
    if sizes is not None:
        section.facts |= {"naconmax": sizes.contact_pool(sim.nworld), "njmax": sizes.njmax}
    section.figures |= meter.metrics()
    section.notes |= meter.notes()
    section.facts |= _memory(sim)
    section.problem = times.problem
    rate = env.nworld * times.steps / timing.median
    alone = statistics.median(times.managers_alone)
    section.headline = (
        f"{rate:,.0f} env-steps/s, managers {100.0 * times.overhead:+.1f} % (alone"
        f" {100.0 * alone:.1f} %)"
    )
    return section


def _carry_start(context: GateContext, sim: Simulation) -> State:
    """States at the start of the measured phase: the batch gate's, or those of some native worlds
    over and over.
    """
    state = context.carry_start
    if state is not None and state.qpos.shape[0] == sim.nworld:
        return state
    t = context.cfg.gate.throughput
    count = min(sim.nworld, t.start_worlds)
    some = context.simulation(count, Backend.native, "cpu")
    state = play_to(context, some, t.from_phase)
    some.close()
    return _rows(state, np.arange(sim.nworld) % count)


def _in_hand(context: GateContext, sim: Simulation) -> int | None:
    """Number of worlds in which both jaws press on the object of the measured phase; None if it
    carries none.
    """
    phases = context.cfg.controller.phases
    number = carried_objects(context.cfg)[
        list(phases).index(context.cfg.gate.throughput.from_phase)
    ]
    return None if number < 0 else int(objects_in_hand(context.index, sim)[:, number].sum())


def _rows(state: State, rows: np.ndarray) -> State:
    return State(state.qpos[rows], state.qvel[rows], state.ctrl[rows])


def _play_bare(
    context: GateContext, sim: MjwarpSimulation, recorded: Recorded | None = None
) -> tuple[float, str]:
    """The same commands from the same start on bare steps: seconds, and why they would not count.

    A plan is evaluated in the loop, as it is in the episode. Overflow bits stay until a reset: one
    look at the end has all.
    """
    cfg = context.cfg
    decimation = context.cfg.timing.decimation
    step = sim.bare_step()
    for _ in range(WARM_UP):  # none of it is timed
        step()
    if sim.device.type == "cuda" and cfg.graph is not GraphMode.off and not step.captured:
        return math.nan, "the bare steps could not be captured"
    env = context.start(sim, cfg.reset)
    driver = context.driver(env) if recorded is None else recorded.rewind()

    def physics() -> None:
        for _ in range(decimation):
            step()

    seconds = rollout(env, driver, physics=physics).seconds
    sim.latch()
    bad = int(_lost(sim).sum())
    if bad:
        return seconds, f"{bad} worlds overflowed or diverged with bare steps"
    judge = context.check(cfg, context.index, context.planner.phases, sim.nworld, sim.device)
    fallen = int((~judge.placed(sim).all(1)).sum())
    return seconds, f"{fallen} worlds did not do the task with bare steps" if fallen else ""


def _lost(sim: Simulation) -> torch.Tensor:
    """Worlds that overflowed or diverged, shape ``(nworld,)``, bool."""
    return not_finite(sim.qpos, sim.qvel) | ((sim.overflow & LOST_PHYSICS) != 0)


def _physics_captured(sim: Simulation, decimation: int) -> dict[str, float]:
    """On Warp's CPU device, where whole steps never are captured: whether their physics was."""
    graph = None if sim.device.type == "cuda" else step_graph(sim, decimation, kinematics=True)
    return {} if graph is None else {"physics_captured": graph.captured}


def _memory(sim: Simulation) -> dict[str, float]:
    """What the worlds take on the GPU."""
    used = device_memory(str(sim.device))
    if used is None:
        return {}
    return {"gpu_memory_arrays_mib": used[0] / 2**20, "gpu_memory_whole_gpu_mib": used[1] / 2**20}
