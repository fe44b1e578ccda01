"""Smooth dynamics in three kernels: poses, forces and the end of the step, by a warp of threads for
every world.
"""

from collections.abc import Iterable

import mujoco
import numpy as np

from mjstack.sim.fused.launch import SHARED_BYTES, largest_tree, launch
from mjstack.sim.mujoco_warp import mjw

_AXES = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
_TRN = mjw.TrnType
_DYN = mjw.DynType
_KINDS = {
    "actuator_dyntype": (_DYN.NONE, _DYN.INTEGRATOR, _DYN.FILTER, _DYN.FILTEREXACT),
    "actuator_gaintype": (mjw.GainType.FIXED, mjw.GainType.AFFINE),
    "actuator_biastype": (mjw.BiasType.NONE, mjw.BiasType.AFFINE),
}


def why_not(m: mjw.Model) -> str:
    """Why these kernels do not apply to a model that `solve` does; empty if they do."""
    size = _shared_bytes(m)
    shared = f"bytes of shared memory, of {SHARED_BYTES:,}"
    joints = m.jnt_type.numpy()
    transmissions = m.actuator_trntype.numpy()
    of_joints = np.isin(transmissions, (_TRN.JOINT, _TRN.JOINTINPARENT))
    driven = joints[m.actuator_trnid.numpy()[of_joints, 0]]
    reasons = {
        "tendons are spatial": not _only(m.wrap_type.numpy(), (mujoco.mjtWrap.mjWRAP_JOINT,)),
        "actuators drive other things than hinges, slides and tendons": not (
            (of_joints | (transmissions == _TRN.TENDON)).all() and _only(driven, _AXES)
        ),
        "actuators have dynamics, gains or biases of special kinds": not all(
            _only(getattr(m, name).numpy(), kinds) for name, kinds in _KINDS.items()
        ),
        "springs are plastic": m.nplastic > 0,
        "there is a fluid": m.has_fluid,
        "there are callbacks": any(vars(m.callback).values()),
        f"the bodies need {size:,} {shared}": size > SHARED_BYTES,
    }
    return "; ".join(reason for reason, applies in reasons.items() if applies)


def positions(m: mjw.Model, d: mjw.Data) -> None:
    """`mujoco_warp.kinematics`, `com_pos` and `tendon` in one launch, for models to which `why_not`
    has no objection.
    """
    launch(("tree", "positions"), m, d)


def forces(m: mjw.Model, d: mjw.Data) -> None:
    """`mujoco_warp.crb`, `tendon_armature`, `transmission`, `fwd_velocity`, `fwd_actuation` and
    `fwd_acceleration` in one launch.

    It does not write what no later stage reads: crb, the factors of M, cacc, cfrc_int, the moments
    of actuators, and the parts of qfrc_passive.
    """
    # Division is then good to the last two bits; sines of the other stages would not be.
    launch(("tree", "forces"), m, d, fast_math=True)


def advance(m: mjw.Model, d: mjw.Data) -> None:
    """`mujoco_warp.implicit`, for the integrator implicitfast, in one launch."""
    launch(("tree", "advance"), m, d)


def _only(values: np.ndarray, allowed: Iterable[int]) -> bool:
    return set(allowed).issuperset(values.tolist())


def _shared_bytes(m: mjw.Model) -> int:
    """Shared memory of a world [bytes]: the arrays at the heads of the C++ files."""
    poses = 58 * m.nbody + 6 * m.njnt + 6 * m.nv + 14 * m.ngeom + 12 * m.nsite + 32
    tree = largest_tree(m)
    rest = 34 * m.nbody + (33 + (tree | 1)) * m.nv + 2 * tree + 2 * m.nactuator + 64
    rest += m.ntendon * (m.nv + 4)
    return 4 * max(poses, rest)
