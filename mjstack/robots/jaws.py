"""Distance between a robot's jaws, as a function of the gripper's commands, in native MuJoCo.

`Jaws` takes a compiled model and names of joints, bodies and sites:

    >>> jaws = Jaws(model, joints, gripper_joints, jaw_bodies, grasp_sites)
    >>> jaws.opened, jaws.shut  # commands [rad, m] at the ends of the range
    >>> jaws.gap(np.array([jaws.opened]))  # [m] between the pads, at the grasp point
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import combinations, product

import mujoco
import numpy as np
from numpy import ndarray

from mjstack.robots.posture import posture

_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
_RAYS = (0.0, -0.004, 0.004, -0.008, 0.008)  # [m] beside the grasp point, where a pad is looked for
_FAR = 1.0  # [m] distances are not measured beyond


def jaw_members(model: mujoco.MjModel, jaws: Sequence[str]) -> list[list[int]]:
    """Bodies of each jaw: the named one and all below it, without those of a jaw further down."""
    roots = {model.body(name).id: number for number, name in enumerate(jaws)}
    members: list[list[int]] = [[] for _ in jaws]
    for body in range(1, model.nbody):
        above = body
        while above and above not in roots:
            above = int(model.body_parentid[above])
        if above:
            members[roots[above]].append(body)
    return members


def jaw_geoms(model: mujoco.MjModel, jaws: Sequence[str]) -> list[ndarray]:
    """Colliding geoms of each jaw."""
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    members = jaw_members(model, jaws)
    return [np.flatnonzero(collides & np.isin(model.geom_bodyid, bodies)) for bodies in members]


class Jaws:
    """A gripper's jaws on their way.

    Attributes:
        opened: Joint positions with the jaws as far apart as their ranges allow [rad, m].
        shut: Those at the ranges' other ends, of the same shape ``(n,)``.
        carry_sites: Whether each of the two sites lies on a jaw, so that they move apart as it does.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        joints: Sequence[str],
        gripper: Sequence[str],
        jaws: Sequence[str],
        sites: Sequence[str],
    ) -> None:
        """Probe a model.

        Args:
            model: A compiled model with the robot, alone or in a scene.
            joints: All commanded joints.
            gripper: Those of the gripper.
            jaws: The bodies that touch a grasped object, each with what hangs below it.
            sites: The two sites whose midpoint is the grasp point.
        """
        self._model = model
        self._data = mujoco.MjData(model)
        self._posture = posture(model, joints)
        self._columns = [list(joints).index(name) for name in gripper]
        self._geoms = jaw_geoms(model, jaws)
        self._sites = [model.site(name).id for name in sites]
        owners = [
            {n for n, bodies in enumerate(jaw_members(model, jaws)) if model.site_bodyid[k] in bodies}
            for k in self._sites
        ]
        self.carry_sites = all(owners) and owners[0] != owners[1]
        ranges = np.array([model.joint(name).range for name in gripper]).reshape(-1, 2)
        middle = ranges.mean(axis=1)
        self.opened, self.shut = ranges[:, 1].copy(), ranges[:, 0].copy()
        for k, ends in enumerate(ranges):
            tries = np.tile(middle, (2, 1))
            tries[:, k] = ends
            low, high = self._each(tries, self._breadth)
            if low > high:
                self.opened[k], self.shut[k] = ends
        ends = (self._posture.agree(self._whole(end)) for end in (self.opened, self.shut))
        self.opened, self.shut = (end[self._columns] for end in ends)
        self._posed(self.opened)
        self._pads = self._find_pads()

    def gap(self, commands: ndarray) -> ndarray:
        """Distance of the pads, less than 0 where they overlap [m], shape ``(k,)``, at commands of
        the gripper's joints of shape ``(k, n)``.
        """
        return self._each(commands, self._gap)

    def spread(self, commands: ndarray) -> ndarray:
        """Distance of the two sites [m], shape ``(k,)``, at commands as of `gap`."""
        return self._each(commands, lambda: float(np.linalg.norm(np.subtract(*self._ends()))))

    def _each(self, commands: ndarray, measure: Callable[[], float]) -> ndarray:
        return np.array([(self._posed(command), measure())[1] for command in commands])

    def _whole(self, command: ndarray) -> ndarray:
        whole = self._posture.rest[self._posture.commanded]
        whole[self._columns] = command
        return whole

    def _posed(self, command: ndarray) -> None:
        self._data.qpos[:] = self._posture.qpos(self._whole(command))
        mujoco.mj_kinematics(self._model, self._data)

    def _ends(self) -> ndarray:
        return self._data.site_xpos[self._sites]

    def _middles(self) -> list[ndarray]:
        return [self._data.geom_xpos[geoms].mean(axis=0) for geoms in self._geoms if len(geoms)]

    def _breadth(self) -> float:
        """A distance that grows as the jaws open."""
        if self.carry_sites:
            return float(np.linalg.norm(np.subtract(*self._ends())))
        pairs = combinations(self._middles(), 2)
        return float(sum(np.linalg.norm(a - b) for a, b in pairs))

    def _gap(self) -> float:
        pairs = [pair for a, b in combinations(self._pads, 2) for pair in product(a, b)]
        measured = (mujoco.mj_geomDistance(self._model, self._data, *p, _FAR, None) for p in pairs)
        return min(measured, default=_FAR)

    def _find_pads(self) -> list[list[int]]:
        """The geoms of each jaw that are beside the grasp point, on the closing axis; all where
        none is there.
        """
        ends = self._ends()
        point = ends.mean(axis=0)
        axis = ends[1] - ends[0]
        middles = self._middles()
        if np.linalg.norm(axis) < 1e-6 and len(middles) > 1:
            axis = middles[1] - middles[0]
        axis /= max(np.linalg.norm(axis), 1e-9)
        across = np.linalg.svd(axis[None])[2][1:]
        for offset in product(_RAYS, repeat=2):
            start = point + np.array(offset) @ across
            pads = [self._hit(geoms, start, axis) for geoms in self._geoms]
            if all(pads):
                return pads
        return [geoms.tolist() for geoms in self._geoms]

    def _hit(self, geoms: ndarray, start: ndarray, axis: ndarray) -> list[int]:
        """The nearest of some geoms on a line through a point."""
        model, data = self._model, self._data
        far = {}
        for geom, way in product(geoms.tolist(), (axis, -axis)):
            shape = int(model.geom_type[geom])
            pose = (data.geom_xpos[geom], data.geom_xmat[geom], model.geom_size[geom])
            distance = (
                mujoco.mj_rayMesh(model, data, geom, start, way)
                if shape == _MESH
                else mujoco.mju_rayGeom(*pose, start, way, shape)
            )
            if distance >= 0.0:
                far[geom] = min(distance, far.get(geom, np.inf))
        return [min(far, key=far.__getitem__)] if far else []


@lru_cache(maxsize=8)
def robot_jaws(model: mujoco.MjModel, *names: tuple[str, ...]) -> Jaws:
    """`Jaws` of a model, probed once; its other arguments as tuples."""
    return Jaws(model, *names)
