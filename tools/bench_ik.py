"""Time a solve of batched inverse kinematics, as single calls and in a CUDA graph.

    python tools/bench_ik.py robot=so101 --nworld 2048 --iterations 4 8

The worlds start at home and their targets are random places that the arm can reach, the same for
every case. The time is that of `BatchedIk.solve`, its two copies of the input included. Every case
is measured with and without the gains of posture and approach.
"""

import argparse
import itertools
import time
from collections.abc import Callable, Iterator

import torch
from common import count, make_parser, run, spread

from mjstack.config.schema import Config
from mjstack.envs.buffers import Advance
from mjstack.errors import MjstackError
from mjstack.kinematics.batched_ik import BatchedIk
from mjstack.report.table import Table
from mjstack.scene import build_model
from mjstack.sim import resolve_device
from mjstack.sim.graph import StepGraph

SOLVES = 10  # per measurement: a graph holds as many, as a step's graph holds other work beside one
TOLERANCE = 0.0005  # m, within which a target is reached
_GAIN = 0.1
_HEADER = ["worlds", "iterations", "gains", "eager, ms", "in a graph, ms"]
_HEADER += ["share within 0.5 mm"]


def measure(args: argparse.Namespace, cfg: Config, advance: Advance) -> Iterator[Table]:
    """Time every combination of the options."""
    device = resolve_device(cfg.sim.device)
    model = build_model(cfg)
    cases = list(itertools.product(args.nworld, args.iterations, (0.0, _GAIN)))
    rows = []
    for number, (nworld, iterations, gain) in enumerate(cases, 1):
        ik = BatchedIk(
            model,
            cfg.robot,
            nworld,
            device,
            iterations=iterations,
            posture_gain=gain,
            approach_gain=gain,
        )
        times, reached = measure_solve(cfg, ik, args.repetitions)
        numbers = [f"{nworld:,}", str(iterations), f"{gain:g}"]
        rows.append([*numbers, *map(spread, times), f"{reached:.4f}"])
        advance("cases", number, len(cases))
    title = f"BatchedIk.solve: {cfg.robot.title}, {device}"
    yield Table(title=title, header=_HEADER, rows=rows)


def measure_solve(
    cfg: Config, ik: BatchedIk, repetitions: int
) -> tuple[tuple[list[float], list[float]], float]:
    """Milliseconds per solve of all worlds, eager and in a graph (none on a CPU), and the share of
    worlds that reached their targets.
    """
    start, target = make_problem(cfg, ik)

    def solves() -> None:
        for _ in range(SOLVES):
            ik.solve(start, target)

    eager = time_solves(solves, ik.device, repetitions)
    captured = []
    if ik.device.startswith("cuda"):
        graph = StepGraph(solves, ik.device, "require", name="the solves")
        for _ in range(2):  # warm-up and capture
            graph()
        captured = time_solves(graph, ik.device, repetitions)
    _, distance = ik.solve(start, target)
    if not bool(torch.isfinite(distance).all()):
        raise MjstackError("a distance is not finite, and a figure would be void")
    return (eager, captured), float((distance <= TOLERANCE).float().mean())


def make_problem(cfg: Config, ik: BatchedIk) -> tuple[torch.Tensor, torch.Tensor]:
    """Home in every world, and grasp points of joints within 0.5 rad of it, of shapes ``(nworld,
    n)`` and ``(nworld, 3)``.
    """
    home = torch.tensor(cfg.robot.home).repeat(ik.nworld, 1)
    columns = [cfg.robot.joints.index(name) for name in cfg.robot.ik_joints]
    noise = torch.rand((ik.nworld, len(columns)), generator=torch.Generator().manual_seed(0)) - 0.5
    target = home.clone()
    target[:, columns] += noise
    return home.to(ik.device), ik.forward(target.to(ik.device))[0].clone()


def time_solves(work: Callable[[], object], device: str, repetitions: int) -> list[float]:
    """Milliseconds per solve of each repetition; one before them warms up."""
    times = []
    for _ in range(repetitions + 1):
        began = time.perf_counter()
        work()
        if device.startswith("cuda"):
            torch.cuda.synchronize(device)
        times.append(1e3 * (time.perf_counter() - began) / SOLVES)
    return times[1:]


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("--nworld", type=count, nargs="+", default=[256, 2048, 8192])
    parser.add_argument("--iterations", type=count, nargs="+", default=[4, 8, 16, 40])
    parser.add_argument("--repetitions", type=count, default=20, help=f"of {SOLVES} solves each")
    run(parser, measure)
