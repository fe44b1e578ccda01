"""Compare the fused solver with ``mujoco_warp.solve`` and native MuJoCo, on recorded states.

    COLUMNS=240 python tools/bench_solver.py nworld=2048 batch.njmax=768 --states 20000

Both solvers get the same inputs, in place on the device. Native MuJoCo solves the same states in
float64, to 1e-12.

An error is the largest difference of a world's vector over the largest element of the reference's
vector. Where the reference's is next to nothing, as the acceleration of a world at rest, it is a
difference of far larger terms, which float32 rounds. So the scale is at least a hundredth of the
smooth vector's largest element (qacc_smooth, qfrc_smooth). States in which native MuJoCo has other
rows, such as a contact at the margin's edge or another axis of two boxes, are not compared with it.

A cost is that of a solver's qacc in MJWarp's rows, computed in float64. Its change is relative to
the cost with ``mujoco_warp.solve``, or to the trace of the inertia where that is larger: the unit
of the solver's tolerance. Of two results at the tolerance's edge one is an iteration behind, and
their costs differ by about the tolerance or less.
"""

import argparse
import copy
from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import Any

import mujoco
import numpy as np
import torch
from common import count, make_parser, run
from solver_states import FUSED, SOLVERS, STOCK, VECTORS, Pipeline, Sample, record_states

from mjstack.config.schema import Backend, Config
from mjstack.envs.buffers import Advance
from mjstack.episodes.stage import Progress, Stage
from mjstack.report.table import Table
from mjstack.sim import SolverLimit, resolve_device
from mjstack.sim.mjwarp import MjwarpSimulation
from mjstack.sim.native import NativeSimulation
from mjstack.sim.sizes import resolve_sizes

TOLERANCES = "cost, in tolerances"  # its change
AGREEMENT = 1e-3  # relative difference of the two solvers
_QUANTILES = (0.5, 0.99, 1.0)
_ENDS = "median / 99 % / largest"
_FLOOR = 0.01  # of an error's scale, of the smooth vector's
_SAME_ROWS = 1e-3  # of the largest residual
_REFERENCE = {"tolerance": 1e-12, "ls_tolerance": 1e-10, "iterations": 1000, "ls_iterations": 200}
Numbers = dict[str, np.ndarray]
"""Numbers of every state, by name, each of shape ``(states,)``."""


def measure(args: argparse.Namespace, cfg: Config, advance: Advance) -> Iterator[Table]:
    """Record states, solve each with both solvers and with native MuJoCo, and report."""
    sim, samples, native = record(args, cfg, advance)
    pipeline = Pipeline(sim)
    parts = []
    for number, sample in enumerate(samples):
        parts.append(compare(pipeline, native, sample))
        advance("samples", number + 1, len(samples))
    native.close()
    sim.close()
    numbers = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    title = f"solvers: {cfg.task.name}, {cfg.robot.title}, {cfg.nworld:,} worlds"
    yield report(numbers, title)


def record(
    args: argparse.Namespace, cfg: Config, advance: Advance
) -> tuple[MjwarpSimulation, list[Sample], NativeSimulation]:
    """MJWarp's worlds, states that they recorded, and native worlds whose solver converges."""
    stage = Stage(cfg, progress=Progress(advance=advance))
    device = resolve_device(cfg.sim.device)
    sim = stage.simulation(
        cfg.nworld, Backend.mjwarp, device, sizes=resolve_sizes(cfg, driven=False)
    )
    assert isinstance(sim, MjwarpSimulation)
    samples = record_states(stage, sim, args.states)
    model = copy.copy(stage.model)
    for name, value in _REFERENCE.items():
        setattr(model.opt, name, value)
    return sim, samples, NativeSimulation(model, sim.nworld, fields=tuple(sim.fields))


