"""MuJoCo's Newton solver as one kernel: one block of threads per world, all iterations inside it."""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
from functools import cache
from pathlib import Path
from typing import Any

import mujoco

from mjstack.sim.warp_setup import mjw, wp

_SHARED = 48 * 1024  # bytes of shared memory that a block may have without asking
_BODY = (Path(__file__).with_name("newton.cpp")).read_text()
vec5 = wp.types.vector(length=5, dtype=float)


def covers(model: mujoco.MjModel, m: mjw.Model, d: mjw.Data) -> str:
    """Why `solve` does not apply to a model; empty if it does."""
    return ""


@cache
def _kernel(
    nv: int, row: int, njmax: int, iterations: int, ls_iterations: int, warmstart: bool
) -> wp.Kernel:
    numbers = {
        "NV": nv,
        "NVP": row,
        "NJ": njmax,
        "ITERATIONS": iterations,
        "LS_ITERATIONS": ls_iterations,
        "WARMSTART": int(warmstart),
        "ELLIPTIC": int(mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC),
        "LIMIT": int(mjw.OverflowType.ITERATIONS),
        "LIMIT_LS": int(mjw.OverflowType.LS_ITERATIONS),
    } | {
        name: int(getattr(mujoco.mjtConstraintState, f"mjCNSTRSTATE_{name}"))
        for name in ("SATISFIED", "QUADRATIC", "LINEARNEG", "LINEARPOS", "CONE")
    }
    constants = "".join(f"constexpr int {name} = {value};\n" for name, value in numbers.items())

    @wp.func_native(constants + _BODY)
    def newton(
        world: int,
        lane: int,
        M_rownnz: wp.array[int],
        M_rowadr: wp.array[int],
        M_row: wp.array[int],
        M_col: wp.array[int],
        entries: int,
        mulm_rowadr: wp.array[int],
        mulm_col: wp.array[int],
        mulm_madr: wp.array[int],
        impratio_invsqrt: wp.array[float],
        opt_tolerance: wp.array[float],
        opt_ls_tolerance: wp.array[float],
        ne_in: wp.array[int],
        nf_in: wp.array[int],
        nl_in: wp.array[int],
        nefc_in: wp.array[int],
        M_in: wp.array2d[float],
        qacc_warmstart: wp.array2d[float],
        qacc_smooth: wp.array2d[float],
        qfrc_smooth: wp.array2d[float],
        contact_friction: wp.array[vec5],
        contact_dim: wp.array[int],
        contact_address: wp.array2d[int],
        efc_type: wp.array2d[int],
        efc_id: wp.array2d[int],
        efc_J: wp.array3d[float],
        efc_D: wp.array2d[float],
        efc_aref: wp.array2d[float],
        efc_frictionloss: wp.array2d[float],
        qacc: wp.array2d[float],
        qfrc_constraint: wp.array2d[float],
        efc_Ma: wp.array2d[float],
        efc_force: wp.array2d[float],
        efc_state: wp.array2d[int],
        solver_niter: wp.array[int],
        overflow: wp.array[int],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def kernel(
        M_rownnz: wp.array[int],
        M_rowadr: wp.array[int],
        M_row: wp.array[int],
        M_col: wp.array[int],
        entries: int,
        mulm_rowadr: wp.array[int],
        mulm_col: wp.array[int],
        mulm_madr: wp.array[int],
        impratio_invsqrt: wp.array[float],
        opt_tolerance: wp.array[float],
        opt_ls_tolerance: wp.array[float],
        ne: wp.array[int],
        nf: wp.array[int],
        nl: wp.array[int],
        nefc: wp.array[int],
        M: wp.array2d[float],
        qacc_warmstart: wp.array2d[float],
        qacc_smooth: wp.array2d[float],
        qfrc_smooth: wp.array2d[float],
        contact_friction: wp.array[vec5],
        contact_dim: wp.array[int],
        contact_address: wp.array2d[int],
        efc_type: wp.array2d[int],
        efc_id: wp.array2d[int],
        efc_J: wp.array3d[float],
        efc_D: wp.array2d[float],
        efc_aref: wp.array2d[float],
        efc_frictionloss: wp.array2d[float],
        qacc: wp.array2d[float],
        qfrc_constraint: wp.array2d[float],
        efc_Ma: wp.array2d[float],
        efc_force: wp.array2d[float],
        efc_state: wp.array2d[int],
        solver_niter: wp.array[int],
        overflow: wp.array[int],
    ):
        world, lane = wp.tid()
        newton(
            world, lane, M_rownnz, M_rowadr, M_row, M_col, entries, mulm_rowadr, mulm_col,
            mulm_madr, impratio_invsqrt, opt_tolerance, opt_ls_tolerance, ne, nf, nl, nefc, M,
            qacc_warmstart, qacc_smooth, qfrc_smooth, contact_friction, contact_dim,
            contact_address, efc_type, efc_id, efc_J, efc_D, efc_aref, efc_frictionloss, qacc,
            qfrc_constraint, efc_Ma, efc_force, efc_state, solver_niter, overflow,
        )  # fmt: skip

    return kernel


def solve(m: mjw.Model, d: mjw.Data, *, threads: int = 64) -> None:
    """`mujoco_warp.solve` in one launch: the same cost, tolerances, limits and outputs.

    Args:
        m: The uploaded model.
        d: The worlds.
        threads: Of a world's block, on CUDA.
    """
    warmstart = not int(m.opt.disableflags) & int(mjw.DisableBit.WARMSTART)
    kernel = _kernel(
        m.nv, d.efc.J.shape[2], d.njmax, m.opt.iterations, m.opt.ls_iterations, warmstart
    )
    wp.launch_tiled(
        kernel,
        dim=d.nworld,
        inputs=[
            m.M_rownnz, m.M_rowadr, m.M_hinit_i, m.M_colind, m.M_colind.shape[0],
            m.M_mulm_rowadr, m.M_mulm_col, m.M_mulm_madr,
            m.opt.impratio_invsqrt, m.opt.tolerance, m.opt.ls_tolerance,
            d.ne, d.nf, d.nl, d.nefc, d.M, d.qacc_warmstart, d.qacc_smooth, d.qfrc_smooth,
            d.contact.friction, d.contact.dim, d.contact.efc_address,
            d.efc.type, d.efc.id, d.efc.J, d.efc.D, d.efc.aref, d.efc.frictionloss,
        ],
        outputs=[
            d.qacc, d.qfrc_constraint, d.efc.Ma, d.efc.force, d.efc.state, d.solver_niter,
            d.overflow,
        ],
        block_dim=threads,
    )  # fmt: skip
