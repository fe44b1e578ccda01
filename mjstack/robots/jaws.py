"""A robot's jaws: which bodies they are, and how far they are apart at the gripper's commands.

`Jaws` takes a compiled model and tuples of names of joints, bodies and sites:

    >>> jaws = Jaws(model, joints, gripper_joints, jaw_bodies, grasp_sites)
    >>> jaws.opened, jaws.shut  # commands [rad, m] at the ends of the range
    >>> jaws.gap([jaws.opened])  # [m] between the pads, at the grasp point
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import combinations, product

import mujoco
import numpy as np
from numpy import ndarray

from mjstack.robots.posture import posture

_BESIDE = 0.005  # [m] that a pad may be farther from the grasp point than another one


def jaw_members(parents: Mapping[str, str], jaws: Sequence[str]) -> dict[str, list[str]]:
    """Bodies of each jaw: the named one and all below it; of one that carries another jaw, such as
    a wrist with a fixed jaw, that alone. ``parents`` has each body's parent, in the tree's order.
    """
    roots = {name: name for name in jaws}
    for name, parent in parents.items():
        if name not in roots and parent in roots:
            roots[name] = roots[parent]
    carriers = set()
    for jaw in jaws:
        while jaw in parents:
            jaw = parents[jaw]
            carriers.add(jaw)
    members = {jaw: [name for name, root in roots.items() if root == jaw] for jaw in jaws}
    return {jaw: [jaw] if jaw in carriers else bodies for jaw, bodies in members.items()}


def jaw_bodies(model: mujoco.MjModel, jaws: Sequence[str]) -> list[list[int]]:
    """Numbers of the bodies of each jaw of a compiled model."""
    names = [model.body(body).name for body in range(model.nbody)]
    parents = {name: names[model.body(name).parentid[0]] for name in names[1:]}
    return [list(map(names.index, bodies)) for bodies in jaw_members(parents, jaws).values()]


class Jaws:
    """A gripper's jaws on their way.

    Attributes:
        opened: Joint positions with the jaws as far apart as their ranges allow [rad, m].
        shut: Those at the ranges' other ends, of the same shape ``(n,)``.
        carry_sites: Whether the sites lie on different jaws, so that they move apart with them.
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
        self._model, self._data = model, mujoco.MjData(model)
        self._posture = posture(model, tuple(joints))
        self._columns = [joints.index(name) for name in gripper]
        self._sites = [model.site(name).id for name in sites]
        members = jaw_bodies(model, jaws)
        collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        geoms = [np.flatnonzero(collides & np.isin(model.geom_bodyid, m)) for m in members]
        solid = [(part, bodies) for part, bodies in zip(geoms, members, strict=True) if part.size]
        self._pads = [part for part, _ in solid]
        owners = [[body in m for m in members] for body in model.site_bodyid[self._sites]]
        self.carry_sites = all(map(any, owners)) and owners[0] != owners[1]

        # The ends of the way
        command = self._posture.rest[self._posture.commanded]
        ranges = np.array([model.joint(name).range for name in gripper]).reshape(-1, 2)
        ranges = np.clip(ranges.T, *self._posture.limits[self._columns].T).T
        self.shut, self.opened = ranges.T.copy()
        for k, ends in enumerate(ranges):
            tries = np.tile(ranges.mean(axis=1), (2, 1))
            tries[:, k] = ends
            low, high = self._measure(tries, self._breadth)
            if low > high:
                self.opened[k], self.shut[k] = ends
        for end in (self.opened, self.shut):
            command[self._columns] = end
            end[:] = self._posture.agree(command)[self._columns]

        # Pads are beside the jaw's own site, or else the grasp point between the open jaws
        self._measure([self.opened], self._breadth)
        for k, (part, bodies) in enumerate(solid):
            sites = [site for site in self._sites if model.site_bodyid[site] in bodies]
            sites = sites if self.carry_sites and sites else self._sites
            point = self._data.site_xpos[sites].mean(0)
            turns = self._data.geom_xmat[part].reshape(-1, 3, 3)
            local = np.einsum("nij,ni->nj", turns, point - self._data.geom_xpos[part])
            middle, half = model.geom_aabb[part].reshape(-1, 2, 3).swapaxes(0, 1)
            away = np.linalg.norm(np.maximum(np.abs(local - middle) - half, 0.0), axis=1)
            self._pads[k] = part[away < away.min() + _BESIDE]

    def gap(self, commands: Iterable[ndarray]) -> ndarray:
        """Distance of the pads, less than 0 where they overlap [m], shape ``(k,)``, at commands of
        the gripper's joints of shape ``(k, n)``.
        """
        return self._measure(commands, self._gap)

    def spread(self, commands: Iterable[ndarray]) -> ndarray:
        """Distance of the two sites [m], shape ``(k,)``, at commands as of `gap`."""
        return self._measure(commands, self._spread)

    def _measure(self, commands: Iterable[ndarray], distance: Callable[[], float]) -> ndarray:
        values = []
        for target in commands:
            command = self._posture.rest[self._posture.commanded]
            command[self._columns] = target
            self._data.qpos[:] = self._posture.qpos(command)
            mujoco.mj_kinematics(self._model, self._data)
            values.append(distance())
        return np.array(values)

    def _spread(self) -> float:
        return float(np.linalg.norm(np.subtract(*self._data.site_xpos[self._sites])))

    def _breadth(self) -> float:
        """A distance that grows as the jaws open."""
        middles = [self._data.geom_xpos[part].mean(axis=0) for part in self._pads]
        apart = [float(np.linalg.norm(a - b)) for a, b in combinations(middles, 2)]
        return self._spread() if self.carry_sites else sum(apart)

    def _gap(self) -> float:
        pairs = [p for a, b in combinations(self._pads, 2) for p in product(a.tolist(), b.tolist())]
        gaps = (mujoco.mj_geomDistance(self._model, self._data, *p, 1.0, None) for p in pairs)
        return min(gaps, default=1.0)
