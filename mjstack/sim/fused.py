"""Contact rows and MuJoCo's Newton solver as one kernel each, by warps of threads that do a whole
contact or a whole world.
"""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
import dataclasses
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

import mujoco

from mjstack.sim.warp_setup import mjw, wp

MAX_NV = 64
_LAUNCH = Lock()
_SHARED = 48 * 1024 - 256  # bytes of shared memory that every block may have, less Warp's own
_ELLIPTIC = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC)
_vec5 = wp.types.vector(length=5, dtype=float)


@wp.struct
class Rows:
    """Arrays that fused_rows.cpp reads and writes, by MJWarp's names."""

    # Model
    geom_bodyid: wp.array[int]
    body_rootid: wp.array[int]
    body_isdofancestor: wp.array2d[int]
    body_invweight0: wp.array2d[wp.vec2]
    opt_timestep: wp.array[float]
    opt_impratio_invsqrt: wp.array[float]
    disableflags: int
    # Data
    qvel: wp.array2d[float]
    subtree_com: wp.array2d[wp.vec3]
    cdof: wp.array2d[wp.spatial_vector]
    nacon: wp.array[int]
    contact_dist: wp.array[float]
    contact_pos: wp.array[wp.vec3]
    contact_frame: wp.array[wp.mat33]
    contact_includemargin: wp.array[float]
    contact_friction: wp.array[_vec5]
    contact_solref: wp.array[wp.vec2]
    contact_solreffriction: wp.array[wp.vec2]
    contact_solimp: wp.array[_vec5]
    contact_dim: wp.array[int]
    contact_geom: wp.array[wp.vec2i]
    contact_worldid: wp.array[int]
    contact_type: wp.array[int]
    # Results
    nefc: wp.array[int]
    contact_efc_address: wp.array2d[int]
    efc_type: wp.array2d[int]
    efc_id: wp.array2d[int]
    efc_J: wp.array3d[float]
    efc_pos: wp.array2d[float]
    efc_margin: wp.array2d[float]
    efc_D: wp.array2d[float]
    efc_vel: wp.array2d[float]
    efc_aref: wp.array2d[float]
    efc_frictionloss: wp.array2d[float]


@wp.struct
class Problem:
    """Arrays that fused_newton.cpp reads and writes, by MJWarp's names."""

    # Model
    M_rownnz: wp.array[int]
    M_rowadr: wp.array[int]
    M_hinit_i: wp.array[int]
    M_colind: wp.array[int]
    M_mulm_rowadr: wp.array[int]
    M_mulm_col: wp.array[int]
    M_mulm_madr: wp.array[int]
    opt_impratio_invsqrt: wp.array[float]
    opt_tolerance: wp.array[float]
    opt_ls_tolerance: wp.array[float]
    # Data
    ne: wp.array[int]
    nf: wp.array[int]
    nl: wp.array[int]
    nefc: wp.array[int]
    M: wp.array2d[float]
    qacc_warmstart: wp.array2d[float]
    qacc_smooth: wp.array2d[float]
    qfrc_smooth: wp.array2d[float]
    contact_friction: wp.array[_vec5]
    contact_dim: wp.array[int]
    contact_efc_address: wp.array2d[int]
    efc_type: wp.array2d[int]
    efc_id: wp.array2d[int]
    efc_J: wp.array3d[float]
    efc_D: wp.array2d[float]
    efc_aref: wp.array2d[float]
    efc_frictionloss: wp.array2d[float]
    # Results
    qacc: wp.array2d[float]
    qfrc_constraint: wp.array2d[float]
    efc_Ma: wp.array2d[float]
    efc_force: wp.array2d[float]
    efc_state: wp.array2d[int]
    solver_niter: wp.array[int]
    overflow: wp.array[int]


def why_not(m: mjw.Model, d: mjw.Data) -> str:
    """Why `solve` does not apply to a model; empty if it does."""
    opt = m.opt
    needed = shared_bytes(m.nv, d.efc.J.shape[2], _rows(d.njmax))
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


def shared_bytes(nv: int, row: int, njmax: int) -> int:
    """Shared memory of a world [bytes]: the arrays at the head of fused_newton.cpp."""
    floats = (nv + 1) * (nv | 1) + 34 * row + 4 * nv + 5 * njmax
    return 4 * floats + 8 * njmax


def collision(m: mjw.Model, d: mjw.Data) -> None:
    """`mujoco_warp.collision`, its narrow phase by blocks that go from pair to pair.

    MJWarp launches a thread for each contact that the buffer has room for. Its 255 registers leave
    room for one block on a multiprocessor, and most blocks find nothing to do.

    Args:
        m: The uploaded model.
        d: The worlds.
    """

    def launch_few(*args: Any, **kwargs: Any) -> Any:
        kernel = kwargs["kernel"] if "kernel" in kwargs else args[0]
        if "primitive_narrowphase" in kernel.key and d.qpos.device.is_cuda:
            kwargs |= {"block_dim": 64, "max_blocks": 16 * d.qpos.device.sm_count}
        return launch(*args, **kwargs)

    with _LAUNCH:
        launch = wp.launch
        wp.launch = launch_few
        try:
            mjw.collision(m, d)
        finally:
            wp.launch = launch


