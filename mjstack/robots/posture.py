"""Where all joints of a robot are, from the commanded ones, as its file couples them.

`posture(model, joints)` takes a compiled model and names of commanded joints. It finds which other
joints follow them by equalities of any kind (joint, tendon, connect, weld), once and in native
MuJoCo, and keeps a table of each over its leader's range:

    >>> fingers = posture(model, ("left",))
    >>> fingers.qpos([0.042])  # (nq,): followers and idle joints in their places
"""

import copy
from collections.abc import Collection, Sequence
from functools import lru_cache

import mujoco
import numpy as np
import torch
from numpy import ndarray
from numpy.typing import ArrayLike
from torch import Tensor

from mjstack.errors import ConfigError, MjstackError

REST = "rest/of/mjstack/"
"""Prefix of a model's numeric field with the position of a joint that has no command."""
KNOTS = 129
"""Positions in a table, over the leader's range."""
_STEPS = 50  # of a projection, at most
_MAX_STEP = 0.3  # [rad, m] per step
_EXACT = 1e-10  # [rad, m] a smaller step ends it
_ERROR = 1e-6  # [rad, m] of an equality that does not hold
_HALVINGS = 16  # of the distance of two knots, where a range ends between them
_MOTION = 1e-9  # [rad, m] less is rounding


