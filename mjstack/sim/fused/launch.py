"""Launches the C++ texts here as kernels: what a text names is found by its name.

``io.NAME`` in a text is an array or a number of MJWarp's model or data; a constant in capitals is a
size of the model, or one of MuJoCo's numbers of types and flags.
"""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
import inspect
import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import mujoco

from mjstack.sim.mujoco_warp import mjw, wp

SHARED_BYTES = 48 * 1024 - 256
"""Shared memory that every block may have, less Warp's own [bytes]."""


def _numbers(owner: Any, names: str, prefix: str = "", here: str = "") -> dict[str, int]:
    """Numbers of MuJoCo's names less a prefix, with the prefix that they have ``here``."""
    return {here + name: int(getattr(owner, prefix + name)) for name in names.split()}


_CONSTANTS = {
    **_numbers(mujoco.mjtJoint, "FREE BALL SLIDE HINGE", "mjJNT_"),
    **_numbers(mujoco.mjtConstraint, "ELLIPTIC FRICTIONLESS", "mjCNSTR_CONTACT_"),
    **_numbers(
        mujoco.mjtConstraintState, "SATISFIED QUADRATIC LINEARNEG LINEARPOS CONE", "mjCNSTRSTATE_"
    ),
    **_numbers(mjw.TrnType, "TENDON"),
    **_numbers(mjw.DynType, "NONE INTEGRATOR FILTER FILTEREXACT"),
    **_numbers(mjw.GainType, "AFFINE", here="GAIN_"),
    **_numbers(mjw.BiasType, "AFFINE", here="BIAS_"),
    **_numbers(mjw.DisableBit, "REFSAFE GRAVITY ACTUATION CLAMPCTRL SPRING DAMPER", here="NO_"),
    **_numbers(
        mjw.OverflowType, "NEFC BROADPHASE NARROWPHASE ITERATIONS LS_ITERATIONS", here="LIMIT_"
    ),
}


def launch(
    texts: tuple[str, ...],
    m: mjw.Model,
    d: mjw.Data,
    *,
    warps: int | None = None,
    fast_math: bool = False,
    bounds: tuple[int, int] | None = None,
    rows: tuple[int, int] | None = None,
    team: int = 1,
) -> None:
    """Run a kernel, whose body is made up of the named C++ files, one after the other; the first
    launch for models of these sizes compiles it.

    There is one warp for each world by default, on CUDA a ``team`` of warps. ``bounds`` are the
    most threads of a block, and the fewest blocks on a multiprocessor. Given ``rows``, the worlds
    are those with more constraint rows than the first number, up to the second. With ``fast_math``
    CUDA's division and roots may be good to the last two bits alone. On a CPU fast math would
    assume that there is no NaN, so it has no effect there.
    """
    warps = warps or d.nworld
    arrays, constants = _names(texts)
    values = {name: find(name, m, d) for name in arrays}
    kinds = tuple(
        (name, None, 0) if isinstance(value, int) else (name, value.dtype, value.ndim)
        for name, value in values.items()
    )
    device = d.qpos.device
    threads = 32 * team if device.is_cuda else 32
    fewer, most = rows or (-1, padded_rows(d.njmax))
    numbers = {**_CONSTANTS, **_sizes(m, d), "WARPS": warps, "LANES": threads}
    numbers |= {"FEWER": fewer, "NJ": most}
    used = tuple((name, int(number)) for name, number in numbers.items() if name in constants)
    kernel, struct = _kernel(texts, kinds, used, fast_math and device.is_cuda, bounds)
    io = struct()
    for name, value in values.items():
        setattr(io, name, int(value) if isinstance(value, int) else value)
    wp.launch_tiled(kernel, dim=warps, inputs=[io], block_dim=threads, device=device)


