"""Native MuJoCo over many worlds: one state row per world, one MjData per thread, a pool over all cores."""

from __future__ import annotations

import copy
import os
import platform
from concurrent.futures import ThreadPoolExecutor, wait

import mujoco
import numpy as np
import torch

from mjstack.sim.simulation import Overflow

_S = mujoco.mjtState
_SPEC = int(_S.mjSTATE_TIME | _S.mjSTATE_QPOS | _S.mjSTATE_QVEL | _S.mjSTATE_ACT | _S.mjSTATE_WARMSTART | _S.mjSTATE_CTRL)
_CONTACT_FULL = int(mujoco.mjtWarning.mjWARN_CONTACTFULL)
_CONSTRAINT_FULL = int(mujoco.mjtWarning.mjWARN_CNSTRFULL)


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class NativeSimulation:
    """`Simulation` on native MuJoCo, float64 on the CPU.

    A world's whole state, warm start included, is one row that goes into a thread's MjData before its substeps and comes
    back after them. MuJoCo's automatic reset of a diverged world is switched off, because it would hide the divergence; a
    world whose state is not finite is not stepped any more, and its derived arrays are NaN.
    """

    backend = "native"

    def __init__(self, model: mujoco.MjModel, nworld: int, *, nthread: int | None = None) -> None:
        """Allocates nworld worlds at qpos0.

        Args:
            model: The compiled model.
            nworld: Number of worlds.
            nthread: Threads; all cores by default.
        """
        self.model = copy.copy(model)
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.nworld = nworld
        self.device = torch.device("cpu")
        self._nthread = max(1, min(nthread or available_cores(), nworld))
        self.description = f"MuJoCo {mujoco.__version__} on {self._nthread} threads, {platform.machine()} CPU"
        self._datas = [mujoco.MjData(self.model) for _ in range(self._nthread)]
        self._pool = ThreadPoolExecutor(self._nthread) if self._nthread > 1 else None

        m = self.model
        self._state = np.zeros((nworld, mujoco.mj_stateSize(m, _SPEC)))
        # mj_getState's order: time, qpos, qvel, act, (history), warm start, ctrl.
        q, v = 1, 1 + m.nq
        self.qpos = torch.from_numpy(self._state[:, q : q + m.nq])
        self.qvel = torch.from_numpy(self._state[:, v : v + m.nv])
        self.ctrl = torch.from_numpy(self._state[:, self._state.shape[1] - m.nu :])
        self._physics = slice(q, v + m.nv)
        self._finite: np.ndarray = np.ones(nworld, dtype=bool)
        self._initial = self._state[0].copy()
        mujoco.mj_getState(m, self._datas[0], self._initial, _SPEC)

        self._derived = {
            "xpos": np.zeros((nworld, m.nbody, 3)),
            "xquat": np.zeros((nworld, m.nbody, 4)),
            "site_xpos": np.zeros((nworld, m.nsite, 3)),
            "qfrc_actuator": np.zeros((nworld, m.nv)),
        }
        self.xpos = torch.from_numpy(self._derived["xpos"])
        self.xquat = torch.from_numpy(self._derived["xquat"])
        self.site_xpos = torch.from_numpy(self._derived["site_xpos"])
        self.qfrc_actuator = torch.from_numpy(self._derived["qfrc_actuator"])
        # Columns: contacts, rows, peak contacts, peak rows, overflow bits.
        self._counts = np.zeros((nworld, 5), dtype=np.int32)
        self.contact_count, self.constraint_count, self.peak_contacts, self.peak_constraints, self.overflow = torch.from_numpy(
            self._counts
        ).unbind(1)
        self._steps = np.zeros(nworld, dtype=np.int64)
        self.step_count = torch.from_numpy(self._steps)
        self.reset()

    def step(self, n: int = 1) -> None:
        """Advances every world by n physics steps under the current ctrl."""
        self._run(n)

    def forward(self) -> None:
        """Computes everything that derives from the state, without advancing time; warm starts stay as they are."""
        self._run(0)

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Puts the masked worlds back to qpos0, at rest."""
        rows = np.ones(self.nworld, dtype=bool) if mask is None else mask.numpy()
        self._state[rows] = self._initial
        self._counts[rows] = 0
        self._steps[rows] = 0

    def option_values(self) -> dict[str, float | int | str]:
        """The physics options of the model."""
        opt = self.model.opt
        return {
            "timestep": opt.timestep,
            "iterations": opt.iterations,
            "ls_iterations": opt.ls_iterations,
            "impratio": opt.impratio,
            "tolerance": opt.tolerance,
            "integrator": mujoco.mjtIntegrator(opt.integrator).name,
            "cone": mujoco.mjtCone(opt.cone).name,
            "solver": mujoco.mjtSolver(opt.solver).name,
            "box_box": "primitive",
        }

    def synchronize(self) -> None:
        """Nothing to wait for: `step` returns when every thread has."""

    def close(self) -> None:
        """Stops the threads."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def _run(self, n: int) -> None:
        # A diverged world stays as it is: MuJoCo would spend every solver iteration on its NaN, and gain nothing.
        self._finite[:] = np.isfinite(self._state[:, self._physics]).all(axis=1)
        if self._pool is None:
            self._run_worlds(self._datas[0], range(self.nworld), n)
            return
        # Interleaved rows balance the load: neighbouring worlds tend to cost alike.
        jobs = [
            self._pool.submit(self._run_worlds, data, range(i, self.nworld, self._nthread), n)
            for i, data in enumerate(self._datas)
        ]
        wait(jobs)
        for job in jobs:
            job.result()

    def _run_worlds(self, data: mujoco.MjData, worlds: range, n: int) -> None:
        """Steps some worlds on one thread. mj_step releases the interpreter lock; the rest is a few microseconds."""
        m, state, counts, steps = self.model, self._state, self._counts, self._steps
        xpos, xquat = self._derived["xpos"], self._derived["xquat"]
        site_xpos, qfrc_actuator = self._derived["site_xpos"], self._derived["qfrc_actuator"]
        warning = data.warning.number
        for w in worlds:
            if not self._finite[w]:
                for derived in (xpos, xquat, site_xpos, qfrc_actuator):
                    derived[w] = np.nan
                continue
            mujoco.mj_setState(m, data, state[w], _SPEC)
            data.maxuse_con = data.maxuse_efc = 0
            warning[:] = 0
            if n:
                mujoco.mj_step(m, data, n)
                mujoco.mj_getState(m, data, state[w], _SPEC)
                steps[w] += n
            else:
                mujoco.mj_forward(m, data)
            xpos[w] = data.xpos
            xquat[w] = data.xquat
            site_xpos[w] = data.site_xpos
            qfrc_actuator[w] = data.qfrc_actuator
            row = counts[w]
            row[0], row[1] = data.ncon, data.nefc
            row[2] = max(row[2], data.maxuse_con, data.ncon)
            row[3] = max(row[3], data.maxuse_efc, data.nefc)
            if warning[_CONTACT_FULL]:
                row[4] |= int(Overflow.NARROWPHASE)
            if warning[_CONSTRAINT_FULL]:
                row[4] |= int(Overflow.NEFC)
