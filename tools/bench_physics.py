"""Time the captured physics step beside a bare replayed ``mujoco_warp.step``.

    python tools/bench_physics.py robot=so101 nworld=2048

Every repetition plays the same control steps from the same states for one after the other, so that
ratios are of one run and one trajectory: the task's joint targets, cube in hand, from the phase
``gate.throughput.from_phase`` on, then random ones over their full range.
"""

import argparse
from collections.abc import Callable, Iterator
from functools import partial

import torch
from common import count, make_parser, run, spread

from mjstack.bench.timing import lost_worlds, timed
from mjstack.config.schema import Backend, Config
from mjstack.envs.buffers import Advance
from mjstack.episodes.recorder import Channels, Recorder, Snapshots, read_commands
from mjstack.episodes.rollout import State, restore, snapshot
from mjstack.episodes.stage import Progress, Stage
from mjstack.errors import MjstackError
from mjstack.report.table import Table
from mjstack.sim import Simulation, resolve_device
from mjstack.sim.compiling import compile_step
from mjstack.sim.fused.step import StepPlan
from mjstack.sim.graph import StepGraph
from mjstack.sim.mjwarp import MjwarpSimulation
from mjstack.sim.mujoco_warp import mjw, torch_stream_scope
from mjstack.sim.sizes import resolve_sizes

BARE = "bare mujoco_warp.step"


def measure(args: argparse.Namespace, cfg: Config, advance: Advance) -> Iterator[Table]:
    """Time each plan of the step, in the task and under random joint targets."""
    stage = Stage(cfg, progress=Progress(advance=advance))
    for random in (False, True):
        times = measure_plans(stage, args.steps, args.repetitions, random)
        targets = "random actions" if random else f"from {cfg.gate.throughput.from_phase}"
        yield Table(
            title=f"a captured step: {cfg.robot.title}, {cfg.nworld:,} worlds, {targets}",
            header=["step", "ms per step", "bare over it"],
            rows=[
                [name, spread(ms), spread([b / a for a, b in zip(ms, times[BARE], strict=True)])]
                for name, ms in times.items()
            ],
        )


def measure_plans(
    stage: Stage, steps: int, repetitions: int, random: bool, *, only_planned: bool = False
) -> dict[str, list[float]]:
    """Milliseconds per batched physics step, one number per repetition, by the step's name;
    ``only_planned`` leaves out all but the planned and the bare one.
    """
    cfg = stage.cfg
    decimation = cfg.timing.decimation
    sizes = resolve_sizes(cfg, driven=False) if random else None
    device = resolve_device(cfg.sim.device)
    sim = stage.simulation(cfg.nworld, Backend.mjwarp, device, sizes=sizes)
    assert isinstance(sim, MjwarpSimulation)
    plans = {"stock": StepPlan(), sim.plan.name: sim.plan}
    if sim.plan.name == "fused":
        plans = {"stock": StepPlan(), "arranged": StepPlan("arranged"), "fused": sim.plan}
    if only_planned:
        plans = {sim.plan.name: sim.plan}
    state, targets = (_random_targets if random else _task_targets)(stage, sim, steps)
    columns = torch.as_tensor(stage.index.ctrl, device=sim.device)
    bare = bare_step(sim)

    def bare_steps() -> None:
        for _ in range(decimation):
            bare()

    def play(step: Callable[[], None]) -> None:
        for target in targets:
            sim.ctrl[:, columns] = target
            step()

    # One repetition more, the first one, warms up
    times: dict[str, list[float]] = {name: [] for name in (BARE, *plans)}
    for repetition in range(repetitions + 1):
        for name, milliseconds in times.items():
            sim.close()  # drops the graph of the plan before
            sim.plan = plans.get(name, sim.plan)
            step = bare_steps if name == BARE else partial(sim.step, decimation)
            for _ in range(2):  # warm-up and capture
                step()
            restore(sim, state)
            seconds = timed(sim, partial(play, step))
            if repetition:
                milliseconds.append(1e3 * seconds / (len(targets) * decimation))
            sim.latch()  # a bare step counts nothing
            if bool(lost_worlds(sim).any()):
                raise MjstackError(
                    f"{name}: physics was lost, and a figure would be void. Run gates=[capacity]."
                )
            graph = bare if name == BARE else sim.graph_of(decimation)
            if sim.device.type == "cuda" and cfg.graph != "off" and not graph.captured:
                raise MjstackError(f"{name}: it ran eagerly. graph=off measures it like that.")
        stage.progress.advance("repetitions", repetition, repetitions)
    return times


def bare_step(sim: MjwarpSimulation) -> StepGraph:
    """One plain ``mujoco_warp.step``, captured and replayed with nothing else: what the rest is
    measured by.
    """
    assert sim.sizes is not None
    compile_step(sim.model, sim._m, sim.sizes, sim._device, StepPlan())

    def work() -> None:
        with torch_stream_scope(sim._device):
            mjw.step(sim._m, sim._d)

    return StepGraph(work, sim.device, sim._graph_mode, name="a bare step", scratch=False)


def _task_targets(stage: Stage, sim: Simulation, steps: int) -> tuple[State, list[torch.Tensor]]:
    """State and joint targets of the task from the measured phase on."""
    first = stage.phase(stage.cfg.gate.throughput.from_phase).start
    snapshots = Snapshots([first - 1])
    recorder = Recorder(Channels(read_commands))
    stage.play(sim, stage.cfg.reset, [snapshots, recorder])
    return snapshots.states[first - 1], list(recorder.rows["ctrl"][first : first + steps])


def _random_targets(stage: Stage, sim: Simulation, steps: int) -> tuple[State, list[torch.Tensor]]:
    """Random joint targets over their full range, and the state after a second of such."""
    columns = torch.as_tensor(stage.index.ctrl, device=sim.device)
    limits = torch.as_tensor(sim.model.actuator_ctrlrange).float().to(sim.device)
    low, high = limits[columns].unbind(1)
    generator = torch.Generator(sim.device).manual_seed(stage.cfg.seed)
    before = round(1.0 / stage.cfg.timing.step_dt)
    targets = []
    for _ in range(before + steps):
        noise = torch.rand((sim.nworld, len(columns)), generator=generator, device=sim.device)
        targets.append(low + (high - low) * noise)
    stage.start(sim, stage.cfg.reset)
    for target in targets[:before]:
        sim.ctrl[:, columns] = target
        sim.step(stage.cfg.timing.decimation)
    return snapshot(sim), targets[before:]


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("--steps", type=count, default=20, help="control steps per repetition")
    parser.add_argument("--repetitions", type=count, default=5)
    run(parser, measure)
