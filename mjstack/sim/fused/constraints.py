"""Collision, contact rows and MuJoCo's Newton solver, each in fewer or better filled launches than
MJWarp's own.
"""

import dataclasses
from functools import partial
from typing import Any

import mujoco
import numpy as np

from mjstack.sim.clearance import find_separate
from mjstack.sim.fused.launch import SHARED_BYTES, arguments, launch, padded_rows
from mjstack.sim.graph import side_by_side
from mjstack.sim.mujoco_warp import mjw, wp

MAX_NV = 64
_WARP_ROWS = 320  # room for so many: a warp does each world
_FEW_ROWS = 128  # in a larger room a warp does worlds with so many, and a team those with more
_TEAM = 4  # warps
_TEAM_NV = 31  # a larger factorization is one warp's


def why_not(m: mjw.Model, d: mjw.Data) -> str:
    """Why `solve` does not apply to a model; empty if it does."""
    opt = m.opt
    size = shared_bytes(m.nv, d.efc.J.shape[2], padded_rows(d.njmax))
    shared = f"bytes of shared memory, of {SHARED_BYTES:,}"
    reasons = {
        "the solver is not Newton's": opt.solver != mjw.SolverType.NEWTON,
        "the Jacobian is sparse": m.is_sparse,
        f"nv is {m.nv}, expected 1 to {MAX_NV}": not 0 < m.nv <= MAX_NV,
        "there is no room for constraint rows": not d.njmax,
        f"{d.njmax} rows need {size:,} {shared}": size > SHARED_BYTES,
        "noslip is on": opt.noslip_iterations > 0,
        "bodies may sleep": int(opt.enableflags) & mujoco.mjtEnableBit.mjENBL_SLEEP,
        "qacc_smooth is not computed": not opt.run_qacc_smooth,
        "the integrator is discrete": opt.integrator == mjw.IntegratorType.DISCRETE,
    }
    return "; ".join(reason for reason, applies in reasons.items() if applies)


def shared_bytes(nv: int, row: int, njmax: int) -> int:
    """Shared memory of a world [bytes]: the arrays at the head of newton.cpp."""
    team, chunk = (_TEAM, 64) if nv <= _TEAM_NV else (1, 32)
    floats = (nv + 1) * (nv | 1) + max((chunk + 2) * row, 512) + 4 * nv + 5 * njmax + 11 * team
    return 4 * floats + 8 * njmax


def without_far_pairs(model: mujoco.MjModel, m: mjw.Model) -> mjw.Model:
    """The model without the pairs of geoms that are proved to be apart in every posture."""
    pairs, numbers = m.nxn_geom_pair_filtered.numpy(), m.nxn_pairid_filtered.numpy()
    if m.opt.broadphase != mjw.BroadphaseType.NXN:
        return m
    listed = (numbers != -1).any(axis=1)  # a pair of the file, or of a sensor
    listed[~listed] = ~find_separate(model, pairs[~listed])
    kinds = np.sort(model.geom_type[pairs[listed]], axis=1)
    count = np.zeros(len(m.geom_pair_type_count), dtype=int)
    index = [mjw._src.math.upper_trid_index(len(mjw.GeomType), *kind) for kind in kinds.tolist()]
    np.add.at(count, index, 1)
    return dataclasses.replace(
        m,
        nxn_geom_pair_filtered=wp.array(pairs[listed], dtype=wp.vec2i),
        nxn_pairid_filtered=wp.array(numbers[listed], dtype=wp.vec2i),
        geom_pair_type_count=tuple(count.tolist()),
    )


def convex_pairs(m: mjw.Model) -> list[tuple[mjw.GeomType, mjw.GeomType]]:
    """Pairs of types of geoms that the model has, and that are none of primitive shapes."""
    table = mjw._src.collision_driver.MJ_COLLISION_TABLE
    primitive = mjw._src.collision_primitive._PRIMITIVE_COLLISIONS
    return [types for types in table if types not in primitive and _count(m, types)]


def _count(m: mjw.Model, types: tuple[mjw.GeomType, mjw.GeomType]) -> int:
    """Number of pairs of geoms of these types."""
    first, second = (kind.value for kind in types)
    return m.geom_pair_type_count[mjw._src.math.upper_trid_index(len(mjw.GeomType), first, second)]