def find(name: str, m: mjw.Model, d: mjw.Data) -> Any:
    """The array or number of this name: ``efc_J`` is the data's ``efc.J``."""
    parts = {"contact": d.contact, "efc": d.efc, "opt": m.opt}
    prefix, _, rest = name.partition("_")
    if prefix in parts:
        return getattr(parts[prefix], rest)
    return getattr(d, name) if hasattr(d, name) else getattr(m, name)


def arguments(kernel: wp.Kernel, m: mjw.Model, d: mjw.Data, *owners: object) -> Iterable[Any]:
    """Arguments of a Warp kernel that are named as MJWarp names them: ``NAME``, ``NAME_in`` where
    the kernel reads the data and ``NAME_out`` where it writes. ``owners`` are objects that are
    searched before the model and the data.
    """
    for parameter in inspect.signature(kernel.func).parameters:
        name = re.sub("_(in|out)$", "", parameter)
        owner = next((owner for owner in owners if hasattr(owner, name)), None)
        yield find(name, m, d) if owner is None else getattr(owner, name)


def padded_rows(njmax: int) -> int:
    """Rows that a kernel has room for: few kernels do for many sizes of the buffers."""
    return -(-njmax // 64) * 64


def largest_tree(m: mjw.Model) -> int:
    """Degrees of freedom of the largest tree; without a copy from the device, for captures."""
    return max((tile.size for tile in m.M_tiles), default=0)


def _sizes(m: mjw.Model, d: mjw.Data) -> dict[str, int]:
    """Sizes and limits that C++ texts name."""
    return {
        "NBODY": m.nbody,
        "NJNT": m.njnt,
        "NGEOM": m.ngeom,
        "NSITE": m.nsite,
        "NBRANCH": m.nbranch,
        "NFREE": m.body_freeadr.size,
        "NV": m.nv,
        "NC": m.nC,
        "NA": m.nactuator,
        "NACT": m.na,
        "NT": m.ntendon,
        "BLOCK": largest_tree(m),
        "NVP": d.efc.J.shape[2],
        "ITERATIONS": m.opt.iterations,
        "LS_ITERATIONS": m.opt.ls_iterations,
        "WARMSTART": not m.opt.disableflags & mjw.DisableBit.WARMSTART,
    }


@cache
def _text(texts: tuple[str, ...]) -> str:
    """The C++ text of a kernel's body."""
    return "\n".join(
        Path(__file__).with_name(f"{name}.cpp").read_text() for name in ("prelude", *texts)
    )


@cache
def _names(texts: tuple[str, ...]) -> tuple[tuple[str, ...], frozenset[str]]:
    """Names of the arrays and numbers of MJWarp's in a body, and all its words in capitals."""
    text = _text(texts)
    arrays = sorted(set(re.findall(r"\bio\.(\w+)", text)))
    return tuple(arrays), frozenset(re.findall(r"\b[A-Z][A-Z_]+\b", text))


@cache
def _kernel(
    texts: tuple[str, ...],
    kinds: tuple[tuple[str, Any, int], ...],
    constants: tuple[tuple[str, int], ...],
    fast_math: bool,
    bounds: tuple[int, int] | None,
) -> tuple[wp.Kernel, Any]:
    """A kernel for models of these sizes, and the struct that it takes."""
    head = "".join(f"constexpr int {name} = {number};\n" for name, number in constants)
    fields = {
        name: wp.array(dtype=dtype, ndim=ndim) if dtype else int for name, dtype, ndim in kinds
    }
    struct = wp.struct(type(f"Fused{texts[-1].title()}", (), {"__annotations__": fields}))

    @wp.func_native(head + _text(texts))
    def body(warp: int, lane: int, io: struct) -> None: ...  # type: ignore[valid-type]

    @wp.kernel(
        module="unique",
        module_options={"fast_math": fast_math},
        enable_backward=False,
        grid_stride=False,
        launch_bounds=bounds,
    )
    def kernel(arrays: struct) -> None:  # type: ignore[valid-type]
        warp, lane = wp.tid()  # type: ignore[misc]
        body(warp, lane, arrays)

    return kernel, struct
