"""Physics steps: under a held joint target with the object in hand, and in each arrangement."""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from mjstack.bench.timing import (
    NO_METER,
    WARM_UP,
    EnergyMeter,
    Measurement,
    describe_lost,
    lost_worlds,
    steps_that_fit,
    timed,
)
from mjstack.config.schema import Backend
from mjstack.episodes.context import RunContext
from mjstack.episodes.rollout import CommandRecorder, Snapshots, State, restore, rollout, snapshot
from mjstack.errors import MjstackError
from mjstack.mdp.geometry import objects_in_hand
from mjstack.sim import Simulation, resolve_device
from mjstack.sim.sizes import resolve_env_sizes

BARE = "bare mujoco_warp.step"


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


def measure_physics(
    context: RunContext, sim: Simulation, *, seconds: float, repetitions: int, meter: EnergyMeter
) -> Measurement:
    """Measure physics steps under a held joint target, the object in hand.

    A grasp may be empty at the start, about to be retried. The number of full ones is reported, and
    there is no figure if they are less than half. The figure includes the rest of a simulation's
    step: counting contacts, latching overflow. Fewer steps are made where the time budget [s] is
    short.
    """
    t = context.cfg.gate.throughput
    out = Measurement(name="physics")
    held = HeldPhysics(sim, carry_start(context, sim), context.cfg.timing.decimation)
    full = _in_hand(context, sim)
    if full is not None:
        out.facts["worlds_with_object_in_hand"] = full
        if 2 * full < sim.nworld:
            where = f"as {t.from_phase} begins (gate.throughput.from_phase)"
            out.problem = f"only {full} of {sim.nworld} worlds have the object in hand {where}"
            return out

    # The repetitions
    steps = steps_that_fit(t.steps, seconds, repetitions * held.warm_up())
    meter.clear()
    times = []
    for repetition in range(repetitions):
        times.append(held.play(steps, meter))
        context.advance("physics, repetitions", repetition + 1, repetitions)

    # The result
    graph = sim.graph_of(held.decimation)
    captured = graph is not None and graph.captured
    out.add_repetitions(
        sim, context.cfg, times, steps, meter, graph, captured=captured, whole=False
    )
    out.facts |= {
        "peak_contacts_per_world": int(sim.peak_contacts.max()),
        "peak_constraint_rows_per_world": int(sim.peak_constraints.max()),
    }
    out.problem = describe_lost(held.lost) or out.problem
    out.headline = (
        f"{out.median('world_steps_per_s'):,.0f} world-steps/s,"
        f" {out.median('ms_per_batched_step'):.3g} ms per step of {sim.nworld} worlds"
    )
    if full is not None and full < sim.nworld:
        out.headline += f" ({sim.nworld - full} of them with an empty grasp)"
    return out


def carry_start(context: RunContext, sim: Simulation) -> State:
    """States at the start of the measured phase.

    Those of gate *batch*, or those of some native worlds over and over.
    """
    state = context.artifacts.carry_start
    if state is not None and state.qpos.shape[0] == sim.nworld:
        return state
    t = context.cfg.gate.throughput
    count = min(sim.nworld, t.start_worlds)
    some = context.simulation(count, Backend.native, "cpu")
    state = play_to_phase(context, some)
    some.close()
    rows = np.arange(sim.nworld) % count
    return State(state.qpos[rows], state.qvel[rows], state.ctrl[rows])


def play_to_phase(context: RunContext, sim: Simulation) -> State:
    """The state of every world as the measured phase begins, played from the configured starts."""
    phase = context.cfg.gate.throughput.from_phase
    env = context.start(sim, context.cfg.reset)
    steps = context.phase(phase).start
    label = f"steps to {phase}"
    rollout(env, context.driver(env), steps=steps, advance=context.advance, label=label)
    return snapshot(sim)


