"""The cost of a solve of batched inverse kinematics, as single calls and in a CUDA graph.

The worlds start at home and their targets are random places that the arm can reach, the same for
every case. The time is that of `BatchedIk.solve`, its two copies of the input included.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import torch

from mjstack.bench.timing import Measurement
from mjstack.config.schema import Config
from mjstack.errors import MjstackError
from mjstack.scene import build_model

if TYPE_CHECKING:
    from mjstack.kinematics.batched_ik import BatchedIk

SOLVES = 10  # per measurement: a graph holds as many, as a step's graph holds other work beside one


def measure_solve(
    cfg: Config,
    device: str,
    *,
    nworld: int,
    iterations: int,
    block_dim: int,
    gain: float,
    repetitions: int,
) -> Measurement:
    """Time one case of the configuration's robot in its scene: repetitions of `SOLVES` solves each.

    ``block_dim`` counts CUDA threads, ``gain`` is that of posture and approach.

    Returns:
        Samples ``eager_ms`` and, on CUDA, ``graph_ms`` per solve of all worlds; facts of the case,
        with the share of worlds ``reached`` within the solver's tolerance.

    Raises:
        MjstackError: An argument is out of range, or a distance is not finite: a figure would be
            void.
    """
    from mjstack.kinematics.batched_ik import BatchedIk  # loads Warp
    from mjstack.sim.graph import StepGraph

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

    out = Measurement(name="ik")
    out.samples["eager_ms"] = _time(solves, ik.device, repetitions)
    if ik.device.startswith("cuda"):
        graph = StepGraph(solves, ik.device, "require", name="the solves")
        for _ in range(2):  # warm-up and capture
            graph()
        out.samples["graph_ms"] = _time(graph, ik.device, repetitions)
    _, distance = ik.solve(start, target)
    if not bool(torch.isfinite(distance).all()):
        raise MjstackError(
            "a distance is not finite, and a figure would be void. Report this with the command."
        )
    out.facts = {
        "nworld": nworld,
        "iterations": iterations,
        "block_dim": block_dim,
        "gain": gain,
        "reached": float((~ik.unreachable).float().mean()),
    }
    return out


def _problem(cfg: Config, ik: "BatchedIk") -> tuple[torch.Tensor, torch.Tensor]:
    """Home in every world, and grasp points within 0.5 rad of it.

    Shapes ``(nworld, n)`` and ``(nworld, 3)``.
    """
    robot = cfg.robot
    names = robot.joints
    home = torch.tensor(robot.home).repeat(ik.nworld, 1)
    moved = [names.index(name) for name in robot.ik_joints]
    away = home.clone()
    away[:, moved] += (
        torch.rand((ik.nworld, len(moved)), generator=torch.Generator().manual_seed(0)) - 0.5
    )
    return home.to(ik.device), ik.forward(away.to(ik.device))[0].clone()


def _time(work: Callable[[], None], device: str, repetitions: int) -> list[float]:
    """Milliseconds per solve of each repetition; one before them warms up."""
    wait = partial(torch.cuda.synchronize, device) if device.startswith("cuda") else lambda: None
    times = []
    for _ in range(repetitions + 1):
        wait()
        began = time.perf_counter()
        work()
        wait()
        times.append(1e3 * (time.perf_counter() - began) / SOLVES)
    return times[1:]
