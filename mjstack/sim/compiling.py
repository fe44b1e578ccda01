"""Kernels of a physics step, compiled at the same time instead of one after the other."""

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial

import mujoco

from mjstack.process import available_cores
from mjstack.sim.fused import constraints, smooth
from mjstack.sim.fused.step import StepPlan
from mjstack.sim.mujoco_warp import mjw, wp
from mjstack.sim.sizes import BatchSizes

log = logging.getLogger(__name__)

Stage = Callable[[mjw.Model, mjw.Data], object]

# Modules of which several stages of `mujoco_warp.step` launch kernels, the slowest first
SHARED = ("forward", "passive", "sensor", "smooth", "solver", "support", "constraint")
_SILENT = 3.0  # s: from the cache it takes less
_done: set[tuple] = set()


def compile_step(
    model: mujoco.MjModel, m: mjw.Model, sizes: BatchSizes, device: wp.Device, plan: StepPlan
) -> None:
    """Compile what a planned step launches, as many modules at once as there are cores: a launch
    waits for its own module alone, and the step makes one launch after the other.

    Every stage works on one scratch world. A stage that fails here fails in the step again, which
    says so. Once in a process for a model's sizes.
    """
    key = (model.nbody, model.ngeom, model.nv, model.nsensor, sizes.njmax, str(device), plan)
    if key in _done:
        return
    _done.add(key)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    def play(stage: Stage) -> None:
        stage(m, mjw.put_data(model, data, **sizes.as_kwargs()))

    source = constraints if plan.name == "fused" else mjw
    pairs = len(constraints.convex_pairs(m)) + 1
    works = [partial(play, stage) for stage in _stages(m, plan)]
    with wp.ScopedDevice(device), ThreadPoolExecutor(available_cores()) as pool:
        futures = [pool.submit(work) for work in works[:pairs]]
        if plan.name != "fused":
            modules = [f"mujoco_warp._src.{name}" for name in SHARED]
            wait([pool.submit(wp.load_module, name, device=device) for name in modules])
        futures += [pool.submit(work) for work in works[pairs:]]
        if wait(futures, timeout=_SILENT).not_done:
            log.info("compiling MJWarp's kernels; later runs on this machine load them")
        wait(futures)
        wait([pool.submit(play, source.collision)])  # if its flags ask for others
    wp.synchronize_device(device)


def _stages(m: mjw.Model, plan: StepPlan) -> list[Stage]:
    """Stages of a step, the slowest first; pairs of geoms share no module with the others."""
    source = constraints if plan.name == "fused" else mjw
    rows: list[Stage] = [mjw.make_constraint]
    if plan.name == "fused" and not constraints.why_not_rows(m):
        rows = [constraints.contact_rows, constraints.noncontact_rows]
    context = mjw._src.collision_core.create_collision_context
    # Kernels of convex pairs take half a minute each
    stages: list[Stage] = [
        lambda m, d, types=types: mjw._src.collision_convex.convex_narrowphase(
            m, d, context(d.naconmax), [types]
        )
        for types in constraints.convex_pairs(m)
    ]
    stages.append(lambda m, d: constraints.primitive_pairs(m, d, context(d.naconmax)))
    stages += [constraints.broad_phase, mjw.sensor_acc, source.solve, *rows]
    stages += [mjw.sensor_pos, mjw.sensor_vel]
    stages.append(lambda m, d: mjw.reset_data(m, d, reset=wp.zeros(1, dtype=bool)))
    if plan.smooth:
        return [*stages, smooth.positions, smooth.forces, smooth.advance]
    stages += [mjw.kinematics, mjw.com_pos, mjw.crb, mjw.transmission, mjw.fwd_velocity]
    stages += [mjw.tendon, mjw._src.smooth.tendon_armature]
    stages += [mjw.fwd_actuation, partial(mjw.fwd_acceleration, factorize=True)]
    if m.opt.integrator == mjw.IntegratorType.IMPLICITFAST:
        stages.append(mjw.implicit)
    return stages
