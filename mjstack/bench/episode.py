"""Physics steps with the object in hand, and the whole judged episode; on MJWarp beside bare
steps of the same commands.
"""

import math
import statistics
import time
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from mjstack.bench.timing import (
    EAGER,
    NO_METER,
    WARM_UP,
    EnergyMeter,
    EnergyObserver,
    Measurement,
    describe_lost,
    lost_worlds,
    settled,
    steps_that_fit,
    time_budget,
    timed,
)
from mjstack.config.schema import Backend
from mjstack.drivers.driver import OpenLoopDriver
from mjstack.drivers.open_loop import JointTrajectory
from mjstack.episodes.recorder import COMMANDS, Recorder
from mjstack.episodes.rollout import (
    FEEDBACK,
    Episode,
    Observer,
    State,
    restore,
    rollout,
    snapshot,
)
from mjstack.episodes.stage import Stage
from mjstack.errors import name_worlds
from mjstack.mdp.geometry import objects_in_hand
from mjstack.sim import Simulation

if TYPE_CHECKING:
    from mjstack.sim.mjwarp import MjwarpSimulation


class HeldPhysics:
    """Physics under a held joint target, timed again and again from one state.

    Attributes:
        lost: Worlds that overflowed, diverged or were not stepped in some repetition, shape
            ``(nworld,)``, bool.
    """

    def __init__(self, sim: Simulation, state: State, decimation: int) -> None:
        """Put the worlds into the state in which every repetition starts."""
        self.sim = sim
        self.state = state
        self.decimation = decimation
        restore(sim, state)
        self.lost = lost_worlds(sim)

    def warm_up(self) -> float:
        """Compile and capture the step; return the seconds that one takes then."""
        return [timed(self.sim, lambda: self._play(1)) for _ in range(WARM_UP)][-1]

    def play(self, steps: int, meter: EnergyMeter = NO_METER) -> float:
        """Seconds that some control steps take from the state."""
        restore(self.sim, self.state)
        seconds = timed(self.sim, lambda: self._play(steps), meter)
        self.lost |= lost_worlds(self.sim, steps * self.decimation)
        return seconds

    def _play(self, steps: int) -> None:
        for _ in range(steps):
            self.sim.step(self.decimation)


def measure_physics(stage: Stage, sim: Simulation, carry: State | None = None) -> Measurement:
    """Measure physics steps under a held joint target, the object in hand.

    A grasp may be empty at the start, about to be retried. The number of full ones is reported, and
    there is no figure if they are less than half. The figure includes the rest of a simulation's
    step: counting contacts, latching overflow. Fewer steps are made where the time budget [s] is
    short.
    """
    t = stage.cfg.gate.throughput
    out = Measurement(name="physics")
    physics = HeldPhysics(sim, carry_start(stage, sim, carry), stage.cfg.timing.decimation)
    carried = stage.phase(t.from_phase).carried
    full = sim.nworld
    if carried >= 0:  # both jaws press on the phase's object
        full = int(objects_in_hand(stage.index, sim)[:, carried].sum())
        out.facts["worlds_with_object_in_hand"] = full
        if 2 * full < sim.nworld:
            where = f"as {t.from_phase} begins (gate.throughput.from_phase)"
            out.problem = f"only {full} of {sim.nworld} worlds have the object in hand {where}"
            return out

    # The repetitions
    seconds = t.repetitions * physics.warm_up()
    steps = steps_that_fit(t.steps, time_budget(stage.cfg, sim), seconds)
    meter = EnergyMeter(str(sim.device))
    times = []
    for repetition in range(t.repetitions):
        times.append(physics.play(steps, meter))
        stage.progress.advance("physics, repetitions", repetition + 1, t.repetitions)
        if settled(stage.cfg, times):
            break

    # The result
    graph = sim.graph_of(physics.decimation)
    captured = graph is not None and graph.captured
    out.add_repetitions(sim, stage.cfg, times, steps, meter, graph, captured=captured, whole=False)
    out.facts |= {
        "peak_contacts_per_world": int(sim.peak_contacts.max()),
        "peak_constraint_rows_per_world": int(sim.peak_constraints.max()),
    }
    out.problem = describe_lost(physics.lost) or out.problem
    out.headline = (
        f"{out.median('world_steps_per_s'):,.0f} world-steps/s,"
        f" {out.median('ms_per_batched_step'):.3g} ms per step of {sim.nworld} worlds"
    )
    if full < sim.nworld:
        out.headline += f" ({sim.nworld - full} of them with an empty grasp)"
    return out