def why_not_rows(m: mjw.Model) -> str:
    """Why MJWarp writes the rows of contacts, and not `make_constraint`; empty if it does not."""
    if m.opt.cone != mjw.ConeType.ELLIPTIC:
        return "cones are pyramidal"
    return "surfaces move" if m.flg_surfacevel else ""


def make_constraint(m: mjw.Model, d: mjw.Data) -> None:
    """`mujoco_warp.make_constraint`, the rows of elliptic contacts in one launch.

    Args:
        m: The uploaded model, dense.
        d: The worlds.
    """
    flags = int(m.opt.disableflags)
    contact = int(mjw.DisableBit.CONTACT)
    none = flags & (contact | int(mjw.DisableBit.CONSTRAINT))
    if none or why_not_rows(m):
        mjw.make_constraint(m, d)
        return
    opt = dataclasses.replace(m.opt, disableflags=flags | contact)
    mjw.make_constraint(dataclasses.replace(m, opt=opt), d)
    device = d.qvel.device
    warps = 64 * device.sm_count if device.is_cuda else 1
    rows = _fill(Rows(), m, d)
    rows.disableflags = flags
    kernel = _rows_kernel(m.nv, warps)
    wp.launch_tiled(kernel, dim=warps, inputs=[rows], block_dim=32, device=device)


def solve(m: mjw.Model, d: mjw.Data) -> None:
    """`mujoco_warp.solve` in one launch: the same cost, tolerances, limits and outputs.

    Args:
        m: The uploaded model, to which `why_not` has no objection.
        d: The worlds.
    """
    kernel = _newton_kernel(
        m.nv,
        d.efc.J.shape[2],
        _rows(d.njmax),
        m.opt.iterations,
        m.opt.ls_iterations,
        warmstart=not int(m.opt.disableflags) & int(mjw.DisableBit.WARMSTART),
        cuda=d.qacc.device.is_cuda,
    )
    problem = _fill(Problem(), m, d)
    wp.launch_tiled(kernel, dim=d.nworld, inputs=[problem], block_dim=32, device=d.qacc.device)


def _fill(struct: Any, m: mjw.Model, d: mjw.Data) -> Any:
    """Give a struct's arrays those of the model and the data that its names say."""
    parts = {"contact": d.contact, "efc": d.efc, "opt": m.opt}
    for name, kind in type(struct).cls.__annotations__.items():
        if kind is int:
            continue
        prefix, _, rest = name.partition("_")
        if prefix in parts:
            setattr(struct, name, getattr(parts[prefix], rest))
        else:
            setattr(struct, name, getattr(d, name) if hasattr(d, name) else getattr(m, name))
    return struct


@cache
def _rows_kernel(nv: int, warps: int) -> wp.Kernel:
    """The kernel of `make_constraint` for these sizes."""
    numbers = {
        "NV": nv,
        "STRIDE": warps,
        "ELLIPTIC": _ELLIPTIC,
        "FRICTIONLESS": int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS),
        "REFSAFE": int(mjw.DisableBit.REFSAFE),
    }

    @wp.func_native(_source("rows", numbers))
    def rows(warp: int, lane: int, io: Rows) -> None: ...

    bounds = (32, 26)  # so many blocks on a multiprocessor, though a few registers are spilled

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, launch_bounds=bounds)
    def kernel(problem: Rows) -> None:
        warp, lane = wp.tid()  # type: ignore[misc]
        rows(warp, lane, problem)

    return kernel


@cache
def _newton_kernel(
    nv: int,
    row: int,
    njmax: int,
    iterations: int,
    ls_iterations: int,
    *,
    warmstart: bool,
    cuda: bool,
) -> wp.Kernel:
    """The kernel of `solve` for these sizes and limits."""
    numbers = {
        "NV": nv,
        "NVP": row,
        "NJ": njmax,
        "ITERATIONS": iterations,
        "LS_ITERATIONS": ls_iterations,
        "WARMSTART": int(warmstart),
        "ELLIPTIC": _ELLIPTIC,
        "LIMIT": int(mjw.OverflowType.ITERATIONS),
        "LIMIT_LS": int(mjw.OverflowType.LS_ITERATIONS),
    }
    for name in ("SATISFIED", "QUADRATIC", "LINEARNEG", "LINEARPOS", "CONE"):
        numbers[name] = int(getattr(mujoco.mjtConstraintState, f"mjCNSTRSTATE_{name}"))

    @wp.func_native(_source("newton", numbers))
    def newton(world: int, lane: int, io: Problem) -> None: ...

    # On CUDA division and roots are then good to the last two bits. On a CPU fast math would assume
    # that there is no NaN.
    options = {"fast_math": cuda}

    @wp.kernel(module="unique", module_options=options, enable_backward=False, grid_stride=False)
    def kernel(problem: Problem) -> None:
        world, lane = wp.tid()  # type: ignore[misc]
        newton(world, lane, problem)

    return kernel


def _source(name: str, numbers: dict[str, int]) -> str:
    """The body of a native function, its constants before it."""
    constants = "".join(f"constexpr int {key} = {value};\n" for key, value in numbers.items())
    return constants + Path(__file__).with_name(f"fused_{name}.cpp").read_text()
