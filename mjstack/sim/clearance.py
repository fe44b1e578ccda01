"""Pairs of geoms that no posture lets touch: a proof by the lengths of links."""

import hashlib
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy import ndarray

from mjstack.sim.model_fields import PLACING_FIELDS

PROVED_BY = PLACING_FIELDS | {
    *("geom_size", "geom_aabb", "geom_rbound", "geom_margin", "geom_gap"),
    *("jnt_pos", "jnt_axis", "qpos0"),
}
"""Fields that a proof reads: it holds for no world that differs in one."""

_SHAPES = range(mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_MESH + 1)
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_CLEAR = 5e-4  # m between surfaces, at least
_DEEP = 3  # joints between two geoms; of more there are too many postures
_POSTURES = 2500  # of a pair, at most
_known: dict[bytes, ndarray] = {}


def find_separate(model: mujoco.MjModel, pairs: ndarray) -> ndarray:
    """Whether two geoms are apart in every posture, shape ``(n,)``, bool, for pairs of shape ``(n,
    2)``. Hinges may turn as they like: a range is a soft limit, and joints overshoot it.

    A proof, not a sample. A hinge that turns by an angle moves no point of a geom farther than that
    angle times the largest distance of the geom from the hinge. So a distance in one posture is
    enough for all postures nearby, and a turn is halved until all are covered. Once in a process.
    """
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    key = hashlib.sha256(content.tobytes()).digest() + pairs.tobytes()
    if key not in _known:
        data = mujoco.MjData(model)
        _known[key] = np.array([_proved(model, data, int(a), int(b)) for a, b in pairs], dtype=bool)
    return _known[key]


def _proved(model: mujoco.MjModel, data: mujoco.MjData, *geoms: int) -> bool:
    bodies = [int(model.geom_bodyid[geom]) for geom in geoms]
    if any(model.geom_type[geom] not in _SHAPES for geom in geoms) or any(
        model.body_mocapid[model.body_rootid[body]] >= 0 for body in bodies
    ):
        return False
    data.qpos = model.qpos0
    mujoco.mj_kinematics(model, data)
    chains = [_chain(model, body) for body in bodies]
    speeds: dict[int, float] = {}  # of a geom's farthest point, in m/rad
    for geom, chain in zip(geoms, chains, strict=True):
        reach, point = float(model.geom_rbound[geom]), data.geom_xpos[geom]
        moving = [joint for joint in chain if (joint in chains[0]) != (joint in chains[1])]
        for joint in moving:
            if model.jnt_type[joint] != _HINGE:
                return False
            arm = point - data.xanchor[joint]
            away = float(np.linalg.norm(arm))
            if joint == moving[0]:  # its own hinge does not move it along the axis
                arm = arm - (arm @ data.xaxis[joint]) * data.xaxis[joint]
            speeds[joint] = reach + float(np.linalg.norm(arm))
            reach, point = reach + away, data.xanchor[joint].copy()
    clear = _CLEAR + float((model.geom_margin + model.geom_gap)[[*geoms]].sum())
    addresses = model.jnt_qposadr[[*speeds]]
    search = _Search(model, data, geoms, addresses, np.array([*speeds.values()]), clear)
    return search.covers(np.zeros(len(speeds)), np.full(len(speeds), np.pi))


def _chain(model: mujoco.MjModel, body: int) -> list[int]:
    """Joints between a body and the world, from the body on."""
    chain: list[int] = []
    while body:
        first = int(model.body_jntadr[body])
        chain += reversed(range(first, first + int(model.body_jntnum[body])))
        body = int(model.body_parentid[body])
    return chain


@dataclass(slots=True)
class _Search:
    """A search for a posture in which two geoms may touch."""

    model: mujoco.MjModel
    data: mujoco.MjData
    geoms: tuple[int, ...]
    addresses: ndarray
    speeds: ndarray
    clear: float
    budget: int = _POSTURES

    def covers(self, middle: ndarray, half: ndarray) -> bool:
        """Whether they are apart wherever each joint is at most ``half`` from ``middle``."""
        self.budget -= 1
        self.data.qpos[self.addresses] = middle
        mujoco.mj_kinematics(self.model, self.data)
        moved = half * self.speeds
        horizon = self.clear + float(moved.sum())  # it searches no farther
        distance = mujoco.mj_geomDistance(self.model, self.data, *self.geoms, horizon, None)
        if distance >= horizon:
            return True
        if distance <= self.clear or self.budget <= 0 or len(half) > _DEEP:
            return False
        widest = np.arange(len(half)) == moved.argmax()
        half = np.where(widest, 0.5 * half, half)
        return all(self.covers(middle + side * widest * half, half) for side in (-1.0, 1.0))
