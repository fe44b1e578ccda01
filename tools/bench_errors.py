"""Compare a whole step's accelerations and forces with native MuJoCo's, for mjstack's step and a
bare ``mujoco_warp.step``, on recorded states.

    python tools/bench_errors.py --config-dir vs050/conf robot=vs050 nworld=1024 --states 20000
    python tools/bench_errors.py robot=so101 nworld=16 sim.device=cpu --states 500

Both steps get the same states, and compute poses, contacts, rows and forces anew. Native MuJoCo
does so in float64, its solver to 1e-12. Errors are as in tools/bench_solver.py. States in which
one of the three has another number of rows, as by a contact at the margin, are not compared. A
bare step makes rows of *connect* and *weld* with the velocities of the step before: it gets those
of this state first, so that the figures are of rounding.
"""

import argparse
from collections.abc import Iterator

import numpy as np
import torch
from bench_solver import distance, join, quantiles, record, solve_natively, to_numpy
from common import count, make_parser, run
from solver_states import SOLVERS, STOCK, VECTORS, Sample

from mjstack.config.schema import Config
from mjstack.envs.buffers import Advance
from mjstack.math import not_finite
from mjstack.report.table import Table
from mjstack.sim import LOST_PHYSICS
from mjstack.sim.fused.step import prepare_stock, rearranged_forward
from mjstack.sim.mjwarp import MjwarpSimulation
from mjstack.sim.mujoco_warp import mjw, torch_stream_scope, wp

_COMPARED = {**VECTORS, **{floor: floor for floor in VECTORS.values()}}
_CONVERGED = 1e-8  # the tolerance that float32 can still tell


def measure(args: argparse.Namespace, cfg: Config, advance: Advance) -> Iterator[Table]:
    """Record states, make each step from them, and report errors."""
    sim, samples, native = record(args, cfg, advance)
    if args.converge:
        assert sim.solver_tolerance is not None
        sim.solver_tolerance.fill_(_CONVERGED)
    errors: dict[str, list[np.ndarray]] = {}
    other = void = 0
    for number, sample in enumerate(samples):
        steps = {name: forward(sim, sample, stock=name == STOCK) for name in SOLVERS}
        expected = solve_natively(native, sample, 1)
        lost = np.any([values["lost"] for values in steps.values()], axis=0)
        rows = [values["nefc"] != expected["nefc"][:, 0] for values in steps.values()]
        differ = np.any(rows, axis=0) & ~lost
        void, other = void + int(lost.sum()), other + int(differ.sum())
        for step, values in steps.items():
            for name, floor in _COMPARED.items():
                error = distance(values[name], expected[name], expected[floor])
                errors.setdefault(f"{name}, {step}", []).append(error[~lost & ~differ])
        advance("samples", number + 1, len(samples))
    native.close()
    sim.close()
    joined = {name: np.concatenate(parts) for name, parts in errors.items()}
    table = {name: quantiles(part) if len(part) else np.array([]) for name, part in joined.items()}
    states = len(samples) * sim.nworld
    yield Table(
        title=f"{cfg.robot.title}, {cfg.task.name}: {states:,} states, {void} void,"
        f" {other} with another number of rows; {sim.plan}",
        header=["error: median / 99 % / largest", *SOLVERS, "ratio"],
        rows=[
            [
                name,
                *(join(table[f"{name}, {step}"], ".2g") for step in SOLVERS),
                join(table[f"{name}, {SOLVERS[1]}"] / table[f"{name}, {STOCK}"], ".3g"),
            ]
            for name in _COMPARED
        ],
    )


def forward(sim: MjwarpSimulation, sample: Sample, *, stock: bool) -> dict[str, np.ndarray]:
    """Vectors of a step from a sample, the rows of each world, and whether it was lost."""
    d = sim._d
    for name, values in sample.state.items():
        wp.to_torch(getattr(d, name)).copy_(values)
    for name, values in sample.fields.items():
        sim.fields[name].copy_(values)
    overflow = wp.to_torch(d.overflow).zero_()
    with torch_stream_scope(sim._device):
        sim._place()
        if stock:
            prepare_stock(sim._m, d)
            mjw.forward(sim._m, d)
        else:
            rearranged_forward(sim._stepped, d, sim.device, sim.plan, sensors=False)
    pool = torch.maximum(wp.to_torch(d.nacon), wp.to_torch(d.ncollision))
    nefc = wp.to_torch(d.nefc)
    lost = ((overflow & LOST_PHYSICS) != 0) | (nefc > d.njmax) | (pool > d.naconmax)
    out = {name: to_numpy(wp.to_torch(getattr(d, name))) for name in _COMPARED}
    lost |= not_finite(*sample.state.values())
    return {**out, "nefc": nefc.cpu().numpy(), "lost": lost.cpu().numpy()}


if __name__ == "__main__":
    parser = make_parser(__doc__)
    words = "to record at least, half in scripted episodes, half under random actions"
    parser.add_argument("--states", type=count, default=20_000, help=words)
    words = "let both solvers go on: where they stop below the model's tolerance is chance"
    parser.add_argument("--converge", action="store_true", help=words)
    run(parser, measure)
