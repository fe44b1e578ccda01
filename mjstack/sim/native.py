"""Native MuJoCo over many worlds: one state row per world, one MjData per thread, a pool over all
cores.
"""

import copy
import os
import platform
import time
import weakref
from _thread import start_new_thread
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from queue import Empty, SimpleQueue

import mujoco
import numpy as np
import torch

from mjstack.interrupt import check_interrupt
from mjstack.sim.model_fields import Fields, SimpleBodies, check_fields
from mjstack.sim.simulation import Overflow, Simulation, named_options

_S = mujoco.mjtState
_SPEC = int(
    _S.mjSTATE_TIME
    | _S.mjSTATE_QPOS
    | _S.mjSTATE_QVEL
    | _S.mjSTATE_ACT
    | _S.mjSTATE_WARMSTART
    | _S.mjSTATE_CTRL
)
_CONTACT_FULL = int(mujoco.mjtWarning.mjWARN_CONTACTFULL)
_CONSTRAINT_FULL = int(mujoco.mjtWarning.mjWARN_CNSTRFULL)
_POLL = 0.2  # s, between two looks at whether the command was interrupted
_SAMEFRAME = {
    "body_sameframe": {"body_ipos", "body_iquat"},
    "geom_sameframe": {"geom_pos", "geom_quat"},
    "site_sameframe": {"site_pos", "site_quat"},
}


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True, slots=True)
class _Worker:
    """The memory of a thread; pairs are an array of all worlds and the thread's own."""

    model: mujoco.MjModel
    data: mujoco.MjData
    fields: list[tuple[np.ndarray, np.ndarray]]
    poses: list[tuple[np.ndarray, np.ndarray]]
    others: list[tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, slots=True)
class _Visit:
    """Work on worlds that threads share.

    Ctrl-C in a script may raise anywhere in the calling thread. So all that is shared is atomic in
    C: there is no lock that could be left as it should not be.
    """

    work: Callable[[_Worker, Iterable[int]], None]
    worlds: Iterator[int]
    begun: list[_Worker] = field(default_factory=list)
    ended: list[BaseException | None] = field(default_factory=list)
    wake: SimpleQueue[None] = field(default_factory=SimpleQueue)

    def run(self, worker: _Worker) -> None:
        """Do a thread's share: all draw from one iterator, so that none waits for another. Which of
        them gets a world does not matter to it, because its whole state is loaded.
        """
        self.begun.append(worker)
        error = None
        try:
            self.work(worker, self.worlds)
        except BaseException as found:
            error = found
        self.ended.append(error)
        self.wake.put(None)

    def wait(self, workers: int) -> None:
        """Wait for every thread, and raise what went wrong."""
        while len(self.ended) < workers:
            with suppress(Empty):
                self.wake.get(timeout=_POLL)
            check_interrupt()
        for error in filter(None, self.ended):
            raise error

    def abandon(self) -> None:
        """Take the worlds away, and wait until no thread writes into the state or uses its data.
        One that begins later finds no world.
        """
        for _ in self.worlds:
            pass
        while len(self.ended) < len(self.begun):
            time.sleep(1e-4)


def _serve(tasks: SimpleQueue[Callable[[], None] | None]) -> None:
    """Do tasks until None comes, which ends every thread."""
    while (task := tasks.get()) is not None:
        task()
        del task  # it refers to the simulation
    tasks.put(None)


