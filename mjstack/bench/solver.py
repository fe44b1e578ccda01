"""The fused Newton solver beside ``mujoco_warp.solve``, on recorded states, and both beside native
MuJoCo.

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

import copy
from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np
import torch

from mjstack.bench.pipeline import FUSED, SOLVERS, STOCK, VECTORS, Pipeline
from mjstack.bench.states import Sample, record_states
from mjstack.config.schema import Backend
from mjstack.episodes.context import RunContext
from mjstack.report.table import Table
from mjstack.sim import SolverLimit, resolve_device
from mjstack.sim.native import NativeSimulation
from mjstack.sim.sizes import resolve_env_sizes

TOLERANCES = "cost, in tolerances"  # its change
AGREEMENT = 1e-3  # relative difference of the two solvers
_QUANTILES = (0.5, 0.99, 1.0)
_ENDS = "median / 99 % / largest"
_FLOOR = 0.01  # of an error's scale, of the smooth vector's
_SAME_ROWS = 1e-3  # of the largest residual
_LISTED = 20  # states that differ by more
_REFERENCE = {"tolerance": 1e-12, "ls_tolerance": 1e-10, "iterations": 1000, "ls_iterations": 200}
Numbers = dict[str, np.ndarray]


def compare_solvers(context: RunContext, *, states: int) -> Numbers:
    """Record states, and solve each with both solvers and with native MuJoCo.

    Args:
        context: The configuration; its worlds run on MJWarp, with room for random actions where the
            sizes are not configured.
        states: How many states to record at least, half in scripted episodes, half under random
            actions.

    Returns:
        Numbers of every state, by name, each of shape ``(states,)``.

    Raises:
        MjstackError: The fused solver does not cover the model.
    """
    from mjstack.sim.mjwarp import MjwarpSimulation  # loads Warp

    cfg = context.cfg
    device = resolve_device(cfg.sim.device)
    sim = context.simulation(cfg.nworld, Backend.mjwarp, device, sizes=resolve_env_sizes(cfg))
    assert isinstance(sim, MjwarpSimulation)
    pipeline = Pipeline(sim)
    samples = record_states(context, sim, states)
    model = copy.copy(context.model)
    for name, value in _REFERENCE.items():
        setattr(model.opt, name, value)
    native = NativeSimulation(model, sim.nworld, fields=tuple(sim.fields))
    parts = []
    for number, sample in enumerate(samples):
        part = _compare(pipeline, native, sample)
        parts.append({"sample": np.full(sim.nworld, number), **part})
        context.advance("samples", number + 1, len(samples))
    native.close()
    sim.close()
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _compare(pipeline: Pipeline, native: NativeSimulation, sample: Sample) -> Numbers:
    """The numbers of a sample's states."""
    void = pipeline.prepare(sample).cpu().numpy()
    smooth = {name: _float(pipeline.array(floor)) for name, floor in VECTORS.items()}
    trace = _float(pipeline.inertia().diagonal(dim1=1, dim2=2).sum(1))
    tolerance = _float(pipeline.tolerance)
    found = {solver: pipeline.solve(solver) for solver in SOLVERS}
    costs = [_float(pipeline.cost(result["qacc"])) for result in found.values()]
    residuals = _float(pipeline.residuals(pipeline.array("qacc_smooth")))
    expected = solve_natively(native, sample, residuals.shape[1])
    rows = pipeline.array("nefc").cpu().numpy()
    used = np.arange(residuals.shape[1]) < rows[:, None]
    other = _differ(np.where(used, residuals, np.inf), expected["residuals"])
    out: Numbers = {
        "world": np.arange(len(void)),
        "kind": sample.kind,
        "void": void,
        "other rows": (expected["nefc"][:, 0] != rows) | other,
    }

    # One beside the other
    stock, fused = found.values()
    for name in VECTORS:
        out[f"{name}, difference"] = _distance(
            _float(fused[name]), _float(stock[name]), smooth[name]
        )
    out["difference"] = np.max([out[f"{name}, difference"] for name in VECTORS], axis=0)
    most = used.shape[1]
    force, expected_force = (
        np.where(used, _float(r["efc.force"][:, :most]), 0) for r in (fused, stock)
    )
    out["efc.force"] = _distance(force, expected_force, np.zeros_like(force))
    differ = (fused["efc.state"] != stock["efc.state"]).cpu().numpy()
    out["efc.state"] = np.any(differ[:, :most] & used, axis=1)
    change = np.nan_to_num(costs[1] - costs[0], nan=np.inf)
    out["cost"] = change / np.maximum(costs[0], trace)
    out[TOLERANCES] = change / (trace * tolerance)

    # Each beside native MuJoCo, and its way
    for solver, result in found.items():
        for name, floor in VECTORS.items():
            error = _distance(_float(result[name]), expected[name], expected[floor])
            out[f"{name}, {solver}"] = error
        out[f"iterations, {solver}"] = result["solver_niter"].cpu().numpy()
        bits = result["overflow"].cpu().numpy()
        for bit in SolverLimit:
            out[f"{bit.name}, {solver}"] = np.not_equal(bits & bit.value, 0)
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
    batch = native.batch
    model = copy.copy(native.model)
    data = mujoco.MjData(model)
    finite = torch.cat([native.qpos, native.qvel, native.act], dim=1).isfinite().all(1)
    for world in finite.nonzero().ravel().tolist():
        batch.get_model(world, model)
        batch.get_data(world, data)
        mujoco.mj_forward(model, data)
        for name, found in out.items():
            found[world] = getattr(data, name)
        product = np.empty(data.nefc)
        mujoco.mj_mulJacVec(model, data, product, data.qacc_smooth)
        product -= data.efc_aref
        residuals[world, : len(product)] = product[:most]
    return {**out, "residuals": residuals}


