"""One physics step out of MJWarp's stages and the kernels here, arranged for a captured graph."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from mjstack.errors import first_line
from mjstack.sim.fused import constraints, smooth
from mjstack.sim.graph import side_by_side
from mjstack.sim.mujoco_warp import mjw, wp

RELEASES = ("4.0.0",)  # of mujoco-warp that docs/design.md, "A new release", was done with
_CONVERGED = 1e-8  # tolerance of the solver that float32 can still tell
_STATES = 8
_WORLDS = 8  # that are compared, at most: each is drawn on the host
_CONTACTS = 512  # of a world: in random states an arm may lie in the table
_AGREES = 1e-3  # of a world's largest acceleration, or of 1 m/s^2


@dataclass(frozen=True)
class StepPlan:
    """How the physics steps of a model are done: ``stock`` is `mujoco_warp.step`; ``arranged`` has
    its stages as parallel branches, and only those that the model needs; ``fused`` is arranged too,
    with contact rows and the solver as one kernel each.
    """

    name: str = "stock"
    smooth: bool = False  # whether a fused step has smooth dynamics as three kernels
    cameras: bool = False  # whether sensors read the poses of cameras
    reason: str = ""  # why the step is not faster; empty if nothing is left to MJWarp

    def __str__(self) -> str:
        return f"{self.name} step" + (f" ({self.reason})" if self.reason else "")


def plan_step(model: mujoco.MjModel, m: mjw.Model, d: mjw.Data) -> StepPlan:
    """The fastest step that does all that the model needs."""
    if reason := why_stock(model, m):
        return StepPlan(reason=reason)
    cameras = mujoco.mjtObj.mjOBJ_CAMERA in (*model.sensor_objtype, *model.sensor_reftype)
    plan = StepPlan("arranged", cameras=cameras)
    if reason := constraints.why_not(m, d):
        return replace(plan, reason=reason)
    slower = {"contact rows": constraints.why_not_rows(m), "smooth dynamics": smooth.why_not(m)}
    reasons = [f"MJWarp's {part}, because {reason}" for part, reason in slower.items() if reason]
    covered = not slower["smooth dynamics"]
    return replace(plan, name="fused", smooth=covered, reason="; ".join(reasons))


def why_stock(model: mujoco.MjModel, m: mjw.Model) -> str:
    """The features of a model that `rearranged_step` does not know, in a sentence; "" if none.

    Adhesion reads contacts among the smooth forces.
    """
    enabled = mujoco.mjtEnableBit.mjENBL_SLEEP | mujoco.mjtEnableBit.mjENBL_ENERGY
    integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    features = {
        "an integrator other than implicitfast": model.opt.integrator != integrator,
        "flexes": model.nflex,
        "adhesion": m.flg_adhesion or m.nacttrnbody,
        "delays": model.nhistory,
        "sleeping or energy": model.opt.enableflags & enabled,
        "no collision detection": not m.opt.run_collision_detection,
        "callbacks": m.callback.control or m.callback.contactfilter,
    }
    named = [name for name, has in features.items() if has]
    return f"mjstack's does not know {', '.join(named)}" if named else ""


def rearranged_forward(
    m: mjw.Model,
    d: mjw.Data,
    device: torch.device,
    plan: StepPlan,
    *,
    sensors: bool,
    beside_kinematics: tuple[Callable[[], None], ...] = (),
) -> None:
    """`mujoco_warp.forward` by a plan, fused or arranged, with contacts and smooth dynamics as
    parallel branches of a captured graph: neither needs the other.

    ``sensors`` says whether sensordata is computed: of several steps only the last one's is seen.
    ``beside_kinematics`` is work that may run while the poses are computed.
    """
    stages = constraints if plan.name == "fused" else mjw
    # The smooth dynamics compute the same velocities in the meantime.
    linked = d
    if links_bodies(m):
        linked = replace(d, cvel=wp.empty_like(d.cvel), cdof_dot=wp.empty_like(d.cdof_dot))

    def poses() -> None:
        if plan.smooth:
            smooth.positions(m, d)
        else:
            mjw.kinematics(m, d)
            mjw.com_pos(m, d)
            mjw.tendon(m, d)

    def inertia() -> None:
        mjw.crb(m, d)
        mjw._src.smooth.tendon_armature(m, d)

    def forces() -> None:
        mjw.transmission(m, d)
        mjw.fwd_velocity(m, d)
        mjw.fwd_actuation(m, d)

    def dynamics() -> None:
        if plan.smooth:
            smooth.forces(m, d)
            return
        side_by_side(device, forces, inertia)
        mjw.fwd_acceleration(m, d, factorize=True)

    def other_rows() -> None:
        find_velocities(m, linked)
        constraints.noncontact_rows(m, linked)

    def contacts() -> None:
        if plan.name == "fused" and not constraints.why_not_rows(m):
            side_by_side(device, partial(constraints.collision, m, d), other_rows)
            constraints.contact_rows(m, d)
        else:
            stages.collision(m, d)
            find_velocities(m, linked)
            mjw.make_constraint(m, linked)

    side_by_side(device, poses, *beside_kinematics)
    side_by_side(device, contacts, dynamics)
    stages.solve(m, d)
    if sensors:
        if plan.cameras:
            mjw.camlight(m, d)
        d.sensordata.zero_()
        mjw.sensor_pos(m, d)
        mjw.sensor_vel(m, d)
        mjw.sensor_acc(m, d)


def links_bodies(m: mjw.Model) -> bool:
    """Whether there are connect or weld equalities."""
    return m.eq_connect_adr.size + m.eq_wld_adr.size > 0


def find_velocities(m: mjw.Model, d: mjw.Data) -> None:
    """Compute the velocities of bodies and axes, which rows of connect and weld read. MJWarp makes
    these rows first, of velocities of the step before; native MuJoCo has those of the step itself.
    """
    if links_bodies(m):
        mjw._src.smooth.com_vel(m, d)


def prepare_stock(m: mjw.Model, d: mjw.Data) -> None:
    """Compute these velocities for a `mujoco_warp.forward` or `step` that follows."""
    if links_bodies(m):
        mjw.fwd_kinematics(m, d)
        find_velocities(m, d)


def rearranged_step(
    m: mjw.Model, d: mjw.Data, device: torch.device, plan: StepPlan, **options: Any
) -> None:
    """`mujoco_warp.step`; arguments as of `rearranged_forward`."""
    rearranged_forward(m, d, device, plan, **options)
    (smooth.advance if plan.smooth else mjw.implicit)(m, d)


def disagreement(
    model: mujoco.MjModel, m: mjw.Model, d: mjw.Data, device: torch.device, plan: StepPlan
) -> str:
    """How the planned step differs from `mujoco_warp.step`; empty if it does not.

    Both make a step from the same states: joints anywhere, some at their limits, free bodies
    pressed into what they lie on, all of them moving. The worlds are others than those of ``d``,
    with room for as many rows. One that needs more does not count: rows are missing then, in an
    order that the two steps need not share.
    """
    nworld = min(len(d.qpos), _WORLDS)
    tolerance = wp.to_torch(m.opt.tolerance)
    configured = tolerance.clone()
    tolerance.fill_(_CONVERGED)
    rng = np.random.default_rng(0)
    worst = 0.0
    try:
        d = mjw.make_data(model, nworld=nworld, nconmax=_CONTACTS, njmax=d.njmax)
        for _ in range(_STATES):
            states = np.stack([_draw(model, rng) for _ in range(nworld)])
            state = torch.tensor(states, dtype=torch.float32, device=device)
            ends = []
            for planned in (True, False):
                mjw.reset_data(m, d)
                wp.to_torch(d.qpos).copy_(state[:, : model.nq])
                wp.to_torch(d.qvel).copy_(state[:, model.nq :])
                if planned:
                    rearranged_step(m, d, device, plan, sensors=False)
                else:
                    prepare_stock(m, d)
                    mjw.step(m, d)
                ends.append(wp.to_torch(d.qacc).clone())
            fits = wp.to_torch(d.overflow) == 0
            worst = max(worst, _error(*(end[fits] for end in ends)))
    except Exception as error:
        return f"fails on it ({first_line(error)})"
    finally:
        tolerance.copy_(configured)
    return "" if worst <= _AGREES else f"differs from its step by {worst:.1e} of an acceleration"


def _draw(model: mujoco.MjModel, rng: np.random.Generator) -> np.ndarray:
    """Positions and velocities of a state."""
    qpos = model.qpos0.copy()
    qvel = rng.uniform(-1.0, 1.0, model.nv)
    for kind, at, (low, high) in zip(
        model.jnt_type, model.jnt_qposadr, model.jnt_range, strict=True
    ):
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            qpos[at + 2] -= rng.uniform(0.0, 1e-3)
        elif low < high:
            qpos[at] = np.clip(rng.uniform(low - 0.1, high + 0.1), low - 0.01, high + 0.01)
    return np.concatenate([qpos, qvel])


def _error(a: Tensor, b: Tensor) -> float:
    """Largest difference of a world over its largest number; infinite where one is not finite."""
    error = (a - b).abs().amax(1) / b.abs().amax(1).clamp(min=1.0)
    return float(error.nan_to_num(nan=torch.inf).max()) if len(error) else 0.0
