"""Kernels of a physics step, compiled at the same time instead of one after the other."""

import logging
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from threading import Lock
from typing import Any

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

    def work(task: Callable[..., object], *args: Any) -> None:
        with turn:
            task(*args)

    turn = Lock()
    source = constraints if plan.name == "fused" else mjw
    pairs = len(constraints.convex_pairs(m)) + 1
    stages = _stages(m, plan)
    workers = ThreadPoolExecutor(available_cores())
    with wp.ScopedDevice(device), _compilers_at_once(turn), workers as pool:
        futures = [pool.submit(work, play, stage) for stage in stages[:pairs]]
        if plan.name != "fused":
            modules = [f"mujoco_warp._src.{name}" for name in SHARED]
            wait([pool.submit(work, wp.load_module, name, device) for name in modules])
        futures += [pool.submit(work, play, stage) for stage in stages[pairs:]]
        if wait(futures, timeout=_SILENT).not_done:
            log.info("compiling MJWarp's kernels; later runs on this machine load them")
        wait(futures)
        wait([pool.submit(work, play, source.collision)])  # if its flags ask for others
    wp.synchronize_device(device)


@contextmanager
def _compilers_at_once(turn: Lock) -> Iterator[None]:
    """Threads that have their ``turn`` give it back while a compiler works for them, and no longer.

    Warp's decorators hand out the newest function of a name: of two threads that declare kernels,
    one gets a kernel that calls the other's function.
    """
    source = wp._src.build  # type: ignore[attr-defined]
    compilers = {name: getattr(source, name) for name in ("build_cpu", "build_cuda")}

    def compile_aside(compiler: Callable[..., object], *args: Any, **options: Any) -> object:
        turn.release()
        try:
            return compiler(*args, **options)
        finally:
            turn.acquire()

    for name, compiler in compilers.items():
        setattr(source, name, partial(compile_aside, compiler))
    try:
        yield
    finally:
        for name, compiler in compilers.items():
            setattr(source, name, compiler)


def _stages(m: mjw.Model, plan: StepPlan) -> list[Stage]:
    """Stages of a step, the slowest first; pairs of geoms share no module with the others."""
    source = constraints if plan.name == "fused" else mjw
    rows: list[Stage] = [mjw.make_constraint]
    if plan.name == "fused" and not constraints.why_not_rows(m):
        rows = [constraints.contact_rows, constraints.noncontact_rows]
    # Kernels of convex pairs take half a minute each
    stages: list[Stage] = [partial(_convex_pairs, types) for types in constraints.convex_pairs(m)]
    stages.append(lambda m, d: constraints.primitive_pairs(m, d, _context(d)))
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


def _convex_pairs(types: Any, m: mjw.Model, d: mjw.Data) -> None:
    mjw._src.collision_convex.convex_narrowphase(m, d, _context(d), [types])


def _context(d: mjw.Data) -> Any:
    return mjw._src.collision_core.create_collision_context(d.naconmax)
