"""What a solve of batched inverse kinematics costs, called one by one and replayed in a CUDA graph.

The worlds start at home and their targets are random places that the arm can reach, the same for
every case. What is timed is `BatchedIk.solve`, its two copies of the input included.
"""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from rich.console import Console
from rich.table import Table

from mjstack.config import load_config
from mjstack.config.schema import Config, GraphMode
from mjstack.errors import ConfigError, MjstackError
from mjstack.report.provenance import collect_provenance
from mjstack.scene import build_model
from mjstack.sim import resolve_device

if TYPE_CHECKING:
    from mjstack.kinematics.batched_ik import BatchedIk

SOLVES = 10  # per measurement: a graph holds as many, as a step's graph holds other work beside one
GAIN = 0.1


@dataclass(kw_only=True, slots=True)
class IkTimes:
    """Milliseconds per solve of all worlds, one number per repetition; a CPU has no graph."""

    nworld: int
    iterations: int
    block_dim: int
    gained: bool
    eager_ms: list[float]
    graph_ms: list[float]
    reached: float  # share of the worlds within the solver's tolerance


def measure_solve(
    cfg: Config,
    device: str,
    *,
    nworld: int,
    iterations: int,
    block_dim: int,
    gained: bool,
    repetitions: int,
) -> IkTimes:
    """Times one case.

    Args:
        cfg: The configuration: its robot, in its scene.
        device: ``"cpu"`` or ``"cuda:N"``.
        nworld: Number of worlds.
        iterations: Iterations per solve.
        block_dim: CUDA threads per block.
        gained: Whether posture and approach count.
        repetitions: Measurements, each of `SOLVES` solves.

    Returns:
        The times.

    Raises:
        MjstackError: An argument is out of range, or a distance is not finite: a figure would be
            void.
    """
    from mjstack.kinematics.batched_ik import BatchedIk  # loads Warp
    from mjstack.sim.graph import StepGraph

    gain = GAIN if gained else 0.0
    ik = BatchedIk(
        build_model(cfg),
        cfg.robot,
        nworld,
        device,
        iterations=iterations,
        posture_gain=gain,
        approach_gain=gain,
        block_dim=block_dim,
    )
    start, target = _problem(cfg, ik)

    def solves() -> None:
        for _ in range(SOLVES):
            ik.solve(start, target)

    eager = _time(solves, ik.device, repetitions)
    graphed: list[float] = []
    if ik.device.startswith("cuda"):
        graph = StepGraph(solves, ik.device, GraphMode.require, name="the solves")
        for _ in range(2):  # warm-up and capture
            graph()
        graphed = _time(graph, ik.device, repetitions)
    _, distance = ik.solve(start, target)
    if not bool(torch.isfinite(distance).all()):
        raise MjstackError(
            "a distance is not finite, and a figure would be void. Report this with the command."
        )
    return IkTimes(
        nworld=nworld,
        iterations=iterations,
        block_dim=block_dim,
        gained=gained,
        eager_ms=eager,
        graph_ms=graphed,
        reached=float((~ik.unreachable).float().mean()),
    )


def _problem(cfg: Config, ik: BatchedIk) -> tuple[torch.Tensor, torch.Tensor]:
    """Home in every world, and where the grasp_point is within 0.5 rad of it, shapes ``(nworld,
    n)`` and ``(nworld, 3)``.
    """
    robot = cfg.robot
    names = [*robot.arm_joints, *robot.gripper_joints]
    home = torch.tensor(robot.home).repeat(ik.nworld, 1)
    moved = [names.index(name) for name in robot.ik_joints]
    away = home.clone()
    away[:, moved] += (
        torch.rand((ik.nworld, len(moved)), generator=torch.Generator().manual_seed(0)) - 0.5
    )
    return home.to(ik.device), ik.grasp_point(away.to(ik.device)).clone()


def _time(work: Callable[[], None], device: str, repetitions: int) -> list[float]:
    """Milliseconds per solve of each repetition; one before them warms up."""
    times = []
    for _ in range(repetitions + 1):
        _synchronize(device)
        began = time.perf_counter()
        work()
        _synchronize(device)
        times.append(1e3 * (time.perf_counter() - began) / SOLVES)
    return times[1:]


def _synchronize(device: str) -> None:
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of scripts/bench_ik.py."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "overrides", nargs="*", help="as for run.py, such as robot=rebot sim.device=cpu"
    )
    parser.add_argument(
        "--nworld",
        type=int,
        nargs="+",
        default=[256, 2048, 8192],
        help="numbers of worlds (256 2048 8192)",
    )
    parser.add_argument(
        "--iterations",
        type=int,
        nargs="+",
        default=[4, 8, 16, 40],
        help="iterations per solve (4 8 16 40)",
    )
    parser.add_argument(
        "--block-dim", type=int, nargs="+", default=[32], help="CUDA threads per block (32)"
    )
    parser.add_argument(
        "--repetitions", type=int, default=20, help=f"measurements of {SOLVES} solves each (20)"
    )
    parser.add_argument("--out", type=Path, help="also write the figures to this JSON file")
    args = parser.parse_args(argv)
    console = Console(soft_wrap=True)
    try:
        if args.repetitions < 1:
            raise ConfigError("--repetitions", args.repetitions, "an integer of at least 1")
        if args.out is not None and not args.out.absolute().parent.is_dir():
            raise ConfigError("--out", args.out, "a file in a folder that exists")
        cfg = load_config(args.overrides)
        device = resolve_device(cfg.sim.device)
        cases = list(itertools.product(args.nworld, args.iterations, args.block_dim, (False, True)))
        results = []
        with console.status("compiling") as status:
            for i, (nworld, iterations, block_dim, gained) in enumerate(cases):
                status.update(
                    f"case {i + 1} of {len(cases)}: {nworld} worlds, {iterations} iterations"
                )
                results.append(
                    measure_solve(
                        cfg,
                        device,
                        nworld=nworld,
                        iterations=iterations,
                        block_dim=block_dim,
                        gained=gained,
                        repetitions=args.repetitions,
                    )
                )
    except MjstackError as error:
        Console(stderr=True, soft_wrap=True, markup=False).print(f"mjstack: {error}")
        raise SystemExit(error.exit_code) from error
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    console.print(_table(f"BatchedIk.solve: {cfg.robot.title}, {device}", results))
    if args.out is not None:
        versions = collect_provenance(config_yaml="", model_text="", device=device, driver="")[
            "versions"
        ]
        rows = [asdict(result) for result in results]
        args.out.write_text(
            json.dumps({"command": sys.argv, "versions": versions, "results": rows}, indent=2)
            + "\n"
        )


def _table(title: str, results: list[IkTimes]) -> Table:
    table = Table(title=title)
    for name in (
        "worlds",
        "iterations",
        "block",
        "eager, ms",
        "in a graph, ms",
        "us per iteration",
        "within 0.5 mm",
        "gains",
    ):
        table.add_column(name, justify="right")
    for r in results:
        best = statistics.median(r.graph_ms or r.eager_ms)
        table.add_row(
            f"{r.nworld:,}",
            str(r.iterations),
            str(r.block_dim),
            f"{statistics.median(r.eager_ms):.4f}",
            f"{statistics.median(r.graph_ms):.4f}" if r.graph_ms else "-",
            f"{1e3 * best / r.iterations:.2f}",
            f"{100.0 * r.reached:.2f} %",
            f"{GAIN if r.gained else 0.0}",
        )
    return table