def compare(pipeline: Pipeline, native: NativeSimulation, sample: Sample) -> Numbers:
    """The numbers of a sample's states."""
    void = pipeline.prepare(sample).cpu().numpy()
    smooth = {name: to_numpy(pipeline.array(floor)) for name, floor in VECTORS.items()}
    trace = to_numpy(pipeline.inertia().diagonal(dim1=1, dim2=2).sum(1))
    tolerance = to_numpy(pipeline.tolerance)
    results = {solver: pipeline.solve(solver) for solver in SOLVERS}
    costs = [to_numpy(pipeline.cost(result["qacc"])) for result in results.values()]
    residuals = to_numpy(pipeline.residuals(pipeline.array("qacc_smooth")))
    expected = solve_natively(native, sample, residuals.shape[1])
    rows = pipeline.array("nefc").cpu().numpy()
    used = np.arange(residuals.shape[1]) < rows[:, None]
    out: Numbers = {"kind": np.full(len(void), sample.kind), "void": void}
    out["other rows"] = (expected["nefc"][:, 0] != rows) | have_other_contacts(
        np.where(used, residuals, np.inf), expected["residuals"]
    )

    # The two solvers beside each other
    stock, fused = ({k: to_numpy(v) for k, v in result.items()} for result in results.values())
    for name in VECTORS:
        out[f"{name}, difference"] = distance(fused[name], stock[name], smooth[name])
    out["difference"] = np.max([out[f"{name}, difference"] for name in VECTORS], axis=0)
    most = used.shape[1]
    forces = [np.where(used, result["efc.force"][:, :most], 0) for result in (fused, stock)]
    out["efc.force"] = distance(*forces, np.zeros_like(forces[0]))
    states = [result["efc.state"][:, :most] for result in (fused, stock)]
    out["efc.state"] = np.any((states[0] != states[1]) & used, axis=1)
    change = np.nan_to_num(costs[1] - costs[0], nan=np.inf)
    out["cost"] = change / np.maximum(costs[0], trace)
    out[TOLERANCES] = change / (trace * tolerance)

    # Each solver beside native MuJoCo, its iterations and its limits
    for solver, result in ((STOCK, stock), (FUSED, fused)):
        for name, floor in VECTORS.items():
            out[f"{name}, {solver}"] = distance(result[name], expected[name], expected[floor])
        out[f"iterations, {solver}"] = result["solver_niter"].astype(int)
        for bit in SolverLimit:
            out[f"{bit.name}, {solver}"] = (result["overflow"].astype(int) & bit.value) != 0
    return out


def solve_natively(native: NativeSimulation, sample: Sample, most: int) -> Numbers:
    """Native MuJoCo's vectors and number of rows of each world of a sample, by name, each of shape
    ``(nworld, n)``, NaN where a state is not finite; and the residuals of at most so many rows
    under the smooth acceleration, infinite beyond them.
    """
    for name, values in sample.state.items():
        getattr(native, name).copy_(values)
    for name, values in sample.fields.items():
        native.fields[name].copy_(values)
    native.forward()  # derives from the fields what a simple body's inertia needs
    nv = native.model.nv
    names = dict.fromkeys((*VECTORS, *VECTORS.values()), nv) | {"nefc": 1}
    out = {name: np.full((native.nworld, size), np.nan) for name, size in names.items()}
    residuals = np.full((native.nworld, most), np.inf)
    model = copy.copy(native.model)
    data = mujoco.MjData(model)
    finite = torch.cat([native.qpos, native.qvel, native.act], dim=1).isfinite().all(1)
    for world in finite.nonzero().ravel().tolist():
        native.batch.get_model(world, model)
        native.batch.get_data(world, data)
        mujoco.mj_forward(model, data)
        for name, values in out.items():
            values[world] = getattr(data, name)
        product = np.empty(data.nefc)
        mujoco.mj_mulJacVec(model, data, product, data.qacc_smooth)
        product -= data.efc_aref
        residuals[world, : len(product)] = product[:most]
    return {**out, "residuals": residuals}


