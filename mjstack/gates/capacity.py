"""Gate *capacity*: are the buffers large enough for the whole episode?"""

from __future__ import annotations

import math

import numpy as np

from mjstack.errors import name_worlds
from mjstack.gates.gate import GateContext
from mjstack.report.record import GateResult, Status, Value
from mjstack.sim import LOST_PHYSICS, Overflow, describe_overflow, resolve_sizes

_MARGIN = 1.25  # of the recommended sizes over the peaks


def run_capacity(context: GateContext) -> list[GateResult]:
    """Plays the task and holds the peaks of contacts and constraint rows against nconmax and njmax."""
    cfg = context.cfg
    on_cuda = context.backend[1].startswith("cuda")
    nworld = cfg.nworld if on_cuda else min(cfg.nworld, cfg.gate.capacity.cpu_nworld)
    sizes = resolve_sizes(cfg)
    sim = context.batch_simulation(nworld)
    context.run(sim, cfg.reset)
    contacts, rows = sim.peak_contacts.cpu().numpy(), sim.peak_constraints.cpu().numpy()
    overflow = sim.overflow.cpu().numpy() & LOST_PHYSICS
    # The contact pool is shared. MJWarp counts what all worlds hold at once; the sum of the worlds' peaks bounds it.
    pool = getattr(sim, "peak_pool", None)
    used, pairs = (int(contacts.sum()), None) if pool is None else (int(pool[0]), int(pool[1]))
    share = sizes.contact_pool(cfg.nworld) / cfg.nworld

    problems: list[str] = []
    over = np.flatnonzero((rows > sizes.njmax) | (overflow & int(Overflow.NEFC | Overflow.NJMAX_NNZ) != 0)).tolist()
    if over:
        problems.append(
            f"njmax overflow in {name_worlds(over, nworld)}; njmax={sizes.njmax}, most needed {rows.max()}. "
            f"Raise it: batch.njmax={_recommend(int(rows.max()))}"
        )
    need = max(used, pairs or 0) / nworld
    pool_fix = (
        f"batch.nconmax={_recommend(math.ceil(need))}"
        if sizes.naconmax is None
        else f"batch.naconmax={_recommend(math.ceil(need * cfg.nworld))}"
    )
    lost = overflow & int(Overflow.NARROWPHASE | Overflow.BROADPHASE)
    if need > share or lost.any():
        worlds = np.flatnonzero((contacts > share) | (lost != 0)).tolist()
        problems.append(
            f"contact pool overflow in {name_worlds(worlds, nworld)}; {share:g} per world, {need:.0f} needed. "
            f"Raise it: {pool_fix}"
        )
    rest = overflow & ~int(Overflow.NEFC | Overflow.NJMAX_NNZ | Overflow.NARROWPHASE | Overflow.BROADPHASE)
    if rest.any():
        names = describe_overflow(int(np.bitwise_or.reduce(rest)))
        key = "batch.nccdmax" if sizes.naccdmax is None else "batch.naccdmax"
        fix = f"Raise {key}" if "CCD" in names else "Simplify the model, or run sim=native"
        problems.append(f"{names} overflow in {name_worlds(np.flatnonzero(rest).tolist(), nworld)}. {fix}")
    metrics: dict[str, Value] = {
        "backend": sim.description,
        "worlds": nworld,
        "peak_contacts_per_world": int(contacts.max()),
        "pool_contacts": used,
        "pool_pairs": pairs,
        "peak_constraint_rows_per_world": int(rows.max()),
        "recommended.nconmax": _recommend(math.ceil(need)),
        "recommended.njmax": _recommend(int(rows.max())),
    }
    if pairs is None:
        metrics["pool_pairs"] = "not counted by native MuJoCo"
    sim.close()
    summary = "; ".join(problems) or (
        f"{contacts.max()} of {share:g} contacts, {rows.max()} of {sizes.njmax} rows, at most, in {nworld} worlds"
    )
    return [
        GateResult(
            name="capacity",
            status=Status.failed if problems else Status.passed,
            reason=summary,
            thresholds={"contacts_per_world": share, "njmax": sizes.njmax},
            metrics=metrics,
        )
    ]


def _recommend(peak: int) -> int:
    """The peak with a margin, rounded up to a multiple of 8."""
    return max(8, 8 * math.ceil(_MARGIN * peak / 8))
