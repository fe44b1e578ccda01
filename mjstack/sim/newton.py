"""MuJoCo's Newton solver as one kernel: a warp of threads per world, all iterations inside it."""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
from functools import cache
from pathlib import Path

import mujoco

from mjstack.sim.warp_setup import mjw, wp

MAX_NV = 64
_SHARED = 48 * 1024  # bytes of shared memory that every block may have
_BODY = Path(__file__).with_suffix(".cpp").read_text()
_vec5 = wp.types.vector(length=5, dtype=float)


@wp.struct
class Problem:
    """What newton.cpp reads and writes, by MJWarp's names."""

    # Model
    M_rownnz: wp.array[int]
    M_rowadr: wp.array[int]
    M_hinit_i: wp.array[int]
    M_colind: wp.array[int]
    M_mulm_rowadr: wp.array[int]
    M_mulm_col: wp.array[int]
    M_mulm_madr: wp.array[int]
    impratio_invsqrt: wp.array[float]
    tolerance: wp.array[float]
    ls_tolerance: wp.array[float]
    # Data
    ne: wp.array[int]
    nf: wp.array[int]
    nl: wp.array[int]
    nefc: wp.array[int]
    M: wp.array2d[float]
    qacc_warmstart: wp.array2d[float]
    qacc_smooth: wp.array2d[float]
    qfrc_smooth: wp.array2d[float]
    # Contacts
    friction: wp.array[_vec5]
    dim: wp.array[int]
    efc_address: wp.array2d[int]
    # Rows
    type: wp.array2d[int]
    id: wp.array2d[int]
    J: wp.array3d[float]
    D: wp.array2d[float]
    aref: wp.array2d[float]
    frictionloss: wp.array2d[float]
    # Results
    qacc: wp.array2d[float]
    qfrc_constraint: wp.array2d[float]
    Ma: wp.array2d[float]
    force: wp.array2d[float]
    state: wp.array2d[int]
    solver_niter: wp.array[int]
    overflow: wp.array[int]


def why_not(m: mjw.Model, d: mjw.Data) -> str:
    """Why `solve` does not apply to a model; empty if it does."""
    opt = m.opt
    needed = shared_bytes(m.nv, _rows(d.njmax))
    reasons = {
        "the solver is not Newton's": opt.solver != mjw.SolverType.NEWTON,
        "the Jacobian is sparse": m.is_sparse,
        f"nv is {m.nv}, expected 1 to {MAX_NV}": not 0 < m.nv <= MAX_NV,
        "there is no room for constraint rows": not d.njmax,
        f"{d.njmax} rows need {needed:,} bytes of shared memory, of {_SHARED:,}": needed > _SHARED,
        "noslip is on": opt.noslip_iterations > 0,
        "bodies may sleep": bool(int(opt.enableflags) & int(mujoco.mjtEnableBit.mjENBL_SLEEP)),
        "qacc_smooth is not computed": not opt.run_qacc_smooth,
        "the integrator is discrete": opt.integrator == mjw.IntegratorType.DISCRETE,
    }
    return "; ".join(reason for reason, applies in reasons.items() if applies)


def _rows(njmax: int) -> int:
    """Rows that a kernel has room for: few kernels do for many sizes of the buffers."""
    return -(-njmax // 64) * 64


def shared_bytes(nv: int, njmax: int) -> int:
    """Shared memory that a world takes, at most [bytes]: the arrays at the head of newton.cpp."""
    row = -(-nv // 16) * 16
    floats = (nv + 1) * (nv | 1) + 32 * row + 2 * row + 4 * nv + 5 * njmax
    return 4 * floats + 6 * njmax


@cache
def _kernel(
    nv: int,
    row: int,
    njmax: int,
    iterations: int,
    ls_iterations: int,
    *,
    warmstart: bool,
    cuda: bool,
) -> wp.Kernel:
    """The kernel for these sizes and limits."""
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
    }
    for name in ("SATISFIED", "QUADRATIC", "LINEARNEG", "LINEARPOS", "CONE"):
        numbers[name] = int(getattr(mujoco.mjtConstraintState, f"mjCNSTRSTATE_{name}"))
    constants = "".join(f"constexpr int {name} = {value};\n" for name, value in numbers.items())

    @wp.func_native(constants + _BODY)
    def newton(world: int, lane: int, io: Problem) -> None: ...

    # Fast on CUDA: division and roots to the last two bits. Of a CPU it would drop NaN.
    options = {"fast_math": cuda}

    @wp.kernel(module="unique", module_options=options, enable_backward=False, grid_stride=False)
    def kernel(problem: Problem) -> None:
        world, lane = wp.tid()  # type: ignore[misc]
        newton(world, lane, problem)

    return kernel


def solve(m: mjw.Model, d: mjw.Data) -> None:
    """`mujoco_warp.solve` in one launch: the same cost, tolerances, limits and outputs.

    Args:
        m: The uploaded model, to which `why_not` has no objection.
        d: The worlds.
    """
    problem = Problem()
    for name in Problem.__annotations__:
        owner = next(o for o in (d.efc, d.contact, d, m.opt, m) if hasattr(o, name))
        setattr(problem, name, getattr(owner, name))
    kernel = _kernel(
        m.nv,
        d.efc.J.shape[2],
        _rows(d.njmax),
        m.opt.iterations,
        m.opt.ls_iterations,
        warmstart=not int(m.opt.disableflags) & int(mjw.DisableBit.WARMSTART),
        cuda=d.qacc.device.is_cuda,
    )
    wp.launch_tiled(kernel, dim=d.nworld, inputs=[problem], block_dim=32)
