"""Kernels of a physics step, compiled at the same time instead of one after the other; those of
`mujoco_warp.step` beside other work.
"""

import logging
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import mujoco

from mjstack.config.schema import Config, GateCfg
from mjstack.errors import first_line
from mjstack.interrupt import check_interrupt
from mjstack.process import POLL, available_cores, own_command
from mjstack.sim.fused import constraints, smooth
from mjstack.sim.fused.step import StepPlan
from mjstack.sim.mujoco_warp import mjw, wp
from mjstack.sim.sizes import BatchSizes, resolve_sizes

log = logging.getLogger(__name__)

Stage = Callable[[mjw.Model, mjw.Data], object]

# Modules of which several stages of `mujoco_warp.step` launch kernels, the slowest first
SHARED = ("forward", "passive", "sensor", "smooth", "solver", "support", "constraint")
_SILENT = 3.0  # s: from the cache it takes less
_LONGEST = 120.0  # s, to wait for a process: on an H100 with 16 cores it takes half a minute
_done: set[tuple] = set()
_planned: list[Callable[[str], subprocess.Popen[bytes]]] = []  # compilers, by the device
_running: list[subprocess.Popen[bytes]] = []


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

    collision, *later = [partial(play, stage) for stage in _stages(m, plan)]
    with wp.ScopedDevice(device), ThreadPoolExecutor(available_cores()) as pool:
        futures = [pool.submit(collision)]
        if plan.name != "fused":
            modules = [f"mujoco_warp._src.{name}" for name in SHARED]
            wait([pool.submit(wp.load_module, name, device=device) for name in modules])
        futures += [pool.submit(stage) for stage in later]
        if wait(futures, timeout=_SILENT).not_done:
            log.info("compiling MJWarp's kernels; later runs on this machine load them")
            if device.is_cuda:
                _compile_planned(str(device))
    wp.synchronize_device(device)


def _stages(m: mjw.Model, plan: StepPlan) -> list[Stage]:
    """Stages of a step: collision, which shares no module with the others, then the slowest."""
    rows = constraints if plan.name == "fused" else mjw
    stages: list[Stage] = [rows.collision, mjw.sensor_acc, rows.solve, rows.make_constraint]
    stages += [mjw.sensor_pos, mjw.sensor_vel, _reset]
    if plan.smooth:
        return [*stages, smooth.positions, smooth.forces, smooth.advance]
    stages += [mjw.kinematics, mjw.com_pos, mjw.crb, mjw.transmission, mjw.fwd_velocity]
    stages += [mjw.fwd_actuation, partial(mjw.fwd_acceleration, factorize=True)]
    if m.opt.integrator == mjw.IntegratorType.IMPLICITFAST:
        stages.append(mjw.implicit)
    return stages


def _reset(m: mjw.Model, d: mjw.Data) -> None:
    mjw.reset_data(m, d, reset=wp.zeros(1, dtype=bool))


@contextmanager
def stock_step_beside(stage: Callable[[], tuple[mujoco.MjModel, Config]]) -> Iterator[None]:
    """Compile what `mujoco_warp.step` launches in another process. It starts when a CUDA kernel of
    this process is not in the cache, and ends with the context. A thread would not do: a graph
    cannot be captured while a thread loads a module.

    Args:
        stage: Gives the scene and the configuration, asked when that process starts.
    """
    _planned.append(lambda device: compile_apart(*stage(), device))
    try:
        yield
    finally:
        _end_processes()


def _compile_planned(device: str) -> None:
    while _planned:
        try:
            _running.append(_planned.pop()(device))
        except Exception as error:  # the kernels compile when they are needed
            log.info("mujoco_warp.step is not compiled apart: %s", first_line(error))


def wait_for_stock_step() -> None:
    """Return when no process is compiling any more, and start none: what follows is timed. One that
    takes too long is ended.
    """
    _planned.clear()
    last = time.monotonic() + _LONGEST
    while any(process.poll() is None for process in _running) and time.monotonic() < last:
        check_interrupt()
        time.sleep(POLL)
    _end_processes()


def _end_processes() -> None:
    _planned.clear()
    while _running:
        process = _running.pop()
        process.kill()
        process.wait()


def compile_apart(model: mujoco.MjModel, cfg: Config, device: str) -> subprocess.Popen[bytes]:
    """Start the process of `stock_step_beside`, which ends with this one."""
    # Gates of the search path may have classes that the process does not find
    cfg = replace(cfg, sim=replace(cfg.sim, step="stock"), gate=GateCfg())
    silent = subprocess.DEVNULL
    with tempfile.TemporaryFile() as worlds:
        pickle.dump((model, cfg, 1, resolve_sizes(cfg), device, ()), worlds)
        worlds.seek(0)
        command = own_command([], "mjstack.sim.compiling")
        return subprocess.Popen(command, stdin=worlds, stdout=silent, stderr=silent)


def main() -> None:
    """The process that `compile_apart` starts."""
    from mjstack.sim.mjwarp import MjwarpSimulation

    MjwarpSimulation(*pickle.load(sys.stdin.buffer)).close()