class Posture:
    """Positions of all hinges and slides of a model, from those of the commanded ones.

    A joint that follows is where the equalities have it, and springs and ranges where these leave
    it free. Any other one keeps its place in the file's home keyframe, or qpos0, within its range.

    Attributes:
        rest: Positions at which joints without a leader stay, shape ``(nq,)``.
        commanded: Addresses in qpos of the commanded joints, shape ``(n,)``.
        limits: Their ranges, as far as what follows them can [rad, m], shape ``(n, 2)``; infinite
            where there is none.
        columns: Addresses that a command determines besides: of what follows, and of what is off
            qpos0, shape ``(m,)``.
        coupled: Numbers of the commanded joints that follow earlier ones; below, m includes them.
        leader: Number of the commanded joint that each follows, or -1, shape ``(m,)``.
        low: Where the leader's range begins [rad, m], shape ``(m,)``.
        step: Distance of two knots [rad, m], shape ``(m,)``.
        value: Position at each knot [rad, m], shape ``(m, KNOTS)``.
    """

    def __init__(self, model: mujoco.MjModel, joints: Sequence[str]) -> None:
        """Probe a model; a MjstackError if a joint follows several commanded ones at once."""
        self._model = m = copy.copy(model)
        m.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        for name in ("CONTACT", "LIMIT", "FRICTIONLOSS"):  # equalities remain
            m.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
        self._data = mujoco.MjData(m)
        plain = np.flatnonzero(m.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE))
        self._dofs, self._addresses = m.jnt_dofadr[plain], m.jnt_qposadr[plain]
        ranges = np.where(m.jnt_limited[:, None], m.jnt_range, [-np.inf, np.inf])
        self._low, self._high = ranges[plain].T
        self._stiffness = m.jnt_stiffness[plain] / max(m.jnt_stiffness.max(initial=0.0), 1e-9)
        numbers = [m.joint(name).id for name in joints]
        self.commanded = m.jnt_qposadr[numbers]
        constant = (m.eq_obj2id < 0) | ~m.eq_data[:, 1:5].any(axis=1)
        pinned = (m.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)) & m.eq_active0 & constant
        for name, number in zip(joints, numbers, strict=True):
            if number in m.eq_obj1id[pinned]:
                problem = (
                    f"joint {name} is held at one place by an equality, expected one that moves"
                )
                raise MjstackError(problem, "Leave it out of arm_joints and gripper_joints")

        # Rest
        self.rest = m.qpos0.copy()
        for joint in range(m.njnt):
            name, first = REST + m.joint(joint).name, m.jnt_qposadr[joint]
            if mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_NUMERIC, name) >= 0:
                self.rest[first : first + len(m.numeric(name).data)] = m.numeric(name).data
        idle = ~np.isin(self._addresses, self.commanded)
        at = self._addresses[idle]
        self.rest[at] = np.clip(self.rest[at], self._low[idle], self._high[idle])
        named = m.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)
        named = np.concatenate((m.eq_obj1id[named], m.eq_obj2id[named]))
        self._linked = np.isin(plain, named)
        # Joints before both ends of an equality have the Jacobian of its error, which is 0 here
        self._linked |= (np.abs(self._rows(m.qpos0)[0]) > 1e-6).any(axis=0)
        self.rest = self._settle(self.rest, self.commanded)

        # Tables
        tables: dict[int, tuple[int, float, float, ndarray]] = {}
        self.limits = ranges[numbers]
        for k, address in enumerate(self.commanded):
            if address in tables or not self._linked[self._addresses == address].any():
                continue
            ends = np.where(np.isinf(self.limits[k]), [-2.0 * np.pi, 2.0 * np.pi], self.limits[k])
            positions = self._walk(int(address), k + 1, ends)
            low, high = positions[[0, -1], address]
            self.limits[k] = np.where([low, high] == ends, self.limits[k], [low, high])
            moved = np.ptp(positions, axis=0) > _MOTION
            moved[address] = False
            for column in np.flatnonzero(moved).tolist():
                if column in tables:
                    name = m.joint(int(np.flatnonzero(m.jnt_qposadr == column)[0])).name
                    leaders = f"{joints[tables[column][0]]} and {joints[k]}"
                    problem = f"joint {name} follows {leaders}, expected one of them"
                    fix = "Leave the other out of arm_joints and gripper_joints"
                    raise MjstackError(problem, fix)
                tables[column] = (k, low, (high - low) / (KNOTS - 1), positions[:, column])
        for column in np.flatnonzero(np.abs(self.rest - m.qpos0) > _MOTION).tolist():
            if column not in self.commanded:
                tables.setdefault(column, (-1, 0.0, 1.0, np.full(KNOTS, self.rest[column])))
        coupled = [k for k, address in enumerate(self.commanded) if address in tables]
        self.coupled = np.array(coupled, dtype=int)
        self.columns = np.array([c for c in tables if c not in self.commanded], dtype=int)
        rows = [tables[address] for address in self.follows]
        self.leader = np.array([leader for leader, *_ in rows], dtype=int)
        self.low = np.array([low for _, low, *_ in rows])
        self.step = np.array([step for *_, step, _ in rows])
        self.value = np.reshape([value for *_, value in rows], (-1, KNOTS))
        self._tensors: dict[tuple, list[Tensor]] = {}

    @property
    def follows(self) -> ndarray:
        """Addresses of the joints of all rows of the tables, shape ``(m,)``."""
        return np.concatenate((self.columns, self.commanded[self.coupled]))

    def qpos(self, command: ArrayLike) -> ndarray:
        """All positions at a command [rad, m], shapes ``(nq,)`` and ``(n,)``."""
        qpos = self.rest.copy()
        qpos[self.commanded] = command
        follow, _ = self.follow(torch.tensor(command, dtype=torch.float64))
        qpos[self.columns] = follow[: len(self.columns)].numpy()
        return qpos

    def agree(self, command: ArrayLike) -> ndarray:
        """Commands [rad, m], shape ``(..., n)``, in which coupled joints follow earlier ones."""
        command = np.array(command, dtype=float)
        self.project(torch.from_numpy(command), range(len(self.commanded)))
        return command

    def project(
        self, command: Tensor, moving: Collection[int], zeros: Tensor | None = None
    ) -> None:
        """Write coupled joints into commands [rad, m], shape ``(..., n)``: those that are among
        some numbers of joints, or whose leaders are. ``zeros``, of the same shape, is how far the
        joints' zeros are off the file's.
        """
        leaders = self.leader[len(self.columns) :].tolist()
        pairs = enumerate(zip(self.coupled.tolist(), leaders, strict=True), len(self.columns))
        rows = [(row, k) for row, (k, leader) in pairs if k in moving or leader in moving]
        if rows:
            follow, _ = self.follow(command if zeros is None else command + zeros)
        for row, k in rows:
            command[..., k] = follow[..., row] - (0.0 if zeros is None else zeros[..., k])

    def shares(self, command: ndarray) -> ndarray:
        """How far each degree of freedom moves with each commanded joint, shape ``(nv, n)``."""
        shares = np.zeros((self._model.nv, len(self.commanded)))
        dofs = dict(zip(self._addresses.tolist(), self._dofs.tolist(), strict=True))
        shares[[dofs[c] for c in self.commanded], np.arange(len(self.commanded))] = 1.0
        shares[[dofs[c] for c in self.commanded[self.coupled]]] = 0.0
        _, slopes = self.follow(torch.from_numpy(command))
        shares[[dofs[c] for c in self.follows], self.leader] = slopes.numpy()
        return shares

    def follow(self, command: Tensor) -> tuple[Tensor, Tensor]:
        """Positions [rad, m] at ``columns`` and then of ``coupled``, and their derivatives by their
        leaders' positions, of commands of shape ``(..., n)``; both of shape ``(..., m)``. After the
        first call the host is not asked.
        """
        key = (command.device, command.dtype)
        if key not in self._tensors:
            tables = [torch.tensor(n).to(*key) for n in (self.low, self.step, self.value)]
            rows = (self.leader.clip(0), np.arange(len(self.leader)))
            self._tensors[key] = tables + [torch.tensor(n, device=command.device) for n in rows]
        low, step, value, leader, row = self._tensors[key]
        at = ((command.index_select(-1, leader) - low) / step).clamp(0.0, KNOTS - 1.0)
        knot = (at.floor() - 1.0).clamp(0.0, KNOTS - 4.0)  # the first of four: a cubic
        t = at - knot
        knot = knot.long()
        a, b, c, d = (value[row, knot + k] for k in range(4))
        first, second, third = b - a, c - 2.0 * b + a, (d - a) - 3.0 * (c - b)
        position = a + t * (first + (t - 1.0) / 2.0 * (second + (t - 2.0) / 3.0 * third))
        slope = first + (t - 0.5) * second + (t * (t / 2.0 - 1.0) + 1.0 / 3.0) * third
        return position, slope / step

    def _walk(self, address: int, count: int, ends: ndarray) -> ndarray:
        """Positions while a joint goes from one end to the other, as far as the equalities hold,
        shape ``(KNOTS, nq)``. Other commanded ones stand, unless the equalities need those after
        the first few, of this count, to move.
        """
        knots = np.linspace(ends[0], ends[1], KNOTS)
        first = int(np.abs(knots - self.rest[address]).argmin())
        positions = np.empty((KNOTS, len(self.rest)))
        exact = np.zeros(KNOTS, dtype=bool)
        for way in (range(first, KNOTS), range(first, -1, -1)):
            qpos = self.rest
            for knot in way:
                qpos, exact[knot] = self._place(qpos, address, knots[knot], count)
                positions[knot] = qpos
                if exact.any() and not exact[knot]:
                    break
        if exact.all() or not exact.any():
            return positions
        inside = np.flatnonzero(exact)[[0, -1]]
        near, far = knots[inside], knots[np.clip(inside + np.array([-1, 1]), 0, KNOTS - 1)]
        for _ in range(_HALVINGS):
            for side, middle in enumerate((near + far) / 2.0):
                holds = self._place(positions[inside[side]], address, middle, count)[1]
                (near if holds else far)[side] = middle
        return self._walk(address, count, near)

    def _place(self, qpos: ndarray, address: int, value: float, count: int) -> tuple[ndarray, bool]:
        """Positions with a joint elsewhere, and whether the equalities hold there."""
        qpos = qpos.copy()
        qpos[address] = value
        for still in (self.commanded, self.commanded[:count]):
            qpos = self._settle(qpos, still)
            if self.error(qpos) <= _ERROR:
                return qpos, True
        return qpos, False

    def error(self, qpos: ndarray) -> float:
        """The largest error of an equality [rad, m] at positions of shape ``(nq,)``."""
        return float(np.abs(self._rows(qpos)[1]).max(initial=0.0))

    def _rows(self, qpos: ndarray) -> tuple[ndarray, ndarray]:
        """Jacobian of the equalities, shape ``(rows, hinges and slides)``, and their errors."""
        self._data.qpos[:] = qpos
        mujoco.mj_fwdPosition(self._model, self._data)
        size = self._data.nefc
        jac = self._data.efc_J[: size * self._model.nv].reshape(size, self._model.nv)
        return jac[:, self._dofs], self._data.efc_pos[:size].copy()

    def _settle(self, qpos: ndarray, still: ndarray) -> ndarray:
        """The nearest positions within ranges at which equalities hold, without a motion at some
        addresses; of what is still free, where springs rest.
        """
        qpos = qpos.copy()
        linked = np.flatnonzero(self._linked & ~np.isin(self._addresses, still))
        for _ in range(_STEPS if linked.size else 0):
            jac, error = self._rows(qpos)
            loose = linked
            while True:
                at = self._addresses[loose]
                stiff = np.diag(self._stiffness[loose] + 1e-4)  # else the shortest way
                system = np.block(
                    [[stiff, jac[:, loose].T], [jac[:, loose], np.zeros((len(error),) * 2)]]
                )
                pull = self._stiffness[loose] * (self._model.qpos_spring[at] - qpos[at])
                step = np.linalg.lstsq(system, np.concatenate((pull, -error)), rcond=1e-11)[0]
                step = step[: len(at)]
                high, low = (qpos[at] >= self._high[loose]), (qpos[at] <= self._low[loose])
                stopped = (high & (step > 0.0)) | (low & (step < 0.0))
                if not stopped.any():
                    break
                loose = loose[~stopped]
            largest = np.abs(step).max(initial=0.0)
            moved = qpos[at] + step * min(1.0, _MAX_STEP / max(largest, _EXACT))
            qpos[at] = np.clip(moved, self._low[loose], self._high[loose])
            if largest < _EXACT:
                break
        return qpos