def collision(m: mjw.Model, d: mjw.Data) -> None:
    """`mujoco_warp.collision`, kinds of pairs as parallel branches, the narrow phase of primitive
    shapes by blocks that go from pair to pair.

    MJWarp launches a thread for each contact that the buffer has room for. The kernel's 255
    registers leave room for one block on a multiprocessor, and most blocks find nothing to do. The
    same kernel is launched here in few blocks. What models rarely have is left to MJWarp.
    """
    off = mjw.DisableBit
    flags = m.opt.disableflags
    if (
        flags & (off.CONSTRAINT | off.CONTACT)
        or not flags & off.NATIVECCD
        or not d.naconmax
        or m.opt.deterministic
        or m.has_sdf_geom
        or m.flg_surfacevel
    ):
        mjw.collision(m, d)
        return

    context = broad_phase(m, d)
    # Each kind of pairs has separate temporaries and counts, and contacts are of no order
    narrow = mjw._src.collision_convex.convex_narrowphase
    works = [partial(narrow, m, d, context, [types]) for types in convex_pairs(m)]
    works.append(partial(primitive_pairs, m, d, context))
    side_by_side(wp.device_to_torch(d.qpos.device), *works)


def broad_phase(m: mjw.Model, d: mjw.Data) -> Any:
    """List pairs of geoms that may touch, in the context that is returned."""
    context = mjw._src.collision_core.create_collision_context(d.naconmax)
    d.ncollision.zero_()
    d.nacon.zero_()
    simple = m.opt.broadphase == mjw.BroadphaseType.NXN
    (mjw.nxn_broadphase if simple else mjw.sap_broadphase)(m, d, context)
    return context


def primitive_pairs(m: mjw.Model, d: mjw.Data, context: Any) -> None:
    """Contacts of pairs of primitive shapes, by a kernel for the types that the model has."""
    source = mjw._src
    functions = {
        types: function
        for types, function in source.collision_primitive._PRIMITIVE_COLLISIONS.items()
        if _count(m, types)
    }
    kernel = source.collision_primitive._primitive_narrowphase([*functions], [*functions.values()])
    device = d.qpos.device
    blocks = {"block_dim": 64, "max_blocks": 16 * device.sm_count} if device.is_cuda else {}
    inputs = [*arguments(kernel, m, d, context)]
    wp.launch(kernel, dim=d.naconmax, inputs=inputs, device=device, **blocks)


def why_not_rows(m: mjw.Model) -> str:
    """Why MJWarp writes the rows of contacts, and not `contact_rows`; empty if it does not."""
    if m.opt.cone != mjw.ConeType.ELLIPTIC:
        return "cones are pyramidal"
    return "surfaces move" if m.flg_surfacevel else ""


def noncontact_rows(m: mjw.Model, d: mjw.Data) -> None:
    """`mujoco_warp.make_constraint` without the rows of contacts, so it need not wait for them."""
    flags = int(m.opt.disableflags) | int(mjw.DisableBit.CONTACT)
    opt = dataclasses.replace(m.opt, disableflags=flags)
    mjw.make_constraint(dataclasses.replace(m, opt=opt), d)


def contact_rows(m: mjw.Model, d: mjw.Data) -> None:
    """Add the rows of a dense model's elliptic contacts to the others, in one launch."""
    if m.opt.disableflags & (mjw.DisableBit.CONTACT | mjw.DisableBit.CONSTRAINT):
        return
    device = d.qvel.device
    warps = 64 * device.sm_count if device.is_cuda else 1
    # So many blocks on a multiprocessor, though a few registers are spilled
    launch(("rows",), m, d, warps=warps, bounds=(32, 26))


def solve(m: mjw.Model, d: mjw.Data) -> None:
    """`mujoco_warp.solve` in one launch, for models to which `why_not` has no objection: the same
    cost, tolerances, limits and outputs.
    """
    device, most = d.qpos.device, padded_rows(d.njmax)
    solver = partial(launch, ("newton",), m, d, fast_math=True)
    if not device.is_cuda or m.nv > _TEAM_NV or most <= _WARP_ROWS:
        solver()
        return
    # A step waits for its slowest world: those with many rows begin first
    teams = partial(solver, rows=(_FEW_ROWS, most), team=_TEAM)
    warps = partial(solver, rows=(-1, _FEW_ROWS), bounds=(32, 20))
    side_by_side(wp.device_to_torch(device), teams, warps)
