"""States from which gate *parity* compares steps."""

import copy
from collections.abc import Iterator

import mujoco
import numpy as np

from mjstack.episodes.rollout import State
from mjstack.episodes.run import Run

SWUNG = "swung"
TWISTED = "twisted"
_SPINS = {"in_motion": 50.0, SWUNG: 0.0, TWISTED: 200.0}  # rad/s; states with the gate's own motion
_OFF_TARGET = 0.1  # rad, m: of servos whose force has no limit


def compared_states(run: Run) -> Iterator[tuple[str, State, tuple[int, ...]]]:
    """Name, state, and after how many steps it is compared."""
    for name, step in run.parity_steps.items():
        state = run.nominal.states[step]
        if name in _SPINS:
            yield name, _moved(run.stage.model, state, name), (1,)
        else:
            yield name, state, (1, 50)


def _forward(model: mujoco.MjModel, state: State, **values: float) -> mujoco.MjData:
    """Data of a state, with values in place of some of its parts."""
    data = mujoco.MjData(model)
    for name, numbers in state._asdict().items():
        getattr(data, name)[:] = values.get(name, numbers[0])
    mujoco.mj_forward(model, data)
    return data


def _moved(model: mujoco.MjModel, state: State, name: str) -> State:
    """The state with velocities with which masses, friction and damping count: joints move to the
    middle of their ranges, because one at its limit may be on either side of it in float32; free
    objects spin about their z axes, or twisted in the jaws about the normal of the contacts. In
    motion, servos are off their targets.
    """
    data = _forward(model, state)
    qvel = np.full((1, model.nv), float(name != TWISTED))
    past_middle = state.qpos[0, model.jnt_qposadr] > model.jnt_range.mean(1)
    qvel[0, model.jnt_dofadr[past_middle & (model.jnt_limited == 1)]] *= -1.0
    bodies = model.geom_bodyid[data.contact.geom]
    movable = (model.body_weldid[bodies] > 0).all(1)
    for joint in np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
        body = model.jnt_bodyid[joint]
        axis = np.array([0.0, 0.0, 1.0])
        if name == TWISTED:
            normals = data.contact.frame[movable & (bodies == body).any(1), :3]
            normal = np.linalg.eigh(normals.T @ normals)[1][:, -1]
            axis = len(normals[:1]) * data.xmat[body].reshape(3, 3).T @ normal
        dof = model.jnt_dofadr[joint]
        qvel[0, dof : dof + 6] = [0.0, 0.0, 0.0, *(_SPINS[name] * axis)]
    state = state._replace(qvel=qvel)
    return state._replace(ctrl=_half_force(model, state)) if name == "in_motion" else state


def _half_force(model: mujoco.MjModel, state: State) -> np.ndarray:
    """Commands, shape ``(1, nu)``, with which servos make half of their largest force, in the
    direction in which their range allows more: none shows its gain at its target or its limit.
    """
    free = copy.copy(model)
    free.actuator_ctrllimited[:] = free.actuator_forcelimited[:] = 0
    rest, more = (_forward(free, state, ctrl=u).actuator_force for u in (0.0, 1.0))
    gain = more - rest
    half = model.actuator_forcerange.T / 2.0
    half = np.where(model.actuator_forcelimited, half, np.outer([-_OFF_TARGET, _OFF_TARGET], gain))
    ctrl = np.clip((half - rest) / np.where(gain, gain, 1.0), *model.actuator_ctrlrange.T)
    larger = np.abs(rest + gain * ctrl).argmax(0)
    ctrl = np.take_along_axis(ctrl, larger[None], 0)
    return np.where(gain * model.actuator_ctrllimited, ctrl, state.ctrl)