posture = lru_cache(maxsize=8)(Posture)
"""The posture of a model's commanded joints, a tuple, probed once per model."""


def idle_servos(
    model: mujoco.MjModel, commanded: ndarray, posture: Posture
) -> tuple[ndarray, ndarray]:
    """Position servos without a command, and commands that hold what they move at rest.

    Raises:
        ConfigError: One pulls at a joint whose place commands determine.
    """
    data = mujoco.MjData(model)
    data.qpos = posture.rest
    mujoco.mj_fwdPosition(model, data)
    moment = actuator_moment(data)
    gain, bias = model.actuator_gainprm[:, 0], model.actuator_biasprm
    fixed = model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)
    servos = np.flatnonzero(fixed & (gain != 0.0) & (bias[:, 1] < 0.0))
    servos = np.setdiff1d(servos, commanded)
    followers = posture.columns[np.ptp(posture.value, axis=1)[: len(posture.columns)] > 0.0]
    moved = np.isin(model.jnt_qposadr[model.dof_jntid], (*posture.commanded, *followers))
    for servo, dof in np.argwhere(moved & (moment != 0.0)):
        if servo in servos:
            name = model.actuator(servo).name or "unnamed"
            joint = model.joint(model.dof_jntid[dof]).name
            expected = f"none that pulls at joint {joint}, which other servos move"
            fix = "List a follower in gripper_joints, or take the actuator out of the robot's file"
            raise ConfigError("actuator without a command", name, expected, fix)
    servos = servos[model.actuator_dyntype[servos] == int(mujoco.mjtDyn.mjDYN_NONE)]
    return servos, -(bias[:, 0] + bias[:, 1] * data.actuator_length)[servos] / gain[servos]


def actuator_moment(data: mujoco.MjData) -> ndarray:
    """Force on each dof by a unit of each actuator's, shape ``(nu, nv)``."""
    moment = np.zeros((data.model.nu, data.model.nv))
    sparse = (data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    mujoco.mju_sparse2dense(moment, data.actuator_moment, *sparse)
    return moment