def _differ(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Worlds whose residuals are not the same in any order: they have other contacts."""
    found = np.sort(found)
    expected = np.sort(expected)
    scale = np.max(abs(expected), axis=1, where=np.isfinite(expected), initial=0)
    with np.errstate(invalid="ignore"):  # infinite ones are equal
        same = (found == expected) | (abs(found - expected) <= _SAME_ROWS * scale[:, None])
    return ~same.all(1)


def _float(values: torch.Tensor) -> np.ndarray:
    return values.double().cpu().numpy()


def _distance(found: np.ndarray, expected: np.ndarray, smooth: np.ndarray) -> np.ndarray:
    """Relative errors of each world's vector; infinite where it is not finite."""
    scale = np.maximum(abs(expected), _FLOOR * abs(smooth)).max(1)
    error = abs(found - expected).max(1) / np.maximum(scale, np.finfo(np.float32).tiny)
    return np.nan_to_num(error, nan=np.inf)


def report(numbers: Numbers) -> list[Table]:
    """Figures by kind of state, and a list of the states in which the two solvers differ most."""
    kinds = list(dict.fromkeys(numbers["kind"].tolist()))
    of_kind = [{k: v[numbers["kind"] == kind] for k, v in numbers.items()} for kind in kinds]
    columns = [_figures(part) for part in (*of_kind, numbers)]
    rows = [[name, *(figures[name] for figures in columns)] for name in columns[-1]]
    tables = [Table(header=["", *kinds, "all"], rows=rows)]
    differing = np.flatnonzero(~numbers["void"] & ~(numbers["difference"] <= AGREEMENT))
    worst = differing[np.argsort(-numbers["difference"][differing], kind="stable")][:_LISTED]
    if len(worst):
        pairs = [f"{name}, {solver}" for name in (*VECTORS, "iterations") for solver in SOLVERS]
        names = ["sample", "world", "kind", "difference", *pairs, TOLERANCES]
        records = [{name: numbers[name][state].item() for name in names} for state in worst]
        title = f"states that differ by more than {AGREEMENT:g}: {len(differing)}"
        tables.append(Table.of(dict(zip(names, names, strict=True)), records, title))
    return tables


def _figures(numbers: Numbers) -> dict[str, str]:
    """Figures of some states, as text by name."""
    kept = {name: values[~numbers["void"]] for name, values in numbers.items()}
    alike = {name: values[~kept["other rows"]] for name, values in kept.items()}
    out = {
        "states": f"{len(numbers['void']):,}",
        "void: not finite, or a buffer too small": str(numbers["void"].sum()),
        "not compared with native: other rows there": str(kept["other rows"].sum()),
    }
    if not len(alike["void"]):
        return defaultdict(lambda: "-", out)
    for name in VECTORS:
        ends = {solver: _ends(alike[f"{name}, {solver}"]) for solver in SOLVERS}
        for solver in SOLVERS:
            out[f"{name}, error of {solver}: {_ENDS}"] = _join(ends[solver], ".2g")
        ratio = ends[FUSED] / ends[STOCK]
        out[f"{name}, ratio of the errors (wanted: at most 1.2)"] = _join(ratio, ".3g")
    for name in ("efc.force", *(f"{vector}, difference" for vector in VECTORS)):
        out[f"{name.split(',')[0]}, between the solvers: {_ENDS}"] = _join(_ends(kept[name]), ".2g")
    for name in VECTORS:
        agree = (kept[f"{name}, difference"] <= AGREEMENT).mean()
        out[f"{name} agrees within {AGREEMENT:g} (wanted: 99.9 %)"] = f"{100 * agree:.3f} %"
    change = kept[TOLERANCES][~(kept["difference"] <= AGREEMENT)]
    edge = (abs(change) <= 1).sum()
    out["do not agree / costs within the tolerance"] = f"{len(change)} / {edge}"
    out["efc.state of a row differs"] = str(kept["efc.state"].sum())
    out["cost, worst change (wanted: at most 1e-05)"] = f"{kept['cost'].max():+.2g}"
    for bit in SolverLimit:
        stock, fused = (kept[f"{bit.name}, {solver}"] for solver in SOLVERS)
        counts = (stock, fused, stock != fused)
        out[f"limit {bit.name}: {STOCK} / {FUSED} / differ"] = _join([c.sum() for c in counts], "d")
    for solver in SOLVERS:
        count = kept[f"iterations, {solver}"]
        out[f"iterations, {solver}: mean / largest"] = f"{count.mean():.3f} / {count.max()}"
    return out


def _ends(values: np.ndarray) -> np.ndarray:
    return np.quantile(
        values, _QUANTILES, method="higher"
    )  # the mean of two may be of an infinite one


def _join(values: Iterable[Any], form: str) -> str:
    return " / ".join(format(value, form) for value in values)
