"""One physics step out of MJWarp's stages and the kernels here, arranged for a captured graph."""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import torch

from mjstack.sim.fused import constraints, smooth
from mjstack.sim.graph import side_by_side
from mjstack.sim.mujoco_warp import mjw


@dataclass(frozen=True)
class StepPlan:
    """How the physics steps of a model are done.

    Attributes:
        name: ``stock`` is `mujoco_warp.step`. ``arranged`` has its stages as parallel branches, and
            only those that the model needs. ``fused`` is arranged too, with contact rows and the
            solver as one kernel each.
        smooth: Whether a fused step has smooth dynamics as three kernels.
        reason: Why the step is not faster; empty if nothing is left to MJWarp.
    """

    name: str = "stock"
    smooth: bool = False
    reason: str = ""

    def __str__(self) -> str:
        return f"{self.name} step" + (f" ({self.reason})" if self.reason else "")


def plan_step(model: mujoco.MjModel, m: mjw.Model, d: mjw.Data) -> StepPlan:
    """The fastest step that does all that the model needs."""
    if not can_rearrange(model, m):
        return StepPlan(reason="the model has features that only mujoco_warp.step knows")
    if reason := constraints.why_not(m, d):
        return StepPlan("arranged", reason=reason)
    slower = {
        "contact rows": constraints.why_not_rows(m),
        "smooth dynamics": smooth.why_not(m),
    }
    reasons = [f"MJWarp's {part}, because {reason}" for part, reason in slower.items() if reason]
    return StepPlan("fused", smooth=not slower["smooth dynamics"], reason="; ".join(reasons))


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
    plan: StepPlan,
    *,
    sensors: bool,
    beside_kinematics: tuple[Callable[[], None], ...] = (),
) -> None:
    """`mujoco_warp.step`, with contacts and smooth dynamics as parallel branches of a captured
    graph: neither needs the other.

    Args:
        m: The uploaded model.
        d: The worlds.
        device: Where they are.
        plan: The step, fused or arranged.
        sensors: Whether sensordata is computed; of several steps only the last one's is seen.
        beside_kinematics: Work that may run while the poses are computed.
    """
    stages = constraints if plan.name == "fused" else mjw

    def poses() -> None:
        if plan.smooth:
            smooth.positions(m, d)
        else:
            mjw.kinematics(m, d)
            mjw.com_pos(m, d)

    def forces() -> None:
        mjw.transmission(m, d)
        mjw.fwd_velocity(m, d)
        mjw.fwd_actuation(m, d)

    def dynamics() -> None:
        if plan.smooth:
            smooth.forces(m, d)
            return
        side_by_side(device, forces, lambda: mjw.crb(m, d))
        mjw.fwd_acceleration(m, d, factorize=True)

    def contacts() -> None:
        stages.collision(m, d)
        stages.make_constraint(m, d)

    side_by_side(device, poses, *beside_kinematics)
    side_by_side(device, contacts, dynamics)
    stages.solve(m, d)
    if sensors:
        d.sensordata.zero_()
        mjw.sensor_pos(m, d)
        mjw.sensor_vel(m, d)
        mjw.sensor_acc(m, d)
    (smooth.advance if plan.smooth else mjw.implicit)(m, d)
