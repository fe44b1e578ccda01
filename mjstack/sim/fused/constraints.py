"""Collision, contact rows and MuJoCo's Newton solver, each in fewer or better filled launches than
MJWarp's own.
"""

import dataclasses
from functools import partial

import mujoco

from mjstack.sim.fused.launch import SHARED_BYTES, arguments, launch, padded_rows
from mjstack.sim.mujoco_warp import mjw, wp

MAX_NV = 64


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
    floats = (nv + 1) * (nv | 1) + 34 * row + 4 * nv + 5 * njmax
    return 4 * floats + 8 * njmax


def collision(m: mjw.Model, d: mjw.Data) -> None:
    """`mujoco_warp.collision`, the narrow phase of primitive shapes by blocks that go from pair to
    pair.

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

    # All pairs, and those of convex shapes
    source = mjw._src
    context = source.collision_core.create_collision_context(d.naconmax)
    d.ncollision.zero_()
    d.nacon.zero_()
    simple = m.opt.broadphase == mjw.BroadphaseType.NXN
    (mjw.nxn_broadphase if simple else mjw.sap_broadphase)(m, d, context)
    primitive = source.collision_primitive._PRIMITIVE_COLLISIONS
    table = source.collision_driver.MJ_COLLISION_TABLE
    convex = [types for types in table if types not in primitive]
    source.collision_convex.convex_narrowphase(m, d, context, convex)

    # Those of primitive shapes, by a kernel for the types that the model has
    place = partial(source.math.upper_trid_index, len(mjw.GeomType))
    functions = {
        types: function
        for types, function in primitive.items()
        if m.geom_pair_type_count[place(types[0].value, types[1].value)]
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
    launch(("newton",), m, d, fast_math=True)