def measure_arrangements(
    context: RunContext, *, steps: int, repetitions: int, random: bool = False
) -> dict[str, list[float]]:
    """Time the captured step in each arrangement, beside a bare replayed ``mujoco_warp.step``.

    Every repetition plays the same control steps from the same states, for one arrangement after
    the other. So the ratios are of one run and one trajectory.

    Args:
        context: The configuration; its worlds run on MJWarp.
        steps: Control steps per repetition.
        repetitions: Measured repetitions; one before them warms up.
        random: Whether the joint targets are random, over their full range, from worlds with room
            for that; else the task's, object in hand, from the phase
            ``gate.throughput.from_phase``.

    Returns:
        Milliseconds per batched physics step, one number per repetition, by arrangement.

    Raises:
        MjstackError: Physics was lost, or a state is not finite: the figures would be void.
    """
    from mjstack.sim.mjwarp import MjwarpSimulation
    from mjstack.sim.substep import ARRANGEMENTS, Arrangement

    cfg = context.cfg
    decimation = cfg.timing.decimation
    arrangements = {
        "and counted, its overflow latched": Arrangement(
            own_stages=False, scratch=False, fused=False
        ),
        "temporaries at fixed addresses": Arrangement(own_stages=False, fused=False),
        "only the stages that are needed": Arrangement(
            branches=False, sensors_once=False, fused=False
        ),
        "sensors in the last substep of a control step alone": Arrangement(
            branches=False, fused=False
        ),
        "contacts beside smooth dynamics": ARRANGEMENTS["arranged"],
        "contact rows and the solver as one kernel each": Arrangement(smooth=False),
        "smooth dynamics as three kernels": ARRANGEMENTS["fused"],
    }
    device = resolve_device(cfg.sim.device)
    sizes = resolve_env_sizes(cfg) if random else None
    sim = context.simulation(cfg.nworld, Backend.mjwarp, device, sizes=sizes)
    assert isinstance(sim, MjwarpSimulation)
    arrangements = {name: one for name, one in arrangements.items() if sim.allows(one)}
    state, targets = (_random_targets if random else _task_targets)(context, sim, steps)
    columns = torch.as_tensor(context.index.ctrl, device=sim.device)
    bare = sim.bare_step()

    def bare_steps() -> None:
        for _ in range(decimation):
            bare()

    def play(step: Callable[[], None]) -> None:
        for target in targets:
            sim.ctrl[:, columns] = target
            step()

    # The repetitions
    times: dict[str, list[float]] = {name: [] for name in (BARE, *arrangements)}
    for repetition in range(repetitions + 1):
        for name, spent in times.items():
            if name in arrangements:
                sim.arrange(arrangements[name])
            step = bare_steps if name == BARE else partial(sim.step, decimation)
            for _ in range(2):  # warm-up and capture
                step()
            restore(sim, state)
            seconds = timed(sim, partial(play, step))
            if repetition:
                spent.append(1e3 * seconds / (len(targets) * decimation))
            if bool(lost_worlds(sim).any()):
                raise MjstackError(
                    f"{name}: physics was lost, and a figure would be void. Run gates=[capacity]."
                )
        context.advance("repetitions", repetition, repetitions)
    sim.close()
    return times


def _task_targets(
    context: RunContext, sim: Simulation, steps: int
) -> tuple[State, list[torch.Tensor]]:
    """State and joint targets of the task from the measured phase on."""
    first = context.phase(context.cfg.gate.throughput.from_phase).start
    snapshots = Snapshots([first - 1])
    recorder = CommandRecorder()
    context.play(sim, context.cfg.reset, [snapshots, recorder])
    recorded = recorder.recorded.rewind()
    targets = [recorded.command() for _ in range(min(first + steps, recorded.steps))][first:]
    return snapshots.states[first - 1], targets


def _random_targets(
    context: RunContext, sim: Simulation, steps: int
) -> tuple[State, list[torch.Tensor]]:
    """Random joint targets over their full range, and the state after a second of such."""
    columns = torch.as_tensor(context.index.ctrl, device=sim.device)
    limits = torch.as_tensor(sim.model.actuator_ctrlrange).float().to(sim.device)
    low, high = limits[columns].unbind(1)
    generator = torch.Generator(sim.device).manual_seed(context.cfg.seed)
    before = round(1.0 / context.cfg.timing.step_dt)
    targets = []
    for _ in range(before + steps):
        noise = torch.rand((sim.nworld, len(columns)), generator=generator, device=sim.device)
        targets.append(low + (high - low) * noise)
    context.start(sim, context.cfg.reset)
    for target in targets[:before]:
        sim.ctrl[:, columns] = target
        sim.step(context.cfg.timing.decimation)
    return snapshot(sim), targets[before:]


def _in_hand(context: RunContext, sim: Simulation) -> int | None:
    """Number of worlds in which both jaws press on the object of the measured phase.

    None if the phase carries none.
    """
    number = context.phase(context.cfg.gate.throughput.from_phase).carried
    return None if number < 0 else int(objects_in_hand(context.index, sim)[:, number].sum())
