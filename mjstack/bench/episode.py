"""Physics steps with the object in hand, and the whole judged episode."""

import statistics
import time
from functools import partial

import numpy as np

from mjstack.bench import timing
from mjstack.bench.timing import EnergyMeter, Measurement
from mjstack.config.schema import Backend
from mjstack.episodes.rollout import Episode, State, restore, rollout, snapshot
from mjstack.episodes.stage import Stage
from mjstack.errors import name_worlds
from mjstack.mdp.geometry import objects_in_hand
from mjstack.report.figure import figures
from mjstack.sim import Simulation


def measure_physics(stage: Stage, sim: Simulation, carry: State | None = None) -> Measurement:
    """Measure physics steps under a held joint target, the object in hand.

    A grasp may be empty at the start, about to be retried. The number of full ones is reported, and
    there is no figure if they are less than half. The figure includes the rest of a simulation's
    step: counting contacts, latching overflow. Fewer steps are made where the time budget [s] is
    short.
    """
    t = stage.cfg.gate.throughput
    out = Measurement(name="physics")
    decimation = stage.cfg.timing.decimation
    state = carry_start(stage, sim, carry)
    restore(sim, state)
    lost = timing.lost_worlds(sim)
    carried = stage.phase(t.from_phase).carried
    full = sim.nworld
    if carried >= 0:  # both jaws press on the phase's object
        full = int(objects_in_hand(stage.index, sim)[:, carried].sum())
        out.facts += figures(worlds_with_object_in_hand=full)
        if 2 * full < sim.nworld:
            where = f"as {t.from_phase} begins (gate.throughput.from_phase)"
            out.problem = f"only {full} of {sim.nworld} worlds have the object in hand {where}"
            return out

    # The repetitions
    def play(count: int) -> None:
        for _ in range(count):
            sim.step(decimation)

    seconds = [timing.timed(sim, partial(play, 1)) for _ in range(timing.WARM_UP)][-1]
    budget = timing.time_budget(stage.cfg, sim)
    steps = timing.steps_that_fit(t.steps, budget, t.repetitions * seconds)
    meter = EnergyMeter(str(sim.device))
    times: list[float] = []
    for repetition in range(t.repetitions):
        restore(sim, state)
        times.append(timing.timed(sim, partial(play, steps), meter))
        lost |= timing.lost_worlds(sim, steps * decimation)
        stage.progress.advance("physics, repetitions", repetition + 1, t.repetitions)
        if timing.settled(stage.cfg, times):
            break

    # The result
    graph = sim.graph_of(decimation)
    captured = graph is not None and graph.captured
    out.add_repetitions(sim, stage.cfg, times, steps, meter, graph, captured=captured, whole=False)
    out.facts += figures(
        peak_contacts_per_world=int(sim.peak_contacts.max()),
        peak_constraint_rows_per_world=int(sim.peak_constraints.max()),
    )
    out.problem = timing.describe_lost(lost) or out.problem
    out.headline = (
        f"{out.median('world_steps'):,.0f} world-steps/s,"
        f" {out.median('ms_per_batched_step'):.3g} ms per step of {sim.nworld} worlds"
    )
    if full < sim.nworld:
        out.headline += f" ({sim.nworld - full} of them with an empty grasp)"
    return out


def carry_start(stage: Stage, sim: Simulation, state: State | None) -> State:
    """States at the start of the measured phase.

    Those of gate *batch*, ``state``, or those of some native worlds over and over, played from the
    configured starts.
    """
    if state is not None and state.qpos.shape[0] == sim.nworld:
        return state
    count = min(sim.nworld, stage.cfg.gate.throughput.start_worlds)
    native = stage.simulation(count, Backend.native, "cpu")
    env = stage.start(native, stage.cfg.reset)
    phase = stage.cfg.gate.throughput.from_phase
    steps = stage.phase(phase).start
    label = f"steps to {phase}"
    rollout(env, stage.driver(env), steps=steps, advance=stage.progress.advance, label=label)
    state = snapshot(native)
    native.close()
    rows = np.arange(sim.nworld) % count
    return State(state.qpos[rows], state.qvel[rows], state.ctrl[rows])


def measure_episode(
    stage: Stage, sim: Simulation, before: Episode | None = None, *, step_seconds: float = 0.0
) -> Measurement:
    """Measure whole episodes with their check.

    The batch gate's episode is the first repetition. On native MuJoCo an episode of thousands of
    worlds lasts minutes, so it is played only as often as the time allows, and not at all where
    even one would not fit.

    ``before`` is the episode of gate *batch*, if it was timed, and ``step_seconds`` about how long
    a control step takes [s].
    """
    cfg = stage.cfg
    t = cfg.gate.throughput
    seconds = timing.time_budget(cfg, sim)
    out = Measurement(name="episode")
    steps = stage.episode_steps
    # The repetitions, and about how long one takes
    worlds = (sim.description, sim.nworld)
    played = [before] if before and (before.description, len(before.start)) == worlds else []
    estimate = max([step_seconds * steps, *(episode.timing.seconds for episode in played)])
    rounds = min(t.repetitions, t.episodes) - len(played)
    began = time.perf_counter()
    meter = EnergyMeter(str(sim.device))
    for number in range(rounds):
        if time.perf_counter() - began + estimate > seconds:
            break
        repetition_began = time.perf_counter()
        played.append(stage.play(sim, cfg.reset, [timing.EnergyObserver(meter)]))
        estimate = time.perf_counter() - repetition_began
        stage.progress.advance("episode, repetitions", number + 1, rounds)
        if timing.settled(cfg, [episode.timing.seconds for episode in played]):
            break
    if not played:
        key = "max_seconds" if sim.device.type == "cuda" else "cpu_max_seconds"
        out.missing = (
            f"an episode would take about {estimate:.0f} s, and a measurement has {seconds:g} s"
            f" (gate.throughput.{key})"
        )
        return out

    # The result
    failed = np.flatnonzero(np.any([episode.failed for episode in played], axis=0)).tolist()
    timings = [episode.timing for episode in played]
    times = [spent.seconds for spent in timings]
    out.samples = {"seconds": times}
    out.failed = bool(failed)
    out.facts = figures(
        of_the_batch_gate=int(played[0] is before), succeeded=sim.nworld - len(failed)
    )
    used = meter if played[-1] is not before else timing.NO_METER
    captured = all(spent.captured for spent in timings)
    out.add_repetitions(sim, cfg, times, steps, used, *timings, captured=captured)
    out.headline = f"{statistics.median(times):.3g} s"
    if failed:
        out.problem = f"{name_worlds(failed, sim.nworld)} failed the check"
    return out