def carry_start(stage: Stage, sim: Simulation, state: State | None) -> State:
    """States at the start of the measured phase.

    Those of gate *batch*, ``state``, or those of some native worlds over and over.
    """
    if state is not None and state.qpos.shape[0] == sim.nworld:
        return state
    count = min(sim.nworld, stage.cfg.gate.throughput.start_worlds)
    native = stage.simulation(count, Backend.native, "cpu")
    state = play_to_phase(stage, native)
    native.close()
    rows = np.arange(sim.nworld) % count
    return State(state.qpos[rows], state.qvel[rows], state.ctrl[rows])


def play_to_phase(stage: Stage, sim: Simulation) -> State:
    """The state of every world as the measured phase begins, played from the configured starts."""
    phase = stage.cfg.gate.throughput.from_phase
    env = stage.start(sim, stage.cfg.reset)
    steps = stage.phase(phase).start
    label = f"steps to {phase}"
    rollout(env, stage.driver(env), steps=steps, advance=stage.progress.advance, label=label)
    return snapshot(sim)


def measure_episode(
    stage: Stage,
    sim: Simulation,
    before: Episode | None = None,
    *,
    step_seconds: float = 0.0,
) -> Measurement:
    """Measure whole episodes with their check, alternating with bare steps on MJWarp.

    The batch gate's episode is the first repetition; on MJWarp at least one more is played, beside
    bare steps. On native MuJoCo an episode of thousands of worlds lasts minutes, so it is played
    only as often as the time allows, and not at all where even one would not fit.

    Args:
        stage: Scene and planner.
        sim: The worlds.
        before: The episode of gate *batch*, if it was timed.
        step_seconds: About how long a control step takes [s].
    """
    cfg = stage.cfg
    t = cfg.gate.throughput
    seconds = time_budget(cfg, sim)
    mjwarp = sim.backend == "mjwarp"
    out = Measurement(name="episode")
    steps = stage.episode_steps
    # The repetitions, and about how long one takes. Bare steps are measured once at least.
    worlds = (sim.description, sim.nworld)
    played = [before] if before and (before.description, len(before.start)) == worlds else []
    estimate = max([step_seconds * steps, *(episode.timing.seconds for episode in played)])
    rounds = min(t.repetitions, t.episodes) - len(played)
    if mjwarp:
        estimate *= 2
        rounds = max(1, rounds)
    began = time.perf_counter()
    meter = EnergyMeter(str(sim.device))
    for number in range(rounds):
        if time.perf_counter() - began + estimate > seconds:
            break
        repetition_began = time.perf_counter()
        played.append(_play(stage, sim, meter, out))
        estimate = time.perf_counter() - repetition_began
        stage.progress.advance("episode, repetitions", number + 1, rounds)
        if settled(cfg, [episode.timing.seconds for episode in played]):
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
    times = [timing.seconds for timing in timings]
    out.samples = {"seconds": times, **out.samples}
    out.facts = {
        "of_the_batch_gate": int(played[0] is before),
        "succeeded": sim.nworld - len(failed),
    }
    used = meter if played[-1] is not before else NO_METER
    captured = all(timing.captured for timing in timings)
    out.add_repetitions(sim, cfg, times, steps, used, *timings, captured=captured)
    out.headline = f"{statistics.median(times):.3g} s"
    if "bare_ratio" in out.samples:
        out.facts["bare_repetitions"] = len(out.samples["bare_ratio"])
        once = ", once" if out.facts["bare_repetitions"] == 1 else ""
        out.headline += f" (its later half {out.median('bare_ratio'):.3f} x bare steps{once})"
    elif mjwarp:
        out.notes["bare_ratio"] = "not measured: no time for an episode and as many bare steps"
    if failed:
        out.problem = f"{name_worlds(failed, sim.nworld)} failed the check"
    return out