class NativeSimulation(Simulation):
    """`Simulation` on native MuJoCo, float64 on the CPU.

    A world's whole state, warm start included (``qacc_warmstart``), is one row that goes into a
    thread's MjData before its physics steps and comes back after them; so do its model fields into
    the thread's MjModel, if there are any. MuJoCo's automatic reset of a diverged world is switched
    off, because it would hide the divergence; a world whose state is not finite is not stepped any
    more, and its derived arrays are NaN.
    """

    backend = "native"

    def __init__(
        self,
        model: mujoco.MjModel,
        nworld: int,
        *,
        fields: Sequence[str] = (),
        nthread: int | None = None,
    ) -> None:
        """Allocate nworld worlds at qpos0.

        Args:
            model: The compiled model.
            nworld: Number of worlds.
            fields: Model fields that may differ from world to world.
            nthread: Threads; all cores by default.

        Raises:
            UnknownName: A field does not exist, or cannot differ.
        """
        self.model = copy.copy(model)
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.nworld = nworld
        self.device = torch.device("cpu")
        self.nthread = nthread = max(1, min(nthread or available_cores(), nworld))
        self.description = (
            f"MuJoCo {mujoco.__version__} on {nthread} threads, {platform.machine()} CPU"
        )
        self._tasks: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._visited: _Visit | None = None  # and perhaps not to its end
        for _ in range(nthread):
            start_new_thread(_serve, (self._tasks,))
        self._stop = weakref.finalize(self, self._tasks.put, None)

        # The state
        # mj_getState's order: time, qpos, qvel, act, warm start, ctrl.
        m = self.model
        self._state = np.zeros((nworld, mujoco.mj_stateSize(m, _SPEC)))
        widths = (1, m.nq, m.nv, m.na, m.nv, m.nu)
        parts = torch.from_numpy(self._state).split(widths, dim=1)
        _, self.qpos, self.qvel, self.act, self.qacc_warmstart, self.ctrl = parts
        self._physics = self._state[:, 1 : 1 + m.nq + m.nv + m.na]
        self._initial = self._state[0].copy()
        mujoco.mj_getState(m, mujoco.MjData(m), self._initial, _SPEC)

        # Derived arrays and counters
        self._poses = {
            "xpos": np.zeros((nworld, m.nbody, 3)),
            "xquat": np.zeros((nworld, m.nbody, 4)),
            "site_xpos": np.zeros((nworld, m.nsite, 3)),
            "geom_xpos": np.zeros((nworld, m.ngeom, 3)),
        }
        self._others = {
            "qfrc_actuator": np.zeros((nworld, m.nv)),
            "sensordata": np.zeros((nworld, m.nsensordata)),
        }
        for name, array in (self._poses | self._others).items():
            setattr(self, name, torch.from_numpy(array))
        # Columns: contacts, rows, peak contacts, peak rows, overflow bits.
        self._counts = np.zeros((nworld, 5), dtype=np.int32)
        (
            self.contact_count,
            self.constraint_count,
            self.peak_contacts,
            self.peak_constraints,
            self.overflow,
        ) = torch.from_numpy(self._counts).unbind(1)
        self._erased = torch.zeros((3, nworld), dtype=torch.int32).unbind(0)
        self._steps = np.zeros(nworld, dtype=np.int64)
        self.step_count = torch.from_numpy(self._steps)

        # Model fields, and the threads
        self._fields = {
            name: np.repeat(np.asarray(getattr(m, name), dtype=float)[None], nworld, axis=0)
            for name in check_fields(fields)
        }
        self.fields = Fields(
            {name: torch.from_numpy(values) for name, values in self._fields.items()}
        )
        derive = not self._fields.keys().isdisjoint(SimpleBodies.FIELDS) and m.dof_simplenum.any()
        self._simple = SimpleBodies(m, self._fields, nworld) if derive else None
        self._workers = [self._worker() for _ in range(nthread)]
        self.reset()

    def step(self, n: int = 1, *, kinematics: bool = False) -> None:
        """See `Simulation`."""
        if n:
            self._compute(n, kinematics)
        elif kinematics:
            self.kinematics()

    def forward(self) -> None:
        """See `Simulation`; warm starts stay as they are."""
        self._compute(0, kinematics=False)

    def kinematics(self, mask: torch.Tensor | None = None) -> None:
        """See `Simulation`; the other worlds are not visited."""
        self._visit(self._pose, self._finite_worlds(self._poses, mask=mask))

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """See `Simulation`."""
        rows = self._rows(mask)
        self._state[rows] = self._initial
        if "qpos0" in self._fields:
            self.qpos.numpy()[rows] = self._fields["qpos0"][rows]
        self._others["sensordata"][rows] = 0
        self._keep_peaks(mask)
        self._counts[rows] = 0
        self._steps[rows] = 0

    @property
    def world_bytes(self) -> int:
        """Memory that a world takes."""
        arrays = (self._state, *self._poses.values(), *self._others.values())
        return sum(a.nbytes for a in (*arrays, *self._fields.values())) // self.nworld

    def option_values(self) -> dict[str, float | int | str]:
        """The physics options of the model."""
        option = self.model.opt
        numbers = {name: getattr(option, name) for name in ("timestep", "impratio", "tolerance")}
        return {**numbers, **named_options(option), "box_box": "primitive"}

    def synchronize(self) -> None:
        """Nothing to wait for: `step` returns when every thread has."""

    def close(self) -> None:
        """Stop the threads."""
        self._stop()

    def _worker(self) -> _Worker:
        """A thread's data, and its own model if worlds differ in it."""
        model = copy.copy(self.model) if self._fields else self.model
        # MuJoCo skips an offset that was zero when it compiled: these flags make it read the field.
        for kind, names in _SAMEFRAME.items():
            if names & self._fields.keys():
                getattr(model, kind)[:] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
        data = mujoco.MjData(model)

        def pairs(
            source: object, arrays: dict[str, np.ndarray]
        ) -> list[tuple[np.ndarray, np.ndarray]]:
            return [(array, getattr(source, name)) for name, array in arrays.items() if array.size]

        fields = pairs(model, self._fields)
        if self._simple is not None:
            fields.append((self._simple.dof_M0, model.dof_M0))
        return _Worker(model, data, fields, pairs(data, self._poses), pairs(data, self._others))

    def _rows(self, mask: torch.Tensor | None) -> np.ndarray:
        """The mask as numpy sees it; every world for None."""
        self.check_mask(mask)
        return np.ones(self.nworld, dtype=bool) if mask is None else mask.numpy()

    def _compute(self, n: int, kinematics: bool) -> None:
        """Step every world n times, 0 meaning forward."""
        work = partial(self._step, n=n, kinematics=kinematics)
        self._visit(work, self._finite_worlds(self._poses, self._others))
        if kinematics:
            self._finite_worlds(self._poses)

    def _finite_worlds(
        self, *derived: dict[str, np.ndarray], mask: torch.Tensor | None = None
    ) -> list[int]:
        """The masked worlds that can be computed; the others' derived arrays become NaN.

        A diverged world is left alone: MuJoCo would spend every solver iteration on its NaN, and
        gain nothing.
        """
        rows = self._rows(mask)
        finite = np.isfinite(self._physics).all(axis=1)
        diverged = rows & ~finite
        if diverged.any():
            for arrays in derived:
                for array in arrays.values():
                    array[diverged] = np.nan
        return np.flatnonzero(rows & finite).tolist()

    def _visit(self, work: Callable[[_Worker, Iterable[int]], None], worlds: list[int]) -> None:
        """Share worlds out among the threads."""
        if self._visited is not None:
            self._visited.abandon()
        if self._simple is not None:
            self._simple.update()
        if len(worlds) < 2:
            work(self._workers[0], worlds)
            return
        visit = self._visited = _Visit(work, iter(worlds))
        try:
            for worker in self._workers:
                self._tasks.put(partial(visit.run, worker))
            visit.wait(self.nthread)
        except BaseException:
            visit.abandon()
            raise
        self._visited = None

    def _load(self, worker: _Worker, w: int) -> None:
        """Make a thread's model and data those of world w."""
        for values, own in worker.fields:
            own[:] = values[w]
        mujoco.mj_setState(worker.model, worker.data, self._state[w], _SPEC)

    def _step(self, worker: _Worker, worlds: Iterable[int], *, n: int, kinematics: bool) -> None:
        """Step some worlds on one thread, n=0 meaning forward.

        MuJoCo's functions release the interpreter lock; the rest is a few microseconds a world.
        """
        m = worker.model
        data = worker.data
        state = self._state
        counts = self._counts
        steps = self._steps
        derived = worker.others if kinematics else worker.poses + worker.others
        warning = data.warning.number
        for w in worlds:
            self._load(worker, w)
            data.maxuse_con = data.maxuse_efc = 0
            warning[:] = 0
            if n:
                mujoco.mj_step(m, data, n)
                mujoco.mj_getState(m, data, state[w], _SPEC)
                steps[w] += n
            else:
                mujoco.mj_forward(m, data)
            for view, array in derived:
                view[w] = array
            row = counts[w]
            row[0] = data.ncon
            row[1] = data.nefc
            row[2] = max(row[2], data.maxuse_con, data.ncon)
            row[3] = max(row[3], data.maxuse_efc, data.nefc)
            if warning[_CONTACT_FULL]:
                row[4] |= int(Overflow.NARROWPHASE)
            if warning[_CONSTRAINT_FULL]:
                row[4] |= int(Overflow.NEFC)
            if kinematics:
                self._write_poses(worker, w)

    def _pose(self, worker: _Worker, worlds: Iterable[int]) -> None:
        """Bring the poses of some worlds up to date on one thread."""
        for w in worlds:
            self._load(worker, w)
            self._write_poses(worker, w)

    def _write_poses(self, worker: _Worker, w: int) -> None:
        """The poses of the state that the thread's data holds. The next world loads its whole
        state, so nothing leaks.
        """
        mujoco.mj_kinematics(worker.model, worker.data)
        for view, array in worker.poses:
            view[w] = array