def have_other_contacts(residuals: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Worlds whose residuals are not the same in any order."""
    residuals = np.sort(residuals)
    expected = np.sort(expected)
    scale = np.max(abs(expected), axis=1, where=np.isfinite(expected), initial=0)
    with np.errstate(invalid="ignore"):  # infinite ones are equal
        near = abs(residuals - expected) <= _SAME_ROWS * scale[:, None]
    return ~((residuals == expected) | near).all(1)


def to_numpy(values: torch.Tensor) -> np.ndarray:
    """In float64, on the host."""
    return values.double().cpu().numpy()


def distance(values: np.ndarray, expected: np.ndarray, smooth: np.ndarray) -> np.ndarray:
    """Relative errors of each world's vector; infinite where it is not finite."""
    scale = np.maximum(abs(expected), _FLOOR * abs(smooth)).max(1)
    error = abs(values - expected).max(1) / np.maximum(scale, np.finfo(np.float32).tiny)
    return np.nan_to_num(error, nan=np.inf)


def report(numbers: Numbers, title: str) -> Table:
    """Figures by kind of state, and of all states."""
    kinds = list(dict.fromkeys(numbers["kind"].tolist()))
    parts = [{k: v[numbers["kind"] == kind] for k, v in numbers.items()} for kind in kinds]
    columns = [summarise(part) for part in (*parts, numbers)]
    rows = [[name, *(figures[name] for figures in columns)] for name in columns[-1]]
    return Table(title=title, header=["", *kinds, "all"], rows=rows)


def summarise(numbers: Numbers) -> dict[str, str]:
    """Figures of some states, as text by name."""
    valid = {name: values[~numbers["void"]] for name, values in numbers.items()}
    alike = {name: values[~valid["other rows"]] for name, values in valid.items()}
    out = {
        "states": f"{len(numbers['void']):,}",
        "void: not finite, or a buffer too small": str(numbers["void"].sum()),
        "not compared with native: other rows there": str(valid["other rows"].sum()),
    }
    if not len(alike["void"]):
        return defaultdict(lambda: "-", out)
    for name in VECTORS:
        ends = {solver: quantiles(alike[f"{name}, {solver}"]) for solver in SOLVERS}
        for solver in SOLVERS:
            out[f"{name}, error of {solver}: {_ENDS}"] = join(ends[solver], ".2g")
        ratio = ends[FUSED] / ends[STOCK]
        out[f"{name}, ratio of the errors (at most 1.2)"] = join(ratio, ".3g")
    for name in ("efc.force", *(f"{vector}, difference" for vector in VECTORS)):
        label = f"{name.split(',')[0]}, between the solvers: {_ENDS}"
        out[label] = join(quantiles(valid[name]), ".2g")
    for name in VECTORS:
        agree = (valid[f"{name}, difference"] <= AGREEMENT).mean()
        out[f"{name} agrees within {AGREEMENT:g} (99.9 %)"] = f"{100 * agree:.3f} %"
    change = valid[TOLERANCES][~(valid["difference"] <= AGREEMENT)]
    edge = (abs(change) <= 1).sum()
    out["do not agree / costs within the tolerance"] = f"{len(change)} / {edge}"
    out["efc.state of a row differs"] = str(valid["efc.state"].sum())
    out["cost, worst change (at most 1e-05)"] = f"{valid['cost'].max():+.2g}"
    for bit in SolverLimit:
        stock, fused = (valid[f"{bit.name}, {solver}"] for solver in SOLVERS)
        counts = [values.sum() for values in (stock, fused, stock != fused)]
        out[f"limit {bit.name}: {STOCK} / {FUSED} / differ"] = join(counts, "d")
    for solver in SOLVERS:
        iterations = valid[f"iterations, {solver}"]
        out[f"iterations, {solver}: mean / largest"] = (
            f"{iterations.mean():.3f} / {iterations.max()}"
        )
    return out


def quantiles(values: np.ndarray) -> np.ndarray:
    """Median, 99 % and largest. The mean of two may be of an infinite one."""
    return np.quantile(values, _QUANTILES, method="higher")


def join(values: Iterable[Any], form: str) -> str:
    """Numbers in a cell."""
    return " / ".join(format(value, form) for value in values)


if __name__ == "__main__":
    parser = make_parser(__doc__)
    words = "to record at least, half in scripted episodes, half under random actions"
    parser.add_argument("--states", type=count, default=20_000, help=words)
    run(parser, measure)
