"""Smooth dynamics in three kernels: poses, forces and the end of the step, by a warp of threads for
every world.
"""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
import re
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjstack.sim.fused import _SHARED, _source
from mjstack.sim.warp_setup import mjw, wp

_JOINTS = {
    name: int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("FREE", "SLIDE", "HINGE")
}
_TRANSMISSIONS = (int(mjw.TrnType.JOINT), int(mjw.TrnType.JOINTINPARENT))
_DYNAMICS = ("NONE", "INTEGRATOR", "FILTER", "FILTEREXACT")
_GAINS = (mjw.GainType.FIXED, mjw.GainType.AFFINE)
_BIASES = (mjw.BiasType.NONE, mjw.BiasType.AFFINE)
_OFF = {
    "NO_GRAVITY": mjw.DisableBit.GRAVITY,
    "NO_ACTUATION": mjw.DisableBit.ACTUATION,
    "NO_CLAMP": mjw.DisableBit.CLAMPCTRL,
    "NO_SPRING": mjw.DisableBit.SPRING,
    "NO_DAMPER": mjw.DisableBit.DAMPER,
}
_LIMITS = {
    "LIMIT_ROWS": mjw.OverflowType.NEFC,
    "LIMIT_BROADPHASE": mjw.OverflowType.BROADPHASE,
    "LIMIT_NARROWPHASE": mjw.OverflowType.NARROWPHASE,
}


def why_not(m: mjw.Model) -> str:
    """Why these kernels do not apply to a model that `fused.solve` does; empty if they do."""
    needed = _shared_bytes(m)
    joints = m.jnt_type.numpy()
    of_joints = np.isin(m.actuator_trntype.numpy(), _TRANSMISSIONS)
    driven = joints[m.actuator_trnid.numpy()[of_joints, 0]]
    reasons = {
        "there are ball joints": not _only(joints, _JOINTS.values()),
        "actuators drive other things than hinges and slides": not (
            of_joints.all() and _only(driven, (_JOINTS["SLIDE"], _JOINTS["HINGE"]))
        ),
        "actuators have dynamics, gains or biases of special kinds": not (
            _only(m.actuator_dyntype.numpy(), (getattr(mjw.DynType, name) for name in _DYNAMICS))
            and _only(m.actuator_gaintype.numpy(), _GAINS)
            and _only(m.actuator_biastype.numpy(), _BIASES)
        ),
        "actuators have damping or armature": not _only(m.jnt_actuatorid.numpy(), (-1,)),
        "springs are plastic": m.nplastic > 0,
        "there is a fluid": m.has_fluid,
        "there are callbacks": any(vars(m.callback).values()),
        f"the bodies need {needed:,} bytes of shared memory, of {_SHARED:,}": needed > _SHARED,
    }
    return "; ".join(reason for reason, applies in reasons.items() if applies)


def positions(m: mjw.Model, d: mjw.Data) -> None:
    """`mujoco_warp.kinematics` and `com_pos` in one launch.

    Args:
        m: The uploaded model, to which `why_not` has no objection.
        d: The worlds.
    """
    _launch("positions", m, d)


def forces(m: mjw.Model, d: mjw.Data) -> None:
    """`mujoco_warp.crb`, `transmission`, `fwd_velocity`, `fwd_actuation` and `fwd_acceleration` in
    one launch.

    It does not write what no later stage reads: crb, the factors of M, cacc, cfrc_int, the moments
    of actuators, and the parts of qfrc_passive.
    """
    _launch("forces", m, d)


def advance(m: mjw.Model, d: mjw.Data) -> None:
    """`mujoco_warp.implicit`, for the integrator implicitfast, in one launch."""
    _launch("advance", m, d)


def _only(values: np.ndarray, allowed: Any) -> bool:
    return {int(value) for value in allowed}.issuperset(values.tolist())


def _largest_tree(m: mjw.Model) -> int:
    """Degrees of freedom of the largest tree; without a copy from the device, for captures."""
    return max(tile.size for tile in m.M_tiles)


def _shared_bytes(m: mjw.Model) -> int:
    """Shared memory of a world [bytes]: the arrays at the heads of the C++ files."""
    poses = 58 * m.nbody + 6 * m.njnt + 6 * m.nv + 14 * m.ngeom + 12 * m.nsite + 32
    tree = _largest_tree(m)
    rest = 34 * m.nbody + (33 + (tree | 1)) * m.nv + 2 * tree + 2 * m.nactuator + 64
    return 4 * max(poses, rest)


def _find(name: str, m: mjw.Model, d: mjw.Data) -> Any:
    """The model's or the data's array or number that the C++ text calls so."""
    parts = {"efc": d.efc, "opt": m.opt}
    prefix, _, rest = name.partition("_")
    if prefix in parts:
        return getattr(parts[prefix], rest)
    return getattr(d, name) if hasattr(d, name) else getattr(m, name)


@cache
def _names(stage: str) -> tuple[str, ...]:
    """Arrays that a stage's C++ text reads and writes, by MJWarp's names."""
    text = "".join(
        Path(__file__).with_name(f"fused_{part}.cpp").read_text() for part in ("tree", stage)
    )
    used = set(re.findall(r"\bio\.(\w+)", text))
    return tuple(sorted(used))


def _launch(stage: str, m: mjw.Model, d: mjw.Data) -> None:
    """Run a stage on all worlds."""
    values = {name: _find(name, m, d) for name in _names(stage)}
    kinds = tuple(
        (name, None, 0) if isinstance(value, int) else (name, value.dtype, value.ndim)
        for name, value in values.items()
    )
    sizes = {
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
        "BLOCK": _largest_tree(m),
    }
    device = d.qpos.device
    kernel, struct = _kernel(stage, kinds, tuple(sizes.items()), device.is_cuda)
    io = struct()
    for name, value in values.items():
        setattr(io, name, int(value) if isinstance(value, int) else value)
    wp.launch_tiled(kernel, dim=d.nworld, inputs=[io], block_dim=32, device=device)


@cache
def _kernel(
    stage: str,
    kinds: tuple[tuple[str, Any, int], ...],
    sizes: tuple[tuple[str, int], ...],
    cuda: bool,
) -> tuple[wp.Kernel, Any]:
    """The kernel of a stage for models of these sizes, and the struct that it takes."""
    numbers = {
        **dict(sizes),
        **_JOINTS,
        **{name: getattr(mjw.DynType, name) for name in _DYNAMICS},
        **_OFF,
        **_LIMITS,
        "AFFINE": mjw.GainType.AFFINE,
        "BIAS_AFFINE": mjw.BiasType.AFFINE,
    }
    head = _source("tree", {name: int(value) for name, value in numbers.items()})
    fields = {
        name: wp.array(dtype=dtype, ndim=ndim) if dtype else int for name, dtype, ndim in kinds
    }
    struct = wp.struct(type(f"Fused{stage.title()}", (), {"__annotations__": fields}))

    @wp.func_native(head + _source(stage, {}))
    def body(world: int, lane: int, io: struct) -> None: ...  # type: ignore[valid-type]

    # Division is then good to the last two bits; sines would not be.
    options = {"fast_math": cuda and stage == "forces"}

    @wp.kernel(module="unique", module_options=options, enable_backward=False, grid_stride=False)
    def kernel(arrays: struct) -> None:  # type: ignore[valid-type]
        world, lane = wp.tid()  # type: ignore[misc]
        body(world, lane, arrays)

    return kernel, struct
