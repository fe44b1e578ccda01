"""One physics step out of MJWarp's own stages, arranged for a captured graph."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import torch

from mjstack.sim.engine import mjw
from mjstack.sim.graph import side_by_side


def can_rearrange(model: mujoco.MjModel, m: mjw.Model) -> bool:
    """Whether `rearranged_step` does all that `mujoco_warp.step` does for this model.

    It leaves out cameras, lights, tendons, flexes, sleeping, energy and callbacks, and it knows one integrator. Equalities
    between bodies read velocities of the step before, and sensors of acceleration need a stage of their own.
    """
    equalities = {int(kind) for kind in model.eq_type}
    return (
        model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
        and model.ntendon == model.nflex == 0
        and model.nhistory == 0
        and not model.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP | mujoco.mjtEnableBit.mjENBL_ENERGY)
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
    beside_kinematics: tuple[Callable[[], None], ...] = (),
) -> None:
    """`mujoco_warp.step`, with contacts and smooth dynamics as parallel branches: neither needs the other.

    Args:
        m: The uploaded model.
        d: The worlds.
        device: Where they are.
        sensors: Whether sensordata is computed; of several steps only the last one's is seen.
        beside_kinematics: Work that may run while the poses are computed.
    """

    def kinematics() -> None:
        mjw.kinematics(m, d)
        mjw.com_pos(m, d)

    def dynamics() -> None:
        mjw.crb(m, d)
        mjw.transmission(m, d)
        mjw.fwd_velocity(m, d)
        mjw.fwd_actuation(m, d)
        mjw.fwd_acceleration(m, d, factorize=True)

    def contacts() -> None:
        mjw.collision(m, d)
        mjw.make_constraint(m, d)

    side_by_side(device, kinematics, *beside_kinematics)
    side_by_side(device, contacts, dynamics)
    mjw.solve(m, d)
    if sensors:
        d.sensordata.zero_()
        mjw.sensor_pos(m, d)
        mjw.sensor_vel(m, d)
        mjw.sensor_acc(m, d)
    mjw.implicit(m, d)
