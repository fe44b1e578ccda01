"""Where all joints of a robot are, from the commanded ones, as its file couples them.

`posture(model, joints)` takes a compiled model and names of commanded joints. It finds which other
joints follow them by equalities of any kind (joint, tendon, connect, weld), once and in native
MuJoCo, and keeps a table of each over its leader's range:

    >>> fingers = posture(model, ["left"])
    >>> qpos = fingers.qpos(np.array([0.042]))  # (nq,): followers and idle joints in their places

`Jaws` measures how far two jaws are apart on the way of the gripper's commands.
"""

import copy
from collections.abc import Sequence
from functools import lru_cache

import mujoco
import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from mjstack.errors import MjstackError

REST = "rest/"
"""Prefix of a model's numeric field with the position of a joint that has no command."""
_KNOTS = 65  # of a table, over the leader's range
_STEPS = 60  # of a projection, at most
_MAX_STEP = 0.3  # [rad, m] per step
_EXACT = 1e-10  # [rad, m] off an equality or beyond a limit
_NEAR = 1e-6  # [rad, m] from a limit that may hold a joint
_COUPLED = 1e-5  # smaller shares of a leader's motion are rounding


class Posture:
    """Positions of all joints of a model, from those of the commanded ones.

    A joint that follows is where the equalities have it, and springs and ranges where these leave
    it free. Any other one keeps its place in the file's home keyframe, or qpos0, within its range.

    Attributes:
        rest: Positions at which joints without a leader stay, shape ``(nq,)``.
        commanded: Addresses in qpos of the commanded joints, shape ``(n,)``.
        columns: Addresses that a command determines besides, those that follow and those off
            qpos0, shape ``(m,)``.
        coupled: Numbers of the commanded joints that follow earlier ones, shape ``(c,)``; below,
            they are among the m.
        leader: Number of the commanded joint that each of them follows, shape ``(m,)``.
        low: Where the leader's range begins [rad, m], shape ``(m,)``.
        step: Distance of two knots [rad, m], shape ``(m,)``.
        value: Position at each knot [rad, m], shape ``(m, knots)``.
        slope: Its derivative by the leader's position, of the same shape.
    """

    def __init__(self, model: mujoco.MjModel, joints: Sequence[str]) -> None:
        """Probe a model; a MjstackError if a joint follows several commanded ones at once."""
        self._model = m = copy.copy(model)
        m.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        m.jnt_margin[:] = m.tendon_margin[:] = _NEAR
        self._data = mujoco.MjData(m)
        numbers = [m.joint(name).id for name in joints]
        self.commanded = m.jnt_qposadr[numbers]
        dofs = m.jnt_dofadr[numbers]
        plain = np.isin(m.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
        self._stiffness, self._spring = np.zeros((2, m.nv))
        self._stiffness[m.jnt_dofadr[plain]] = m.jnt_stiffness[plain]
        self._stiffness /= max(self._stiffness.max(initial=0.0), 1e-9)
        self._springs = (m.jnt_dofadr[plain], m.jnt_qposadr[plain])
        self._spring[self._springs[0]] = m.qpos_spring[self._springs[1]]

        moves = [self._moved_by(k) for k in range(m.neq)]
        self._moves = np.reshape(moves, (m.neq, m.nv))

        self.rest = m.qpos0.copy()
        for k in range(m.nnumeric):
            numeric = m.numeric(k)
            if numeric.name.startswith(REST):
                joint = m.joint(numeric.name.removeprefix(REST))
                self.rest[joint.qposadr[0] :][: len(numeric.data)] = numeric.data
        self.rest = self._settle(self.rest, dofs)
        leaders = self._leaders(dofs)
        held = dofs[leaders]
        tables: dict[int, tuple[int, float, float, ndarray, ndarray]] = {}
        for k in leaders if m.neq else ():
            _, few = self._walk(numbers[k], held, 9)
            if (np.abs(few) > _COUPLED).sum() > len(few):  # more than itself
                poses, slopes = self._walk(numbers[k], held, _KNOTS)
                follows = (np.abs(slopes) > _COUPLED).any(axis=0)
                follows[self.commanded[k]] = False
                low, high = poses[[0, -1], self.commanded[k]]
                for column in np.flatnonzero(follows):
                    values = (poses[:, column], slopes[:, column])
                    tables[int(column)] = (k, low, (high - low) / (_KNOTS - 1), *values)
        for column in np.flatnonzero(np.abs(self.rest - m.qpos0) > 1e-9):
            constant = (0, 0.0, 1.0, np.full(_KNOTS, self.rest[column]), np.zeros(_KNOTS))
            tables.setdefault(int(column), constant)
        for address in self.commanded[leaders]:
            tables.pop(int(address), None)
        coupled = [k for k, address in enumerate(self.commanded) if address in tables]
        self.coupled = np.array(coupled, dtype=int)
        self.columns = np.array([c for c in tables if c not in self.commanded], dtype=int)
        rows = [tables[c] for c in (*self.columns, *self.commanded[self.coupled])]
        leader, low, step, value, slope = zip(*rows, strict=True) if rows else [()] * 5
        self.leader = np.array(leader, dtype=int)
        self.low, self.step = np.array(low), np.array(step)
        self.value, self.slope = (np.reshape(n, (-1, _KNOTS)) for n in (value, slope))
        self._tensors: dict[tuple, list[Tensor]] = {}

    def qpos(self, command: ndarray) -> ndarray:
        """All positions at a command [rad, m], shapes ``(nq,)`` and ``(n,)``."""
        qpos = self.rest.copy()
        qpos[self.commanded] = command
        command = torch.from_numpy(np.asarray(command, dtype=float))
        qpos[self.columns] = self.follow(command)[0][: len(self.columns)].numpy()
        return qpos

    def agree(self, command: ndarray) -> ndarray:
        """Commands [rad, m], shape ``(..., n)``, with coupled joints where earlier ones have them."""
        command = np.array(command, dtype=float)
        follow, _ = self.follow(torch.from_numpy(command))
        command[..., self.coupled] = follow[..., len(self.columns) :].numpy()
        return command

    def follow(self, command: Tensor) -> tuple[Tensor, Tensor]:
        """Positions [rad, m] at ``columns`` and then ``coupled``, and their derivatives by their
        leaders' positions, of commands of shape ``(..., n)``; both of shape ``(..., m)``. No host
        is asked on a device after the first call.
        """
        key = (command.device, command.dtype)
        if key not in self._tensors:
            numbers = (self.low, self.step, self.value, self.slope)
            to = [torch.from_numpy(np.asarray(n, dtype=float)).to(*key) for n in numbers]
            indices = (self.leader, np.arange(len(self.leader)))
            to += [torch.from_numpy(np.asarray(n)).to(command.device) for n in indices]
            self._tensors[key] = to
        low, step, value, slope, leader, row = self._tensors[key]
        at = ((command.index_select(-1, leader) - low) / step).clamp(0.0, _KNOTS - 1.0)
        knot = at.floor().clamp(max=_KNOTS - 2.0)
        t = at - knot
        knot = knot.long()
        a, b = value[row, knot], value[row, knot + 1]
        da, db = step * slope[row, knot], step * slope[row, knot + 1]
        bend = da + db - 2.0 * (b - a)  # a cubic with these ends
        lean = (b - a) - da - bend
        return a + t * (da + t * (lean + t * bend)), (da + t * (2.0 * lean + 3.0 * t * bend)) / step

    def _walk(self, joint: int, held: ndarray, count: int) -> tuple[ndarray, ndarray]:
        """Positions, and their derivatives by a leader's position, while it goes over its range,
        both of shape ``(count, nq)``.
        """
        m = self._model
        wide = [-2.0 * np.pi, 2.0 * np.pi]
        low, high = m.jnt_range[joint] if m.jnt_limited[joint] else wide
        address = m.jnt_qposadr[joint]
        number = held.tolist().index(m.jnt_dofadr[joint])
        knots = np.linspace(low, high, count)
        first = int(np.abs(knots - self.rest[address]).argmin())
        poses, slopes = np.empty((2, count, m.nq))
        begin = self.rest.copy()
        for begin[address] in np.linspace(begin[address], knots[first], 20)[1:]:
            begin = self._settle(begin, held)
        for way in (range(first, count), range(first, -1, -1)):
            qpos = begin.copy()
            for knot in way:
                qpos[address] = knots[knot]
                qpos = self._settle(qpos, held)
                shares = self._shares(qpos, held)
                several = (np.abs(shares) > _COUPLED).sum(axis=1) > 1
                if several.any():
                    self._refuse(int(m.dof_jntid[several.argmax()]), held, shares)
                moved = qpos.copy()
                mujoco.mj_integratePos(m, moved, shares[:, number], 1e-5)
                poses[knot], slopes[knot] = qpos, (moved - qpos) / 1e-5
        return poses, slopes

    def _moved_by(self, equality: int) -> ndarray:
        """Whether each degree of freedom moves what an equality couples: both ends move alike with
        those before them, whose Jacobian is the equality's error alone.
        """
        m = self._model
        kind = int(m.eq_objtype[equality])
        ends = [m.eq_obj1id[equality], m.eq_obj2id[equality]]
        site, body = int(mujoco.mjtObj.mjOBJ_SITE), int(mujoco.mjtObj.mjOBJ_BODY)
        if kind == site:
            ends = m.site_bodyid[ends]
        if kind not in (site, body):
            return np.ones(m.nv, dtype=bool)
        moved = np.zeros((2, m.nv), dtype=bool)
        for row, body in zip(moved, ends, strict=True):
            while body:
                row[m.body_dofadr[body] :][: m.body_dofnum[body]] = True
                body = m.body_parentid[body]
        return moved[0] != moved[1]

    def _refuse(self, joint: int, held: ndarray, shares: ndarray) -> None:
        m = self._model
        row = np.abs(shares[m.jnt_dofadr[joint]]) > _COUPLED
        names = " and ".join(m.joint(m.dof_jntid[dof]).name for dof in held[row])
        raise MjstackError(
            f"joint {m.joint(joint).name} follows {names} by the file's equalities, expected one of"
            " the commanded joints",
            "Leave the others out of arm_joints and gripper_joints",
        )

    def _leaders(self, dofs: ndarray) -> list[int]:
        """Numbers of the commanded joints that do not follow earlier ones."""
        jac, _, equal = self._rows(self.rest)
        leaders: list[int] = []
        for k, dof in enumerate(dofs):
            loose = np.ones(self._model.nv, dtype=bool)
            loose[dofs[leaders]] = False
            rows = jac[equal][:, loose]
            _, size, basis = np.linalg.svd(rows) if rows.size else (0, ndarray(0), np.eye(1))
            null = basis[(size > 1e-9).sum() :]
            if not rows.size or np.abs(null[:, loose[:dof].sum()]).max(initial=0.0) > _COUPLED:
                leaders.append(k)
        return leaders

    def _rows(self, qpos: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        """Jacobians, shape ``(rows, nv)``, errors [rad, m], and which rows are equalities: others
        are limits that are near.
        """
        data = self._data
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(self._model, data)
        kind = data.efc_type[: data.nefc]
        equal = kind == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        limits = (mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT, mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON)
        chosen = equal | np.isin(kind, limits)
        jac = data.efc_J[: data.nefc * self._model.nv].reshape(-1, self._model.nv).copy()
        jac[equal] *= self._moves[data.efc_id[: data.nefc][equal]]
        return jac[chosen], data.efc_pos[: data.nefc][chosen], equal[chosen]

    def _settle(self, qpos: ndarray, held: ndarray) -> ndarray:
        """The nearest positions within limits at which the equalities hold, those of held degrees
        of freedom as they are; of coupled joints that are still free, where their springs rest.
        """
        qpos = qpos.copy()
        for _ in range(_STEPS):
            step, off, _ = self._step(qpos, held)
            largest = np.abs(step).max(initial=0.0)
            if off < _EXACT and largest < _EXACT:
                break
            mujoco.mj_integratePos(self._model, qpos, step, min(1.0, _MAX_STEP / largest))
        return qpos

    def _step(self, qpos: ndarray, held: ndarray) -> tuple[ndarray, float, ndarray]:
        """One step of `_settle`: Newton's, with limits as an active set; the largest error; and the
        Jacobian of what holds.
        """
        jac, pos, equal = self._rows(qpos)
        free = np.ones(self._model.nv, dtype=bool)
        free[held] = False
        rows = (np.abs(jac[:, free]) > 1e-9).any(axis=1) & (equal | (pos < _NEAR))
        jac, pos, equal = jac[rows], pos[rows], equal[rows]
        force = np.zeros(self._model.nv)
        stiff = self._stiffness * (np.abs(jac[equal]) > 1e-9).any(axis=0)
        dofs, addresses = self._springs
        force[dofs] = stiff[dofs] * (self._spring[dofs] - qpos[addresses])
        step = np.zeros(self._model.nv)
        while True:
            step[free], push = _nearest(stiff[free], force[free], jac[:, free], -pos)
            pulls = ~equal & (pos > -_EXACT) & (push < -1e-12)  # such a limit holds nothing
            if not pulls.any():
                break
            jac, pos, equal = jac[~pulls], pos[~pulls], equal[~pulls]
        off = np.abs(pos[equal]).max(initial=0.0)
        holds = equal | (push > 1e-9) & (off < _NEAR)  # a range may cut the way off
        return step, np.abs(pos).max(initial=0.0), jac[holds]

    def _shares(self, qpos: ndarray, held: ndarray) -> ndarray:
        """How far each degree of freedom moves with each held one, shape ``(nv, len(held))``."""
        _, _, jac = self._step(qpos, held)
        free = np.ones(self._model.nv, dtype=bool)
        free[held] = False
        shares = np.zeros((self._model.nv, len(held)))
        shares[held, np.arange(len(held))] = 1.0
        stiff = self._stiffness[free]
        for column, dof in enumerate(held):
            goal = -jac[:, dof]
            shares[free, column], _ = _nearest(stiff, np.zeros(len(stiff)), jac[:, free], goal)
        return shares


def _nearest(
    stiff: ndarray, force: ndarray, jac: ndarray, goal: ndarray
) -> tuple[ndarray, ndarray]:
    """The step along which springs yield least with ``jac @ step = goal``, and its multipliers."""
    size, rows = len(stiff), len(goal)
    system = np.zeros((size + rows, size + rows))
    system[:size, :size] = np.diag(stiff + 1e-4)
    system[:size, size:] = -jac.T
    system[size:, :size] = jac
    both = np.linalg.lstsq(system, np.concatenate((force, goal)), rcond=1e-11)[0]
    return both[:size], both[size:]


@lru_cache(maxsize=8)
def _cached(model: mujoco.MjModel, joints: tuple[str, ...]) -> Posture:
    return Posture(model, joints)


def posture(model: mujoco.MjModel, joints: Sequence[str]) -> Posture:
    """The posture of a model's commanded joints, probed once per model."""
    return _cached(model, tuple(joints))
