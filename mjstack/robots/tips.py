"""The fingers of a hand: how they close, which surfaces face each other, and where it grasps."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy import ndarray

from mjstack.robots.bodies import geom_corners, solid_geoms
from mjstack.robots.hand import Hand
from mjstack.robots.posture import Posture

# m that the tips reach beyond the grasp point, clear of a table under a small cube, and half of the
# height of what they grasp: less where the fingers are thick
_DEPTHS = ((0.016, 0.013), (0.010, 0.013), (0.005, 0.013), (0.005, 0.004))
_REACH = 0.018  # m that they may at most, which a jaw on a hinge changes as it opens
_ROOM = 0.016  # m beside an object that is enough
_EDGE = 0.002  # m from a tip's end at least
_GRASPED = 0.012  # m of an object's side that the shorter tip touches
_SPREAD = 0.015  # m that the jaws may be wider at the point than at an object's upper edge
_SHALLOW = -0.010  # m for a depth then: jaws press it out, the less the higher they grasp it
_PLATE = [0.004, 0.013, 0.0005]  # m: half sizes of the patch of a surface that counts
_TIP = 0.004  # m of it that is beyond the grasp point; the rest is as high as an object there
_FAR = 0.3  # m
_ADVANCES = 8
_WIDE = 0.085  # m: as far as jaws open, with room beside a cube
_SHARES = np.linspace(0.0, 1.0, 33)  # of the way from open to shut


@dataclass(frozen=True)
class Grip:
    """A hand around an object. Vectors are in the palm's frame.

    Attributes:
        opened: Positions of the gripper's joints where it is open [rad, m].
        touching: The same, where it touches the object.
        shut: The same, at the other end of their ranges.
        gap: Distance of the surfaces at both ends [m].
        beyond: How far a tip reaches beyond the middle of the sites, open or around it [m].
        spread: Distance of the surfaces at that middle, less that half a width above it [m].
        point: Middle between the surfaces [m].
        closing: Unit vector from the first jaw to the second.
        approach: Unit vector from the wrist towards the tips.
        jaws: Bodies with these surfaces.
        sites: Where they touch [m], in the frames of these bodies.
    """

    opened: ndarray
    touching: ndarray
    shut: ndarray
    gap: tuple[float, float]
    beyond: float
    spread: float
    point: ndarray
    closing: ndarray
    approach: ndarray
    jaws: list[int]
    sites: list[ndarray]


class Fingers:
    """Moves a hand's fingers while the arm rests, and measures between them."""

    def __init__(self, spec: mujoco.MjSpec, hand: Hand, ranges: ndarray) -> None:
        """Compile a description, in which joints have the same numbers, with a plate to measure by;
        ``ranges`` are those of the gripper's joints [rad, m], shape ``(n, 2)``.
        """
        spec = spec.copy()
        spec.compiler.discardvisual = False  # which a URDF sets; the plate does not collide
        plate = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=_PLATE)
        plate.contype = plate.conaffinity = 0
        plate.name = "plate/of/mjstack"
        self.model = model = spec.compile()
        self._data = mujoco.MjData(model)
        self._plate = model.geom(plate.name).id
        self._hand = hand
        self._ranges = ranges
        self._posture = Posture(model, [model.joint(j).name for j in (*hand.arm, *hand.gripper)])
        self._arm = self._posture.rest[self._posture.commanded[: len(hand.arm)]]
        self._solid = solid_geoms(model)
        palm = model.body_weldid[hand.palm]
        self._fixed = np.flatnonzero(model.body_weldid == palm) if palm else np.array([hand.palm])

    def settle(self, gripper: ndarray) -> None:
        """Bring the gripper's joints to positions, and what follows them along."""
        self._data.qpos[:] = self._posture.qpos(np.concatenate((self._arm, gripper)))
        mujoco.mj_kinematics(self.model, self._data)

    def _agree(self, gripper: ndarray) -> ndarray:
        """The positions that coupled joints can have at once [rad, m]."""
        whole = self._posture.agree(np.concatenate((self._arm, gripper)))
        return whole[len(self._arm) :]

    def points(self, bodies: Sequence[int]) -> ndarray:
        """Vertices of the solid meshes of bodies, corners of the boxes around other solid geoms,
        in the palm's frame [m], shape ``(n, 3)``.
        """
        model, data = self.model, self._data
        clouds = [np.zeros((0, 3))]
        for geom in solid_geoms(model, bodies):
            cloud = geom_corners(data, [geom])[0]
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
                mesh = model.geom_dataid[geom]
                first = model.mesh_vertadr[mesh]
                cloud = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
                cloud = cloud @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            clouds.append(self._to_palm(cloud))
        return np.concatenate(clouds)

    def measure(self, width: float, deepest: float = math.inf) -> Grip:
        """Find the grasp around an object of some width [m], where the tips reach beyond it by
        ``deepest`` [m] at most; a ValueError if the fingers do not close around one.
        """
        hand = self._hand
        middle = self._ranges.mean(axis=1)
        self.settle(middle)
        bodies = [body for body in hand.bodies if len(self.points([body]))]
        if not bodies:
            raise ValueError("the fingers have no geoms that collide")

        def centres(gripper: ndarray) -> ndarray:
            self.settle(gripper)
            return np.array([self.points([body]).mean(axis=0) for body in bodies])

        ways = np.empty((len(middle), len(bodies), 3))  # from a joint's lower end to its upper
        for number in range(len(middle)):
            still = np.arange(len(middle)) != number
            low, high = (centres(np.where(still, middle, ends)) for ends in self._ranges.T)
            ways[number] = high - low
        closing = np.linalg.svd(ways.reshape(-1, 3))[2][0]
        along = centres(middle) @ closing
        right = along > 0.5 * (along.min() + along.max())
        if right[0]:  # the first jaw is the one that the file has first
            closing, right = -closing, ~right
        first = [body for body, far in zip(bodies, right, strict=True) if not far]
        second = [body for body, far in zip(bodies, right, strict=True) if far]
        if hand.one_finger:
            first, second, right = [*self._fixed], bodies, np.ones(len(bodies), dtype=bool)
            if not len(cloud := self.points(first)):
                raise ValueError("the body that carries the jaw has no geoms that collide")
            if along.mean() < (cloud @ closing).mean():
                closing = -closing
        elif not second:  # all move in step
            raise ValueError("its fingers do not close on each other")

        def relative(moves: ndarray) -> ndarray:
            """How the second side moves, seen from the first, from the bodies' ways."""
            first_way = 0.0 if right.all() else moves[~right].mean(axis=0)
            return moves[right].mean(axis=0) - first_way

        opens = relative((ways @ closing).T)
        low, high = self._ranges.T
        opened = self._agree(np.where(opens > 0.0, high, low))
        shut = self._agree(np.where(opens > 0.0, low, high))
        # Nearly shut a jaw on a hinge lies along the approach axis
        nearly, closed = (centres(shut + share * (opened - shut)) for share in (0.15, 0.0))
        away = relative(nearly - closed)
        approach = self._approach(closed.mean(axis=0), _unit(away))
        jaw = hand.gripper[0]
        axis = self._data.xmat[hand.palm].reshape(3, 3).T @ self._data.xaxis[jaw]
        hinge = self.model.jnt_type[jaw] == mujoco.mjtJoint.mjJNT_HINGE
        if hand.one_finger and hinge and abs(axis @ approach) > 0.8:  # a wrist that rolls
            raise ValueError("its fingers do not close on each other")
        closing = _unit(away - (away @ approach) * approach)
        self._frame = np.stack((np.cross(approach, closing), approach, closing), axis=1)
        self._sides = first, second
        grips = []
        depths = [pair for pair in _DEPTHS if pair[0] <= deepest]
        for depth, self.model.geom_size[self._plate, 1] in depths:
            grip = self._grasp(width, (opened, shut), depth)
            if grip.spread > _SPREAD:
                grip = self._grasp(width, (opened, shut), _SHALLOW)
                break
            grips.append(grip)
            if grip.gap[0] >= width + _ROOM and grip.beyond <= _REACH:
                break
        else:
            grip = max(grips, key=lambda grip: min(grip.gap[0], width + _ROOM) - grip.beyond)
        if grip.gap[0] < width + 0.1 * _ROOM:
            raise ValueError(f"its fingers open by {1e3 * max(grip.gap[0], 0.0):.0f} mm only")
        return grip

    def _approach(self, middle: ndarray, closing: ndarray) -> ndarray:
        """Unit vector from the wrist to the fingers' middle, across the closing axis: along the
        last joint's axis, or one of the palm's, where that is near.
        """
        model, data, palm = self.model, self._data, self._hand.palm
        last = self._hand.arm[-1]
        turn = data.xmat[palm].reshape(3, 3)
        hinge = model.jnt_type[last] == mujoco.mjtJoint.mjJNT_HINGE
        body = self.points([*self._fixed])
        origin = body.mean(axis=0) if len(body) and not hinge else self._to_palm(data.xanchor[last])
        away = middle - origin
        away = _unit(away - (away @ closing) * closing)
        axes = [*([turn.T @ data.xaxis[last]] if hinge else []), *np.eye(3)]
        for axis, near in zip(axes, [0.8] * hinge + [0.95] * 3, strict=True):
            if abs(axis @ away) > near and abs(axis @ closing) < 0.6:
                return np.copysign(1.0, axis @ away) * axis
        return away

    def _grasp(self, width: float, ends: tuple[ndarray, ndarray], depth: float) -> Grip:
        """Close the jaws around an object: where they touch it, near their tips."""
        opened, shut = ends
        frame = self._frame
        share = 1.0
        for _ in range(3):  # tips may move along the approach axis as they close
            self.settle(opened + share * (shut - opened))
            clouds = [self.points(side) @ frame for side in self._sides]
            tops = [cloud[:, 1].max() for cloud in clouds]
            high = 2.0 * self.model.geom_size[self._plate, 1] - _TIP  # of an object, over the point
            level = min(min(tops) + max(high - _GRASPED, -_EDGE), max(tops) - depth)
            tips = [
                c[c[:, 1] > min(level, top) - _EDGE] for c, top in zip(clouds, tops, strict=True)
            ]
            start = np.array([tips[1][:, 0].mean(), level, np.mean([t[:, 2].mean() for t in tips])])
            gaps = np.array([self._gap(opened + s * (shut - opened), start)[0] for s in _SHARES])
            if gaps.min() > width - 0.01:
                raise ValueError("its fingers do not close on each other")
            share = _last(gaps, width)
        most = _WIDE - 0.015 * self._hand.one_finger  # it swings up as it opens
        wide = opened + _last(gaps, min(most, float(gaps.max()))) * (shut - opened)
        touching = opened + share * (shut - opened)
        _, point, geoms = self._gap(touching, start)
        tall = self.model.geom_size[self._plate, 1]
        self.model.geom_size[self._plate, 1] = _TIP
        here, above = (self._gap(touching, point - [0.0, up, 0.0])[0] for up in (0.0, 0.5 * width))
        self.model.geom_size[self._plate, 1] = tall
        jaws = [int(self.model.geom_bodyid[geom]) for geom in geoms]
        sites = []
        for jaw, sign in zip(jaws, (-0.5, 0.5), strict=True):
            world = self._from_palm(frame @ (point + np.array([0.0, 0.0, sign * width])))
            turn = self._data.xmat[jaw].reshape(3, 3)
            sites.append(turn.T @ (world - self._data.xpos[jaw]))
        reaches = []
        for state in (touching, wide):
            self.settle(state)
            touches = [
                self._to_palm(self._data.xpos[jaw] + self._data.xmat[jaw].reshape(3, 3) @ site)
                for jaw, site in zip(jaws, sites, strict=True)
            ]
            top = max((self.points(side) @ frame)[:, 1].max() for side in self._sides)
            reaches.append(float(top - np.mean(touches, axis=0) @ frame[:, 1]))
        gap = (float(gaps.max()), float(gaps.min()))
        point, (_, approach, closing) = frame @ point, frame.T
        measures = (gap, max(reaches), here - above)
        return Grip(wide, touching, shut, *measures, point, closing, approach, jaws, sites)

    def _gap(self, gripper: ndarray, start: ndarray) -> tuple[float, ndarray, list[int]]:
        """Distance of the sides [m] along the closing axis, the point between them, in the grasp's
        frame, and the geoms there.
        """
        self.settle(gripper)
        point = start.copy()
        for _ in range(4):
            (left, first), (right, second) = (
                self._touch(point, side, sign)
                for side, sign in zip(self._sides, (-1.0, 1.0), strict=True)
            )
            point[2] += 0.5 * (right - left)
        return left + right + 2.0 * _PLATE[2], point, [first, second]

    def _touch(self, point: ndarray, bodies: Sequence[int], sign: float) -> tuple[float, int]:
        """How far the plate goes along the closing axis until it touches a solid geom of some
        bodies, and which one.
        """
        model, data = self.model, self._data
        back = model.geom_size[self._plate, 1] - _TIP
        turn = data.xmat[self._hand.palm].reshape(3, 3)
        data.geom_xmat[self._plate] = (turn @ self._frame).ravel()
        way, geom = 0.0, -1
        for _ in range(_ADVANCES):  # by the distance, which is less where the surface is slanted
            at = point + np.array([0.0, -back, sign * way])
            data.geom_xpos[self._plate] = self._from_palm(self._frame @ at)
            left = _FAR
            for solid in self._solid[np.isin(model.geom_bodyid[self._solid], bodies)]:
                near = mujoco.mj_geomDistance(model, data, self._plate, solid, _FAR, None)
                left, geom = min((left, geom), (near, int(solid)))
            way += left
            if way >= _WIDE or abs(left) < 1e-5:
                break
        return min(way, _WIDE), geom

    def _to_palm(self, points: ndarray) -> ndarray:
        palm = self._hand.palm
        return (points - self._data.xpos[palm]) @ self._data.xmat[palm].reshape(3, 3)

    def _from_palm(self, point: ndarray) -> ndarray:
        palm = self._hand.palm
        return self._data.xpos[palm] + self._data.xmat[palm].reshape(3, 3) @ point


def _last(gaps: ndarray, gap: float) -> float:
    """The largest share of the way to shut at which the jaws are still so far apart."""
    number = int(np.flatnonzero(gaps >= min(gap, gaps.max()))[-1])
    if number == len(gaps) - 1 or gaps[number] < gap:
        return float(_SHARES[number])
    rise = (gaps[number] - gap) / (gaps[number] - gaps[number + 1])
    return float(_SHARES[number] + rise * (_SHARES[1] - _SHARES[0]))


def _unit(vector: ndarray) -> ndarray:
    return vector / np.linalg.norm(vector)
