"""``mujoco.rollout`` as the baseline of native MuJoCo's physics."""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco import rollout

from mjstack.envs import Env
from mjstack.errors import MjstackError
from mjstack.sim.native import NativeSimulation


class RolloutBaseline:
    """``mujoco.rollout`` over the steps of a repetition.

    It gets the warm starts of every step, which it does not carry over by itself.
    """

    def __init__(self, env: Env) -> None:
        """Allocate buffers for the worlds of a native environment."""
        assert isinstance(env.sim, NativeSimulation)
        self._sim: NativeSimulation = env.sim
        m = self._sim.model
        threads = self._sim.nthread
        self._pool = rollout.Rollout(nthread=threads)
        self._datas = [mujoco.MjData(m) for _ in range(threads)]
        self._nstep = env.cfg.timing.decimation
        n = env.nworld
        self._states = np.empty((n, mujoco.mj_stateSize(m, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
        self._out = np.empty((n, self._nstep, self._states.shape[1]))
        self._sensors = np.empty((n, self._nstep, m.nsensordata))
        self._ctrl: list[np.ndarray] = []
        self._warm: list[np.ndarray] = []

    def begin(self) -> None:
        """Take the simulation's state as the start."""
        self._ctrl.clear()
        self._warm.clear()
        sim = self._sim
        m = self._sim.model
        data = mujoco.MjData(self._sim.model)
        for w in range(sim.nworld):
            data.qpos = sim.qpos[w].numpy()
            data.qvel = sim.qvel[w].numpy()
            mujoco.mj_getState(m, data, self._states[w], mujoco.mjtState.mjSTATE_FULLPHYSICS)

    def record(self) -> None:
        """Record joint targets and warm starts before a step."""
        ctrl = self._sim.ctrl.numpy()[:, None]
        self._ctrl.append(
            np.ascontiguousarray(np.broadcast_to(ctrl, (ctrl.shape[0], self._nstep, ctrl.shape[2])))
        )
        self._warm.append(self._sim.qacc_warmstart.numpy().copy())

    def play(self) -> None:
        """Play the steps that were recorded."""
        states = self._states
        for ctrl, warm in zip(self._ctrl, self._warm, strict=True):
            self._pool.rollout(
                self._sim.model,
                self._datas,
                states,
                ctrl,
                nstep=self._nstep,
                initial_warmstart=warm,
                state=self._out,
                sensordata=self._sensors,
            )
            states = self._out[:, -1].copy()

    def check(self) -> None:
        """Raise unless every world ended as the simulation's did, bit for bit."""
        if not np.array_equal(self._out[:, -1, 1 : 1 + self._sim.model.nq], self._sim.qpos.numpy()):
            raise MjstackError(
                "mujoco.rollout and the simulation ended in different states: the figure would be"
                " void."
            )