class LaterHalf(Observer):
    """Times the steps of a rollout from some step on.

    Attributes:
        first: The step.
        state: The worlds before it.
        seconds: Time of the steps from there [s].
    """

    def __init__(self, first: int) -> None:
        """Take the number of the step."""
        self.first = first

    @override
    def after_step(self, step: int) -> None:
        if step == self.first - 1:
            self.env.sim.synchronize()
            reading = time.perf_counter()
            self.state = snapshot(self.env.sim)
            self._began = time.perf_counter()
            self.aside = self._began - reading

    @override
    def finish(self) -> None:
        self.seconds = time.perf_counter() - self._began


def play_bare(
    stage: Stage,
    sim: "MjwarpSimulation",
    commands: Tensor | None = None,
    half: LaterHalf | None = None,
) -> tuple[float, str]:
    """Play the same commands from the same start with bare steps, or the later half of them.

    Joint trajectories are evaluated in the loop, as in the episode; ``commands`` are those of a
    driver that cannot give them again, shape ``(steps, nworld, nu)``. Overflow bits stay until a
    reset, so that one look at the end has all.

    Returns:
        Seconds, and why they do not count: empty where they do.
    """
    cfg = stage.cfg
    step = sim.bare_step()
    for _ in range(WARM_UP):  # none of it is timed
        step()
    if sim.device.type == "cuda" and cfg.graph != "off" and not step.captured:
        return math.nan, "the bare steps could not be captured"
    env = stage.start(sim, cfg.reset)
    if commands is None:
        driver = stage.driver(env)
    else:  # a knot at every step
        numbers = torch.arange(len(commands), device=sim.device)[:, None]
        weights = torch.ones_like(numbers, dtype=commands.dtype)
        knots = commands.transpose(0, 1)
        driver = OpenLoopDriver(JointTrajectory(knots, weights, numbers, np.zeros(len(knots))), [])

    first = half.first if half else 0
    for _ in range(first):
        driver.command()
    if half:
        restore(sim, half.state)
    columns = env.index.on(sim.device, sim.ctrl.dtype).ctrl

    def play() -> None:
        for _ in range(first, driver.steps):
            columns.write(sim.ctrl, driver.command())
            for _ in range(cfg.timing.decimation):
                step()

    seconds = timed(sim, play)
    sim.latch()
    if lost := int(lost_worlds(sim).sum()):
        return seconds, f"{lost} worlds overflowed or diverged with bare steps"
    end = stage.check.view(env).step()
    fallen = int((~stage.check.placed(end).all(1)).sum())
    return seconds, f"{fallen} worlds did not do the task with bare steps" if fallen else ""


def _play(stage: Stage, sim: Simulation, meter: EnergyMeter, out: Measurement) -> Episode:
    """Play one repetition: the episode and, on MJWarp, its later half with bare steps, which are
    several times slower. The half has the contacts, and the end that the task is judged by.

    Joint trajectories can be evaluated again; the commands of a driver with feedback are recorded.
    """
    cfg = stage.cfg
    mjwarp = sim.backend == "mjwarp"
    keep = mjwarp and cfg.controller.name in FEEDBACK
    recorder = Recorder(COMMANDS)
    half = LaterHalf(max(EAGER, stage.episode_steps // 2))
    observers: list[Observer] = [recorder] if keep else []
    if mjwarp and half.first < stage.episode_steps:
        observers.append(half)
    # Of the observers the last one finishes first, with nothing of another's in its time
    episode = stage.play(sim, cfg.reset, [EnergyObserver(meter), *observers])
    if half in observers:
        commands = recorder.rows.get("ctrl")
        bare, problem = play_bare(stage, cast("MjwarpSimulation", sim), commands, half)
        out.problem = out.problem or problem
        times = {"half_seconds": half.seconds, "bare_seconds": bare}
        for name, value in (times | {"bare_ratio": half.seconds / bare}).items():
            out.samples.setdefault(name, []).append(value)
    return episode
