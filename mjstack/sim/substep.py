"""One physics step out of MJWarp's own stages, arranged for a captured graph."""

# No `from __future__ import annotations` here: Warp reads the annotations as objects.
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import torch

from mjstack.sim import fused, fused_smooth
from mjstack.sim.graph import side_by_side
from mjstack.sim.warp_setup import mjw, wp


@dataclass(frozen=True, kw_only=True, slots=True)
class Arrangement:
    """Measures that make a captured step faster than MJWarp's own. All but the fused solver leave
    the numbers as they are.

    Attributes:
        branches: Contacts beside smooth dynamics, there inertia beside forces, and counting beside
            the next step's kinematics, as parallel branches.
        sensors_once: Sensors in the last of several steps alone: no one sees the others'.
        own_stages: Only the stages that the model needs: no cameras, lights, tendons, flexes or
            energy.
        scratch: Temporaries at fixed addresses (`Scratch`), not allocated and freed by the graph.
        fused: Contact rows and the solver as one kernel each.
        smooth: With fused, smooth dynamics as three kernels where they apply.
    """

    branches: bool = True
    sensors_once: bool = True
    own_stages: bool = True
    scratch: bool = True
    fused: bool = True
    smooth: bool = True


ARRANGEMENTS = {
    "stock": Arrangement(own_stages=False, fused=False),
    "arranged": Arrangement(fused=False),
    "fused": Arrangement(),
}


def can_rearrange(model: mujoco.MjModel, m: mjw.Model) -> bool:
    """Whether `rearranged_step` does all that `mujoco_warp.step` does for this model.

    It leaves out cameras and lights, which nothing in the physics reads, tendons, flexes, sleeping,
    energy and callbacks, and it knows one integrator. Equalities between bodies read velocities of
    the step before, adhesion reads contacts among the smooth forces, and sensors of acceleration or
    of a camera need stages of their own.
    """
    equalities = {int(kind) for kind in model.eq_type}
    seen_by = {int(kind) for kind in (*model.sensor_objtype, *model.sensor_reftype)}
    return (
        m.opt.run_collision_detection
        and not m.nacttrnbody
        and not m.flg_adhesion
        and int(mujoco.mjtObj.mjOBJ_CAMERA) not in seen_by
        and model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
        and model.ntendon == model.nflex == 0
        and model.nhistory == 0
        and not model.opt.enableflags
        & int(mujoco.mjtEnableBit.mjENBL_SLEEP | mujoco.mjtEnableBit.mjENBL_ENERGY)
        and equalities <= {int(mujoco.mjtEq.mjEQ_JOINT)}
        and not m.sensor_rne_postconstraint
        and not m.opt.run_rne_postconstraint
        and not any((m.callback.control, m.callback.contactfilter))
    )


def rearranged_step(
    m: mjw.Model,
    d: mjw.Data,
    device: torch.device,
    *,
    sensors: bool,
    branches: bool = True,
    own: bool = True,
    smooth: bool = True,
    beside_kinematics: tuple[Callable[[], None], ...] = (),
) -> None:
    """`mujoco_warp.step`, with contacts and smooth dynamics as parallel branches: neither needs the
    other.

    Args:
        m: The uploaded model.
        d: The worlds.
        device: Where they are.
        sensors: Whether sensordata is computed; of several steps only the last one's is seen.
        branches: Whether a captured graph gets branches.
        own: Whether contact rows and the solver are one kernel each.
        smooth: Whether smooth dynamics are three kernels.
        beside_kinematics: Work that may run while the poses are computed.
    """

    def forces() -> None:
        mjw.transmission(m, d)
        mjw.fwd_velocity(m, d)
        mjw.fwd_actuation(m, d)

    def dynamics() -> None:
        if smooth:
            fused_smooth.forces(m, d)
            return
        side_by_side(device, forces, lambda: mjw.crb(m, d), branches=branches)
        mjw.fwd_acceleration(m, d, factorize=True)

    def contacts() -> None:
        (fused if own else mjw).collision(m, d)
        (fused if own else mjw).make_constraint(m, d)

    side_by_side(device, lambda: pose(m, d, own=smooth), *beside_kinematics, branches=branches)
    side_by_side(device, contacts, dynamics, branches=branches)
    (fused if own else mjw).solve(m, d)
    if sensors:
        d.sensordata.zero_()
        mjw.sensor_pos(m, d)
        mjw.sensor_vel(m, d)
        mjw.sensor_acc(m, d)
    (fused_smooth.advance if smooth else mjw.implicit)(m, d)


def pose(m: mjw.Model, d: mjw.Data, *, own: bool) -> None:
    """Poses, and what is computed about centres of mass: in one kernel, or by MJWarp."""
    if own:
        fused_smooth.positions(m, d)
        return
    mjw.kinematics(m, d)
    mjw.com_pos(m, d)


@wp.kernel(enable_backward=False)
def place_static_geoms(
    body_rootid: wp.array[int],
    body_weldid: wp.array[int],
    body_mocapid: wp.array[int],
    geom_bodyid: wp.array[int],
    geom_pos: wp.array2d[wp.vec3],
    geom_quat: wp.array2d[wp.quat],
    xpos: wp.array2d[wp.vec3],
    xquat: wp.array2d[wp.quat],
    geom_xpos: wp.array2d[wp.vec3],
    geom_xmat: wp.array2d[wp.mat33],
) -> None:
    """Write the poses of exactly those geoms that MJWarp's kinematics leaves out. Warp's own
    quaternions are xyzw.
    """
    world, geom = wp.tid()  # type: ignore[misc]
    body = geom_bodyid[geom]
    if body_weldid[body] != 0 or body_mocapid[body_rootid[body]] != -1:
        return
    # Fields that the worlds share have one row.
    p = geom_pos[world % geom_pos.shape[0], geom]
    g = geom_quat[world % geom_quat.shape[0], geom]
    b = xquat[world, body]
    q = wp.quat(b[1], b[2], b[3], b[0])
    geom_xpos[world, geom] = xpos[world, body] + wp.quat_rotate(q, p)
    geom_xmat[world, geom] = wp.quat_to_matrix(wp.normalize(q * wp.quat(g[1], g[2], g[3], g[0])))
